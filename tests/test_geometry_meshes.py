"""Coloured meshes, compared with the files' own XML, and with the pixels of a page."""

import xml.etree.ElementTree as ET
from collections import Counter
from unittest.mock import Mock

import browser
import numpy as np
import pytest
from playwright.sync_api import ViewportSize

import twodof
from twodof.cli.main import main
from twodof.geometry.meshes import Meshes, ReadMesh, Surface
from twodof.geometry.shapes import link_shapes
from twodof.plant.urdf import RobotError, read_urdf

ONE = np.ones(3)


def surfaces(name: str, read: ReadMesh, scale: np.ndarray) -> list[Surface]:
    with Meshes(read) as meshes:
        return meshes.scaled(name, scale)


DAE = "{http://www.collada.org/2005/11/COLLADASchema}"


@pytest.mark.parametrize("name", ["link5", "hand"])
def test_triangles_have_the_colours_of_their_materials(robots, name):
    """The number of triangles of each colour is that of the file's lists; the shape is coal's."""
    content = (robots / f"panda_description/meshes/visual/{name}.dae").read_bytes()
    tree = ET.fromstring(content)
    diffuse = {
        str(effect.get("id")): tuple(
            round(float(value), 3) for value in effect.findtext(f".//{DAE}diffuse/{DAE}color", "").split()[:3]
        )
        for effect in tree.iter(f"{DAE}effect")
    }
    effects = {
        str(material.get("id")): material.findall(f"{DAE}instance_effect")[0].attrib["url"][1:]
        for material in tree.iter(f"{DAE}material")
    }
    symbols = {str(bound.get("symbol")): bound.attrib["target"][1:] for bound in tree.iter(f"{DAE}instance_material")}
    expected: Counter[tuple[float, ...]] = Counter()
    for kind in ("triangles", "polylist"):
        for listed in tree.iter(f"{DAE}{kind}"):
            colour = diffuse[effects[symbols[listed.attrib["material"]]]]
            expected[colour] += int(listed.attrib["count"])
    with Meshes({f"{name}.dae": content}.get) as meshes:
        parts = meshes.scaled(f"{name}.dae", 2.0 * ONE)
        (shape,) = meshes.surfaces(f"{name}.dae", coloured=False)
    triangles: Counter[tuple[float, ...]] = Counter()
    for part in parts:
        own = np.array(part.colour, float)
        nearest = min(diffuse.values(), key=lambda c: np.abs(np.subtract(c, own)).max())
        np.testing.assert_allclose(own, nearest, atol=0.5 / 255 + 1e-3)
        triangles[nearest] += len(part.triangles)
    assert triangles == expected and len(triangles) > 1 - (name == "hand")
    points = np.concatenate([part.vertices for part in parts])
    corners = 2.0 * shape.vertices
    np.testing.assert_allclose(points.min(axis=0), corners.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(points.max(axis=0), corners.max(axis=0), atol=1e-6)


CUBE = """mtllib colours.mtl
o cube
v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
usemtl green
f 1 4 3 2
f 1 2 6 5
f 3 4 8 7
usemtl red
f 5 6 7 8
f 2 3 7 6
f 4 1 5 8
"""
COLOURS = "newmtl red\nKd 0.9 0.05 0.05\nmap_Kd /etc/passwd\nnewmtl green\nKd 0.05 0.8 0.05\n"


def test_an_obj_has_the_colours_of_its_library():
    files = {"meshes/cube.obj": CUBE.encode(), "meshes/cube.obj.mtl": COLOURS.encode()}
    parts = surfaces("meshes/cube.obj", files.get, np.array([1.0, 2.0, 3.0]))
    assert {tuple(np.round(part.colour or (), 2)): len(part.triangles) for part in parts} == {
        (0.9, 0.05, 0.05): 6,
        (0.05, 0.8, 0.05): 6,
    }
    assert np.abs(parts[0].vertices).max(axis=0).tolist() == [1.0, 2.0, 3.0]
    del files["meshes/cube.obj.mtl"]
    plain = surfaces("meshes/cube.obj", files.get, ONE)
    assert {part.colour for part in plain} == {None}
    assert sum(len(part.triangles) for part in plain) == 12


def test_meshes_without_colours_or_that_cannot_be_read():
    triangle = b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    files = {"a.stl": triangle + b"endloop\nendfacet\nendsolid a\n", "b.dae": b"<a", "c.obj": b"v"}
    (part,) = surfaces("a.stl", files.get, ONE)
    assert part.colour is None and part.triangles.tolist() == [[0, 1, 2]]
    assert [surfaces(name, files.get, ONE) for name in ("b.dae", "c.obj", "d.dae")] == [[]] * 3


URDF = """<robot name="cube"><material name="blue"><color rgba="0.1 0.1 0.9 1"/></material>
<link name="base"/><link name="tip"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial><visual>
<origin xyz="0.5 0 0"/><geometry><mesh filename="cube.obj" scale="0.2 0.2 0.2"/></geometry>
<material name="blue"/></visual></link><joint name="j" type="continuous"><parent link="base"/>
<child link="tip"/><axis xyz="0 0 1"/></joint><link name="hand"/><joint name="k" type="fixed">
<parent link="tip"/><child link="hand"/><origin xyz="1 0 0"/></joint></robot>"""


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_mesh_that_is_not_finite_is_not_drawn(number, caplog):
    """A page with numbers that JSON does not have would show nothing."""
    facet = np.array([0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0], "<f4")
    robot = read_urdf(URDF.replace("cube.obj", "cube.stl"))
    for value, text in ((2.0, ""), (number, "mesh 'cube.stl' is left out: it has a vertex that")):
        facet[6] = value
        content = bytes(80) + b"\1\0\0\0" + facet.tobytes() + bytes(2)
        shapes, absent = link_shapes(robot, {"cube.stl": content}.get)
        assert absent == [] and text in caplog.text and bool(text) == bool(caplog.text)
        assert all(np.isfinite(shape.vertices).all() for shape in shapes)


SMALL: ViewportSize = {"width": 600, "height": 280}


def test_a_replay_shows_them(tmp_path, monkeypatch):
    """It shows both colours of the cube, and not the URDF's, which is for meshes without colours."""
    for name, text in {"cube.urdf": URDF, "cube.obj": CUBE, "colours.mtl": COLOURS}.items():
        (tmp_path / name).write_text(text)
    options = twodof.FmuOptions(urdf=tmp_path / "cube.urdf", axes="y", name="Cube")
    fmu = twodof.build_fmu(tmp_path / "Cube.fmu", options)
    twodof.simulate(fmu, twodof.Bag(tmp_path / "bag"), stop_time=0.1)
    monkeypatch.chdir(tmp_path)
    assert main(["view", "bag", "--export", "bag.html", "--no-browser"]) == 0
    with browser.chromium() as shown, shown.new_context(viewport=SMALL, offline=True) as context:
        context.set_default_timeout(1e3 * browser.TIMEOUT)
        page = context.new_page()
        page.clock.install(time=0)
        page.clock.pause_at(1)  # a replay that never rests cannot be looked at
        page.goto((tmp_path / "bag.html").as_uri())
        page.wait_for_selector("canvas")
        for _ in range(20):  # while the scene is being loaded
            page.clock.run_for(100)
            seen = coloured(browser.still(page))
            if min(seen) > 100:
                break
        assert min(seen) > 100


def coloured(shown: np.ndarray) -> tuple[int, int]:
    """Numbers of red and of green pixels."""
    r, g, b = np.moveaxis(shown.astype(int), -1, 0)
    red, green = (r > 100) & (g < r / 2) & (b < r / 2), (g > 80) & (r < g / 2) & (b < g / 2)
    return int(red.sum()), int(green.sum())


def test_visuals_of_one_missing_mesh_read_it_once_and_a_long_colour_is_refused():
    visual = '<visual><geometry><mesh filename="package://none.stl"/></geometry><material name="m"/></visual>'
    material = '<material name="m"><color rgba="1 1 1 1"/></material>'
    text = f'<robot name="r">{material}<link name="l">{visual * 3}</link></robot>'
    read = Mock(return_value=None)
    assert link_shapes(read_urdf(text), read)[1] == ["none.stl"] and read.call_count == 2  # as a mesh, and at the end
    with pytest.raises(RobotError, match="link 'l' cannot be drawn: rgba has more than 1000 characters"):
        link_shapes(read_urdf(text.replace("1 1 1 1", "1 " * 501)), read)
