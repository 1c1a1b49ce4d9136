"""A run of the tests: its temporary folder, its lines about missing tools, its order."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from harness import python

HERE = Path(__file__).parent
CONFTEST = """
from scratch import Scratch
from tools import pytest_terminal_summary

def pytest_configure(config):
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Scratch(config))
"""
TOOL = """
import pytest, tools
tools.TOOLS["nowhere"] = tools.Tool("the moon", "rocket")
@pytest.mark.parametrize("i", range(3))
def test_it(i):
    tools.needs("nowhere")
"""
KEPT = "import tempfile\ndef test_it(tmp_path):\n    tempfile.mkdtemp(prefix='kept-')\n"
KILLED = """
import os, subprocess, sys
TEXT = "import os, twodof.files as f\\nwith f.temporary_folder(): os.kill(os.getpid(), 9)"
def test_it(tmp_path):
    assert subprocess.call([sys.executable, "-c", TEXT]) == -9
    assert any(name.startswith(".twodof.tmp") for name in os.listdir(os.environ["TMPDIR"]))
"""
CLEAN = "import tempfile\ndef test_it(tmp_path):\n    tempfile.TemporaryDirectory().cleanup()\n"


def ran(folder: Path, text: str, *options: str, ci: str = "") -> subprocess.CompletedProcess[str]:
    """Run a file of tests with the hooks of this folder; ``folder/tmp`` is the system's."""
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_it.py").write_text(text)
    (folder / "pytest.ini").write_text("[pytest]\n")
    (folder / "tmp").mkdir(exist_ok=True)
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("PYTEST")},
        "TMPDIR": str(folder / "tmp"),
        "PYTHONPATH": str(HERE),
        "CI": ci,
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
    }
    return python("-m", "pytest", "-p", "xdist", "-p", "randomly", *options, folder, cwd=folder, env=environment)


def test_a_file_left_in_the_temporary_folder_fails_the_run(tmp_path):
    for options in (["-n", "0"], ["-n", "2"]):
        done = ran(tmp_path, KEPT, *options)
        assert done.returncode == 1 and "1 passed" in done.stdout
        assert "left in the temporary folder" in done.stdout and "\nkept-" in done.stdout
        (folder,) = (tmp_path / "tmp").iterdir()
        assert f"Temporary files of this run: {folder}\n" in done.stdout
        shutil.rmtree(folder)


@pytest.mark.parametrize("text", [CLEAN, KILLED], ids=["clean", "killed"])
def test_a_run_that_leaves_nothing_removes_its_folder(text, tmp_path):
    """The next process removes what a killed one leaves."""
    for options in (["-n", "0"], ["-n", "2"]):
        done = ran(tmp_path, text, *options)
        assert (done.returncode, done.stderr) == (0, "") and "1 passed" in done.stdout
        assert list((tmp_path / "tmp").iterdir()) == []


def test_a_missing_tool_is_one_line_and_a_failure_in_ci(tmp_path):
    line = "tests of the moon were not run: apt install rocket"
    done = ran(tmp_path, TOOL, "-n", "0")
    assert done.returncode == 0 and done.stdout.count(f"\n3 {line}\n") == 1
    done = ran(tmp_path, TOOL, "-n", "0", ci="true")
    assert done.returncode == 1 and "3 failed" in done.stdout and line in done.stdout


def test_the_seed_of_the_order_is_printed(tmp_path):
    """The same seed gives the same order."""
    text = "import pytest\n@pytest.mark.parametrize('i', range(20))\ndef test_it(i): pass\n"
    orders = []
    for seed in (1, 1, 2):
        done = ran(tmp_path, text, "-n", "0", "-v", f"--randomly-seed={seed}")
        assert f"--randomly-seed={seed}\n" in done.stdout
        orders.append([line.split()[0] for line in done.stdout.splitlines() if "PASSED" in line])
    assert orders[0] == orders[1] != orders[2] and len(orders[0]) == 20
