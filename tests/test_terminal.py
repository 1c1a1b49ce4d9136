"""Unusual command lines and streams get one line each; names contain no terminal commands."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from bags import joint_message, write_third_party
from harness import forged

import twodof
from twodof.cli.main import MOST_MESSAGES
from twodof.files import data_file

TWODOF = [sys.executable, "-m", "twodof"]
ESCAPES = "\x1b[31mred\x1b[0m‮reversed⁦"


def run(*arguments: str | bytes, cwd: Path, shell: str = '"$@"', **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a command by a shell, which may close its streams."""
    return subprocess.run(
        ["sh", "-c", shell, "sh", *TWODOF, *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        errors="surrogateescape",
        env={**os.environ, **variables},
        check=False,
    )


@pytest.mark.parametrize("arguments", [["build", "-o--"], ["plot", "bag", "-o--"], ["run", "--set=--"]])
def test_a_value_that_argparse_loses_is_refused(arguments, tmp_path):
    done = run(*arguments, cwd=tmp_path)
    (line,) = done.stderr.splitlines()
    option = arguments[-1][:-2].rstrip("=")
    assert done.returncode == 2
    assert line == f"twodof: error: argument {option}: '--' is not a value"


@pytest.mark.parametrize("verb", ["sweep", "info", "plot"])
def test_a_sweep_whose_name_is_no_text_is_refused(verb, native_path, tmp_path):
    name = b"\xff\xfe"
    if verb == "sweep":
        arguments: list[str | bytes] = [verb, str(native_path), "--grid", "Kp=10:20:2", "-o", name]
    else:
        twodof.sweep(native_path, grid={"Kp": [50.0]}, stop_time=0.1, output=tmp_path / "sweep")
        os.rename(tmp_path / "sweep", os.fsencode(tmp_path) + b"/" + name)
        arguments = [verb, name]
    done = run(*arguments, cwd=tmp_path)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1 and "is not UTF-8 text" in line
    assert "Traceback" not in done.stdout


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_streams_that_are_closed_end_no_run(closed, native_path, tmp_path):
    """No file of the run becomes one of them."""
    command = ["run", str(native_path), "--stop-time", "0.1", "-o", "bag"]
    assert run(*command, cwd=tmp_path, shell=f'"$@" {closed}').returncode == 0
    assert len(twodof.read_bag(tmp_path / "bag").t) == 11


def test_a_page_is_not_written_to_a_closed_standard_output(native_path, tmp_path):
    done = run("page", str(native_path), "-o", "-", cwd=tmp_path, shell='"$@" >&-')
    assert (done.returncode, "argument -o: the standard output is closed" in done.stderr) == (2, True)


def test_an_invalid_date_for_reproducible_builds_ends_no_plot(native_path, tmp_path):
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.1)
    done = run("plot", "bag", "-o", "plot.png", cwd=tmp_path, SOURCE_DATE_EPOCH="x")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("backend", ["module://a_package.that_is_not_here", "a name that matplotlib does not know"])
def test_a_backend_of_matplotlib_that_is_not_here_ends_no_plot(backend, native_path, tmp_path):
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.1)
    done = run("plot", "bag", "-o", "plot.png", cwd=tmp_path, MPLBACKEND=backend)
    assert (done.returncode, done.stderr) == (0, "")


def test_names_do_not_control_the_terminal(native_path, tmp_path):
    """This includes suggested commands, warnings of matplotlib, and errors of the command line."""
    name = f"bag {ESCAPES}"
    command = ["run", str(native_path), "--stop-time", "0.1", "-o", name]
    ran = run(*command, cwd=tmp_path)
    drawn = run("plot", name, "-o", f"{ESCAPES}.png", cwd=tmp_path)
    wrong = run("run", f"--{ESCAPES}", cwd=tmp_path)
    assert (ran.returncode, drawn.returncode, wrong.returncode) == (0, 0, 2)
    assert "Glyph" in drawn.stderr and "next" in ran.stdout
    for done in (ran, drawn, wrong):
        text = done.stdout + done.stderr
        assert "\\x1b[31mred" in text and "\\u202e" in text
        assert all(c.isprintable() or c == "\n" for c in text)


def test_a_long_name_makes_no_long_warning(tmp_path):
    name = "/".join(["a" * 200] * 20)
    text = data_file("urdf", "2dof.urdf").read_text("utf-8")
    (tmp_path / "a.urdf").write_text(text.replace("</robot>", f'<mesh filename="{name}"/></robot>'))
    *_, line = run("build", "a.urdf", cwd=tmp_path).stderr.splitlines()
    assert name[:100] in line and len(line) < 2200


def test_a_line_break_in_a_name_makes_no_line(native_path, tmp_path):
    """It could look like a fact that the program prints."""
    path = forged(native_path, tmp_path, 'modelName="TwoDof"', 'modelName="TwoDof&#10;verdict  reached"')
    done = run("info", str(path), cwd=tmp_path)
    assert done.returncode == 0 and "TwoDof\\nverdict  reached" in done.stdout
    assert not any(line.startswith("verdict") for line in done.stdout.splitlines())


def test_a_line_break_in_a_name_begins_no_line(tmp_path):
    """The name would look like a message of this program."""
    text = data_file("urdf", "2dof.urdf").read_text("utf-8")
    text = re.sub('lower="[^"]*" upper="[^"]*"', 'lower="0" upper="0"', text)
    text = text.replace("joint1", "a&#10;twodof: error: b")
    (tmp_path / "robot.urdf").write_text(text, "utf-8")
    done = run("build", "robot.urdf", cwd=tmp_path)
    assert r"joints 'a\ntwodof: error: b'" in done.stderr
    assert {line.partition(" ")[0] for line in done.stderr.splitlines()} == {"WARNING:"}
    printed = run("info", "robot.fmu", "--json", cwd=tmp_path).stdout
    assert json.loads(printed)["joints"][0] == "a\ntwodof: error: b"


def test_a_file_causes_a_limited_number_of_messages(tmp_path):
    """The font has none of the characters of these names."""
    names = ["".join(chr(0x4E00 + 10 * i + k) for k in range(10)) for i in range(10)]
    state = joint_message(1, names, [0.0] * 10)
    write_third_party(tmp_path / "bag", [("/joint_states", stamp, state) for stamp in (1, 2)])
    done = run("plot", "bag", "-o", "plot.png", cwd=tmp_path)
    lines = done.stderr.splitlines()
    assert (done.returncode, len(lines)) == (0, MOST_MESSAGES)
    assert lines[-1] == "WARNING: further messages of this minute are not shown"


@pytest.mark.parametrize(("name", "value"), [("PYTHONOPTIMIZE", "2"), ("TMPDIR", ".")])
def test_variables_of_python_end_no_run(name, value, native_path, tmp_path):
    done = run("run", str(native_path), "--stop-time", "0.1", "-o", "bag", cwd=tmp_path, **{name: value})
    assert (done.returncode, done.stderr) == (0, "")
    for file, variables in (("a.fmu", {}), ("b.fmu", {name: value})):
        assert run("build", "-o", file, cwd=tmp_path, **variables).returncode == 0
    assert (tmp_path / "a.fmu").read_bytes() == (tmp_path / "b.fmu").read_bytes()  # with the same documentation
