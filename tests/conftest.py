"""Fixtures that several test files share."""

import importlib.metadata
import os
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bags import run as run
from nodes import listen as listen
from nodes import number as number
from nodes import program as program
from recordings import changing as changing
from recordings import default as default
from recordings import foreign as foreign
from recordings import gains as gains
from scratch import Scratch
from tools import missing, needs
from tools import pytest_runtest_setup as pytest_runtest_setup
from tools import pytest_terminal_summary as pytest_terminal_summary

import twodof
from twodof.cli import printing


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Start as from a shell in the foreground, with the environment activated.

    A shell's background job ignores Ctrl-C, and so would all processes that tests start.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    printing.MOMENT = 600.0  # s: no command tells a test how slow a busy machine is
    here = str(Path(sys.executable).parent)
    if here not in os.environ["PATH"].split(os.pathsep):
        os.environ["PATH"] = os.pathsep.join([here, os.environ["PATH"]])
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Scratch(config))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--full", action="store_true", help="run the long tests in full length")


@pytest.fixture(scope="session")
def length(request: pytest.FixtureRequest) -> Callable[[int, int], int]:
    """Return the length of a long test: the first number with --full, else the second."""
    return lambda full, short: full if request.config.getoption("full") else short


LONGEST = (
    "native_platforms",
    "publish",
    "docs",
    "native_engine",
    "states",
    "live",
    "fmi3",
    "sweep_workers",
    "listener",
    "view",
    "stiffness",
    "directional",
    "page",
    "control",
    "bare_plant",
    "plot_files",
    "mutations",
    "ends",
    "slave",
    "pose",
    "sweep_table",
    "sweep",
    "hostile",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the files that take longest, so that the processes end at about the same time.

    Groups of eight files are in the shuffled order. Tests that need a file's page come last, because an open page draws
    while other tests run.
    """
    place = {f"test_{name}.py": i // 8 for i, name in enumerate(LONGEST)}

    def order(item: pytest.Item) -> tuple[int, bool]:
        fixtures = item.fixturenames if isinstance(item, pytest.Function) else ()
        return place.get(item.path.name, len(place)), "page" in fixtures

    items.sort(key=order)


@pytest.fixture(scope="session")
def fmu_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default arm's FMU, built once."""
    return twodof.build_fmu(tmp_path_factory.mktemp("fmu") / "TwoDof.fmu")


@pytest.fixture(scope="session")
def native_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default arm's native FMU, built once."""
    folder = tmp_path_factory.mktemp("native")
    return twodof.build_fmu(folder / "TwoDof-native.fmu", twodof.FmuOptions(native=True))


@pytest.fixture
def folder(tmp_path: Path, fmu_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with the default arm's FMU."""
    place = tmp_path / "work"
    place.mkdir()
    (place / "arm.fmu").symlink_to(fmu_path)
    monkeypatch.chdir(place)
    return place


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Mount a small disk of some KiB, as often as requested."""
    mounted: list[Path] = []

    def mount(size: int, options: str = "rw") -> Path:
        folder = tmp_path / f"disk{len(mounted)}"
        folder.mkdir()
        needs("disks")
        command = ["mount", "-t", "tmpfs", "-o", f"{options},size={size}k", "tmpfs", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            missing("disks")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture(scope="session")
def robots() -> Path:
    """Folder of the URDFs of example-robot-data, one folder per robot."""
    files = importlib.metadata.files("example-robot-data") or []
    urdf = next(file for file in files if file.parts[-4:-2] == ("robots", "panda_description"))
    return Path(str(urdf.locate())).parents[2]


@pytest.fixture(scope="session")
def ur5(robots: Path) -> str:
    """URDF text of the UR5, six joints."""
    return (robots / "ur_description/urdf/ur5_robot.urdf").read_text()


@pytest.fixture(scope="session")
def panda(robots: Path) -> str:
    """URDF text of the Panda arm with seven joints: fixed fingers, no joint damping.

    The second finger mimics the first. Damping, which the controller does not compensate, has no closed form.
    """
    tree = ET.fromstring((robots / "panda_description/urdf/panda.urdf").read_text())
    for joint in tree.findall("joint"):
        if "finger_joint" in str(joint.get("name")):
            joint.set("type", "fixed")
        for element in [*joint.findall("mimic"), *joint.findall("dynamics")]:
            joint.remove(element)
    return ET.tostring(tree, encoding="unicode")
