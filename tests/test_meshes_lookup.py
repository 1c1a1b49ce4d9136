"""Meshes of a URDF: the folders that are searched, names in the FMU, and refusals."""

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from twodof.errors import BuildError
from twodof.export.mesh_files import collect_meshes

FILES = {
    "ws/arm_description/package.xml": b"<package/>",
    "ws/arm_description/urdf/arm.urdf": b"",
    "ws/arm_description/meshes/base.stl": b"base",
    "ws/arm_description/meshes/visual/link.stl": b"visual",
    "ws/arm_description/meshes/collision/link.stl": b"collision",
    "ws/arm_description/urdf/beside.stl": b"beside",
    "ws/tool_description/package.xml": b"<package/>",
    "ws/tool_description/meshes/tool.stl": b"tool",
    "ws/arm_description/meshes/with space & more.stl": b"space",
    "secret.stl": b"secret",
}


@pytest.fixture
def disk(tmp_path):
    for name, content in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return tmp_path


def urdf(*uris: str) -> str:
    meshes = "".join(f'<mesh filename="{uri}" scale="1 1 1"/>' for uri in uris)
    return f'<robot name="arm"><link name="base">{meshes}</link></robot>'


def names(text: str) -> list[str]:
    return re.findall(r'filename="package://(.*?)"', text)


def collect(disk: Path, uri: str, mesh_dir: str | None) -> bytes:
    """The only mesh that is collected for a URDF with this name."""
    folder = disk / "ws/arm_description/urdf"
    text, files = collect_meshes(urdf(uri), folder, None if mesh_dir is None else disk / mesh_dir)
    assert names(text) == list(files)
    (name,) = files
    assert name.startswith("meshes/")
    return files[name]


PACKAGE = "package://arm_description/meshes/base.stl"
FOUND = {
    "mesh_dir holds the package": (PACKAGE, "ws", b"base"),
    "mesh_dir is the package": (PACKAGE, "ws/arm_description", b"base"),
    "mesh_dir is the mesh folder": (PACKAGE, "ws/arm_description/meshes", b"base"),
    "mesh_dir above a subfolder": (
        "package://arm_description/meshes/visual/link.stl",
        "ws/arm_description/meshes",
        b"visual",
    ),
    "model://": ("model://arm_description/meshes/base.stl", "ws", b"base"),
    "the URDF's package": (PACKAGE, None, b"base"),
    "another package, mesh_dir holds both": ("package://tool_description/meshes/tool.stl", "ws", b"tool"),
    "the URDF's package in a folder of another name": ("package://renamed/meshes/base.stl", None, b"base"),
    "relative to the URDF": ("beside.stl", None, b"beside"),
    "relative to the URDF with ./": ("./beside.stl", None, b"beside"),
    "relative to the URDF though mesh_dir is given": ("beside.stl", "ws", b"beside"),
    "a link to inside the places": ("link.stl", None, b"base"),
    "relative, in the URDF's package": ("../meshes/base.stl", None, b"base"),
    "relative to mesh_dir": ("visual/link.stl", "ws/arm_description/meshes", b"visual"),
    "relative, out of the URDF's folder but inside mesh_dir": ("../meshes/base.stl", "ws/arm_description", b"base"),
    "percent and entity": ("package://arm_description/meshes/with%20space%20&amp;%20more.stl", "ws", b"space"),
    "entity in a relative name": ("with space &amp; more.stl", "ws/arm_description/meshes", b"space"),
}


@pytest.mark.parametrize(("uri", "mesh_dir", "content"), FOUND.values(), ids=FOUND)
def test_mesh_is_found(disk, uri, mesh_dir, content):
    (disk / "ws/arm_description/urdf/link.stl").symlink_to("../meshes/base.stl")
    assert collect(disk, uri, mesh_dir) == content


@pytest.mark.parametrize("scheme", ["file://", ""])
@pytest.mark.parametrize(
    ("name", "mesh_dir"),
    [
        ("arm_description/urdf/beside.stl", None),
        ("arm_description/meshes/base.stl", None),
        ("tool_description/meshes/tool.stl", "ws"),
    ],
    ids=["URDF's folder", "URDF's package", "mesh_dir"],
)
def test_absolute_name_is_found_where_meshes_may_be(disk, scheme, name, mesh_dir):
    content = FILES[f"ws/{name}"]
    assert collect(disk, f"{scheme}{disk}/ws/{name}", mesh_dir) == content


def test_package_in_mesh_dir_goes_before_a_shorter_match(disk):
    (disk / "ws/meshes").mkdir()
    (disk / "ws/meshes/base.stl").write_bytes(b"other")
    assert collect(disk, PACKAGE, "ws") == b"base"


ABSENT = {
    "not there": ("package://arm_description/meshes/none.stl", "ws"),
    "not there, no mesh_dir": ("package://nowhere/none.stl", None),
    "no path": ("package://", "ws"),
    "absolute, not there": ("/nowhere/none.stl", None),
    "another scheme": ("http://example.com/a.stl", "ws"),
    "not a URI": ("package://[arm/a.stl", "ws"),
}
ELSEWHERE = {
    "a folder": ("package://arm_description/meshes", "ws"),
    "no name": ("", "ws"),
    "absolute": ("{disk}/secret.stl", "ws"),
    "absolute, no mesh_dir": ("{disk}/secret.stl", None),
    "file": ("file://{disk}/secret.stl", "ws"),
    "file, no mesh_dir": ("file://{disk}/secret.stl", None),
    "file, percent": ("file://{disk}/%73ecret.stl", None),
    "file, relative": ("file://../../../secret.stl", None),
    "absolute in a package": ("package://{disk}/secret.stl", "ws"),
    "absolute in a package, no mesh_dir": ("package://{disk}/secret.stl", None),
    "a folder above as the package": ("package://{disk.name}/secret.stl", None),
    "a folder above as any package": ("package://any/secret.stl", None),
    "a package beside the URDF's": ("package://tool_description/meshes/tool.stl", None),
    "out of mesh_dir": ("package://../secret.stl", "ws"),
    "out of the package": ("package://arm_description/../../secret.stl", "ws"),
    "out of the URDF's package": ("package://arm_description/../../secret.stl", None),
    "percent": ("package://%2e%2e/secret.stl", "ws"),
    "relative, out of the URDF's package": ("../../../secret.stl", None),
    "relative, out of mesh_dir": ("../secret.stl", "ws"),
    "relative, beside mesh_dir": ("../ws2/secret.stl", "ws"),
}


@pytest.mark.parametrize(("uri", "mesh_dir"), ABSENT.values(), ids=ABSENT)
def test_warning_names_the_mesh_that_is_left_out(disk, uri, mesh_dir, caplog):
    text, files = collect_meshes(
        urdf(uri), disk / "ws/arm_description/urdf", None if mesh_dir is None else disk / mesh_dir
    )
    assert files == {} and uri in text and uri in caplog.text


@pytest.mark.parametrize(("uri", "mesh_dir"), ELSEWHERE.values(), ids=ELSEWHERE)
def test_refusal_names_the_mesh_and_where_it_may_be(disk, uri, mesh_dir):
    uri = uri.format(disk=disk)
    (disk / "ws2").mkdir()
    (disk / "ws2/secret.stl").write_bytes(b"secret")
    with pytest.raises(BuildError, match=r"not found in .*`mesh_dir`") as refusal:
        collect(disk, uri, mesh_dir)
    assert f"mesh '{uri}'" in str(refusal.value)
    assert f"'{disk / (mesh_dir or 'ws/arm_description')}'" in str(refusal.value)


@pytest.mark.parametrize("name", ["a" * 5000, "a/" * 1000])
def test_too_long_a_name_is_refused(name, disk):
    with pytest.raises(BuildError, match=r"cannot be read: .*too long"):
        collect(disk, f"package://arm/{name}", "ws")


def test_too_many_names_are_refused(disk):
    with pytest.raises(BuildError, match="more than 5000 different meshes"):
        collect_meshes(urdf(*map(str, range(6000))), disk, None)


@pytest.mark.parametrize("uri", ["../meshes/base.stl", PACKAGE])
def test_folder_of_the_urdf_alone_where_there_is_no_package(disk, uri):
    """Names of parent folders have no effect."""
    (disk / "ws/arm_description/package.xml").unlink()
    with pytest.raises(BuildError, match="not found in"):
        collect(disk, uri, None)
    assert collect(disk, uri, "ws/arm_description") == b"base"
    assert collect(disk, "beside.stl", None) == b"beside"


@pytest.mark.parametrize("mesh_dir", ["ws", None])
@pytest.mark.parametrize("link", ["meshes/link.stl", "urdf/link.stl", "more", "meshes/more"])
def test_symbolic_link_out_of_the_places_is_refused(disk, link, mesh_dir):
    folder = disk / "ws/arm_description"
    folder.joinpath(link).symlink_to(disk if "more" in link else disk / "secret.stl")
    name = f"{link}/secret.stl" if "more" in link else link
    for uri in (f"package://arm_description/{name}", f"../{name}", f"{folder}/{name}"):
        with pytest.raises(BuildError, match="not found in"):
            collect(disk, uri, mesh_dir)


def test_mesh_that_cannot_be_read_is_refused(disk, monkeypatch):
    def fail(path: Path, _flags: int) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "open", fail)
    with pytest.raises(BuildError, match=r"base\.stl.*Permission denied"):
        collect(disk, PACKAGE, "ws")


def test_meshes_of_one_basename_get_different_names(disk):
    uris = [f"package://arm_description/meshes/{kind}/link.stl" for kind in ("visual", "collision")]
    text, files = collect_meshes(urdf(*uris), disk, disk / "ws")
    assert len(set(names(text))) == 2
    assert [files[name] for name in names(text)] == [b"visual", b"collision"]


def test_a_mesh_used_twice_is_taken_along_once(disk):
    text, files = collect_meshes(urdf(PACKAGE, PACKAGE), disk, disk / "ws")
    assert names(text) == ["meshes/base.stl"] * 2
    assert files == {"meshes/base.stl": b"base"}


def test_nothing_but_the_names_of_meshes_changes(disk):
    before = urdf(PACKAGE).replace("<link", '<!-- <mesh filename="package://old/gone.stl"/> -->\n<link\n  ')
    after, _ = collect_meshes(before, disk, disk / "ws")
    expected = before.replace(PACKAGE, "package://meshes/base.stl")
    assert ET.canonicalize(after, with_comments=True) == ET.canonicalize(expected, with_comments=True)


def test_characters_that_file_systems_refuse_are_replaced(disk):
    _, files = collect_meshes(urdf("package://arm_description/meshes/with%20space%20%26%20more.stl"), disk, disk / "ws")
    assert list(files) == ["meshes/with_space___more.stl"]


def test_collected_robot_can_be_collected_again(disk, tmp_path):
    uris = [f"package://arm_description/meshes/{kind}/link.stl" for kind in ("visual", "collision")]
    text, files = collect_meshes(urdf(PACKAGE, *uris), disk, disk / "ws")
    for name, content in files.items():
        (tmp_path / "fmu" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "fmu" / name).write_bytes(content)
    _, again = collect_meshes(text, tmp_path / "fmu", None)
    assert sorted(again.values()) == sorted(files.values())


EXAMPLES = {
    "ur_description/urdf/ur5_robot.urdf": 14,
    "panda_description/urdf/panda.urdf": 19,
    "tiago_description/robots/tiago.urdf": 34,  # and one in a comment
    "so_arm_description/urdf/so100.urdf": 13,
}


@pytest.mark.parametrize(("name", "count"), EXAMPLES.items(), ids=[Path(e).stem for e in EXAMPLES])
def test_example_robot_needs_no_mesh_dir(robots, name, count):
    path = robots / name
    text, files = collect_meshes(path.read_text("utf-8"), path.parent, None)
    assert len(files) == count
    meshes = {mesh.get("filename", "") for mesh in ET.fromstring(text).iter("mesh")}
    assert meshes == {f"package://{name}" for name in files}


LIBRARY = {
    "in the same folder": ("colours.mtl", b"newmtl red\n"),
    "with a space": ("two words.mtl", b"newmtl blue\n"),
    "that is not there": ("none.mtl", None),
}


@pytest.mark.parametrize(("name", "content"), LIBRARY.values(), ids=LIBRARY)
def test_an_obj_brings_the_library_of_its_colours(disk, name, content):
    folder = disk / "ws/arm_description/meshes"
    (folder / "box.obj").write_text(f"# a box\r\nmtllib {name}\r\nmtllib {name}\r\nv 0 0 0\r\n")
    if content:
        (folder / name).write_bytes(content)
    _, files = collect_meshes(urdf("../meshes/box.obj"), disk / "ws/arm_description/urdf", None)
    libraries = {key: value.strip() for key, value in files.items() if key.endswith(".mtl")}
    assert libraries == ({"meshes/box.obj.mtl": content.strip()} if content else {})


HOSTILE_LIBRARIES = {
    "many": ("".join(f"mtllib {i}.mtl\n" for i in range(101)), "more than 100 material libraries"),
    "large": ("mtllib a.mtl\nmtllib ./a.mtl\n", "File too large"),
}


@pytest.mark.parametrize(("text", "reason"), HOSTILE_LIBRARIES.values(), ids=HOSTILE_LIBRARIES)
def test_libraries_are_bounded(text, reason, disk):
    folder = disk / "ws/arm_description/meshes"
    (folder / "box.obj").write_text(text)
    with (folder / "a.mtl").open("wb") as library:
        library.truncate(200 * 1024**2)
    with pytest.raises(BuildError, match=f"box.obj.* cannot be read: .*{reason}"):
        collect_meshes(urdf("../meshes/box.obj"), disk / "ws/arm_description/urdf", None)


def test_a_library_outside_of_the_folders_is_refused(disk):
    path = disk / "ws/arm_description/meshes/box.obj"
    path.write_text("mtllib ../../../secret.stl\n")
    with pytest.raises(BuildError, match=r"secret\.stl.* no other folder may be read"):
        collect_meshes(urdf("../meshes/box.obj"), disk / "ws/arm_description/urdf", None)
