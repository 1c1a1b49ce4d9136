"""Files from elsewhere, damaged: whatever is in them, a command ends well or with one clear line.

Each command is a process of its own, with limits of time and memory. Case i of a kind is made by
``random.Random(i)``, so that one that fails runs again on its own: its seed is in its name.
"""

from __future__ import annotations

import faulthandler
import gc
import importlib
import json
import os
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import traceback
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from random import Random
from typing import Any, NamedTuple, NoReturn

import lz4.frame
import mutations
import numpy as np
import pytest
from bags import assert_consistent
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore
from sinks import resident

import twodof
from twodof.cli.main import main
from twodof.errors import FmuError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

pytestmark = pytest.mark.long

CASES, ALL_CASES = 40, 1000
SECONDS = 10  # of processor time
WAIT = 300  # s by the clock: a guard against hanging
MIB = 1024**2
MEMORY = 1024 * MIB  # bytes beyond what the worker has at its start
ADDRESS_SPACE = 8192 * MIB
SECRET = b"not for the FMU"
ROOT = Path(__file__).parents[1]
STORE = get_typestore(Stores.ROS2_HUMBLE)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """All cases with --full; without, fewer mutations, and no file that takes a second to read."""
    full = metafunc.config.getoption("full")
    if "seed" in metafunc.fixturenames:
        metafunc.parametrize("seed", range(ALL_CASES if full else CASES))
    for name, table in HOSTILE.items():
        if name in metafunc.fixturenames:
            ids = [case for case in table if full or case not in SLOW]
            metafunc.parametrize(name, [table[case] for case in ids], ids=ids)


# --- the worker ---


class Outcome(NamedTuple):
    """How a command ended.

    Attributes:
        status: its exit status, −N where it died of signal N.
        memory: the most that it held beyond what it had at its start, bytes.
        out, err: what it wrote.
    """

    status: int
    memory: int
    out: str
    err: str


class Worker:
    """A process with all modules loaded, which forks for each command."""

    def __init__(self, folder: Path, tmp: Path) -> None:
        environment = {
            **os.environ,
            "TMPDIR": str(tmp),
            "HOME": str(folder),
            "OPENBLAS_NUM_THREADS": "1",  # a process that forks has one thread
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        }
        self._process = subprocess.Popen(
            [sys.executable, __file__], cwd=folder, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    def run(self, *arguments: object) -> Outcome:
        """Run a command; one that takes too long ends with the traceback of where it was."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([str(argument) for argument in arguments]) + "\n")
        self._process.stdin.flush()
        return Outcome(*json.loads(self._process.stdout.readline()))

    def stop(self) -> None:
        self._process.communicate()


MODULES = (
    "twodof.bag.reader",
    "twodof.bag.recovery",
    "twodof.export.package",
    "twodof.simulation.master",
    "twodof.ros.scene",
    "lxml.etree",
    "tqdm",
)


def serve() -> None:
    """The worker: arguments come as lines of JSON, outcomes go."""
    for module in MODULES:
        importlib.import_module(module)
    requests = os.fdopen(os.dup(0), "r")
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.fsync = lambda _: None  # the disk is not what is tested
    gc.freeze()  # or every child copies what it looks through
    for line in requests:
        files = [os.memfd_create("out"), os.memfd_create("err")]
        child = os.fork()
        if child == 0:
            for number, file in enumerate(files, start=1):
                os.dup2(file, number)
            run(json.loads(line))
        before = resident()
        _, status, usage = os.wait4(child, 0)
        texts = [Path(f"/proc/self/fd/{file}").read_text("utf-8", "replace") for file in files]
        for file in files:
            os.close(file)
        memory = usage.ru_maxrss * 1024 - before
        answers.write(json.dumps((os.waitstatus_to_exitcode(status), memory, *texts)) + "\n")
        answers.flush()


def run(arguments: list[str]) -> NoReturn:
    """A command in this process, to its end."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    faulthandler.enable()
    faulthandler.register(signal.SIGXCPU, chain=True)
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, 2 * SECONDS))
    faulthandler.dump_traceback_later(WAIT, exit=True)
    try:
        status = main(arguments)
    except BaseException:
        traceback.print_exc()
        status = 1
    if arguments[0] == "run":
        sys.exit(status)  # libraries that were loaded may crash now
    sys.stdout.flush()
    os._exit(status)


# --- the promise ---


class Jail:
    """A folder tree in which a command may write below ``target`` alone.

    Attributes:
        input: for the files that a command is given.
        target: for what it writes.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.input = folder / "jail/input"
        self.target = folder / "jail/target"
        self._tmp = folder / "jail/tmp"
        self._tmp.mkdir(parents=True)
        self._worker = Worker(folder / "jail", self._tmp)

    def clean(self) -> None:
        for path in (self.input, self.target):
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir()
        for path in (self._folder, self._folder / "jail", self.input):
            (path / "secret").write_bytes(SECRET)

    def close(self) -> None:
        self._worker.stop()

    def run(self, *arguments: object, prints: bool = False) -> Outcome:
        """A command's outcome, after the checks of all that is promised of every command.

        Args:
            arguments: of the command line.
            prints: whether the command runs code that may print what it likes.
        """
        before = self._listing()
        outcome = self._worker.run(*arguments)
        print(arguments, outcome)
        assert outcome.status in (0, 1, 130)
        lines = outcome.err.splitlines()
        if outcome.status:
            assert lines[-1:] == [line for line in lines if line.startswith("twodof: error: ")]
            assert len(lines.pop()) < 5000
            assert outcome.out == ""
        others = [line for line in lines if not line.startswith(("WARNING: ", "ERROR: "))]
        assert prints or others == []
        assert self._listing() == before
        assert outcome.memory < MEMORY
        return outcome

    def _listing(self) -> dict[str, tuple[int, int, int]]:
        """All files but those below the target: mode, size and time of change."""
        found = {}
        for folder, folders, files in os.walk(self._folder):
            for name in [*folders, *files]:
                path = os.path.join(folder, name)
                if not path.startswith(str(self.target)):
                    state = os.lstat(path)
                    changed = 0 if path == str(self._tmp) else state.st_mtime_ns
                    found[path] = (state.st_mode, state.st_size, changed)
        return found


@pytest.fixture(scope="module")
def the_jail(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Jail]:
    jail = Jail(tmp_path_factory.mktemp("mutations"))
    yield jail
    jail.close()


@pytest.fixture
def jail(the_jail: Jail) -> Jail:
    the_jail.clean()
    return the_jail


# --- FMUs ---

TEXTS = {
    "modelDescription.xml": mutations.xml,
    "modelDescription.xm": mutations.xml,
    "resources/.*urdf": mutations.xml,
    "resources/.*stl": mutations.blind,
    "(documentation|sources|model.png)": mutations.text,
}
FMU = mutations.several(mutations.container, mutations.member(TEXTS, kept="binaries/"), most=1)
PYTHON_FMU = mutations.member(
    {"resources/.*[.]py": mutations.text, "resources/.*(txt|json)": mutations.json_tree}
)


def test_mutated_fmu(seed: int, jail: Jail, native_path: Path, fmu_path: Path) -> None:
    rng = Random(seed)
    python = rng.random() < 0.1
    mutation = PYTHON_FMU if python and rng.random() < 0.7 else FMU
    fmu = jail.input / "mutated.fmu"
    fmu.write_bytes(mutation(rng, (fmu_path if python else native_path).read_bytes()))
    bag = jail.target / "bag"
    jail.run("info", fmu)
    assert list(jail.target.iterdir()) == []
    scene = rng.choice(([], ["--scene"]))
    outcome = jail.run("run", fmu, "--stop-time", "0.05", "-o", bag, *scene, prints=python)
    check_bag(jail, bag, outcome)


def check_bag(jail: Jail, bag: Path, outcome: Outcome) -> None:
    """A run that was refused leaves no bag, one that ended later a bag that can be read."""
    if outcome.status == 0 or bag.exists():
        assert jail.run("info", bag).status == 0
    assert set(jail.target.iterdir()) <= {bag}


# --- URDFs ---


def arm_urdf(n: int, mesh: str = "package://meshes/link1.stl") -> str:
    """A tree of n joints, every second one prismatic."""
    body = (
        '<inertial><origin xyz="0.1 0 0"/><mass value="1"/>'
        '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>'
        f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
    )
    text = '<robot name="tree"><link name="link0"/>'
    for i in range(1, n + 1):
        kind = "prismatic" if i % 2 == 0 else "revolute"
        text += (
            f'<link name="link{i}">{body}</link><joint name="joint{i}" type="{kind}">'
            f'<parent link="link{i // 2}"/><child link="link{i}"/><origin xyz="0 0 0.1"/>'
            '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5" velocity="1"/>'
            '<dynamics damping="0.1" friction="0.1"/></joint>'
        )
    return text + "</robot>"


@pytest.fixture(scope="module")
def urdfs(ur5: str, panda: str) -> list[tuple[bytes, list[str]]]:
    """URDFs and what is said of each on the command line."""
    shipped = (ROOT / "urdf/2dof.urdf").read_bytes()
    robots = [(shipped, ["--frame", "EndEffector", "--axes", "xy"])]
    for text, frame in ((ur5, "tool0"), (panda, "panda_link8"), (arm_urdf(5), "link5")):
        tree = ET.fromstring(text)
        for mesh in tree.iter("mesh"):  # small ones: their size is not what is tested
            mesh.set("filename", "package://meshes/link1.stl")
        robots.append((ET.tostring(tree), ["--frame", frame]))
    return robots


def test_mutated_urdf(seed: int, jail: Jail, urdfs: list[tuple[bytes, list[str]]]) -> None:
    rng = Random(seed)
    data, options = rng.choice(urdfs)
    urdf = jail.input / "mutated.urdf"
    urdf.write_bytes(mutations.xml(rng, data))
    meshes = jail.input / "meshes"
    shutil.copytree(ROOT / "meshes", meshes, ignore=shutil.ignore_patterns("*.py"))
    fmu = jail.target / "new.fmu"
    outcome = jail.run("build", "--urdf", urdf, "--mesh-dir", meshes, "-o", fmu, *options)
    assert list(jail.target.iterdir()) == ([] if outcome.status else [fmu])
    if outcome.status == 0:
        with zipfile.ZipFile(fmu) as archive:
            contents = [archive.read(name) for name in archive.namelist()]
        assert not any(SECRET in content or b"root:x:0:0" in content for content in contents)


# --- CSVs ---


def test_mutated_csv(seed: int, jail: Jail, native_path: Path) -> None:
    rng = Random(seed)
    rows = [f"{0.005 * k:g},{0.2 + 0.001 * k:g},{0.05 - 0.002 * k:g},{80 + k}" for k in range(20)]
    csv = jail.input / "mutated.csv"
    csv.write_bytes(mutations.csv(rng, "\n".join(["time,x_des[1],x_des[2],Kp[1]", *rows]).encode()))
    bag = jail.target / "bag"
    outcome = jail.run("run", native_path, "--input", csv, "--stop-time", "0.1", "-o", bag)
    check_bag(jail, bag, outcome)


# --- bags ---

STORAGE_FILES = {".mcap": mutations.mcap, ".db3": mutations.sqlite}
BAG_FILES = {**STORAGE_FILES, ".yaml": mutations.yaml, ".json": mutations.json_tree}
BAGS = ("mcap", "mcap scene", "sqlite3", "sqlite3 scene", "mcap zstd", "sqlite3 foreign")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory, native_path: Path) -> dict[str, Path]:
    """Bags of this package, and of rosbags with other options."""
    folder = tmp_path_factory.mktemp("bags")
    for name in BAGS:
        storage, _, kind = name.partition(" ")
        if kind in ("", "scene"):
            run = twodof.experiment(native_path, stop_time=0.3)
            twodof.simulate(run, twodof.Bag(folder / name, storage=storage, scene=bool(kind)))
        else:
            write_foreign_bag(
                folder / name, StoragePlugin[storage.upper()], compressed=kind == "zstd"
            )
    return {name: folder / name for name in BAGS}


def write_foreign_bag(path: Path, storage: StoragePlugin, *, compressed: bool) -> None:
    writer = Writer(path, version=9, storage_plugin=storage)
    if compressed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    types = STORE.types
    with writer:
        connections = [
            writer.add_connection(topic, "sensor_msgs/msg/JointState", typestore=STORE)
            for topic in ("/arm/joint_states", "/joint_states")
        ]
        for k in range(40):
            stamp = types["builtin_interfaces/msg/Time"](sec=k // 10, nanosec=k % 10 * 10**8)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
            numbers = np.array([k, -k / 7])
            message = types["sensor_msgs/msg/JointState"](
                header, ["a", "b"], numbers, numbers, np.zeros(0)
            )
            data = STORE.serialize_cdr(message, "sensor_msgs/msg/JointState")
            for connection in connections:
                writer.write(connection, k * 10**8, data)


def test_mutated_bag(seed: int, jail: Jail, bags: dict[str, Path]) -> None:
    rng = Random(seed)
    bag = jail.target / "bag"
    shutil.copytree(bags[rng.choice(BAGS)], bag)
    mutate_bag(rng, bag, bags)
    check_reading(jail, bag)


def mutate_bag(rng: Random, bag: Path, bags: dict[str, Path]) -> None:
    """One or two changes of its files' content, and now and then of the files themselves."""
    for _ in range(rng.randint(1, 2)):
        files = sorted(path for path in bag.iterdir() if path.suffix in BAG_FILES)
        storage = [path for path in files if path.suffix in STORAGE_FILES]
        file = rng.choice(rng.choice((storage, storage, storage, files)) or [bag / "x.mcap"])
        kind = rng.randrange(10)
        if kind == 0 and file.exists():
            file.unlink()
        elif kind == 1 and file.exists():
            file.rename(bag / rng.choice(("x_1.mcap", "x_1.db3", "metadata.yaml", "run.json", "x")))
        elif kind == 2:  # a file of another bag
            other = rng.choice(sorted(bags[rng.choice(BAGS)].iterdir()))
            shutil.copyfile(other, bag / rng.choice((file.name, other.name)))
        elif kind == 3:  # what SQLite would take for its own, and our reserve
            ending = rng.choice(("-wal", "-journal", "-shm", ".zstd", ".unfinished"))
            (bag / (file.name + ending)).write_bytes(file.read_bytes() if file.exists() else b"x")
        elif file.exists():
            file.write_bytes(BAG_FILES[file.suffix](rng, file.read_bytes()))


def check_reading(jail: Jail, bag: Path) -> None:
    """Reading changes nothing; recovery gives a bag that other readers open, and keeps the old."""
    before = contents(bag)
    jail.run("info", bag)
    assert contents(bag) == before
    recovered = jail.run("recover", bag)
    old = bag.with_name("bag.unfinished")
    if old.exists():
        assert recovered.status == 0
        assert contents(old) == before
        storage = "mcap" if (bag / "bag.mcap").exists() else "sqlite3"
        assert_consistent(bag, storage)
        assert jail.run("recover", bag).out.endswith("there is nothing to recover\n")
        jail.run("info", bag)
    else:
        assert contents(bag) == before
    assert set(bag.parent.iterdir()) <= {bag, old}


def contents(folder: Path) -> dict[str, bytes | int]:
    """The files of a folder; of large ones the size."""
    sizes = {path: path.stat().st_size for path in folder.iterdir() if path.is_file()}
    return {p.name: p.read_bytes() if size < MIB else size for p, size in sizes.items()}


# --- made by hand: special files ---


def sparse(path: Path) -> None:
    """Zeros that take no room on the disk."""
    with path.open("wb") as file:
        file.truncate(3000 * MIB)


SPECIAL: dict[str, tuple[Callable[[Path], object], str]] = {
    "a pipe": (os.mkfifo, "Not a regular file"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "Not a regular file"),
    "a folder": (Path.mkdir, "Is a directory|no bag|it has no .mcap"),
    "a link to itself": (lambda path: path.symlink_to(path.name), "symbolic links"),
    "3 GB of zeros": (sparse, "File too large"),
}


@pytest.mark.parametrize("what", ["fmu", "urdf", "csv", "mesh"])
@pytest.mark.parametrize(("make", "reason"), SPECIAL.values(), ids=SPECIAL)
def test_what_is_no_file_of_bearable_size_is_refused(
    make: Callable[[Path], object], reason: str, what: str, jail: Jail, native_path: Path
) -> None:
    path = jail.input / what
    make(path)
    (jail.input / "arm.urdf").write_text(arm_urdf(1, mesh="mesh"))
    build = ["build", "-o", jail.target / "x.fmu", "--frame", "link1", "--urdf"]
    command = {
        "fmu": ["run", path, "-o", jail.target / "bag"],
        "urdf": [*build, path],
        "csv": ["run", native_path, "--input", path, "-o", jail.target / "bag"],
        "mesh": [*build, jail.input / "arm.urdf"],
    }
    refused(jail, f"mesh .*(not found|leaves its folder|cannot be read)|{reason}", *command[what])


def refused(jail: Jail, reason: str, *command: object) -> None:
    outcome = jail.run(*command)
    assert outcome.status == 1
    assert re.search(reason, outcome.err), outcome.err
    assert list(jail.target.iterdir()) == []


# --- made by hand: FMUs ---

Q_AND_V = "".join(
    f'<ScalarVariable name="{name}[1]" valueReference="{i}" causality="output"'
    ' variability="continuous"><Real/></ScalarVariable>'
    for i, name in enumerate("qv")
)
LAUGHS = "<!DOCTYPE r [<!ENTITY l0 'ha'>" + "".join(
    f"<!ENTITY l{i} '{f'&l{i - 1};' * 10}'>" for i in range(1, 10)
) + "]>"  # fmt: skip
EXTERNAL = '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]>'


def description(head: str = "", notes: str = "", variables: str = "") -> str:
    """The modelDescription.xml of an FMU of another maker."""
    unknowns = '<Unknown index="1"/><Unknown index="2"/>'
    return (
        f'{head}<fmiModelDescription fmiVersion="2.0" modelName="m" guid="g">'
        f'<CoSimulation modelIdentifier="m"/><VendorAnnotations><Tool name="x">{notes}</Tool>'
        f"</VendorAnnotations><ModelVariables>{Q_AND_V}{variables}</ModelVariables>"
        f"<ModelStructure><Outputs>{unknowns}</Outputs>"
        f"<InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure></fmiModelDescription>"
    )


def variables(count: int) -> str:
    return "".join(
        f'<ScalarVariable name="a{i}" valueReference="{i}"><Real/></ScalarVariable>'
        for i in range(count)
    )


def attributes(count: int) -> str:
    return f"<a {' '.join(f'a{i}=%r' % '' for i in range(count))}/>"


def external(encoding: str, declared: str = "") -> bytes:
    head = f'<?xml version="1.0" encoding="{declared or encoding}"?>{EXTERNAL}'
    return description(head, "&a;").encode(encoding)


def fmu_of(xml: str | bytes, *more: tuple[str, bytes, int, int]) -> bytes:
    """An FMU with a library that cannot be loaded: the last of all refusals of a run."""
    content = {"modelDescription.xml": xml, "binaries/linux64/m.so": b"x"}
    members = []
    for name, value in content.items():
        data = value.encode() if isinstance(value, str) else value
        packer = zlib.compressobj(1, zlib.DEFLATED, -15)
        packed = packer.compress(data) + packer.flush()
        members.append((name, packed, len(data), zlib.crc32(data)))
    return mutations.raw_zip([*members, *more])


def bomb(name: str, declared: int) -> bytes:
    """An FMU with a member of 10 GB of zeros, of which the directory may say that it is small."""
    zeros = mutations.deflated_zeros(10_000 * MIB)
    good = [] if name == "modelDescription.xml" else [description()]
    member = (name, zeros, declared, zlib.crc32(bytes(declared % 2**20)))
    return fmu_of(good[0], member) if good else mutations.raw_zip([member])


def many_members(count: int, size: int = 0) -> bytes:
    """An FMU with members that are all the same data."""
    zeros = mutations.deflated_zeros(size)
    crc = zlib.crc32(bytes(size))
    same = [(f"{i:x}", zeros, size, crc) for i in range(count)]
    return fmu_of(description(), *same)


UNPLAIN = "declares entities or is not UTF-8"
UNLOADED = "cannot be loaded"
HOSTILE_FMUS: dict[str, tuple[Callable[[], bytes], str]] = {
    "a billion laughs": (lambda: fmu_of(description(LAUGHS, "&l9;")), UNPLAIN),
    "an external entity": (lambda: fmu_of(description(EXTERNAL, "&a;")), UNPLAIN),
    "UTF-16": (lambda: fmu_of(external("utf-16")), UNPLAIN),
    "UTF-16 without a mark": (lambda: fmu_of(external("utf-16-le", "utf-16")), UNPLAIN),
    "UTF-32": (lambda: fmu_of(external("utf-32")), UNPLAIN),
    "UTF-7": (lambda: fmu_of(external("ascii", "utf-7").replace(b"<!", b"+ADwAIQ-")), UNPLAIN),
    "EBCDIC": (lambda: fmu_of(external("cp037")), UNPLAIN),
    "100,000 elements deep": (
        lambda: fmu_of(description(notes="<a>" * 100_000 + "</a>" * 100_000)), "not valid"
    ),
    "100 MB of an attribute": (
        lambda: fmu_of(description(notes=f"<a b='{'x' * 100 * MIB}'/>")), "larger than"
    ),
    "6 MB of attributes": (lambda: fmu_of(description(notes=attributes(500_000))), UNLOADED),
    "8 MB of elements": (lambda: fmu_of(description(notes="<a/>" * (2 * MIB - 300))), "not valid"),
    "8 MB of variables": (lambda: fmu_of(description(variables=variables(105_000))), UNLOADED),
    "a million variables": (
        lambda: fmu_of(description(variables=variables(1_000_000))), "larger than"
    ),
    "80,000 members": (lambda: many_members(80_000), "cannot unzip"),
    "a million members": (lambda: many_members(1_000_000), "Too many members"),
    "40 GB in members that overlap": (lambda: many_members(40_000, MIB), "it exceeds"),
    "2 GB in members that overlap": (lambda: many_members(2000, MIB), "cannot unzip"),
    "10 GB of zeros": (lambda: bomb("resources/x", 2**32 - 1), "it exceeds"),
    "10 GB that are said to be 1 kB": (lambda: bomb("resources/x", 1000), UNLOADED),
    "10 GB of URDF": (lambda: bomb("resources/robot.urdf", 1000), UNLOADED),
    "10 GB of description": (lambda: bomb("modelDescription.xml", 1000), UNPLAIN),
    "900 folders deep": (
        lambda: fmu_of(description(), ("a/" * 900 + "b", b"\3\0", 0, 0)), "nested deeper"
    ),
}  # fmt: skip


def test_hostile_fmu_is_refused(hostile_fmu: tuple[Callable[[], bytes], str], jail: Jail) -> None:
    make, reason = hostile_fmu
    path = jail.input / "x.fmu"
    path.write_bytes(make())
    jail.run("info", path)
    refused(jail, reason, "run", path, "-o", jail.target / "bag")
    jail.run("run", path, "-o", jail.target / "bag", "--scene")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_fmu_compressed_as_fmi_does_not_allow_is_refused(method: int, jail: Jail) -> None:
    content = {"modelDescription.xml": description().encode(), "binaries/linux64/m.so": b"x"}
    path = jail.input / "x.fmu"
    path.write_bytes(mutations.zip_of(content, method=method))
    refused(jail, f"compressed by method {method}", "info", path)


MODULES_THAT_ARE_NONE = {
    "no text": b"\xff\xfe",
    "empty": b"",
    "not there": b"gone\n",
    "too long": b"x" * 5000,
    "elsewhere": b"../resources/slave_{}\n",
    "a folder of modules": b"twodof_{}",
    "with a space": b"slave_{} \n",
    "with a NUL": b"slave_{}\0\n",
}


@pytest.mark.parametrize("name", MODULES_THAT_ARE_NONE.values(), ids=MODULES_THAT_ARE_NONE)
def test_python_fmu_without_its_module_is_refused(name: bytes, jail: Jail, fmu_path: Path) -> None:
    """pythonfmu's wrapper would crash."""
    with zipfile.ZipFile(fmu_path) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    digest = members["resources/slavemodule.txt"].strip().removeprefix(b"slave_")
    members["resources/slavemodule.txt"] = name.replace(b"{}", digest)
    path = jail.input / "x.fmu"
    path.write_bytes(mutations.zip_of(members))
    refused(jail, "slavemodule.txt does not name", "run", path, "-o", jail.target / "bag")
    del members["resources/slavemodule.txt"]
    path.write_bytes(mutations.zip_of(members))
    refused(jail, "slavemodule.txt does not name", "run", path, "-o", jail.target / "bag")


def test_fmu_of_any_name_is_read(jail: Jail, native_path: Path) -> None:
    """FMPy takes a file for a model description where its name says so."""
    shutil.copyfile(native_path, jail.input / "x.xml")
    assert jail.run("info", jail.input / "x.xml").status == 0


def test_fmu_that_cannot_be_loaded_leaves_the_working_directory(tmp_path: Path) -> None:
    (tmp_path / "x.fmu").write_bytes(fmu_of(description()))
    before = Path.cwd()
    with pytest.raises(FmuError, match="cannot be loaded"):
        twodof.simulate(tmp_path / "x.fmu")
    assert Path.cwd() == before


# --- made by hand: URDFs ---

LINK = (
    '<link name="{0}"><inertial><mass value="{1}"/>'
    '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>{2}</link>'
)
JOINT = (
    '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>'
    '<limit lower="{3}" upper="{4}"/></joint>'
)


def robot(*parts: str) -> str:
    return f'<robot name="r"><link name="base"/>{"".join(parts)}</robot>'


def tip(mass: object = 1, inside: str = "", lower: object = -1, upper: object = 1) -> str:
    return LINK.format("tip", mass, inside) + JOINT.format("j", "base", "tip", lower, upper)


def chain(n: int) -> str:
    names = ["base", *(f"l{i}" for i in range(n - 1)), "tip"]
    links = (LINK.format(name, 1, "") for name in names[1:])
    joints = (JOINT.format(f"j{i}", *names[i : i + 2], -1, 1) for i in range(n))
    return robot(*links, *joints)


def shapes(names: Iterable[str]) -> str:
    return "".join(
        f'<visual><geometry><mesh filename="{name}"/></geometry></visual>' for name in names
    )


def meshes(folder: Path) -> None:
    """Folders, pipes, devices and links in the place of meshes."""
    (folder / "in/folder").mkdir(parents=True)
    os.mkfifo(folder / "in/pipe")
    (folder / "in/zero").symlink_to("/dev/zero")
    (folder / "in/out").symlink_to("../../secret")
    (folder / "in/up").symlink_to("../..")
    (folder / "in/circle").symlink_to("circle")
    (folder / "in/good.stl").write_bytes(b"good")
    for i in range(3):
        with (folder / f"in/large{i}").open("wb") as file:
            file.truncate(100 * MIB)


HOSTILE_URDFS: dict[str, tuple[Callable[[], str], str]] = {
    "a billion laughs": (lambda: LAUGHS + robot(tip()), "document type"),
    "an external entity": (lambda: EXTERNAL + robot(tip()), "document type"),
    "a million links": (lambda: robot('<link name="a"/>' * 10**6), "File too large"),
    "8 MB of links": (
        lambda: robot(*(f'<link name="{i}"/>' for i in range(370_000))), "370001 links; at most"
    ),
    "8 MB of elements": (lambda: robot("<a/>" * (2 * MIB - 50)), "no moving joint"),
    "7 MB of attributes": (lambda: robot(attributes(600_000)), "no moving joint"),
    "100,000 elements deep": (
        lambda: robot("<a>" * 100_000 + "</a>" * 100_000, tip()), "nested deeper than 100"
    ),
    "100,000 elements deep in an inertial": (
        lambda: robot(tip()).replace("<inertial>", "<inertial>" + "<a>" * 10**5 + "</a>" * 10**5),
        "nested deeper than 100",
    ),
    "a chain of 129 joints": (lambda: chain(129), "129 moving joints"),
    "a mass of 1e308": (lambda: robot(tip(mass="1e308")), "too large"),
    "a mass of nan": (lambda: robot(tip(mass="nan")), "not finite"),
    "a limit of nan": (lambda: robot(tip(upper="nan")), "not finite"),
    "a mass in other digits": (lambda: robot(tip(mass="٣")), "not a number"),
    "a mass with an underscore": (lambda: robot(tip(mass="1_0")), "not a number"),
    "a circle": (
        lambda: robot(*(LINK.format(n, 1, "") for n in ("a", "tip")),
                      JOINT.format("j", "a", "tip", 0, 1), JOINT.format("k", "tip", "a", 0, 1)),
        "its own ancestor",
    ),
    "two parents": (
        lambda: robot(tip(), LINK.format("a", 1, ""), JOINT.format("k", "base", "a", 0, 1),
                      JOINT.format("l", "a", "tip", 0, 1)),
        "two parents",
    ),
    "a mesh that is a folder": (lambda: robot(tip(inside=shapes(["folder"]))), "not found"),
    "a mesh that is a pipe": (lambda: robot(tip(inside=shapes(["pipe"]))), "not found"),
    "a mesh that is a device": (lambda: robot(tip(inside=shapes(["zero"]))), "not found"),
    "a device by its own name": (
        lambda: robot(tip(inside=shapes(["file:///dev/zero"]))), "not found"
    ),
    "a file without an end": (
        lambda: robot(tip(inside=shapes(["file:///dev/zero"]))), "not found"
    ),
    "a mesh that is a link out": (lambda: robot(tip(inside=shapes(["out"]))), "not found"),
    "a mesh behind a link out": (
        lambda: robot(tip(inside=shapes(["package://up/secret"]))), "not found"
    ),
    "a mesh that is a link to itself": (lambda: robot(tip(inside=shapes(["circle"]))), "circle"),
    "a mesh of another folder": (
        lambda: robot(tip(inside=shapes(["../../secret"]))), "not found"
    ),
    "meshes of 300 MB": (
        lambda: robot(tip(inside=shapes(f"large{i}" for i in range(3)))), "File too large"
    ),
    "100,000 meshes that are not there": (
        lambda: robot(tip(inside=shapes(f"package://{i}/x" for i in range(10**5)))), "not found"
    ),
}  # fmt: skip


def test_hostile_urdf_is_refused(hostile_urdf: tuple[Callable[[], str], str], jail: Jail) -> None:
    make, reason = hostile_urdf
    refused(jail, reason, *build_command(jail, make()))


def build_command(jail: Jail, text: str) -> list[object]:
    meshes(jail.input)
    urdf = jail.input / "x.urdf"
    urdf.write_text(text, "utf-8")
    folder = jail.input / "in"
    output = jail.target / "x.fmu"
    return ["build", "--frame", "tip", "--urdf", urdf, "--mesh-dir", folder, "-o", output]


LARGE_URDFS: dict[str, Callable[[], str]] = {
    "a chain of 128 joints": lambda: chain(128),
    "100,000 uses of a mesh": lambda: robot(tip(inside=shapes(["good.stl"] * 10**5))),
    "200 MB of meshes": lambda: robot(tip(inside=shapes(["large0", "large1"]))),
    "names of 100,000 letters": lambda: robot(tip()).replace('"j"', f'"{"j" * 10**5}"'),
    "names with markup": lambda: robot(tip()).replace('"j"', '"&lt;&quot;&#10;%s${x}\\"'),
}


def test_large_urdf_is_built_or_refused(large_urdf: Callable[[], str], jail: Jail) -> None:
    jail.run(*build_command(jail, large_urdf()))


# --- made by hand: CSVs ---

HOSTILE_CSVS: dict[str, tuple[Callable[[], bytes], str]] = {
    "60 MB of zero bytes": (lambda: bytes(60 * MIB), "not a CSV file|no column 'time'"),
    "60 MB of one letter": (lambda: "𝄞".encode() * (15 * MIB), "not a CSV file"),
    "60 MB of one row": (lambda: b"time,Kn\n" + b"0," * (30 * MIB), "more than 1000000 cells"),
    "60 MB of one cell": (lambda: b'time,Kn\n0,"' + b"0" * (60 * MIB), "not a CSV file"),
    "60 MB of line breaks": (lambda: b"\n" * (60 * MIB), "more than 1000000 cells"),
    "60 MB of rows": (lambda: b"time,Kn\n" + b"0,0\n" * (15 * MIB), "more than 1000000 cells"),
    "a row of 500,000 cells": (lambda: b"time\n" + b"0," * 500_000, "row 2: 500001 cells"),
    "a cell of 100,000 digits": (lambda: b"time,Kn\n0," + b"1" * 10**5, "Kn = 1{50} is not finite"),
    "a cell over several lines": (lambda: b'time,Kn\n0,"1\n1"\n', r"row 3: 1 cells, expected 2"),
    "500,000 columns": (lambda: b"time," + b"x," * 500_000, "x is not an input"),
    "a column name of 100,000 letters": (lambda: b"time," + b"x" * 10**5, "no variable 'xxx"),
}


def test_hostile_csv_is_refused(
    hostile_csv: tuple[Callable[[], bytes], str], jail: Jail, native_path: Path
) -> None:
    make, reason = hostile_csv
    path = jail.input / "x.csv"
    path.write_bytes(make())
    refused(jail, reason, "run", native_path, "--input", path, "-o", jail.target / "bag")


# --- made by hand: bags ---


def record(opcode: int, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack("<BQ", opcode, len(body)) + body


def words(*texts: str) -> bytes:
    return b"".join(struct.pack("<I", len(text)) + text.encode() for text in texts)


JOINT_STATE = "sensor_msgs/msg/JointState"
SCHEMA = record(3, struct.pack("<H", 1), words(JOINT_STATE, "ros2msg", ""))
CHANNEL = record(4, struct.pack("<HH", 1, 1), words("/joint_states", "cdr"), bytes(4))


def mcap_of(*records: bytes) -> bytes:
    """An MCAP file without an index."""
    begin = mutations.MCAP_MAGIC + record(1, words("ros2", "x"))
    return begin + b"".join(records) + record(2, bytes(20)) + mutations.MCAP_MAGIC


def chunk(content: bytes, size: int, compression: str) -> bytes:
    head = struct.pack("<QQQI", 0, 0, size, 0) + words(compression)
    return record(6, head, struct.pack("<Q", len(content)), content)


def zipped(content: bytes, times: int = 1) -> bytes:
    """The same over and over, compressed at once."""
    packer = zstd.ZstdCompressor()
    return b"".join([*(packer.compress(content) for _ in range(times)), packer.flush()])


def with_mcap(make: Callable[[], bytes]) -> Callable[[Path], None]:
    def change(bag: Path) -> None:
        (file,) = bag.glob("*.mcap")
        file.write_bytes(make())

    return change


def with_sql(script: str) -> Callable[[Path], None]:
    """The database after some SQL, in the place of the MCAP file."""

    def change(bag: Path) -> None:
        (file,) = bag.glob("*.mcap")
        file.unlink()
        data = (bag.parents[1] / "input/good.db3").read_bytes()
        (bag / "bag.db3").write_bytes(mutations.sqlite_after(data, script))

    return change


def instead(name: str, make: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(bag: Path) -> None:
        file = next(bag.glob(name))
        file.unlink()
        make(file)

    return change


def written(content: Callable[[], bytes]) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content())


def many_files(bag: Path) -> None:
    for i in range(5000):
        (bag / f"x_{i}.mcap").write_bytes(b"")


def circle(bag: Path) -> None:
    """Rows enough for pages of pages, whose children then are all the same full one."""
    with_sql(
        f"{ENDLESS} INSERT INTO messages SELECT i + 99, 1, i, zeroblob(300) FROM r LIMIT 200000"
    )(bag)
    file = bag / "bag.db3"
    pages = bytearray(file.read_bytes())
    interior = [start for start in range(4096, len(pages), 4096) if pages[start] == 5]
    assert len(interior) > 2
    for start in interior:
        (cells,) = struct.unpack_from(">H", pages, start + 3)
        (last,) = struct.unpack_from(">I", pages, start + 8)
        for i in range(cells):
            (cell,) = struct.unpack_from(">H", pages, start + 12 + 2 * i)
            struct.pack_into(">I", pages, start + cell, last)
    file.write_bytes(pages)


def lz4_zeros(size: int) -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    parts = [packer.begin(), *(packer.compress(bytes(MIB)) for _ in range(size // MIB))]
    return b"".join([*parts, packer.flush()])


def channel(number: int, qos: str = "") -> bytes:
    metadata = words("offered_qos_profiles", qos)
    head = struct.pack("<HH", number % 65536, 1)
    return record(4, head, words(f"/t{number}", "cdr"), struct.pack("<I", len(metadata)), metadata)


def message(data: bytes, number: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, 1, 1), data)


def joint_state(positions: int, names: int) -> bytes:
    """A joint state that is nearly nothing when packed."""
    types, kind = STORE.types, "sensor_msgs/msg/JointState"
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "")
    none = np.zeros(0)
    state = types[kind](header, ["a"] * names, np.zeros(positions), none, none)
    return bytes(STORE.serialize_cdr(state, kind))


def hollow(size: int, content: bytes) -> Callable[[Path], None]:
    """A file of this size, that unpacks to the same over and over, 32 MiB a chunk."""

    def make() -> bytes:
        chunks = content * (32 * MIB // len(content))
        packed = chunk(zipped(chunks), len(chunks), "zstd")
        return mcap_of(SCHEMA, *map(channel, range(1, 1000)), *[packed] * (size // len(packed)))

    return with_mcap(make)


ENDLESS = "WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM r)"
HOSTILE_BAGS: dict[str, Callable[[Path], None]] = {
    **{
        f"{what} instead of {name}": instead(name, make)
        for name in ("*.mcap", "metadata.yaml", "run.json")
        for what, (make, _) in SPECIAL.items()
    },
    "5000 files": many_files,
    "10 GB in a chunk": with_mcap(
        lambda: mcap_of(chunk(zipped(bytes(MIB), 10_000), 10_000 * MIB, "zstd"))
    ),
    "10 GB in a chunk of 1 kB": with_mcap(
        lambda: mcap_of(chunk(zipped(bytes(MIB), 10_000), 1000, "zstd"))
    ),
    "250 MB of zeros in a chunk": with_mcap(
        lambda: mcap_of(chunk(zipped(bytes(MIB), 250), 250 * MIB, "zstd"))
    ),
    "250 MB of one record in each of 500 chunks": with_mcap(
        lambda: mcap_of(*[chunk(record(9, b"") + zipped(bytes(MIB), 250), 250 * MIB, "zstd")] * 500)
    ),
    "250 MB of messages in a chunk": with_mcap(
        lambda: mcap_of(SCHEMA, CHANNEL, chunk(
            zipped(message(bytes(44)) * 1000, 3500), 75 * 3_500_000, "zstd"))
    ),
    "2.5 GB in a chunk of lz4": with_mcap(
        lambda: mcap_of(chunk(lz4_zeros(2500 * MIB), 1000, "lz4"))
    ),
    "434 kB of empty messages": hollow(
        434_000, b"".join(message(b"", i) for i in range(1, 1000))
    ),
    "434 kB of joint states of nothing": hollow(434_000, message(joint_state(0, 0))),
    "434 kB of joint states of 40,000 joints": hollow(434_000, message(joint_state(40_000, 0))),
    "434 kB of joint states of 80,000 names": hollow(434_000, message(joint_state(0, 80_000))),
    "434 kB of topics of 1 MB": hollow(434_000, channel(1, " " * MIB)),
    "100,000 channels": with_mcap(lambda: mcap_of(SCHEMA, *map(channel, range(100_000)))),
    "a thousand topics with profiles of their own": with_mcap(
        lambda: mcap_of(
            SCHEMA,
            *(channel(i, "- {depth: [" + "1," * 200 + f"]}}#{i}") for i in range(1, 1000)),
            *(message(bytes(4), i) for i in range(1, 1000)),
        )
    ),
    "a message of 700 MB": with_mcap(
        lambda: mcap_of(SCHEMA, CHANNEL, message(bytes(700 * MIB)))
    ),
    "60 MB of small records": with_mcap(lambda: mcap_of(record(8) * (7 * MIB))),
    "an array of 4 billion": with_mcap(
        lambda: mcap_of(SCHEMA, CHANNEL, message(b"\0\1\0\0" + bytes(8) + b"\xff" * 400))
    ),
    "no topic in CDR": with_sql(
        "UPDATE topics SET serialization_format = 'json'; DELETE FROM messages WHERE id = 3"
    ),
    "stamps before 1970": with_sql(
        "UPDATE messages SET timestamp = -1; DELETE FROM messages WHERE id = 3"
    ),
    "a view of topics without end": with_sql(
        f"DROP TABLE topics; CREATE VIEW topics AS {ENDLESS} SELECT max(i) AS id, 'a' AS name,"
        " 'b' AS type, 'cdr' AS serialization_format, '' AS offered_qos_profiles FROM r"
    ),
    "pages in a circle": circle,
    "100,000 topics": with_sql(
        f"{ENDLESS} INSERT INTO topics SELECT i + 9, 't' || i, 'x', 'cdr', '', '' FROM r"
        " LIMIT 100000"
    ),
    "a message of 300 MB in a database": with_sql(
        "UPDATE messages SET data = zeroblob(300000000) WHERE id = 1"
    ),
    "laughing metadata": instead("metadata.yaml", written(
        lambda: mutations.laughs() + b"rosbag2_bagfile_information: {compression_format: *l8}"
    )),
    "60 MB of metadata": instead("metadata.yaml", written(lambda: b"[" * (60 * MIB))),
    "60 MB of provenance": instead("run.json", written(
        lambda: b'{"format":1,"fmu":[' + b"{}," * (20 * MIB) + b"0]}"
    )),
    "provenance 10,000 deep": instead("run.json", written(lambda: b"[" * 10_000)),
}  # fmt: skip


def test_hostile_bag(
    hostile_bag: Callable[[Path], None], jail: Jail, bags: dict[str, Path]
) -> None:
    bag = jail.target / "bag"
    shutil.copytree(bags["mcap"], bag)
    (bag / "mcap.mcap").rename(bag / "bag.mcap")
    shutil.copyfile(bags["sqlite3"] / "sqlite3.db3", jail.input / "good.db3")
    hostile_bag(bag)
    check_reading(jail, bag)


SLOW = {
    "6 MB of attributes", "8 MB of elements", "8 MB of variables", "a million variables",
    "100 MB of an attribute", "80,000 members", "a million members",
    "40 GB in members that overlap",
    "7 MB of attributes", "8 MB of links", "100,000 meshes that are not there", "meshes of 300 MB",
    "200 MB of meshes", "100,000 uses of a mesh", "a chain of 128 joints",
    "60 MB of rows", "60 MB of line breaks", "60 MB of one letter", "60 MB of one cell",
    "5000 files", "pages in a circle", "10 GB in a chunk", "10 GB in a chunk of 1 kB",
    "2.5 GB in a chunk of lz4", "250 MB of zeros in a chunk",
    "250 MB of one record in each of 500 chunks", "250 MB of messages in a chunk",
    "a message of 700 MB", "a message of 300 MB in a database", "60 MB of small records",
    "60 MB of metadata", "60 MB of provenance",
}  # fmt: skip
HOSTILE: dict[str, dict[str, Any]] = {
    "hostile_fmu": HOSTILE_FMUS,
    "hostile_urdf": HOSTILE_URDFS,
    "large_urdf": LARGE_URDFS,
    "hostile_csv": HOSTILE_CSVS,
    "hostile_bag": HOSTILE_BAGS,
}


if __name__ == "__main__":
    serve()
