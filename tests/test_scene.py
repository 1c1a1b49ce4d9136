"""The scene: transforms against Pinocchio's kinematics, fitted shapes against the meshes.

SciPy converts quaternions and rpy angles to matrices. trimesh reads meshes, Pinocchio COLLADA files.
"""

import io
import json
import logging
import math
import os
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple
from urllib.request import urlopen

import numpy as np
import oracles
import pinocchio as pin
import pytest
import trimesh
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from tools import needs

import twodof
from twodof.export.stock_robots import stock_robots
from twodof.plant.urdf import Joint, RobotError
from twodof.ros.scene import Scene
from twodof.simulation.sample import Sample

START = 1_700_000_000  # s since the epoch
SECOND = 1_000_000_000  # ns
LATCHED = ["/robot_description", "/tf_static"]
ROBOTS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "panda, two prismatic joints": "panda_description/urdf/panda.urdf",
    "kinova, three continuous joints": "kinova_description/robots/kinova.urdf",
    "tiago, a tree with all of them": "tiago_description/robots/tiago_no_hand.urdf",
}

Messages = dict[str, list[tuple[int, Any]]]
Placements = dict[str, np.ndarray]


# --- poses ---


class Transform(NamedTuple):
    """Pose of a child link in its parent link: m, and a unit quaternion (x, y, z, w)."""

    parent: str
    child: str
    translation: tuple[float, ...]
    rotation: tuple[float, ...]


def transforms_of(scene: Scene, joints: Iterable[Joint], q: np.ndarray) -> list[list[Transform]]:
    """Return a bag's transforms of some joints at each of N positions."""
    each = [np.broadcast_to(part, (len(q), 7)) for part in scene.transforms(joints, q)]
    return [
        [
            Transform(joint.parent, joint.child, tuple(part[k, :3]), tuple(part[k, 3:]))
            for joint, part in zip(joints, each)
        ]
        for k in range(len(q))
    ]


def pose(translation: Iterable[float], rotation: Rotation) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()
    matrix[:3, 3] = list(translation)
    return matrix


def chained(transforms: Iterable[Transform]) -> Placements:
    """Poses of all child links in the root, computed as tf2 does."""
    local: dict[str, tuple[str, np.ndarray]] = {}
    for parent, child, translation, rotation in transforms:
        assert child not in local
        local[child] = (parent, pose(translation, Rotation.from_quat(rotation)))

    def placement(link: str) -> np.ndarray:
        if link not in local:
            return np.eye(4)
        parent, matrix = local[link]
        return placement(parent) @ matrix

    return {child: placement(child) for child in local}


def placements(urdf: str, joints: list[str], q: np.ndarray) -> Placements:
    """The same by Pinocchio, which has two coordinates for a continuous joint."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    configuration = pin.neutral(model)
    for name, angle in zip(joints, q, strict=True):
        joint = model.joints[model.getJointId(name)]
        values = [angle] if joint.nq == 1 else [math.cos(angle), math.sin(angle)]
        configuration[joint.idx_q : joint.idx_q + joint.nq] = values
    pin.framesForwardKinematics(model, data, configuration)
    bodies = {f.name: i for i, f in enumerate(model.frames) if f.type == pin.FrameType.BODY}
    return {name: data.oMf[i].homogeneous for name, i in bodies.items()}


def moving_joints(urdf: str) -> list[str]:
    return list(pin.buildModelFromXML(urdf).names)[1:]


def assert_same_poses(found: Placements, expected: Placements, urdf: str) -> None:
    children = [child.attrib["link"] for child in ET.fromstring(urdf).findall("joint/child")]
    assert sorted(found) == sorted(children)
    for link, matrix in found.items():
        np.testing.assert_allclose(matrix, expected[link], rtol=0.0, atol=1e-12, err_msg=link)


def nothing(_: str) -> None:
    return None


@pytest.fixture
def robot(request, robots):
    return (robots / ROBOTS[request.param]).read_text()


@pytest.mark.parametrize("robot", list(ROBOTS), indirect=True)
def test_transforms_and_end_effector_are_the_placements_of_pinocchio(robot):
    joints = moving_joints(robot)[::-1]  # not in the order of the file
    last = ET.fromstring(robot).findall("link")[-1].get("name", "")
    scene = Scene(robot, joints, last, nothing)
    several = np.random.default_rng(0).uniform(-4.0, 4.0, (10, len(joints)))
    each = transforms_of(scene, [*scene.fixed, *scene.moving], several)
    for q, transforms, x in zip(several, each, scene.end_effector(several), strict=True):
        for transform in transforms:
            assert np.linalg.norm(transform.rotation) == pytest.approx(1.0, abs=1e-14)
        expected = placements(robot, joints, q)
        assert_same_poses(chained(transforms), expected, robot)
        np.testing.assert_allclose(x, expected[last][:3, 3], rtol=0.0, atol=1e-12)


@pytest.mark.filterwarnings("error")
def test_fixed_joint_may_have_a_zero_axis():
    urdf = (
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="fixed">'
        '<parent link="a"/><child link="b"/><origin xyz="1 2 3"/><axis xyz="0 0 0"/>'
        "</joint></robot>"
    )
    expected = [Transform("a", "b", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))]
    scene = Scene(urdf, [], "b", nothing)
    assert transforms_of(scene, scene.fixed, np.empty((1, 0))) == [expected]


@pytest.mark.parametrize("axis", ["1 0 0", "0 1 0", "0 0 1", "-3 2 1"])
@pytest.mark.parametrize("angle", [0.0, 1e-9, -1.0, math.pi, 3.3, -math.pi])
def test_quaternion_is_x_y_z_w_also_near_half_turns(axis, angle):
    urdf = (
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
        f'<parent link="a"/><child link="b"/><axis xyz="{axis}"/></joint></robot>'
    )
    scene = Scene(urdf, ["j"], "b", nothing)
    ((found,),) = transforms_of(scene, scene.moving, np.array([[angle]]))
    direction = np.array(axis.split(), dtype=float)
    expected = Rotation.from_rotvec(angle * direction / np.linalg.norm(direction))
    np.testing.assert_allclose(Rotation.from_quat(found.rotation).as_matrix(), expected.as_matrix(), atol=1e-14)


# --- topics of a bag ---


def read(bag: Path) -> Messages:
    messages: Messages = {}
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, decoded))
    return messages


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec * SECOND + stamp.nanosec)


def transforms(message: Any) -> list[Transform]:
    found = []
    for stamped in message.transforms:
        p, r = stamped.transform.translation, stamped.transform.rotation
        parent, child = stamped.header.frame_id, stamped.child_frame_id
        found.append(Transform(parent, child, (p.x, p.y, p.z), (r.x, r.y, r.z, r.w)))
    return found


def xyz(message: Any) -> list[float]:
    return [message.point.x, message.point.y, message.point.z]


@pytest.fixture(scope="module")
def fmu_urdf(fmu_path):
    with zipfile.ZipFile(fmu_path) as fmu:
        return fmu.read("resources/robot.urdf").decode()


@pytest.fixture(scope="module")
def messages(fmu_path, tmp_path_factory):
    """Return the messages of a run of the default arm whose target jumps after 0.5 s."""
    folder = tmp_path_factory.mktemp("scene")
    inputs = folder / "inputs.csv"
    inputs.write_text("time,x_des[1],x_des[2]\n0,0.2,0.05\n0.5,0.1,0.2\n")
    run = twodof.experiment(fmu_path, stop_time=1.0, input_file=inputs, stamp_start=START)
    twodof.simulate(run, twodof.Bag(folder / "bag", scene=True))
    return read(folder / "bag")


def test_scene_has_one_message_a_sample_and_one_on_latched_topics(messages):
    """Their stamps are their log times."""
    streams = ["/joint_states", "/tf", "/target", "/end_effector"]
    assert set(messages) == {*streams, *LATCHED}
    for topic, each in messages.items():
        times = [START * SECOND + k * SECOND // 100 for k in range(1 if topic in LATCHED else 101)]
        assert [log_time for log_time, _ in each] == times
        for log_time, message in each:
            parts = [] if topic == LATCHED[0] else getattr(message, "transforms", [message])
            assert {nanoseconds(part.header.stamp) for part in parts} <= {log_time}


def test_tf_of_the_bag_shows_the_arm_where_its_joint_states_put_it(messages, fmu_urdf):
    ((_, static),) = messages["/tf_static"]
    for (_, state), (_, tf) in zip(messages["/joint_states"], messages["/tf"], strict=True):
        expected = placements(fmu_urdf, list(state.name), np.array(state.position))
        found = chained([*transforms(static), *transforms(tf)])
        assert_same_poses(found, expected, fmu_urdf)


def test_end_effector_and_target_are_in_the_root_frame(messages):
    states, points, targets = (messages[f"/{it}"] for it in ("joint_states", "end_effector", "target"))
    for (_, state), (_, point), (_, target) in zip(states, points, targets, strict=True):
        assert point.header.frame_id == target.header.frame_id == "world"
        expected = [*oracles.position(np.array(state.position)), 0.0]
        np.testing.assert_allclose(xyz(point), expected, rtol=0.0, atol=1e-15)
    found = [xyz(target) for _, target in targets]
    assert found[:50] == [[0.2, 0.05, 0.0]] * 50
    assert found[51:] == [[0.1, 0.2, 0.0]] * 50  # the change and sample 50 are at the same time


def test_target_follows_the_end_effector_along_axes_that_are_not_controlled(robots, ur5, tmp_path):
    options = twodof.FmuOptions(urdf=robots / ROBOTS["ur5"], mesh_dir=robots.parents[1], frame="tool0", axes="zx")
    fmu = twodof.build_fmu(tmp_path / "ur5.fmu", options)
    run = twodof.experiment(fmu)
    q = (0.1, -0.9, 1.2, 0.4, 0.5, 0.6)
    inputs = {"x_des[1]": 0.7, "x_des[2]": -0.3}
    with twodof.Bag(tmp_path / "bag", scene=True).begin(run) as bag:
        bag.write(Sample(0, 0.0, q, q, (0.0, 0.0), q, inputs, 0.0, 0))
    found = read(tmp_path / "bag")
    ((_, end_effector),) = found["/end_effector"]
    ((_, target),) = found["/target"]
    assert end_effector.header.frame_id == target.header.frame_id == "world"
    x = placements(ur5, moving_joints(ur5), np.array(q))["tool0"][:3, 3]
    np.testing.assert_allclose(xyz(end_effector), x, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(xyz(target), [-0.3, x[1], 0.7], rtol=0.0, atol=1e-12)


# --- robot description ---


def geometries(urdf: str) -> list[tuple[ET.Element, np.ndarray]]:
    """Shapes of all visuals and collisions in file order, and their poses."""
    found = []
    for link in ET.fromstring(urdf).findall("link"):
        for part in (*link.findall("visual"), *link.findall("collision")):
            origin = part.find("origin")
            attributes = {} if origin is None else origin.attrib
            position, angles = (
                [float(word) for word in attributes.get(key, "0 0 0").split()] for key in ("xyz", "rpy")
            )
            shape = part.findall("geometry/*")[0]
            found.append((shape, pose(position, Rotation.from_euler("xyz", angles))))
    return found


def moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def outside(shape: ET.Element, points: np.ndarray) -> float:
    """Return the distance of points outside of a box or cylinder about their origin, m."""
    if shape.tag == "box":
        half = np.array([float(word) for word in shape.get("size", "").split()]) / 2
        return float((np.abs(points) - half).max())
    assert shape.tag == "cylinder"
    radial = np.hypot(points[:, 0], points[:, 1]) - float(shape.get("radius", ""))
    axial = np.abs(points[:, 2]) - float(shape.get("length", "")) / 2
    return float(max(radial.max(), axial.max()))


def volume(shape: ET.Element) -> float:
    if shape.tag == "box":
        return math.prod(float(word) for word in shape.get("size", "").split())
    return math.pi * float(shape.get("radius", "")) ** 2 * float(shape.get("length", ""))


def assert_shapes_hold_the_meshes(description: str, urdf: str, vertices: Callable[[str], np.ndarray]) -> None:
    assert "<mesh" not in description
    before, after = geometries(urdf), geometries(description)
    meshes = 0
    for (mesh, placed), (shape, fitted) in zip(before, after, strict=True):
        if mesh.tag != "mesh":
            assert (shape.tag, shape.attrib) == (mesh.tag, mesh.attrib)
            np.testing.assert_array_equal(fitted, placed)
            continue
        meshes += 1
        own = vertices(mesh.get("filename", ""))
        own = own * np.array([float(word) for word in mesh.get("scale", "1 1 1").split()])
        local = moved(moved(own, placed), np.linalg.inv(fitted))
        assert outside(shape, local) <= 1e-9
        assert volume(shape) <= np.prod(np.ptp(own, axis=0)) * (1.0 + 1e-9)
    assert meshes > 0


def assert_same_robot(description: str, urdf: str) -> None:
    """Assert that urdfdom reads the same robot, except for the geometry."""
    found, expected = pin.buildModelFromXML(description), pin.buildModelFromXML(urdf)
    assert found == expected


def test_description_of_the_default_arm_holds_its_meshes(messages, fmu_path, fmu_urdf):
    ((_, message),) = messages["/robot_description"]
    assert_same_robot(message.data, fmu_urdf)
    model = pin.buildModelFromXML(message.data)
    for kind in (pin.VISUAL, pin.COLLISION):
        shapes = pin.buildGeomFromUrdfString(model, message.data, kind)
        assert len(shapes.geometryObjects) == 2
    with zipfile.ZipFile(fmu_path) as fmu:

        def vertices(uri: str) -> np.ndarray:
            name = uri.removeprefix("package://")
            file = io.BytesIO(fmu.read(f"resources/{name}"))
            return np.array(trimesh.load_mesh(file, file_type="stl").vertices)

        assert_shapes_hold_the_meshes(message.data, fmu_urdf, vertices)


def test_description_of_the_ur5_holds_its_meshes(robots, ur5):
    folder = robots.parents[1]
    joints = moving_joints(ur5)
    description = Scene(ur5, joints, "tool0", lambda name: (folder / name).read_bytes()).description
    assert_same_robot(description, ur5)
    model = pin.buildModelFromXML(ur5)
    visuals = pin.buildGeomFromUrdfString(model, ur5, pin.VISUAL, None, [str(folder)])
    collada = {thing.meshPath: thing.geometry.vertices() for thing in visuals.geometryObjects}

    def vertices(uri: str) -> np.ndarray:
        path = folder / uri.removeprefix("package://")
        if path.suffix == ".stl":
            return np.array(trimesh.load_mesh(path).vertices)
        return np.array(collada[str(path)])

    assert_shapes_hold_the_meshes(description, ur5, vertices)


def with_mesh(attributes: str = "", origin: str = "") -> str:
    return (
        '<robot name="thing"><link name="base"/><link name="thing"><visual>'
        f'{origin}<geometry><mesh filename="package://meshes/thing.stl"{attributes}/></geometry>'
        "</visual></link><joint name='fixed' type='fixed'><parent link='base'/>"
        "<child link='thing'/></joint></robot>"
    )


def placed(seed: int) -> np.ndarray:
    """Return a random pose for a seed; 0 gives the identity."""
    if seed == 0:
        return np.eye(4)
    turn = Rotation.from_rotvec(np.random.default_rng(seed).normal(size=3))
    return pose([0.3, -0.2, 0.1], turn)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("box", (0.05, 0.1, 0.3)),
        ("box", (0.02, 0.1, 0.2)),
        ("box", (0.8, 0.9, 1.0)),
        ("cylinder", (0.04, 0.3)),
        ("cylinder", (0.2, 0.02)),
        ("cylinder", (0.1, 0.25)),
    ],
)
def test_fit_recovers_a_box_or_a_cylinder(seed, kind, size):
    if kind == "box":
        mesh = trimesh.creation.box(extents=size, transform=placed(seed))
    else:
        radius, height = size
        mesh = trimesh.creation.cylinder(radius, height, sections=64, transform=placed(seed))
    shape = fitted_shape(mesh)[0]
    assert shape.tag == kind
    words = shape.get("size") or f"{shape.get('radius')} {shape.get('length')}"
    found = [float(word) for word in words.split()]
    assert (sorted(found) if kind == "box" else found) == pytest.approx(size, rel=1e-2)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_fit_finds_the_axis_of_a_cylinder(axis):
    mesh = trimesh.creation.cylinder(0.04, 0.3, sections=64)
    mesh.vertices = np.roll(mesh.vertices, axis + 1, axis=1)
    shape, fitted = fitted_shape(mesh)
    assert float(shape.get("length", "")) == pytest.approx(0.3)
    np.testing.assert_allclose(np.abs(fitted[:3, 2]), np.eye(3)[axis], atol=1e-6)


def fitted_shape(mesh: trimesh.Trimesh, urdf: str = "") -> tuple[ET.Element, np.ndarray]:
    """Return the shape that replaces a mesh in a robot description, and its pose."""
    content, urdf = mesh.export(file_type="stl"), urdf or with_mesh()
    assert isinstance(content, bytes)
    description = Scene(urdf, [], "thing", lambda _: content).description
    assert_shapes_hold_the_meshes(description, urdf, lambda _: single(mesh.vertices))
    (found,) = geometries(description)
    return found


def single(vertices: np.ndarray) -> np.ndarray:
    """Round to the precision of an STL file."""
    return np.asarray(vertices, dtype=np.float32).astype(float)


@pytest.mark.parametrize("angles", ["0 0 0", "0.3 -0.4 2.5", "0 1.5707963267948966 0", "1 -1.5707963267948966 2"])
def test_fit_keeps_the_origin_and_the_scale_of_the_mesh(angles):
    mesh = trimesh.creation.box(extents=(300.0, 100.0, 50.0))
    mesh.apply_translation([10.0, 20.0, 30.0])
    origin = f'<origin xyz="1 2 3" rpy="{angles}"/>'
    shape, _ = fitted_shape(mesh, with_mesh(' scale="0.001 0.002 0.003"', origin))
    size = sorted(float(word) for word in shape.get("size", "").split())
    assert size == pytest.approx([0.15, 0.2, 0.3], rel=1e-6)


@pytest.mark.parametrize("attributes", [' scale="x"', ' scale="nan 1 1"'])
def test_a_mesh_that_is_not_placed_by_numbers_is_refused(attributes):
    with pytest.raises(RobotError, match="its meshes cannot be placed: "):
        Scene(with_mesh(attributes), [], "thing", lambda _: None)


@pytest.mark.parametrize("k", range(24))
def test_fit_is_right_where_the_shape_is_turned_by_right_angles(k):
    # a third of these have a pitch of a right angle, where roll and yaw turn about one axis
    turned = placed(1)
    mesh = trimesh.creation.box(extents=(0.3, 0.1, 0.05), transform=turned)
    turn = Rotation.create_group("O")[k] * Rotation.from_matrix(turned[:3, :3]).inv()
    roll, pitch, yaw = turn.as_euler("xyz").tolist()
    fitted_shape(mesh, with_mesh(origin=f'<origin xyz="1 2 3" rpy="{roll!r} {pitch!r} {yaw!r}"/>'))


@pytest.mark.parametrize("content", [None, b"this is no mesh"], ids=["missing", "unreadable"])
def test_mesh_that_cannot_be_read_is_left_out_and_named(content, caplog):
    with caplog.at_level(logging.WARNING):
        description = Scene(with_mesh(), [], "thing", lambda _: content).description
    assert "thing.stl" in caplog.text
    assert "<mesh" not in description
    assert geometries(description) == []
    assert_same_robot(description, with_mesh())


UP = "../" * 40  # from a temporary folder to the root


def test_mesh_whose_geometry_is_in_another_file_is_left_out(tmp_path, caplog):
    """Otherwise a page would contain the other file's bytes as vertices."""
    (tmp_path / "secret").write_bytes(struct.pack("<9f", *range(9)))
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"uri": f"{UP}{tmp_path}/secret", "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    }
    urdf = with_mesh().replace("thing.stl", "thing.gltf")
    description = Scene(urdf, [], "thing", lambda _: json.dumps(content).encode()).description
    assert "its format '.gltf' is not one of .stl" in caplog.text
    assert geometries(description) == []


def test_library_of_colours_is_not_read_with_a_mesh(tmp_path):
    """It may be a pipe, for which reading would wait without end."""
    os.mkfifo(tmp_path / "pipe")
    content = f"mtllib {UP}{tmp_path}/pipe\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl x\nf 1 2 3\n"
    code = (
        "import sys; from twodof.geometry.meshes import Meshes\n"
        "with Meshes({'a.obj': sys.argv[1].encode()}.get) as meshes:\n"
        "    print(len(meshes.surfaces('a.obj', coloured=False)[0].triangles))"
    )
    command = [sys.executable, "-c", code, content]
    assert subprocess.check_output(command, text=True, timeout=60) == "1\n"


def description_in(bag: Path) -> str:
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        decoded = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["/robot_description"])
        ((_, _, _, message),) = decoded
    return str(message.data)


def test_meshes_of_a_scene_are_opened_by_their_uris(native_path, tmp_path):
    bag = tmp_path / "a b#1%20ü?"
    twodof.simulate(native_path, twodof.Bag(bag, meshes=True), stop_time=0.02)
    names = [str(mesh.get("filename")) for mesh in ET.fromstring(description_in(bag)).iter("mesh")]
    assert len(names) >= 2
    for name in names:
        with urlopen(name) as content:
            assert content.read() == (bag / "meshes" / Path(name).name).read_bytes()


def test_meshes_are_read_from_an_fmu_that_stores_folders(native_path, tmp_path):
    """As ``zip -r`` and many other tools do."""
    fmu = tmp_path / "folders.fmu"
    with zipfile.ZipFile(native_path) as source, zipfile.ZipFile(fmu, "w") as archive:
        for folder in ("resources/", "resources/meshes/"):
            archive.writestr(folder, b"")
        for name in source.namelist():
            archive.writestr(name, source.read(name))
    for path in (native_path, fmu):
        twodof.simulate(path, twodof.Bag(tmp_path / path.stem, meshes=True), stop_time=0.02)
    folders = [tmp_path / path.stem / "meshes" for path in (native_path, fmu)]
    plain, other = ({file.name: file.read_bytes() for file in folder.iterdir()} for folder in folders)
    assert len(plain) >= 2 and other == plain


@pytest.fixture(scope="module")
def panda(tmp_path_factory):
    return twodof.build_fmu(tmp_path_factory.mktemp("panda") / "panda.fmu", twodof.stock_robot("panda"))


def test_a_scene_with_meshes_shows_them_where_pinocchio_has_them(panda, tmp_path):
    """Pinocchio reads URDF and meshes by the bag's description and the files that it names."""
    twodof.simulate(panda, twodof.Bag(tmp_path / "Müller", meshes=True), stop_time=0.02)
    description = description_in(tmp_path / "Müller")
    source = stock_robots()["panda"]
    truth = pin.buildGeomFromUrdf(
        pin.buildModelFromUrdf(str(source)), str(source), pin.GeometryType.VISUAL, package_dirs=str(source.parents[4])
    )
    model = pin.buildModelFromXML(description)
    found = pin.buildGeomFromUrdfString(model, description, pin.GeometryType.VISUAL)
    assert len(found.geometryObjects) == len(truth.geometryObjects) >= 10
    for shown, wanted in zip(found.geometryObjects, truth.geometryObjects):
        assert shown.name == wanted.name and shown.meshPath.startswith(str(tmp_path / "Müller/meshes"))
        np.testing.assert_allclose(shown.placement.homogeneous, wanted.placement.homogeneous, rtol=0.0, atol=1e-9)
        corners = [geometry.geometry.vertices() for geometry in (shown, wanted)]
        assert corners[0].size >= 954
        np.testing.assert_allclose(corners[0], corners[1], rtol=0.0, atol=1e-9)


@pytest.mark.needs("urdf-loader")
def test_a_scene_with_meshes_shows_a_panda_in_three_js_where_pinocchio_has_it(panda, tmp_path):
    """Pinocchio reads the original URDF and its meshes; three.js has vertices in single precision.

    It also has four vertices that Pinocchio leaves out, within the bounding boxes of the links.
    """
    bag = tmp_path / "a b#1%20ü?"
    twodof.simulate(panda, twodof.Bag(bag, meshes=True), stop_time=0.5, settings={"x_des": (0.45, 0.25, 0.6)})
    command = [needs("node"), str(Path(__file__).with_name("scene_reader.mjs")), str(bag / f"{bag.name}.mcap")]
    found = json.loads(subprocess.check_output(command, stderr=subprocess.PIPE).splitlines()[-1])
    assert np.ptp([twodof.read_bag(bag).q[0], twodof.read_bag(bag).q[-1]], axis=0).max() > 0.1
    source = str(stock_robots()["panda"])
    model = pin.buildModelFromUrdf(source)
    visuals = pin.buildGeomFromUrdf(
        model, source, pin.GeometryType.VISUAL, package_dirs=str(stock_robots()["panda"].parents[4])
    )
    q = np.array([found["q"][name.replace("finger_joint2", "finger_joint1")] for name in list(model.names)[1:]])
    poses = visuals.createData()
    pin.updateGeometryPlacements(model, model.createData(), visuals, poses, q)
    links = 0
    for shape, pose in zip(visuals.geometryObjects, poses.oMg):
        link = model.frames[shape.parentFrame].name
        expected = shape.geometry.vertices() @ pose.rotation.T + pose.translation
        for way in ("joints", "tf"):
            vertices = np.array(found[way][link])
            assert KDTree(vertices).query(expected)[0].max() < 1e-6, (way, link)
            box = [[points.min(axis=0), points.max(axis=0)] for points in (vertices, expected)]
            np.testing.assert_allclose(box[0], box[1], rtol=0.0, atol=1e-6, err_msg=f"{way} {link}")
        links += 1
    assert links == 11
