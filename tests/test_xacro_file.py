"""Xacro files: expanded as xacro does, in a process that can read only the file's own folders."""

from __future__ import annotations

import os
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from xml.etree.ElementTree import canonicalize

import pytest

import twodof
from twodof import FmuOptions
from twodof.cli.main import main
from twodof.errors import BuildError
from twodof.export import xacro_file
from twodof.export.urdf_source import read_text

ROBOT = """<?xml version="1.0" encoding="utf-8"?>
<robot name="Ärm" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="links" default="3"/>
<xacro:include filename="$(find my_robot)/urdf/macros.xacro" ns="parts"/>
<xacro:property name="sizes" value="${xacro.load_yaml('$(find my_robot)/config/sizes.yaml')}"/>
<xacro:property name="n" value="$(arg links)"/>
<xacro:property name="names" value="${[name.upper() for name in sizes.names]}"/>
<link name="link0"/>
<xacro:macro name="chain" params="i:=1">
  <xacro:parts.part i="${i}" mass="${sizes.mass[i - 1]}"
      length="${sizes['length'] * (1 if i % 2 else 0.5)}">
    <origin xyz="0 0 ${max(sizes.length, 0.1)}" rpy="0 0 ${radians(30) + math.pi / 6}"/>
  </xacro:parts.part>
  <xacro:if value="${i &lt; n and names[0] == 'UPPER'}"><xacro:chain i="${i + 1}"/></xacro:if>
</xacro:macro>
<xacro:chain/>
</robot>"""
MACROS = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:property name="g" value="9.81" scope="global"/>
<xacro:macro name="part" params="i mass length *origin">
  <xacro:property name="I" value="${mass * length**2 / 12}"/>
  <link name="link${i}"><inertial><origin xyz="${length / 2} 0 0"/><mass value="${mass}"/>
    <inertia ixx="${0.1 * I}" iyy="${I}" izz="${I}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="joint${i}" type="revolute"><xacro:insert_block name="origin"/>
    <parent link="link${i - 1}"/><child link="link${i}"/><axis xyz="0 ${i % 2} ${1 - i % 2}"/>
    <limit lower="${-pi}" upper="${pi}" effort="10" velocity="5"/></joint>
</xacro:macro></robot>"""
SIZES = "length: !millimeters 300\nmass: [3, 2.5, 1]\nnames: [upper, lower, hand]\n"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package in a folder with another name, next to a file that must not be read."""
    folder = tmp_path / "checkout"
    for name, text in {
        "package.xml": "<package><name>my_robot</name></package>",
        "urdf/arm.urdf.xacro": ROBOT,
        "urdf/macros.xacro": MACROS,
        "config/sizes.yaml": SIZES,
        "../secret.xacro": "<robot secret='hidden'/>",
        "../secret.yaml": "hidden: 1",
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, "utf-8")
    return folder


def test_the_result_equals_that_of_xacro(package: Path) -> None:
    """Includes, namespaces, arguments, YAML with units, conditions, blocks, a recursive macro."""
    path = package / "urdf/arm.urdf.xacro"
    free = path.with_name("free.xacro")
    free.write_text(ROBOT.replace("$(find my_robot)", str(package)), "utf-8")
    command = [sys.executable, "-c", "import xacro; xacro.main()", str(free)]
    expected = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    ours = canonicalize(read_text(path, None), strip_text=True)
    assert ours == canonicalize(expected, strip_text=True)
    assert ours.count("<joint ") == 3 and "secret" not in ours


def test_xacro_files_are_built_and_run(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(package)
    assert main(["build", "urdf/arm.urdf.xacro", "-o", "built.fmu"]) == 0
    assert twodof.load_fmu("built.fmu").frame == "link3"
    assert main(["run", "urdf/arm.urdf.xacro", "-o", "bag", "--stop-time", "0.1"]) == 0
    assert Path("arm.fmu").exists()
    assert twodof.read_bag("bag").joints == ("joint1", "joint2", "joint3")


def test_other_packages_are_found_in_the_mesh_folder(package: Path, tmp_path: Path) -> None:
    lone = tmp_path / "lone.xacro"
    lone.write_text(ROBOT, "utf-8")
    with pytest.raises(BuildError, match=r"package 'my_robot' not found in '.*'; give the folder"):
        read_text(lone, None)
    for mesh_dir in (package, package.rename(tmp_path / "my_robot").parent):
        if mesh_dir.exists():
            assert read_text(lone, mesh_dir).count("<joint ") == 3


INCLUDE, VALUE = "<xacro:include filename='{}'/>", "<link name='{}'/>"
READ_ELSEWHERE = "the only folders that may be read"
HOSTILE = {
    "include by path": (INCLUDE.format("/etc/passwd"), READ_ELSEWHERE),
    "include upwards": (INCLUDE.format("../../secret.xacro"), READ_ELSEWHERE),
    "include by find": (INCLUDE.format("$(find my_robot)/../secret.xacro"), READ_ELSEWHERE),
    "include by a name with dots": (INCLUDE.format("$(find ../..)/secret.xacro"), "not found"),
    "include that may fail": (
        "<xacro:include filename='/etc/shadow' optional='true'/><link name='$(env HOME)'/>",
        "'HOME' is not set",
    ),
    "include by a link": (INCLUDE.format("link.xacro"), READ_ELSEWHERE),
    "include by a pattern": (INCLUDE.format("../../*.xacro"), READ_ELSEWHERE),
    "include of a pipe": (INCLUDE.format("pipe.xacro"), "Not a regular file"),
    "include of itself": (INCLUDE.format("robot.xacro"), "recursion"),
    "yaml": (VALUE.format('${xacro.load_yaml("../../secret.yaml")}'), READ_ELSEWHERE),
    "environment": (VALUE.format("$(env HOME)"), "'HOME' is not set"),
    "insides of a text": (VALUE.format('${"".__class__}'), "not available"),
    "insides by format": (VALUE.format('${"{0.__class__%s"%"\\x7d".format(1)}'), "not available"),
    "a function": (VALUE.format("${(lambda: 1)()}"), "Lambda"),
    "a generator's frame": (VALUE.format("${(i for i in [1]).gi_frame}"), "not available"),
    "nested": (VALUE.format("${[().__class__ for i in [1]]}"), "not available"),
    "vars": (VALUE.format("${python.vars(python.int)}"), "vars"),
    "type": (VALUE.format("${python.type(1)}"), "type"),
    "eval": (VALUE.format("$(eval (i for i in ()).gi_frame.f_back)"), "not supported"),
    "eval of arithmetic": (VALUE.format("$(eval 1 + 1)"), "write"),
    "import": (VALUE.format('${__import__("os")}'), "not defined"),
    "document": (
        "<xacro:include filename='block.xacro' ns='b'/>" + VALUE.format('${b.get("**block").ownerDocument}'),
        "not allowed",
    ),
    "an argument without a default": (VALUE.format("$(arg size)"), "'size' has no default"),
    "a huge power": (VALUE.format("${9**9**9**9}"), "don't want to evaluate"),
    "a long text": (VALUE.format('${"a" * 10**9}'), "something that long"),
    "a long list": (VALUE.format("${list(python.range(10**10))}"), "MemoryError"),
    "ever more elements": (
        "<xacro:macro name='m' params='i'>"
        + "<xacro:if value='${i}'>"
        + "<xacro:m i='${i - 1}'/>" * 9
        + "</xacro:if></xacro:macro><xacro:m i='20'/>",
        "CPU time limit exceeded",
    ),
    "no XML": ("<", "not well-formed"),
}


@pytest.mark.parametrize(("body", "message"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_files_are_refused(package: Path, body: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if "CPU" in message:
        monkeypatch.setattr(xacro_file, "MAX_XACRO_SECONDS", 2)
    path = package / "urdf/robot.xacro"
    path.write_text(f"<robot xmlns:xacro='http://www.ros.org/wiki/xacro'>{body}</robot>")
    (path.parent / "link.xacro").symlink_to("../../secret.xacro")
    os.mkfifo(path.parent / "pipe.xacro")
    block = "<xacro:property name='block'><a/></xacro:property>"
    (path.parent / "block.xacro").write_text(path.read_text().replace(body, block))
    with pytest.raises(BuildError, match=message) as refusal:
        read_text(path, None)
    assert "\n" not in str(refusal.value) and "hidden" not in str(refusal.value)


def test_long_messages_of_a_file_are_cut(package: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The parent process does not receive gigabytes of them."""
    path = package / "urdf/robot.xacro"
    warning = "<a b='${xacro.warning(\"w\" * 50000)}'/>" * 100
    path.write_text(f"<robot xmlns:xacro='http://www.ros.org/wiki/xacro' name='r'>{warning}</robot>")
    assert 'name="r"' in read_text(path, None)
    assert 1000 < len(caplog.messages[0]) < 3000


def test_an_answer_that_is_no_json_is_refused(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pickle from a process that a file controls would run code here."""
    monkeypatch.setattr(xacro_file, "_expand", send_a_pickle)
    with pytest.raises(BuildError, match="cannot expand"):
        read_text(package / "urdf/arm.urdf.xacro", None)


def send_a_pickle(pipe: Connection, *_: object) -> None:
    pipe.send(("<robot/>", "", ""))


def test_a_missing_extra_is_named(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "simpleeval", None)
    with pytest.raises(BuildError, match=r"no simpleeval; install the extra 'xacro': .* pip install "):
        twodof.build_fmu(None, FmuOptions(urdf=package / "urdf/arm.urdf.xacro"))
