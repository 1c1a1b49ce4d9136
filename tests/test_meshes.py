"""The default robot: its meshes are sound, and its URDF agrees with them.

trimesh computes mass properties from the committed files and the density in the URDF; the script that made the files
has its own integrals.
"""

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
import trimesh

ROOT = Path(__file__).parents[1]
URDF = ROOT / "urdf" / "2dof.urdf"
LINKS = ["link1", "link2"]
VISUAL = [f"{link}.stl" for link in LINKS]
COLLISION = [f"{link}_collision.stl" for link in LINKS]
PRECISION = 1e-7  # m, that of single-precision corners


def records(name: str) -> np.ndarray:
    """The triangles exactly as stored, without trimesh's merging."""
    data = (ROOT / "meshes" / name).read_bytes()
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    assert (len(data) - 84) / record.itemsize == int.from_bytes(data[80:84], "little")
    return np.frombuffer(data, record, offset=84)


def facets(name: str) -> np.ndarray:
    return records(name)["corners"].astype(float)


def mesh(name: str) -> trimesh.Trimesh:
    return trimesh.load_mesh(ROOT / "meshes" / name)


def link(name: str) -> ElementTree.Element:
    element = ElementTree.parse(URDF).find(f"link[@name='{name}']")
    assert element is not None
    return element


def numbers(element: ElementTree.Element, path: str, attribute: str) -> list[float]:
    inner = element.find(path)
    assert inner is not None, path
    return [float(word) for word in inner.get(attribute, "").split()]


@pytest.mark.parametrize("name", VISUAL + COLLISION)
def test_mesh_is_closed_and_oriented_outwards(name):
    corners = facets(name)
    edges = Counter(
        (tuple(triangle[i]), tuple(triangle[(i + 1) % 3])) for triangle in corners.tolist() for i in range(3)
    )
    # each edge belongs to two triangles, which run along it in opposite directions
    assert set(edges.values()) == {1}
    assert all((end, start) in edges for start, end in edges)
    assert np.linalg.det(corners).sum() > 0.0
    surface = mesh(name)
    assert surface.is_watertight
    assert surface.is_winding_consistent
    assert surface.body_count == 1


@pytest.mark.parametrize("name", VISUAL + COLLISION)
def test_triangles_have_a_size_and_their_own_normals(name):
    a, b, c = facets(name).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    sides = np.linalg.norm([b - a, c - b, a - c], axis=2)
    assert sides.min() > 1e-4
    assert (areas[:, 0] / sides.max(axis=0)).min() > 1e-5  # the heights
    np.testing.assert_allclose(records(name)["normal"], normals / areas, atol=1e-6)


@pytest.mark.parametrize("name", COLLISION)
def test_collision_mesh_is_small_and_convex(name):
    surface = mesh(name)
    assert len(surface.faces) < 200
    assert surface.volume == pytest.approx(surface.convex_hull.volume, rel=1e-4)


@pytest.mark.parametrize("name", LINKS)
def test_collision_mesh_encloses_the_visual_mesh(name):
    # inside a convex body is behind each of its faces
    hull = mesh(f"{name}_collision.stl")
    points = facets(f"{name}.stl").reshape(-1, 3)
    offsets = np.einsum("fi,fi->f", hull.face_normals, hull.triangles[:, 0])
    ahead = points @ hull.face_normals.T - offsets
    assert ahead.max() <= PRECISION
    assert 500 <= len(points) / 3 <= 4000
    # and closely so: no more than a millimetre and a half beyond it, anywhere in its bounds
    assert np.abs(hull.bounds - [points.min(axis=0), points.max(axis=0)]).max() < 1.5e-3


@pytest.mark.parametrize("suffix", ["", "_collision"])
def test_links_are_apart_at_any_angle(suffix):
    assert facets(f"link1{suffix}.stl")[..., 2].max() < 0.0
    assert facets(f"link2{suffix}.stl")[..., 2].min() >= 0.0


def test_tool_tip_is_the_end_effector():
    tip = min(facets("link2.stl").reshape(-1, 3), key=lambda corner: corner[2])
    np.testing.assert_allclose(tip, [0.15, 0.0, 0.0], atol=PRECISION)


@pytest.mark.parametrize("name", LINKS)
def test_inertial_is_that_of_the_mesh(name):
    stated = re.search(r"Density: (\S+) kg/m3", URDF.read_text(encoding="utf-8"))
    assert stated is not None
    surface = mesh(f"{name}.stl")
    surface.density = float(stated[1])
    inertial = link(name).find("inertial")
    assert inertial is not None

    assert numbers(inertial, "mass", "value") == pytest.approx([surface.mass], rel=1e-9)
    np.testing.assert_allclose(numbers(inertial, "origin", "xyz"), surface.center_mass, rtol=1e-9, atol=1e-12)
    assert numbers(inertial, "origin", "rpy") == [0.0, 0.0, 0.0]
    axes = "xyz"
    inertia = [[numbers(inertial, "inertia", f"i{''.join(sorted(a + b))}")[0] for b in axes] for a in axes]
    np.testing.assert_allclose(inertia, surface.moment_inertia, rtol=1e-9, atol=1e-15)


def test_script_reproduces_the_files(tmp_path):
    script = ROOT / "meshes" / "make_meshes.py"
    subprocess.run([sys.executable, script, tmp_path], check=True, capture_output=True)
    committed = {path.name: path.read_bytes() for path in (ROOT / "meshes").glob("*.stl")}
    assert set(committed) == set(VISUAL + COLLISION)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == committed


def test_pinocchio_loads_the_robot():
    model = pin.buildModelFromUrdf(str(URDF))
    data = model.createData()
    assert model.name == "2dof"
    assert list(model.names) == ["universe", "joint1", "joint2"]
    frame = model.getFrameId("EndEffector", pin.FrameType.BODY)
    for q, end in [
        ([0.0, 0.0], [0.3, 0.0, 0.0]),
        ([np.pi / 2, 0.0], [0.0, 0.3, 0.0]),
        ([0.0, np.pi / 2], [0.15, 0.15, 0.0]),
    ]:
        pin.framesForwardKinematics(model, data, np.array(q))
        np.testing.assert_allclose(data.oMf[frame].translation, end, atol=1e-15)
    np.testing.assert_array_equal(model.upperPositionLimit, [np.pi, np.pi])
    np.testing.assert_array_equal(model.lowerPositionLimit, [-np.pi, -np.pi])
    np.testing.assert_array_equal(model.effortLimit, [10.0, 10.0])
    np.testing.assert_array_equal(model.velocityLimit, [20.0, 20.0])


def test_pinocchio_finds_the_meshes():
    model = pin.buildModelFromUrdf(str(URDF))
    for kind, names in ((pin.VISUAL, VISUAL), (pin.COLLISION, COLLISION)):
        geometry = pin.buildGeomFromUrdf(model, str(URDF), kind, package_dirs=[str(ROOT)])
        assert [Path(thing.meshPath).name for thing in geometry.geometryObjects] == names
        assert all(thing.geometry.num_vertices > 0 for thing in geometry.geometryObjects)
