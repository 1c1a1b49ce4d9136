"""Malicious files: a command refuses them with one clear line, or reads them in bounded time and memory."""

import io
import os
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import mutations
import pytest
from jail import MIB, SPECIAL, Jail, refused, without_slow
from jail import jail as jail
from jail import the_jail as the_jail

import twodof
from twodof.errors import FmuError
from twodof.files import read_member

pytestmark = pytest.mark.long


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    without_slow(metafunc, HOSTILE, SLOW)


# --- special files ---


ANYWHERE = ("a pipe", "3 GB of zeros")  # the others one function refuses for all


@pytest.mark.parametrize(
    ("what", "kind"),
    [("fmu", kind) for kind in SPECIAL] + [(what, kind) for what in ("urdf", "csv", "mesh") for kind in ANYWHERE],
)
def test_a_file_beyond_the_limit_or_no_regular_file_is_refused(what, kind, jail, native_path):
    make, reason = SPECIAL[kind]
    path = jail.input / what
    make(path)
    (jail.input / "arm.urdf").write_text(robot(tip(inside=shapes(["mesh"]))))
    build = ["build", "-o", jail.target / "x.fmu", "--frame", "tip", "--urdf"]
    command = {
        "fmu": ["run", path, "-o", jail.target / "bag"],
        "urdf": [*build, path],
        "csv": ["run", native_path, "--input", path, "-o", jail.target / "bag"],
        "mesh": [*build, jail.input / "arm.urdf"],
    }
    refused(jail, f"mesh .*(not found|is outside of its folder|cannot be read)|{reason}", *command[what])


# --- FMUs ---

Q_AND_V = "".join(
    f'<ScalarVariable name="{name}[1]" valueReference="{i}" causality="output"'
    ' variability="continuous"><Real/></ScalarVariable>'
    for i, name in enumerate("qv")
)
LAUGHS = (
    "<!DOCTYPE r [<!ENTITY l0 'ha'>" + "".join(f"<!ENTITY l{i} '{f'&l{i - 1};' * 10}'>" for i in range(1, 10)) + "]>"
)
EXTERNAL = '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]>'


def description(head: str = "", notes: str = "", variables: str = "") -> str:
    """A third-party modelDescription.xml."""
    unknowns = '<Unknown index="1"/><Unknown index="2"/>'
    return (
        f'{head}<fmiModelDescription fmiVersion="2.0" modelName="m" guid="g">'
        f'<CoSimulation modelIdentifier="m"/><VendorAnnotations><Tool name="x">{notes}</Tool>'
        f"</VendorAnnotations><ModelVariables>{Q_AND_V}{variables}</ModelVariables>"
        f"<ModelStructure><Outputs>{unknowns}</Outputs>"
        f"<InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure></fmiModelDescription>"
    )


def variables(count: int) -> str:
    return "".join(f'<ScalarVariable name="a{i}" valueReference="{i}"><Real/></ScalarVariable>' for i in range(count))


def attributes(count: int) -> str:
    return f"<a {' '.join(f'a{i}=%r' % '' for i in range(count))}/>"


def external(encoding: str, declared: str = "") -> bytes:
    head = f'<?xml version="1.0" encoding="{declared or encoding}"?>{EXTERNAL}'
    return description(head, "&a;").encode(encoding)


def fmu_of(xml: str | bytes, *more: tuple[str, bytes, int, int]) -> bytes:
    """An FMU whose library cannot be loaded, which is the last refusal of a run."""
    content = {"modelDescription.xml": xml, "binaries/linux64/m.so": b"x"}
    members = []
    for name, value in content.items():
        data = value.encode() if isinstance(value, str) else value
        packer = zlib.compressobj(1, zlib.DEFLATED, -15)
        packed = packer.compress(data) + packer.flush()
        members.append((name, packed, len(data), zlib.crc32(data)))
    return mutations.raw_zip([*members, *more])


def bomb(name: str, declared: int) -> bytes:
    """An FMU with a member of 10 GB of zeros, whose size in the directory may be small."""
    zeros = mutations.deflated_zeros(10_000 * MIB)
    good = [] if name == "modelDescription.xml" else [description()]
    member = (name, zeros, declared, zlib.crc32(bytes(declared % 2**20)))
    return fmu_of(good[0], member) if good else mutations.raw_zip([member])


def many_members(count: int, size: int = 0) -> bytes:
    """An FMU whose members are all the same data."""
    zeros = mutations.deflated_zeros(size)
    crc = zlib.crc32(bytes(size))
    same = [(f"{i:x}", zeros, size, crc) for i in range(count)]
    return fmu_of(description(), *same)


def beside(content: str) -> bytes:
    """An FMU of FMI 3.0 with given content in its build description."""
    data = f'<fmiBuildDescription fmiVersion="3.0">{content}</fmiBuildDescription>'.encode()
    packer = zlib.compressobj(1, zlib.DEFLATED, -15)
    packed = packer.compress(data) + packer.flush()
    return fmu_of(arrays('start="2"'), ("sources/buildDescription.xml", packed, len(data), zlib.crc32(data)))


UNPLAIN = "declares entities or is not UTF-8"
UNLOADED = "cannot be loaded"
HOSTILE_FMUS: dict[str, tuple[Callable[[], bytes], str]] = {
    "a billion laughs": (lambda: fmu_of(description(LAUGHS, "&l9;")), UNPLAIN),
    "an external entity": (lambda: fmu_of(description(EXTERNAL, "&a;")), UNPLAIN),
    "UTF-16": (lambda: fmu_of(external("utf-16")), UNPLAIN),
    "UTF-7": (lambda: fmu_of(external("ascii", "utf-7").replace(b"<!", b"+ADwAIQ-")), UNPLAIN),
    "EBCDIC": (lambda: fmu_of(external("cp037")), UNPLAIN),
    "100,000 elements deep": (lambda: fmu_of(description(notes="<a>" * 100_000 + "</a>" * 100_000)), "not valid"),
    "100 MB of an attribute": (lambda: fmu_of(description(notes=f"<a b='{'x' * 100 * MIB}'/>")), "larger than"),
    "8 MB of variables": (lambda: fmu_of(description(variables=variables(105_000))), UNLOADED),
    "9,000 members": (lambda: many_members(9_000), "cannot unzip"),
    "10,000 members": (lambda: many_members(10_000), "more than 10000 files and folders"),
    "400 members in folders of their own": (
        lambda: fmu_of(description(), *((f"{i}/" * 30 + "x", b"\3\0", 0, 0) for i in range(400))),
        "more than 10000 files and folders",
    ),
    "a million members": (lambda: many_members(1_000_000), "Too many members"),
    "40 GB in members that overlap": (lambda: many_members(8000, 5 * MIB), "it exceeds"),
    "2 GB in members that overlap": (lambda: many_members(2000, MIB), "cannot unzip"),
    "10 GB of zeros": (lambda: bomb("resources/x", 2**32 - 1), "it exceeds"),
    "10 GB that are said to be 1 kB": (lambda: bomb("resources/x", 1000), UNLOADED),
    "10 GB of description": (lambda: bomb("modelDescription.xml", 1000), UNPLAIN),
    "12 million elements beside the description": (lambda: beside("<a/>" * 12_000_000), "no binary for this platform"),
    "two descriptions": (
        lambda: fmu_of(description(), ("modelDescription.xml", b"\3\0", 0, 0)),
        "two members 'modelDescription.xml'",
    ),
    "two descriptions of other names": (
        lambda: fmu_of(description(), (".//modelDescription.xml", b"\3\0", 0, 0)),
        "two members 'modelDescription.xml'",
    ),
    "no version": (lambda: fmu_of("<fmiModelDescription/>"), "it states no fmiVersion"),
    "900 folders deep": (lambda: fmu_of(description(), ("a/" * 900 + "b", b"\3\0", 0, 0)), "nested deeper"),
}


def test_hostile_fmu_is_refused(hostile_fmu, jail):
    make, reason = hostile_fmu
    path = jail.input / "x.fmu"
    path.write_bytes(make())
    jail.run("info", path)
    refused(jail, reason, "run", path, "-o", jail.target / "bag")
    jail.run("run", path, "-o", jail.target / "bag", "--scene")


def arrays(*dimensions: str, step: str = "0.01", aliases: int = 0, name: str = "q", more: str = "") -> str:
    """The modelDescription.xml of an FMU of FMI 3.0 whose output has given dimensions and a number of aliases."""
    output = ' causality="output" variability="continuous"'
    inside = "".join(f"<Dimension {dimension}/>" for dimension in dimensions)
    inside += "".join(f'<Alias name="q{i}"/>' for i in range(aliases))
    return (
        '<fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="g">'
        f'<CoSimulation modelIdentifier="m"/><DefaultExperiment stepSize="{step}"/><ModelVariables>'
        '<Float64 name="t" valueReference="0" causality="independent" variability="continuous"/>'
        '<UInt64 name="n" valueReference="9" causality="structuralParameter" variability="fixed"'
        f' start="1000000000"/><Float64 name="{name}" valueReference="1"{output}>{inside}</Float64>'
        f'<Float64 name="v" valueReference="2"{output}><Dimension start="2"/></Float64>'
        f"{more}</ModelVariables><ModelStructure/></fmiModelDescription>"
    )


TOO_MANY = "more than 50000 elements"
LONG_NAMES = "names of its arrays' elements have more than 8388608 characters"
ARRAYS = {
    "a billion": (arrays('start="1000000000"'), TOO_MANY),
    "2^64 - 1": (arrays('start="18446744073709551615"'), "a dimension whose size is unknown"),
    "of another variable": (arrays('valueReference="9"'), TOO_MANY),
    "of none": (arrays('valueReference="8"'), "a dimension whose size is unknown"),
    "a product": (arrays(*['start="300"'] * 2), TOO_MANY),
    "a billion times none": (arrays('start="0"', 'start="1000000000"'), TOO_MANY),
    "with an underscore": (arrays('start="2_0"'), "a dimension whose size is unknown"),
    "20,000 dimensions": (arrays('start="49000"', *['start="1"'] * 20_000), "more than 16 dimensions"),
    "40,000 names": (arrays('start="40000"', aliases=40_000), TOO_MANY),
    "300,000 names of a scalar": (arrays(aliases=300_000), TOO_MANY),
    "a name of 100,000 characters": (arrays('start="49000"', name="A" * 100_000), "has more than 1000 characters"),
    "49,000 names of 1000 characters": (arrays('start="49000"', name="A" * 1000), LONG_NAMES),
    "100,000 variables without a name": (arrays(more="<Float64/>" * 100_000), "'name' is required"),
    "as many as there may be": (arrays('start="49998"'), "names|to log|cannot be loaded"),
    "a step of 1e-300 s": (arrays('start="2"', step="1e-300"), "at least 1e-06 s"),
}


@pytest.mark.parametrize(("xml", "reason"), ARRAYS.values(), ids=ARRAYS)
def test_fmu_without_end_is_refused(xml, reason, jail):
    """Its arrays exceed every memory, or with its steps no run ends."""
    path = jail.input / "x.fmu"
    path.write_bytes(fmu_of(xml))
    jail.run("info", path)
    refused(jail, reason, "run", path, "-o", jail.target / "bag")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_fmu_compressed_as_fmi_does_not_allow_is_refused(method, jail):
    content = {"modelDescription.xml": description().encode(), "binaries/linux64/m.so": b"x"}
    path = jail.input / "x.fmu"
    path.write_bytes(mutations.zip_of(content, method=method))
    refused(jail, f"compressed by method {method}", "info", path)


MODULES_THAT_ARE_NONE = {
    "no such member": None,
    "no text": b"\xff\xfe",
    "empty": b"",
    "not there": b"gone\n",
    "too long": b"x" * 5000,
    "elsewhere": b"../resources/slave_{}\n",
    "a folder of modules": b"twodof_{}",
    "with a NUL": b"slave_{}\0\n",
}


@pytest.mark.parametrize("name", MODULES_THAT_ARE_NONE.values(), ids=MODULES_THAT_ARE_NONE)
def test_python_fmu_without_its_module_is_refused(name, jail, fmu_path):
    """pythonfmu's wrapper would crash."""
    with zipfile.ZipFile(fmu_path) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    digest = members.pop("resources/slavemodule.txt").strip().removeprefix(b"slave_")
    if name is not None:
        members["resources/slavemodule.txt"] = name.replace(b"{}", digest)
    path = jail.input / "x.fmu"
    path.write_bytes(mutations.zip_of(members))
    refused(jail, "slavemodule.txt does not name", "run", path, "-o", jail.target / "bag")


def test_fmu_of_any_name_is_read(jail, native_path):
    """FMPy would take a file with some names for a model description."""
    shutil.copyfile(native_path, jail.input / "x.xml")
    assert jail.run("info", jail.input / "x.xml").status == 0


def test_fmu_that_cannot_be_loaded_leaves_the_working_directory(tmp_path):
    (tmp_path / "x.fmu").write_bytes(fmu_of(description()))
    before = Path.cwd()
    with pytest.raises(FmuError, match="cannot be loaded"):
        twodof.simulate(tmp_path / "x.fmu")
    assert Path.cwd() == before


# --- URDFs ---

LINK = (
    '<link name="{0}"><inertial><mass value="{1}"/>'
    '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>{2}</link>'
)
JOINT = (
    '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><limit lower="{3}" upper="{4}"/></joint>'
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
    return "".join(f'<visual><geometry><mesh filename="{name}"/></geometry></visual>' for name in names)


def meshes(folder: Path) -> None:
    """Folders, pipes, devices and links instead of meshes."""
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
    "an external entity": (lambda: EXTERNAL + robot(tip()), "document type"),
    "a million links": (lambda: robot('<link name="a"/>' * 10**6), "File too large"),
    "8 MB of links": (lambda: robot(*(f'<link name="{i}"/>' for i in range(370_000))), "more than 100000 elements"),
    "100,000 elements deep": (lambda: robot("<a>" * 100_000 + "</a>" * 100_000, tip()), "nested deeper than 100"),
    "a chain of 129 joints": (lambda: chain(129), "129 moving joints"),
    "a mass of 1e308": (lambda: robot(tip(mass="1e308")), "too large"),
    "a mass of nan": (lambda: robot(tip(mass="nan")), "not finite"),
    "a mesh that is a pipe": (lambda: robot(tip(inside=shapes(["pipe"]))), "not found"),
    "a mesh that is a device": (lambda: robot(tip(inside=shapes(["zero"]))), "not found"),
    "a device by its own name": (lambda: robot(tip(inside=shapes(["file:///dev/zero"]))), "not found"),
    "a mesh that is a link out": (lambda: robot(tip(inside=shapes(["out"]))), "not found"),
    "a mesh behind a link out": (lambda: robot(tip(inside=shapes(["package://up/secret"]))), "not found"),
    "a mesh that is a link to itself": (lambda: robot(tip(inside=shapes(["circle"]))), "circle"),
    "a mesh of another folder": (lambda: robot(tip(inside=shapes(["../../secret"]))), "not found"),
    "meshes of 300 MB": (lambda: robot(tip(inside=shapes(f"large{i}" for i in range(3)))), "File too large"),
    "1,001 links": (lambda: robot(*(f'<link name="{i}"/>' for i in range(1000))), "1001 links; at most"),
    "5,001 visuals": (lambda: robot(tip(inside=shapes(["good.stl"] * 5001))), "5001 visuals and collisions"),
}


def test_hostile_urdf_is_refused(hostile_urdf, jail):
    make, reason = hostile_urdf
    refused(jail, reason, *build_command(jail, make()))


def test_similar_names_are_searched_in_bounded_time(jail):
    """The time to compare two names grows with the cube of their length if one of them repeats its letters."""
    names = [f"{'aab' * 64}{i:07}" for i in range(500)]
    joints = (
        f'<joint name="{name}" type="fixed"><parent link="base"/><child link="{name}"/></joint>' for name in names
    )
    urdf = jail.input / "x.urdf"
    urdf.write_text(robot(tip(), *(f'<link name="{name}"/>' for name in names), *joints))
    refused(jail, "no frame 'a*' in the URDF", "build", urdf, "--frame", "a" * 199, "-o", jail.target / "x.fmu")


def build_command(jail: Jail, text: str) -> list[object]:
    meshes(jail.input)
    urdf = jail.input / "x.urdf"
    urdf.write_text(text, "utf-8")
    folder = jail.input / "in"
    output = jail.target / "x.fmu"
    return ["build", "--frame", "tip", "--urdf", urdf, "--mesh-dir", folder, "-o", output]


LARGE_URDFS: dict[str, Callable[[], str]] = {
    "a chain of 128 joints": lambda: chain(128),
    "4,000 meshes that are not there": lambda: robot(tip(inside=shapes(f"package://{i}/x" for i in range(4000)))),
    "5,000 uses of a mesh": lambda: robot(tip(inside=shapes(["good.stl"] * 5000))),
    "200 MB of meshes": lambda: robot(tip(inside=shapes(["large0", "large1"]))),
    "names with markup": lambda: robot(tip()).replace('"j"', '"&lt;&quot;&#10;%s${x}\\"'),
}


def test_large_urdf_is_built_or_refused(large_urdf, jail):
    jail.run(*build_command(jail, large_urdf()))


# --- CSVs ---

HOSTILE_CSVS: dict[str, tuple[Callable[[], bytes], str]] = {
    "60 MB of zero bytes": (lambda: bytes(60 * MIB), "not a CSV file|no column 'time'"),
    "60 MB of one row": (lambda: b"time,Kn\n" + b"0," * (30 * MIB), "more than 1000000 cells"),
    "60 MB of one cell": (lambda: b'time,Kn\n0,"' + b"0" * (60 * MIB), "not a CSV file"),
    "a row of 500,000 cells": (lambda: b"time,Kn\n" + b"0," * 500_000, "row 2: 500001 cells"),
    "a cell of 100,000 digits": (lambda: b"time,Kn\n0," + b"1" * 10**5, "Kn = 1{50} is not finite"),
    "500,000 columns": (lambda: b"time," + b"x," * 500_000, "x is not an input"),
    "a column name of 100,000 letters": (lambda: b"time," + b"x" * 10**5, "no variable 'xxx"),
    "a column name of 130,000 digits and a letter": (lambda: b"time," + b"1" * 130_000 + b"x\n0,1", "no variable '111"),
}


def test_hostile_csv_is_refused(hostile_csv, jail, native_path):
    make, reason = hostile_csv
    path = jail.input / "x.csv"
    path.write_bytes(make())
    refused(jail, reason, "run", native_path, "--input", path, "-o", jail.target / "bag")


SLOW = {
    "8 MB of variables",
    "100 MB of an attribute",
    "9,000 members",
    "a million members",
    "40 GB in members that overlap",
    "8 MB of links",
    "4,000 meshes that are not there",
    "meshes of 300 MB",
    "200 MB of meshes",
    "5,000 uses of a mesh",
    "a chain of 128 joints",
    "60 MB of one cell",
}
HOSTILE: dict[str, Mapping[str, object]] = {
    "hostile_fmu": HOSTILE_FMUS,
    "hostile_urdf": HOSTILE_URDFS,
    "large_urdf": LARGE_URDFS,
    "hostile_csv": HOSTILE_CSVS,
}


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_member_that_is_shorter_than_stated_is_refused(method: int) -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method) as archive:
        archive.writestr("a", b"x" * 100)
        archive.writestr("b", b"y" * 100)
    with zipfile.ZipFile(content) as archive:
        member = archive.getinfo("a")
        member.file_size = 100_000
        member.compress_size += 99_900 * (method == zipfile.ZIP_STORED)
        with pytest.raises(zipfile.BadZipFile, match=r"'a' is shorter than stated|entries: 'a'"):
            read_member(archive, "a", 1_000_000)
