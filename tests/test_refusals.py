"""Invalid input gets one line that names the culprit, and leaves nothing."""

import json
import logging
import os
import re
import shutil
import stat
import zipfile
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest
from tools import needs

import twodof
from twodof.cli.main import main

EMPTY_ZIP = b"PK\x05\x06" + bytes(18)


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Sizes and times of all that is below a folder."""
    entries = {}
    for path in folder.rglob("*"):
        state = path.lstat()
        changed = 0 if stat.S_ISDIR(state.st_mode) else state.st_mtime_ns
        entries[str(path.relative_to(folder))] = (state.st_size, changed)
    return entries


@pytest.fixture(scope="module")
def bag_path(fmu_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / "bag"
    twodof.simulate(fmu_path, twodof.Bag(path), stop_time=0.05)
    return path


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
    kind: str = "CoSimulation",
    outputs: tuple[str, ...] = ("q[1]", "v[1]"),
    causality: str = "output",
    head: str = "",
) -> str:
    """A minimal third-party modelDescription.xml."""
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
        f'<fmiModelDescription fmiVersion="2.0" modelName="m" guid="g">'
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


def damaged(content: bytes) -> bytes:
    """A zip archive with invalid compressed data of the description."""
    at = content.index(b"modelDescription.xml") + len("modelDescription.xml")
    return content[:at] + b"\xff" * 40 + content[at + 40 :]


def swollen(content: bytes) -> bytes:
    """A zip archive whose directory states 4 GB for each entry."""
    entry = re.compile(rb"(PK\x01\x02.{20})....", re.DOTALL)
    return entry.sub(lambda match: match[1] + b"\xfe\xff\xff\xff", content)


def encrypted(content: bytes) -> bytes:
    """A zip archive whose entries are marked as encrypted."""
    head = re.compile(rb"(PK\x03\x04..|PK\x01\x02....)\x00", re.DOTALL)
    return head.sub(lambda match: match[1] + b"\x01", content)


def text(name: str, content: str | bytes) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content

    def make(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return make


def fmu(
    xml: str, *more: str, binary: str = "linux64/m.so", link: str = "", change: Callable[..., bytes] = bytes
) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        with zipfile.ZipFile(folder / "bad.fmu", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", xml)
            for name in (f"binaries/{binary}", *more):
                archive.writestr(name, b"content")
            if link:
                entry = zipfile.ZipInfo(link)
                entry.external_attr = (stat.S_IFLNK | 0o777) << 16
                archive.writestr(entry, "/etc/passwd")
        (folder / "bad.fmu").write_bytes(change((folder / "bad.fmu").read_bytes()))

    return make


def nothing(folder: Path) -> None:
    del folder


def a_bag(folder: Path) -> None:
    (folder / "bag").mkdir()
    (folder / "bag/metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 8\n")


def a_link_to_itself(folder: Path) -> None:
    (folder / "link").symlink_to("link")


BUILD = ["build", "-o", "new.fmu", "--frame", "a", "--urdf", "arm.urdf"]
RUN = ["run", "arm.fmu", "-o", "out", "--stop-time", "0.02"]
RUN_BAD = ["run", "bad.fmu", "-o", "out"]
INFO = ["info", "bad.fmu"]
CSV = [*RUN, "--input", "in.csv"]
LONG = "x" * 300

Case = tuple[Callable[[Path], None], list[str], str]
BAD: dict[str, Case] = {
    # build
    "URDF no XML": (text("arm.urdf", "a: 1"), BUILD, "arm.urdf: the URDF is not XML"),
    "URDF no text": (text("arm.urdf", b"\xff\x00"), BUILD, "'arm.urdf' is not UTF-8"),
    "URDF with NUL": (text("arm.urdf", urdf(mesh="a\0b.stl")), BUILD, "mesh 'a.*b.stl'|the URDF is not XML"),
    "URDF with entities": (text("arm.urdf", '<!DOCTYPE robot [<!ENTITY a "b">]>' + urdf()), BUILD, "document type"),
    "joint type": (text("arm.urdf", urdf(kind="planar")), BUILD, "'j' is of type 'planar'"),
    "no mass": (text("arm.urdf", urdf(link='<link name="a"/>')), BUILD, "'j': .*no mass .*--lock"),
    "negative mass": (
        text("arm.urdf", urdf(link=GOOD_LINK.replace('value="1"', 'value="-1"'))),
        BUILD,
        "'a': negative mass -1",
    ),
    "inertia not physical": (
        text("arm.urdf", urdf(link=GOOD_LINK.replace('ixx="1"', 'ixx="-9"'))),
        BUILD,
        "'a': its in",
    ),
    "inertia missing": (text("arm.urdf", urdf(link=re.sub("<inertia .*?/>", "", GOOD_LINK))), BUILD, "link 'a'"),
    "q-start NaN": (nothing, ["build", "--q-start", "nan", "0"], "q_start.*nan.* finite"),
    "name that leaves the folder": (nothing, ["build", "--name", "../x"], "name '../x'"),
    "output below a file": (text("file", "x"), ["build", "-o", "file/x.fmu"], "cannot write 'file/x.fmu': Not a direc"),
    "output a folder": (nothing, ["build", "-o", "."], "cannot write '.'"),
    # an FMU
    "FMU no zip": (text("bad.fmu", "FMU"), RUN_BAD, "'bad.fmu' is not an FMU: .*not a zip"),
    "FMU empty zip": (text("bad.fmu", EMPTY_ZIP), RUN_BAD, "'bad.fmu' .*no modelDescription.xml"),
    "FMU damaged": (fmu(description(), change=damaged), RUN_BAD, "'bad.fmu'"),
    "FMI 1.0": (fmu(FMI1), RUN_BAD, "'bad.fmu' is FMI 1.0 .*FMI 2.0"),
    "FMI 3.0": (fmu(FMI3), RUN_BAD, "'bad.fmu' is FMI 3.0 .*FMI 2.0 or 3.0 co-simulation"),
    "FMU encrypted": (fmu(description(), change=encrypted), RUN_BAD, "'bad.fmu'.*encrypted"),
    "model exchange": (fmu(description(kind="ModelExchange")), RUN_BAD, "'bad.fmu' is FMI 2.0 model exchange"),
    "description no XML": (fmu("<fmiModel"), RUN_BAD, "'bad.fmu': modelDescription.xml is not val"),
    "description not of the schema": (
        fmu(description().replace("modelName", "title")),
        RUN_BAD,
        "'bad.fmu'.*(title|modelName)",
    ),
    "description with a DTD, info": (
        fmu(description(head='<!DOCTYPE x SYSTEM "/etc/passwd">')),
        INFO,
        "declares entities",
    ),
    "no binary for this platform": (
        fmu(description(), binary="win64/m.dll"),
        RUN_BAD,
        r"no binary for this platform \(linux64\), only for: win64",
    ),
    "binary that is none": (fmu(description()), RUN_BAD, "'bad.fmu' cannot be loaded"),
    "no outputs q": (fmu(description(outputs=("y",))), RUN_BAD, r"no outputs q\[1\]"),
    "fewer v than q": (fmu(description(outputs=("q[1]", "q[2]", "v[1]"))), RUN_BAD, r"no outputs q\[1\]"),
    "q and v not outputs": (fmu(description(causality="local")), INFO, r"no outputs q\[1\]"),
    "q and v not Real": (
        fmu(description().replace("<Real/>", "<Integer/>").replace("continuous", "discrete")),
        INFO,
        r"no outputs q\[1\]",
    ),
    "joints of another number": (
        fmu(description().replace("<ModelVariables>", VENDOR_JOINTS + "<ModelVariables>")),
        INFO,
        "'bad.fmu' names 2 joints but has 1 outputs",
    ),
    "zip slip": (fmu(description(), "../evil"), RUN_BAD, "unsafe: its member '../evil' is outside"),
    "zip slip below": (fmu(description(), "resources/../../evil"), RUN_BAD, "unsafe: .*evil"),
    "zip slip of Windows": (fmu(description(), "..\\evil"), RUN_BAD, "unsafe: .*evil"),
    "absolute member": (fmu(description(), "/tmp/twodof_evil"), RUN_BAD, "unsafe: .*'/tmp/twodof_"),
    "symbolic link": (fmu(description(), link="resources/link"), RUN_BAD, "unsafe: its member 'resources/link'"),
    "zip bomb": (fmu(description(), change=swollen), RUN_BAD, "unsafe: unzipped it exceeds"),
    # settings
    "--set with a line break": (nothing, [*RUN, "--set", "K\np=1"], "no variable 'K.*p'"),
    # inputs over time
    "CSV with a line break": (text("in.csv", 'time,Kn\n1,"a\nb"'), CSV, "'in.csv' row 2: Kn = 'a"),
    # the bag
    "bag exists": (a_bag, [*RUN, "-o", "bag"], "'bag' exists already.*--overwrite"),
    "bag is a file": (text("bag", "x"), [*RUN, "-o", "bag"], "'bag' exists already"),
    "folder that is not a bag, --overwrite": (
        lambda folder: (folder / "bag").mkdir(),
        [*RUN, "-o", "bag", "--overwrite"],
        "'bag' is not a bag",
    ),
    "file, --overwrite": (text("bag", "x"), [*RUN, "-o", "bag", "--overwrite"], "'bag' is not a bag"),
    "symbolic link to itself, --overwrite": (a_link_to_itself, [*RUN, "-o", "link", "--overwrite"], "link'"),
    "stamp negative": (nothing, [*RUN, "--stamp-start", "-1"], "stamp_start = -1 s"),
    "info of a folder": (nothing, ["info", "."], r"'\.' is not a bag: it is a folder"),
    "info of a bag's file": (text("a.db3", "x"), ["info", "a.db3"], "give the bag's folder"),
    "info of a file that is not a bag": (text("a.mcap", "x"), ["info", "a.mcap"], "cannot read the bag 'a.mcap'"),
    "info of too long a name": (nothing, ["info", LONG], f"'{LONG}'.*too long|no FMU, bag or sweep '{LONG}'"),
}


@pytest.mark.parametrize(("make", "arguments", "culprit"), BAD.values(), ids=BAD)
def test_bad_input_gets_one_line_and_leaves_nothing(make, arguments, culprit, folder, capfd):
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


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        ([], "there is no verb; begin with"),
        (["help", "nothing"], "nothing"),
        (["info"], "FMU|BAG"),
        (["run", "--stop-time", "inf"], "stop time inf s"),
        (["run", "arm.fmu", "--native"], "leave it out with an FMU"),
        (["run", "--frame", "a"], "--frame applies to a URDF"),
        (["build", "--scalars"], "--scalars needs --native --fmi 3"),
        (["build", "--orientation", "--control", "joint"], "--orientation needs"),
        (["build", "a.urdf", "--urdf", "b"], "given twice"),
        (["build", "--mesh-dir", "."], "without a URDF"),
        (["build", "arm.urdf", "--mesh-dir", ".", "--no-meshes"], "--no-meshes has no effect with --mesh-dir"),
        (["publish", "--rate", "0"], "--rate 0"),
        (["publish", "arm.fmu", "--storage", "mcap"], "--storage has no effect without -o"),
        (["publish", "arm.fmu", "--fsync"], "--fsync has no effect without -o"),
        (["publish", "arm.fmu", "--foxglove-port", "0"], "without --foxglove$"),
        (["publish", "a=arm.fmu", "a=arm.fmu", "-o", "z"], "two robots are named 'a'"),
        (["publish", "=arm.fmu", "b=arm.fmu"], "'=arm.fmu' names no robot"),
        (["publish", "left="], "'left=' names no FMU"),
        (["sweep", "arm.fmu", "--grid", "Kp=1:2:2", "--seed", "0"], "without --random"),
        (["sweep", "arm.fmu", "--workers", "1", "--scheduler", "tcp://a"], "--workers has no effect with --scheduler"),
        (["view", "bag", "--export", "a.html", "--port", "0"], "no effect with --export"),
        *(
            ([verb, option, ""], f"argument {option}: it is empty")
            for verb, option in (
                ("run", "-o"),
                ("publish", "-o"),
                ("sweep", "-o"),
                ("page", "-o"),
                ("live", "-o"),
                ("view", "--export"),
                *product(("run", "publish", "layouts", "page"), ["--frame"]),
                *product(("plot", "view"), ("--frame", "--urdf")),
                ("build", "--frame"),
            )
        ),
    ],
)
def test_a_wrong_command_line_is_status_2(arguments, culprit, folder, capsys):
    if "publish" in arguments:
        needs("cyclonedds")
    before = listing(folder)
    try:
        status: object = main(arguments)
    except SystemExit as end:
        status = end.code
    assert status == 2
    assert re.search(f"twodof.*: error: .*{culprit}", capsys.readouterr().err.splitlines()[-1])
    assert listing(folder) == before


def test_refused_build_keeps_the_file_that_was_there(folder, capfd):
    (folder / "arm.urdf").write_text(urdf(kind="planar"))
    (folder / "new.fmu").write_bytes(b"before")
    assert main(BUILD) == 1
    assert (folder / "new.fmu").read_bytes() == b"before"
    assert "'planar'" in capfd.readouterr().err


@pytest.mark.parametrize("provenance", ["{}", '{"robot": "x"}', "[]", "1"])
def test_info_of_a_bag_with_a_run_json_of_another_tool(provenance, bag_path, folder, capfd):
    shutil.copytree(bag_path, folder / "bag")
    (folder / "bag/run.json").write_text(provenance)
    assert main(["info", "bag"]) == 0
    assert "6 joint states" in capfd.readouterr().out


HOSTILE = "\x1b]0;title\x07 \x9b2J \x1b[31m"
"""Commands to a terminal, which some carry out whoever printed them."""


def test_text_of_a_bag_is_no_command_to_the_terminal(bag_path, tmp_path, capsys):
    bag = tmp_path / "bag"
    shutil.copytree(bag_path, bag)
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


def test_damaged_default_fmu_is_built_again(folder, fmu_path, capfd):
    (folder / "TwoDof.fmu").write_bytes(damaged(fmu_path.read_bytes()))
    assert main(["run", "--stop-time", "0.01", "-o", "bag"]) == 0
    assert (folder / "TwoDof.fmu").read_bytes() == fmu_path.read_bytes()
    said = "no FMU is named: using TwoDof.fmu, the default planar arm\n"
    assert capfd.readouterr().err == said


OTHER = 65534
OWNERS = {  # mode, owner and group of the folder, then of the FMU; whether it is run
    "own": ((0o755, 0, 0), (0o644, 0, 0), True),
    "of the own group": ((0o775, 0, 0), (0o664, 0, 0), True),
    "own, in a folder such as /tmp": ((0o1777, 0, 0), (0o644, 0, 0), True),
    "of another user in a folder such as /tmp": ((0o1777, 0, 0), (0o644, OTHER, OTHER), False),
    "in a folder that all may write": ((0o777, 0, 0), (0o644, 0, 0), False),
    "in a folder that another group may write": ((0o775, 0, OTHER), (0o644, 0, 0), False),
    "in a folder of another user": ((0o755, OTHER, OTHER), (0o644, 0, 0), False),
    "that all may write": ((0o755, 0, 0), (0o666, 0, 0), False),
}


@pytest.mark.needs("root")
@pytest.mark.parametrize(("of_folder", "of_fmu", "runs"), OWNERS.values(), ids=OWNERS)
def test_an_fmu_that_others_could_replace_after_its_check_is_not_run(of_folder, of_fmu, runs, folder, fmu_path, capsys):
    shutil.copy(fmu_path, folder / "TwoDof.fmu")
    for path, (mode, owner, group) in {folder: of_folder, folder / "TwoDof.fmu": of_fmu}.items():
        os.chown(path, owner, group)
        path.chmod(mode)
    assert main(["run", "--stop-time", "0.01", "-o", "bag"]) == (0 if runs else 2)
    assert ("other users can change or replace" in capsys.readouterr().err) != runs
    assert (folder / "bag").exists() == runs


@pytest.mark.needs("root")
def test_an_fmu_behind_a_link_of_another_user_is_not_run(folder, fmu_path):
    folder.chmod(0o1777)
    (folder / "TwoDof.fmu").symlink_to(fmu_path)
    os.lchown(folder / "TwoDof.fmu", OTHER, OTHER)
    assert main(["run", "--stop-time", "0.01", "-o", "bag"]) == 2
    assert not (folder / "bag").exists()


def test_an_fmu_in_the_place_of_the_default_arms_is_asked_for_by_name(folder, native_path, capfd):
    """There may be other FMUs; only those that `run` accepts are suggested."""
    assert main(["build", "--control", "effort", "--no-meshes", "-o", "TwoDof.fmu"]) == 0
    before = (folder / "TwoDof.fmu").read_bytes()
    shutil.copy(native_path, folder / "other.fmu")
    capfd.readouterr()
    assert main(["run", "--stop-time", "0.01", "-o", "bag"]) == 2
    said = capfd.readouterr().err
    assert "type 'twodof run TwoDof.fmu' to use it" in said and "--overwrite" not in said
    assert (folder / "TwoDof.fmu").read_bytes() == before and not (folder / "bag").exists()


def test_a_run_replaces_no_file_that_is_not_its_own(folder, capfd):
    """Without --overwrite it replaces neither notes nor an FMU of another version of the URDF."""
    (folder / "robot.urdf").write_text(urdf())
    (folder / "robot.fmu").write_text("notes")
    run = ["run", "robot.urdf", "--stop-time", "0.1"]
    assert main([*run, "-o", "bag"]) == 1
    assert "'robot.fmu' is not an FMU, and is not replaced" in capfd.readouterr().err
    assert (folder / "robot.fmu").read_text() == "notes"
    (folder / "robot.fmu").unlink()
    assert main([*run, "-o", "first"]) == main([*run, "-o", "second"]) == 0
    before = (folder / "robot.fmu").read_bytes()
    (folder / "robot.urdf").write_text(urdf().replace('upper="1"', 'upper="2"'))
    assert main([*run, "-o", "third"]) == 1
    assert "'robot.fmu' is another FMU, and is not replaced" in capfd.readouterr().err
    assert (folder / "robot.fmu").read_bytes() == before and not (folder / "third").exists()
    assert main([*run, "-o", "third", "--overwrite"]) == 0
    assert (folder / "robot.fmu").read_bytes() != before


@pytest.mark.parametrize("verb", ["run", "page", "sweep --grid Kp=1:2:2"])
def test_the_only_fmu_of_a_folder_is_asked_for_by_name(verb, tmp_path, monkeypatch, capfd):
    """Another robot's FMU is not run without its name, nor replaced by the default arm's."""
    folder = tmp_path
    monkeypatch.chdir(folder)
    (folder / "robot.urdf").write_text(urdf())
    assert main(["build", "robot.urdf", "--control", "joint"]) == 0
    before = (folder / "robot.fmu").read_bytes()
    (folder / "TwoDof.fmu").write_bytes(before)
    (folder / "robot.fmu").unlink()
    capfd.readouterr()
    assert main(verb.split()) == 2
    name = verb.partition(" ")[0]
    assert f"type 'twodof {name} TwoDof.fmu' to use it" in capfd.readouterr().err
    assert [path.name for path in folder.glob("*.fmu")] == ["TwoDof.fmu"]
    assert (folder / "TwoDof.fmu").read_bytes() == before
