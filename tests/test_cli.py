"""The command line: what it prints, and one line that names the culprit where input is bad."""

from __future__ import annotations

import json
import logging
import math
import os
import re
import shutil
import stat
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest

import twodof
from twodof.cli.main import main

ROOT = Path(__file__).parents[1]
COMMAND = [sys.executable, "-m", "twodof"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
EMPTY_ZIP = b"PK\x05\x06" + bytes(18)


def twodof_command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    return subprocess.run(
        [*COMMAND, *arguments],
        cwd=cwd,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=300,
    )


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Sizes and times of all that is below a folder."""
    found = {}
    for path in folder.rglob("*"):
        state = path.lstat()
        changed = 0 if stat.S_ISDIR(state.st_mode) else state.st_mtime_ns
        found[str(path.relative_to(folder))] = (state.st_size, changed)
    return found


@pytest.fixture(scope="session")
def bag_path(fmu_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "bag"
    run = twodof.experiment(fmu_path, stop_time=0.05)
    twodof.simulate(run, twodof.Bag(path))
    return path


@pytest.fixture
def folder(tmp_path: Path, fmu_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with a good FMU; what the tables below add is made by them."""
    place = tmp_path / "work"
    place.mkdir()
    (place / "arm.fmu").symlink_to(fmu_path)
    monkeypatch.chdir(place)
    return place


# --- things that are wrong ---

GOOD_LINK = (
    '<link name="a"><inertial><mass value="1"/>'
    '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
)


def urdf(*, kind: str = "revolute", link: str = GOOD_LINK, mesh: str = "") -> str:
    shape = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>' if mesh else ""
    return (
        f'<robot name="r"><link name="base">{shape}</link>{link}<joint name="j" type="{kind}">'
        '<parent link="base"/><child link="a"/><limit lower="-1" upper="1"/></joint></robot>'
    )


def description(
    *,
    version: str = "2.0",
    kind: str = "CoSimulation",
    outputs: tuple[str, ...] = ("q[1]", "v[1]"),
    causality: str = "output",
    head: str = "",
) -> str:
    """A modelDescription.xml of another maker, as small as it may be."""
    variables = "".join(
        f'<ScalarVariable name="{name}" valueReference="{i}" causality="{causality}"'
        ' variability="continuous"><Real/></ScalarVariable>'
        for i, name in enumerate(outputs)
    )
    unknowns = "".join(f'<Unknown index="{i + 1}"/>' for i in range(len(outputs)))
    unknown = f"<Outputs>{unknowns}</Outputs><InitialUnknowns>{unknowns}</InitialUnknowns>"
    if causality != "output":
        unknown = ""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>{head}'
        f'<fmiModelDescription fmiVersion="{version}" modelName="m" guid="g">'
        f'<{kind} modelIdentifier="m"/><ModelVariables>{variables}</ModelVariables>'
        f"<ModelStructure>{unknown}</ModelStructure></fmiModelDescription>"
    )


VENDOR_JOINTS = (
    '<VendorAnnotations><Tool name="twodof"><Robot name="r"><Joint name="a"/><Joint name="b"/>'
    "</Robot></Tool></VendorAnnotations>"
)
FMI1 = (
    '<fmiModelDescription fmiVersion="1.0" modelName="m" modelIdentifier="m" guid="g"'
    ' numberOfContinuousStates="0" numberOfEventIndicators="0"><ModelVariables/>'
    "</fmiModelDescription>"
)
FMI3 = (
    '<fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="t">'
    '<ModelExchange modelIdentifier="m"/><ModelVariables>'
    '<Float64 name="time" valueReference="0" causality="independent"/>'
    '<Float64 name="q[1]" valueReference="1" causality="output"/>'
    '<Float64 name="v[1]" valueReference="2" causality="output"/></ModelVariables>'
    '<ModelStructure><Output valueReference="1"/><Output valueReference="2"/>'
    "</ModelStructure></fmiModelDescription>"
)


def write_fmu(
    path: Path, xml: str | None = None, members: tuple[str, ...] = ("binaries/linux64/m.so",)
) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        if xml is not None:
            archive.writestr("modelDescription.xml", xml)
        for name in members:
            archive.writestr(name, b"content")


def write_link(path: Path) -> None:
    write_fmu(path, description())
    with zipfile.ZipFile(path, "a") as archive:
        entry = zipfile.ZipInfo("resources/link")
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")


def damaged(content: bytes) -> bytes:
    """A zip in which the compressed data of the description is not what deflate writes."""
    at = content.index(b"modelDescription.xml") + len("modelDescription.xml")
    return content[:at] + b"\xff" * 40 + content[at + 40 :]


def encrypted(content: bytes) -> bytes:
    """A zip whose entries say that they are encrypted."""
    header = re.compile(rb"(PK\x03\x04..|PK\x01\x02....)\x00", re.DOTALL)
    return header.sub(lambda found: found[1] + b"\x01", content)


def swollen(content: bytes) -> bytes:
    """A zip whose directory says that each entry unzips to 4 GB."""
    entry = re.compile(rb"(PK\x01\x02.{20})....", re.DOTALL)
    return entry.sub(lambda found: found[1] + b"\xfe\xff\xff\xff", content)


def text(name: str, content: str | bytes) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content

    def make(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return make


def fmu(
    xml: str | None, *more: str, binary: str = "linux64/m.so", change: Callable[..., bytes] = bytes
) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        write_fmu(folder / "bad.fmu", xml, (f"binaries/{binary}", *more))
        (folder / "bad.fmu").write_bytes(change((folder / "bad.fmu").read_bytes()))

    return make


def nothing(folder: Path) -> None:
    del folder


def a_bag(folder: Path) -> None:
    (folder / "bag").mkdir()
    (folder / "bag/metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 8\n")


def a_linked_bag(folder: Path) -> None:
    a_bag(folder)
    (folder / "link").symlink_to("bag")


BUILD = ["build", "-o", "new.fmu", "--frame", "a", "--urdf", "arm.urdf"]
RUN = ["run", "arm.fmu", "-o", "out", "--stop-time", "0.02"]
RUN_BAD = ["run", "bad.fmu", "-o", "out"]
INFO = ["info", "bad.fmu"]
CSV = [*RUN, "--input", "in.csv"]
LONG = "x" * 300

Case = tuple[Callable[[Path], None], list[str], str]
BAD: dict[str, Case] = {
    # build
    "URDF missing": (nothing, BUILD, "arm.urdf': No such file"),
    "URDF a folder": (nothing, [*BUILD[:-1], "."], "'.': Is a directory"),
    "URDF no XML": (text("arm.urdf", "a: 1"), BUILD, "arm.urdf: the URDF is not XML"),
    "URDF no text": (text("arm.urdf", b"\xff\x00"), BUILD, "'arm.urdf' is not UTF-8"),
    "URDF with NUL": (
        text("arm.urdf", urdf(mesh="a\0b.stl")), BUILD, "mesh 'a.*b.stl'|the URDF is not XML",
    ),
    "URDF with entities": (
        text("arm.urdf", '<!DOCTYPE robot [<!ENTITY a "b">]>' + urdf()), BUILD, "document type",
    ),
    "no such frame": (
        text("arm.urdf", urdf()), [*BUILD, "--frame", "hand"], "no frame 'hand'.*: base, a$",
    ),
    "joint type": (text("arm.urdf", urdf(kind="planar")), BUILD, "'j' is of type 'planar'"),
    "no mass": (text("arm.urdf", urdf(link='<link name="a"/>')), BUILD, "'j': .*no mass .*--lock"),
    "negative mass": (
        text("arm.urdf", urdf(link=GOOD_LINK.replace('value="1"', 'value="-1"'))),
        BUILD, "'a': negative mass -1",
    ),
    "inertia not physical": (
        text("arm.urdf", urdf(link=GOOD_LINK.replace('ixx="1"', 'ixx="-9"'))), BUILD, "'a': its in",
    ),
    "inertia missing": (
        text("arm.urdf", urdf(link=re.sub("<inertia .*?/>", "", GOOD_LINK))), BUILD, "link 'a'",
    ),
    "mesh folder missing": (
        text("arm.urdf", urdf()), [*BUILD, "--mesh-dir", "gone"], "mesh folder 'gone'",
    ),
    "axes": (text("arm.urdf", urdf()), [*BUILD, "--axes", "xw"], "axes 'xw'"),
    "axes of the shipped arm": (nothing, ["build", "--axes", "xyz"], "axes are xy"),
    "q-start of another length": (
        text("arm.urdf", urdf()), [*BUILD, "--q-start", "1", "2"], "q_start has 2 values.* 1 ",
    ),
    "q-start NaN": (nothing, ["build", "--q-start", "nan", "0"], "q_start .*nan.* finite"),
    "gravity infinite": (nothing, ["build", "--gravity", "0", "0", "inf"], "gravity .*inf"),
    "name": (nothing, ["build", "--name", "2 dof"], "name '2 dof'"),
    "name that leaves the folder": (nothing, ["build", "--name", "../x"], "name '../x'"),
    "output folder missing": (nothing, ["build", "-o", "gone/x.fmu"], "cannot write 'gone/x.fmu'"),
    "output below a file": (
        text("file", "x"), ["build", "-o", "file/x.fmu"], "cannot write 'file/x.fmu': Not a direc",
    ),
    "output a folder": (nothing, ["build", "-o", "."], "cannot write '.'"),
    # an FMU
    "FMU missing": (nothing, RUN_BAD, "no FMU 'bad.fmu'; build one with 'twodof build'"),
    "FMU missing, info": (nothing, INFO, "no FMU 'bad.fmu'"),
    "FMU a folder": (nothing, ["run", ".", "-o", "out"], "cannot read '.': Is a directory"),
    "FMU no zip": (text("bad.fmu", "FMU"), RUN_BAD, "'bad.fmu' is no FMU: .*not a zip"),
    "FMU no zip, info": (text("bad.fmu", "FMU"), INFO, "'bad.fmu' is no FMU: .*not a zip"),
    "FMU empty file": (text("bad.fmu", b""), RUN_BAD, "'bad.fmu' is no FMU: .*not a zip"),
    "FMU empty zip": (text("bad.fmu", EMPTY_ZIP), RUN_BAD, "'bad.fmu' .*no modelDescription.xml"),
    "FMU damaged": (fmu(description(), change=damaged), RUN_BAD, "'bad.fmu'"),
    "FMU encrypted": (fmu(description(), change=encrypted), RUN_BAD, "'bad.fmu'"),
    "FMI 1.0": (fmu(FMI1), RUN_BAD, "'bad.fmu' is FMI 1.0 .*FMI 2.0"),
    "FMI 3.0": (fmu(FMI3), RUN_BAD, "'bad.fmu' is FMI 3.0 .*FMI 2.0 or 3.0 co-simulation"),
    "FMI 3.0, info": (fmu(FMI3), INFO, "'bad.fmu' is FMI 3.0"),
    "model exchange": (
        fmu(description(kind="ModelExchange")), RUN_BAD, "'bad.fmu' is FMI 2.0 model exchange",
    ),
    "description no XML": (fmu("<fmiModel"), RUN_BAD, "'bad.fmu': modelDescription.xml is not val"),
    "description of something else": (fmu("<html/>"), RUN_BAD, "'bad.fmu': modelDescription.xml"),
    "description not of the schema": (
        fmu(description().replace("modelName", "title")), RUN_BAD, "'bad.fmu'.*(title|modelName)",
    ),
    "description with entities": (
        fmu(description(head='<!DOCTYPE x [<!ENTITY a "b">]>')), RUN_BAD, "declares entities",
    ),
    "description with a DTD, info": (
        fmu(description(head='<!DOCTYPE x SYSTEM "/etc/passwd">')), INFO, "declares entities",
    ),
    "no binary for this platform": (
        fmu(description(), binary="win64/m.dll"), RUN_BAD,
        r"no binary for this platform \(linux64\), only for: win64",
    ),
    "binary of another name": (
        fmu(description(), binary="linux64/x.so"), RUN_BAD, "no binary .*only for: none",
    ),
    "binary that is none": (fmu(description()), RUN_BAD, "'bad.fmu' cannot be loaded"),
    "no outputs q": (fmu(description(outputs=("y",))), RUN_BAD, r"no outputs q\[1\]"),
    "no outputs v": (fmu(description(outputs=("q[1]", "y"))), RUN_BAD, r"no outputs q\[1\]"),
    "fewer v than q": (
        fmu(description(outputs=("q[1]", "q[2]", "v[1]"))), RUN_BAD, r"no outputs q\[1\]",
    ),
    "q and v not outputs": (fmu(description(causality="local")), INFO, r"no outputs q\[1\]"),
    "q and v not Real": (
        fmu(description().replace("<Real/>", "<Integer/>").replace("continuous", "discrete")),
        INFO, r"no outputs q\[1\]",
    ),
    "joints of another number": (
        fmu(description().replace("<ModelVariables>", VENDOR_JOINTS + "<ModelVariables>")),
        INFO, "'bad.fmu' names 2 joints but has 1 outputs",
    ),
    "zip slip": (fmu(description(), "../evil"), RUN_BAD, "unsafe: its member '../evil' leaves"),
    "zip slip below": (fmu(description(), "resources/../../evil"), RUN_BAD, "unsafe: .*evil"),
    "zip slip of Windows": (fmu(description(), "..\\evil"), RUN_BAD, "unsafe: .*evil"),
    "absolute member": (fmu(description(), "/tmp/twodof_evil"), RUN_BAD, "unsafe: .*'/tmp/twodof_"),
    "symbolic link": (
        lambda folder: write_link(folder / "bad.fmu"), RUN_BAD, "unsafe: its member 'resources/li",
    ),
    "symbolic link, info": (
        lambda folder: write_link(folder / "bad.fmu"), INFO, "unsafe: its member 'resources/li",
    ),
    "zip bomb": (fmu(description(), change=swollen), RUN_BAD, "unsafe: unzipped it exceeds"),
    # settings
    "--set of an unknown name": (nothing, [*RUN, "--set", "Kpp=1"], "'Kpp'; did you mean 'Kp'"),
    "--set of no number": (nothing, [*RUN, "--set", "Kp=high"], "--set Kp=high: 'high' is not a n"),
    "--set without a value": (nothing, [*RUN, "--set", "Kp"], "--set Kp: expected NAME=VALUE"),
    "--set twice": (nothing, [*RUN, "--set", "Kp=1", "--set", "Kp=2"], "--set Kp is given twice"),
    "--set of an output": (nothing, [*RUN, "--set", "q=1"], r"q\[1\] .*cannot be set"),
    "--set of NaN": (nothing, [*RUN, "--set", "x_des=nan"], r"x_des\[1\] = nan is not finite"),
    "--set with a line break": (nothing, [*RUN, "--set", "K\np=1"], "no variable 'K.*p'"),
    # inputs over time
    "CSV missing": (nothing, CSV, "cannot read 'in.csv': No such file"),
    "CSV a folder": (nothing, [*CSV[:-1], "."], "cannot read the bag '.': it has no"),
    "CSV empty": (text("in.csv", b""), CSV, "'in.csv' is empty"),
    "CSV no text": (text("in.csv", b"\xff\xfe"), CSV, "'in.csv' is not a CSV file"),
    "CSV without time": (text("in.csv", "t,Kn\n0,1"), CSV, "'in.csv' has no column 'time'"),
    "CSV unsorted": (text("in.csv", "time,Kn\n1,1\n0,1"), CSV, "'in.csv' row 3: time 0 is before"),
    "CSV ragged": (text("in.csv", "time,Kn\n1"), CSV, "'in.csv' row 2: 1 cells, expected 2"),
    "CSV with NaN": (text("in.csv", "time,Kn\n1,nan"), CSV, "'in.csv' row 2: Kn = nan"),
    "CSV with words": (text("in.csv", "time,Kn\n1,high"), CSV, "'in.csv' row 2: Kn = 'high'"),
    "CSV with a line break": (text("in.csv", 'time,Kn\n1,"a\nb"'), CSV, "'in.csv' row 2: Kn = 'a"),
    "CSV with unknown columns": (text("in.csv", "time,Kq\n0,1"), CSV, "'in.csv': .*'Kq'; did you"),
    "CSV with a parameter": (text("in.csv", "time,rtol\n0,1"), CSV, "'in.csv': rtol is not an in"),
    "CSV and --set": (text("in.csv", "time,Kn\n0,1"), [*CSV, "--set", "Kn=1"], "Kn is both set"),
    # times
    "step 0": (nothing, [*RUN, "--step", "0"], "step 0 s must be > 0"),
    "step negative": (nothing, [*RUN, "--step", "-1"], "step -1 s must be > 0"),
    "step NaN": (nothing, [*RUN, "--step", "nan"], "step nan s must be > 0"),
    "step of nothing": (nothing, [*RUN, "--step", "1e-320"], "step 1.*e-320"),
    "stop no multiple": (nothing, [*RUN, "--step", "0.015"], "0.02 s is no whole .* of 0.015 s"),
    "stop 0": (nothing, [*RUN, "--stop-time", "0"], "stop time 0 s must be after"),
    "stop infinite": (nothing, [*RUN, "--stop-time", "inf"], "stop time inf s"),
    # options that would do nothing
    "live documentation": (
        nothing, ["build", "-o", "a.fmu", "--no-live-documentation"], "without --native",
    ),
    "mesh folder of the arm": (nothing, ["build", "-o", "a.fmu", "--mesh-dir", "."], "without a U"),
    "mesh folder and no meshes": (
        text("arm.urdf", urdf()), [*BUILD, "--mesh-dir", ".", "--no-meshes"],
        "--no-meshes does nothing beside --mesh-dir",
    ),
    "storage of no bag": (nothing, ["publish", "arm.fmu", "--storage", "mcap"], "without -o"),
    "fsync of no bag": (nothing, ["publish", "arm.fmu", "--fsync"], "--fsync .* without -o"),
    "port of no Foxglove": (
        nothing, ["publish", "arm.fmu", "--foxglove-port", "0"], "without --foxglove$",
    ),
    "seed of no draws": (
        nothing, ["sweep", "arm.fmu", "--grid", "Kp=1:2:2", "--seed", "0"], "without --random",
    ),
    "workers and a scheduler": (
        nothing, ["sweep", "arm.fmu", "--workers", "1", "--scheduler", "tcp://a"],
        "--workers does nothing beside --scheduler",
    ),
    "port of a file": (
        nothing, ["view", "bag", "--export", "a.html", "--port", "0"], "beside --export",
    ),
    "two robots of one name": (
        nothing, ["publish", "a=arm.fmu", "a=arm.fmu", "-o", "z"], "two robots are 'a'",
    ),
    "a robot without its name": (
        nothing, ["publish", "=arm.fmu", "b=arm.fmu"], "'=arm.fmu' names no robot",
    ),
    "a robot's name alone": (nothing, ["publish", "left="], "'left=' names no FMU"),
    # the bag
    "bag exists": (a_bag, [*RUN, "-o", "bag"], "'bag' exists already.*--overwrite"),
    "bag is a file": (text("bag", "x"), [*RUN, "-o", "bag"], "'bag' exists already"),
    "folder that is no bag, --overwrite": (
        lambda folder: (folder / "bag").mkdir(), [*RUN, "-o", "bag", "--overwrite"],
        "'bag' is not a bag",
    ),
    "file, --overwrite": (
        text("bag", "x"), [*RUN, "-o", "bag", "--overwrite"], "'bag' is not a bag",
    ),
    "bag below a file": (text("file", "x"), [*RUN, "-o", "file/bag"], "'file/bag'.*Not a dir"),
    "bag with too long a name": (nothing, [*RUN, "-o", LONG], f"'{LONG}'.*too long"),
    "symbolic link to a bag, --overwrite": (
        a_linked_bag,
        [*RUN, "-o", "link", "--overwrite"], "'link'",
    ),
    "stamp negative": (nothing, [*RUN, "--stamp-start", "-1"], "stamp_start = -1 s"),
    "stamp NaN": (nothing, [*RUN, "--stamp-start", "nan"], "stamp.*nan"),
    "stamp infinite": (nothing, [*RUN, "--stamp-start", "inf"], "stamp.*inf"),
    "stamp too late": (nothing, [*RUN, "--stamp-start", "2147483648"], "stamp_start = 2"),
    "stamp too late at the end": (
        nothing, [*RUN, "--stamp-start", "2147483647", "--stop-time", "2"], "stamp",
    ),
    "info of a folder": (nothing, ["info", "."], r"cannot read the bag '\.'"),
    "info of a bag's file": (text("a.db3", "x"), ["info", "a.db3"], "give the bag's folder"),
    "info of a file that is no bag": (
        text("a.mcap", "x"), ["info", "a.mcap"], "cannot read the bag 'a.mcap'"
    ),
    "info of too long a name": (nothing, ["info", LONG], f"'{LONG}'.*too long"),
}  # fmt: skip


@pytest.mark.parametrize(("make", "arguments", "culprit"), BAD.values(), ids=BAD)
def test_bad_input_gets_one_line_and_leaves_nothing(
    make: Callable[[Path], None],
    arguments: list[str],
    culprit: str,
    folder: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    make(folder)
    before = listing(folder.parent)
    status = main(arguments)
    out, err = capfd.readouterr()
    assert status not in (0, None)
    assert out == ""
    assert len(err.splitlines()) == 1, err
    assert err.startswith("twodof: error: ")
    assert re.search(culprit, err), err
    assert listing(folder.parent) == before
    assert not Path("/tmp/twodof_evil").exists()


REFUSED_BY_THE_FMU = {
    "q_min > q_max": (["--set", "q_min=1", "--set", "q_max=0"], r"q_min\[1\] = 1 > q_max\[1\] = 0"),
    "rtol 0": (["--set", "rtol=0"], "rtol = 0 must be > 0"),
    "max_step negative": (["--set", "max_step=-1"], "max_step = -1"),
}


@pytest.mark.parametrize(
    ("settings", "culprit"), REFUSED_BY_THE_FMU.values(), ids=REFUSED_BY_THE_FMU
)
def test_parameter_that_the_fmu_refuses_leaves_no_bag(
    settings: list[str], culprit: str, folder: Path
) -> None:
    before = listing(folder)
    done = twodof_command(*RUN, *settings, cwd=folder)
    assert done.returncode == 1
    assert done.stdout == ""
    assert re.fullmatch(f"twodof: error: .*{culprit}.*\n", done.stderr), done.stderr
    assert listing(folder) == before


def test_bad_input_in_a_process_of_its_own(folder: Path) -> None:
    done = twodof_command(*RUN, "--set", "Kpp=1", cwd=folder)
    expected = "twodof: error: there is no variable 'Kpp'; did you mean 'Kp'?\n"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", expected)


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        ([], "VERB"),
        (["fly"], "fly"),
        (["run", "--step", "small"], "--step.*small"),
        (["run", "--storage", "db3"], "--storage.*db3"),
        (["build", "--gravity", "0", "1"], "--gravity"),
        (["info"], "FMU|BAG"),
        *(
            ([verb, option, ""], f"argument {option}: it is empty")
            for verb, option in (
                ("run", "-o"), ("publish", "-o"), ("sweep", "-o"), ("page", "-o"), ("live", "-o"),
                ("view", "--export"), *product(("run", "publish", "layouts", "page"), ["--frame"]),
                *product(("plot", "view"), ("--frame", "--urdf")), ("build", "--frame"),
            )
        ),
    ],
)  # fmt: skip
def test_bad_command_line_is_refused_with_status_2(
    arguments: list[str], culprit: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    err = capfd.readouterr().err
    assert end.value.code == 2
    assert re.search(f"twodof.*: error: .*{culprit}", err.splitlines()[-1])


def test_refused_build_keeps_the_file_that_was_there(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (folder / "arm.urdf").write_text(urdf(kind="planar"))
    (folder / "new.fmu").write_bytes(b"before")
    assert main(BUILD) == 1
    assert (folder / "new.fmu").read_bytes() == b"before"
    assert "'planar'" in capfd.readouterr().err


@pytest.mark.parametrize("provenance", ["{}", '{"robot": "x"}', "[]", "1"])
def test_info_of_a_bag_with_a_run_json_of_another_tool(
    provenance: str, bag_path: Path, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(bag_path, folder / "bag")
    (folder / "bag/run.json").write_text(provenance)
    assert main(["info", "bag"]) == 0
    assert "6 joint states" in capfd.readouterr().out


HOSTILE = "\x1b]0;title\x07 \x9b2J \x1b[31m"
"""Commands to a terminal, which some carry out whoever printed them."""


def test_text_of_a_bag_is_no_command_to_the_terminal(
    native_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "bag"
    twodof.simulate(native_path, twodof.Bag(bag), stop_time=0.02)
    provenance = json.loads((bag / "run.json").read_text())
    provenance["command_line"] = provenance["fmu"]["name"] = HOSTILE
    (bag / "run.json").write_text(json.dumps(provenance))
    assert main(["info", str(bag)]) == 0
    assert main(["info", str(tmp_path / HOSTILE)]) == 1
    logging.getLogger("twodof").warning("mesh '%s' is left out", HOSTILE)
    out, err = capsys.readouterr()
    assert out.count(r"\x1b[31m") == 2 and err.count(r"\x1b[31m") >= 1
    assert all(c.isprintable() or c == "\n" for c in out + err)
    assert main(["info", str(bag), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["command_line"] == HOSTILE


@pytest.mark.parametrize("kept", [0, 10, 300])
def test_info_of_a_truncated_bag_is_refused(
    kept: int, bag_path: Path, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(bag_path, folder / "bag")
    file = folder / "bag/bag.mcap"
    file.write_bytes(file.read_bytes()[:kept])
    assert main(["info", "bag"]) == 1
    assert re.fullmatch("twodof: error: .*'bag'.*\n", capfd.readouterr().err)


def test_damaged_default_fmu_is_built_again(
    folder: Path, fmu_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (folder / "TwoDof.fmu").write_bytes(damaged(fmu_path.read_bytes()))
    assert main(["run", "--stop-time", "0.01", "-o", "bag"]) == 0
    assert (folder / "TwoDof.fmu").read_bytes() == fmu_path.read_bytes()
    assert capfd.readouterr().err == ""


# --- what works ---


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What a user sees who builds, runs and looks, each in a process of its own."""
    cwd = tmp_path_factory.mktemp("session")
    outputs = {"cwd": str(cwd)}
    for name, line in {
        "build": "build",
        "run": "run TwoDof.fmu -o bag --stop-time 1.5 --set Kp=80 --stamp-start 1000",
        "info bag": "info bag",
        "info fmu": "info TwoDof.fmu",
    }.items():
        done = twodof_command(*line.split(), cwd=cwd)
        assert (done.returncode, done.stderr) == (0, "")
        outputs[name] = done.stdout
    return outputs


def rows(output: str) -> dict[str, str]:
    """The labelled rows of an output's first paragraph."""
    first, _, _ = output.partition("\n\n")
    return dict(re.split(r"  +", line, maxsplit=1) for line in first.splitlines())


def test_build_says_what_it_built_and_what_to_do_next(session: dict[str, str]) -> None:
    found = rows(session["build"])
    size = (Path(session["cwd"]) / "TwoDof.fmu").stat().st_size / 1024
    assert found["FMU"] == f"TwoDof.fmu ({size:.0f} KB, linux64)"
    assert found["robot"] == "2dof: joint1, joint2"
    assert found["controlled"] == "EndEffector, axes x y of world; task control"
    assert "twodof run TwoDof.fmu" in session["build"].partition("\nnext\n")[2]


def test_run_leaves_the_messages_that_it_promises(session: dict[str, str]) -> None:
    found = rows(session["run"])
    bag = twodof.read_bag(Path(session["cwd"]) / "bag")
    promised = re.fullmatch(r"bag \((\d+) messages on /joint_states, mcap\)", found["bag"])
    assert promised is not None
    assert int(promised[1]) == len(bag.t) == bag.topics[0].count == 151
    assert found["FMU"] == "TwoDof.fmu"
    assert bag.stamps[0] == 1000 * 10**9


def test_run_says_how_far_the_end_effector_is_from_its_target(session: dict[str, str]) -> None:
    found = rows(session["run"])["end effector"]
    promised = re.fullmatch(r"(\S+) m from its target \(0.2, 0.05\) m", found)
    assert promised is not None
    (last,) = twodof.read_bag(Path(session["cwd"]) / "bag").q[-1:]
    a, b = last[0], last[0] + last[1]
    x = (0.15 * (math.cos(a) + math.cos(b)), 0.15 * (math.sin(a) + math.sin(b)))
    assert float(promised[1]) == pytest.approx(math.dist(x, (0.2, 0.05)), rel=5e-3)


def test_run_says_how_fast_it_was_and_what_to_do_next(session: dict[str, str]) -> None:
    timing = re.fullmatch(
        r"1\.5 s simulated in ([\d.]+) s, ([\d.]+) × real time", rows(session["run"])["time"]
    )
    assert timing is not None
    assert float(timing[2]) == pytest.approx(1.5 / float(timing[1]), rel=0.1)
    following = session["run"].partition("\nnext\n")[2]
    assert [line.strip() for line in following.splitlines()] == [
        "twodof plot bag", "twodof view bag", "ros2 bag play bag",
    ]  # fmt: skip


def test_info_of_a_bag_shows_what_is_in_it(session: dict[str, str]) -> None:
    found = rows(session["info bag"])
    bag = twodof.read_bag(Path(session["cwd"]) / "bag")
    assert found["joints"] == "joint1, joint2"
    assert found["duration"] == "1.5 s, 151 joint states, 100 Hz"
    assert found["first stamp"] == "1000.000000000 s"
    assert found["first state"] == "q = (0.5, 0.35), v = (0, 0)"
    assert found["last state"].startswith(f"q = ({bag.q[-1, 0]:.6g}, {bag.q[-1, 1]:.6g}), v = (")
    assert found["made by"].endswith("run TwoDof.fmu -o bag --stop-time 1.5 --set Kp=80"
                                     " --stamp-start 1000")  # fmt: skip
    topics = session["info bag"].partition("\n\n")[2].split()
    assert topics == ["/joint_states", "151", "sensor_msgs/msg/JointState"]


def test_info_of_an_fmu_shows_what_is_in_it(session: dict[str, str]) -> None:
    found = rows(session["info fmu"])
    assert found["digest"] == twodof.load_fmu(Path(session["cwd"]) / "TwoDof.fmu").guid
    assert found["platforms"] == "linux64"
    assert found["joints"] == "joint1, joint2"
    for capability in ("canGetAndSetFMUstate", "canSerializeFMUstate", "needsExecutionTool"):
        assert capability in found["capabilities"]
    table = session["info fmu"].partition("\n\n")[2]
    for line in (
        r"x_des\[2\] +m +0\.2, 0\.05 +input",
        r"tau\[2\] +N\.m +output",
        r"q_min\[2\] +rad +-3\.14159, -3\.14159 +parameter",
        r"gravity\[3\] +m/s2 +0, -9\.81, 0 +parameter",
        r"limit_effort +false +parameter",
    ):
        assert re.search(f"^{line}$", table, re.MULTILINE), line


def test_default_run_builds_the_fmu_again_only_if_it_differs(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    fmu_file = folder / "TwoDof.fmu"

    def run(bag: str) -> int:
        assert main(["run", "--stop-time", "0.01", "-o", bag]) == 0
        return fmu_file.stat().st_mtime_ns

    first, content = run("one"), fmu_file.read_bytes()
    assert run("two") == first
    assert main(["build", "--q-start", "0.1", "0.2"]) == 0
    assert fmu_file.read_bytes() != content
    assert run("three") > first
    assert fmu_file.read_bytes() == content
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_overwrite_replaces_a_bag(
    storage: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main([*RUN, "-o", "bag"]) == 0
    assert (
        main([*RUN, "-o", "bag", "--overwrite", "--stop-time", "0.04", "--storage", storage]) == 0
    )
    assert len(twodof.read_bag("bag").t) == 5
    assert capfd.readouterr().err == ""


def test_bag_without_a_name_is_named_after_the_date(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "arm.fmu", "--stop-time", "0.01"]) == 0
    (bag,) = (path for path in folder.iterdir() if path.is_dir())
    assert re.fullmatch(r"rosbag2_\d{4}(_\d\d){2}-\d\d(_\d\d){2}", bag.name)
    assert bag.name in capfd.readouterr().out


def test_a_second_bag_of_the_same_second_has_a_name_of_its_own(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "strftime", lambda form: form.partition("%")[0] + "now")
    for _ in range(3):
        assert main(["run", "arm.fmu", "--stop-time", "0.01"]) == 0
    bags = {path.name for path in folder.iterdir() if path.is_dir()}
    assert bags == {"rosbag2_now", "rosbag2_now-2", "rosbag2_now-3"}


def test_a_start_outside_the_limits_is_told_when_it_is_built(folder: Path) -> None:
    for control in ("task", "effort"):
        command = ["build", "-o", "far.fmu", "--q-start", "9", "0", "--control", control]
        done = twodof_command(*command, cwd=folder)
        (line,) = done.stderr.splitlines()
        assert re.match(r"WARNING: q_start\[1\] = 9 of joint 'joint1' is outside its lim", line)


def test_controls_are_told_in_the_words_of_the_options(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main([*RUN, "--set", "quat_des=1"]) == 1
    told = "it is of control 'task --orientation'; this FMU has control 'task'\n"
    assert capfd.readouterr().err.endswith(told)
    for command in (["build", "--orientation", "-o", "six.fmu"], ["info", "six.fmu"]):
        assert main(command) == 0
        of = rows(capfd.readouterr().out)["controlled"]
        assert of == "EndEffector, axes x y of world; task control with --orientation"


def test_bag_remembers_the_arguments_of_its_command(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(RUN) == 0
    command = twodof.read_bag("out").provenance["command_line"]
    assert command == "twodof run arm.fmu -o out --stop-time 0.02"


def test_warnings_of_the_robot_and_the_fmu_are_shown(folder: Path) -> None:
    done = twodof_command(*RUN, "--set", "q_start=9,0", cwd=folder)
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert re.match(r"WARNING: q_start\[1\] = 9 of joint 'joint1' is outside", line)


# --- output that nobody reads ---


@pytest.mark.parametrize("line", ["info arm.fmu", "--help", "run arm.fmu -o bag --stop-time 0.01"])
def test_reader_that_leaves_early_gets_no_traceback(line: str, folder: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    process = subprocess.Popen(
        [*COMMAND, *line.split()], cwd=folder, env=ENVIRONMENT, stdout=writing,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    os.close(writing)
    _, err = process.communicate(timeout=120)
    assert err == ""


@pytest.mark.parametrize("output", ["/dev/full", None])
def test_output_that_cannot_be_written_gives_no_traceback(output: str | None, folder: Path) -> None:
    redirect = f">{output}" if output else ">&-"
    done = subprocess.run(
        ["sh", "-c", f'"$0" "$@" {redirect}', *COMMAND, "info", "arm.fmu"],
        cwd=folder, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, timeout=120,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) <= 1


@pytest.mark.parametrize("verb", ["", "build", "run", "info"])
def test_help_of_each_verb_says_what_there_is(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main([*filter(None, [verb]), "--help"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: twodof{' ' * bool(verb)}{verb}")
    options = {
        "": ["build", "run", "info", "--version"],
        "build": ["--urdf", "--mesh-dir", "--frame", "--axes", "--gravity", "--q-start", "--name"],
        "run": ["-o", "--stop-time", "--step", "--set", "--input", "--storage", "--scene",
                "--effort", "--stamp-start", "--overwrite", "--realtime"],
        "info": ["FMU|BAG"],
    }  # fmt: skip
    assert [option for option in options[verb] if option not in out] == []


def test_a_run_replaces_no_file_that_is_no_fmu(
    folder: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """By the name that it chooses itself; and tells where it was another FMU."""
    (folder / "robot.urdf").write_text(urdf())
    (folder / "robot-native.fmu").write_text("notes")
    run = ["run", "robot.urdf", "--native", "--stop-time", "0.1", "-o", "bag", "--overwrite"]
    assert main(run) == 1
    assert "'robot-native.fmu' is no FMU, and is not replaced" in capfd.readouterr().err
    assert (folder / "robot-native.fmu").read_text() == "notes"
    (folder / "robot-native.fmu").unlink()
    assert main([*run]) == main([*run]) == 0
    assert "replaced" not in caplog.text
    (folder / "robot.urdf").write_text(urdf().replace('upper="1"', 'upper="2"'))
    assert main([*run]) == 0
    assert "'robot-native.fmu' was another FMU, and is replaced" in caplog.text
