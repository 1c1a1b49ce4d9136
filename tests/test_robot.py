"""URDFs: refusals with the culprit's name, and the meaning of accepted elements."""

from __future__ import annotations

import math
import re
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from twodof.plant.robot import Robot, load_robot
from twodof.plant.urdf import MAX_JOINTS, UNBOUNDED, RobotError

LIMIT = '<limit lower="-1" upper="2" effort="3" velocity="4"/>'


def inertial(mass: object = 1.0, ixx: object = 1, iyy: object = 1, izz: object = 1) -> str:
    return (
        f'<inertial><origin xyz="0.1 0.02 0.03"/><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>'
    )


def link(name: str, inside: str | None = None) -> str:
    return f'<link name="{name}">{inertial() if inside is None else inside}</link>'


def joint(
    name: str,
    parent: str,
    child: str,
    inside: str = LIMIT,
    kind: str = "revolute",
    axis: str = "0 0 1",
    xyz: str = "0.3 0.2 0.1",
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>{inside}</joint>'
    )


def shoulder(inside: str = LIMIT, **changes: str) -> str:
    return joint("shoulder", "base", "upper", inside, **changes)


def elbow(inside: str = LIMIT, **changes: str) -> str:
    return joint("elbow", "upper", "tip", inside, **changes)


def robot(*parts: str) -> str:
    return f'<robot name="arm">{"".join(parts)}</robot>'


def arm(*more: str, **changes: str) -> str:
    """An arm of two joints, with replaced or added parts."""
    parts = {
        "base": link("base", ""),
        "upper": link("upper"),
        "tip": link("tip"),
        "shoulder": shoulder(),
        "elbow": elbow(),
    }
    return robot(*{**parts, **changes}.values(), *more)


def chain(links: int) -> str:
    names = [f"link{i}" for i in range(links)]
    joints = [joint(f"joint{i}", names[i - 1], names[i]) for i in range(1, links)]
    return robot(*map(link, names), *joints)


DTD = '<!DOCTYPE robot [<!ENTITY a "b">]>'
REFUSED = {
    "empty": ("", "not XML"),
    "no XML": ("robot: arm", "not XML"),
    "unclosed": (arm()[:-3], "not XML"),
    "another root": (arm().replace("robot", "sdf"), "<sdf>, expected <robot>"),
    "document type": (DTD + arm(), "document type"),
    "entity": ("<?xml version='1.0'?>" + DTD + arm(), "document type"),
    "link without a name": (arm("<link/>"), "<link> without a name"),
    "joint without a name": (arm(elbow=elbow().replace('name="elbow"', "")), "<joint> without"),
    "a name of 1001 characters": (arm(link("x" * 1001)), "<link> whose name has 1001 characters"),
    "two links of one name": (arm(link("tip")), "two links named 'tip'"),
    "two joints of one name": (arm(link("x"), joint("elbow", "tip", "x")), "two joints .*'elbow'"),
    "no links": (robot(), "no links"),
    "3 million elements": (robot("<a/>" * 3_000_000), "the URDF has .* characters; at most 8388608 are supported"),
    "no moving joint": (
        robot(link("base"), link("a"), joint("weld", "base", "a", kind="fixed")),
        "no joint moves a link",
    ),
    "one link only": (robot(link("base")), "no joint moves a link"),
    "missing parent": (arm(elbow=joint("elbow", "ghost", "tip")), "'elbow'.* parent .*'ghost'"),
    "missing child": (arm(joint("wrist", "tip", "ghost")), "'wrist'.* child .*'ghost'"),
    "no parent element": (arm(elbow=elbow().replace('<parent link="upper"/>', "")), "'elbow'"),
    "two parents": (arm(joint("loop", "base", "tip")), "'tip' has two parents"),
    "cycle": (arm(link("a"), link("b"), joint("f", "a", "b"), joint("g", "b", "a")), "'a'|'b'"),
    "whole cycle": (robot(link("a"), joint("f", "a", "a")), "'a' is its own ancestor"),
    "two roots": (arm(link("stray")), "one root link, it has 2: base, stray"),
    "no type": (arm(elbow=elbow().replace(' type="revolute"', "")), "'elbow'.* type"),
    "mimic of none": (arm(elbow=elbow(LIMIT + '<mimic joint="e"/>')), "'elbow' mimics 'e'.* exist"),
    "mimic of no name": (arm(elbow=elbow(LIMIT + "<mimic/>")), "'elbow' mimics ''.* not exist"),
    "mimic of itself": (arm(elbow=elbow(LIMIT + '<mimic joint="elbow"/>')), "'elbow' mimics itself"),
    "mimics in a circle": (
        arm(elbow=elbow(LIMIT + '<mimic joint="shoulder"/>'), shoulder=shoulder(LIMIT + '<mimic joint="elbow"/>')),
        "mimics 'shoulder', which follows it",
    ),
    "mimic of a fixed joint": (
        arm(
            elbow=elbow(LIMIT + '<mimic joint="weld"/>'),
            hand=link("hand"),
            weld=joint("weld", "tip", "hand", kind="fixed"),
        ),
        "'elbow' mimics 'weld', which is fixed: make 'elbow' fixed too",
    ),
    "mimic by a word": (
        arm(elbow=elbow(LIMIT + '<mimic joint="shoulder" multiplier="two"/>')),
        "'elbow': its <mimic> has a factor or offset that is not a number",
    ),
    "mimics that multiply": (
        arm(
            elbow=elbow(LIMIT + '<mimic joint="shoulder" multiplier="1e5"/>'),
            shoulder=shoulder(LIMIT + '<mimic joint="wrist" multiplier="1e5"/>'),
            hand=link("hand"),
            wrist=joint("wrist", "tip", "hand", LIMIT),
        ),
        "'elbow': the factors or offsets of the joints that it mimics are too large",
    ),
    "mimic beyond its limits": (
        arm(elbow=elbow(LIMIT + '<mimic joint="shoulder" offset="9"/>')),
        "'elbow' mimics 'shoulder', but no position of 'shoulder' is within the limits of both",
    ),
    "no limit": (arm(elbow=elbow("")), "'elbow' has no <limit>"),
    "no limit, prismatic": (arm(elbow=elbow("", kind="prismatic")), "'elbow' has no <limit>"),
    "inverted limits": (arm(elbow=elbow('<limit lower="1" upper="-1"/>')), "'elbow': lower limit"),
    "upper below default 0": (arm(elbow=elbow('<limit upper="-1"/>')), "'elbow': lower limit 0"),
    "negative effort": (arm(elbow=elbow('<limit effort="-1"/>')), "'elbow': negative effort"),
    "negative friction": (arm(elbow=elbow(LIMIT + '<dynamics friction="-1"/>')), "'elbow'.* friction"),
    "negative damping": (arm(elbow=elbow(LIMIT + '<dynamics damping="-1"/>')), "'elbow'.* damping"),
    "zero axis": (arm(elbow=elbow(axis="0 0 0")), "'elbow': its axis is zero"),
    "axis of two": (arm(elbow=elbow(axis="0 1")), "'elbow': <axis xyz='0 1'>"),
    "axis of words": (arm(elbow=elbow(axis="x y z")), "'elbow': <axis xyz='x y z'>"),
    "NaN axis": (arm(elbow=elbow(axis="0 0 nan")), "'elbow': <axis xyz='0 0 nan'>"),
    "huge axis": (arm(elbow=elbow(axis="0 0 1e200")), "'elbow': <axis xyz='0 0 1e200'>"),
    "infinite origin": (arm(elbow=elbow(xyz="0 0 inf")), "'elbow': <origin xyz='0 0 inf'>"),
    "NaN limit": (arm(elbow=elbow('<limit upper="nan"/>')), "'elbow': <limit upper='nan'>"),
    "limit no number": (arm(elbow=elbow('<limit upper="pi"/>')), "'elbow': <limit upper='pi'>"),
    "NaN damping": (arm(elbow=elbow(LIMIT + '<dynamics damping="nan"/>')), "'elbow': <dynamics"),
    "no inertial": (arm(tip=link("tip", "")), "'elbow': .* no mass .* or lock the joint"),
    "zero mass": (arm(tip=link("tip", inertial(0, 0, 0, 0))), "'elbow': .* no mass"),
    "negative mass": (arm(tip=link("tip", inertial(-1))), "'tip': negative mass -1"),
    "NaN mass": (arm(tip=link("tip", inertial("nan"))), "'tip': <mass value='nan'>"),
    "infinite mass": (arm(tip=link("tip", inertial("inf"))), "'tip': <mass value='inf'>"),
    "huge mass": (arm(tip=link("tip", inertial("1e30"))), "'tip': <mass value='1e30'>"),
    "mass no number": (arm(tip=link("tip", inertial("1 kg"))), "'tip': <mass value='1 kg'>"),
    "negative inertia": (arm(tip=link("tip", inertial(1, 1, 1, -0.1))), "'tip': its inertia"),
    "NaN inertia": (arm(tip=link("tip", inertial(1, "nan"))), "'tip': <inertia ixx='nan'>"),
    "huge inertia": (arm(tip=link("tip", inertial(1, "1e99"))), "'tip': <inertia ixx='1e99'>"),
    "mass in other digits": (arm(tip=link("tip", inertial("١"))), "'tip': <mass value='١'>"),
    "mass with an underscore": (arm(tip=link("tip", inertial("1_0"))), "'tip': <mass value='1_0'>"),
    "nested deeply": (arm("<b>" * 100 + "</b>" * 100), "nested deeper than 100"),
    "no <inertia>": (arm(tip=link("tip", '<inertial><mass value="1"/></inertial>')), "link 'tip'"),
    "no ixy": (arm(tip=link("tip", inertial().replace('ixy="0"', ""))), "link 'tip'"),
    "singular mass matrix, one joint": (
        robot(
            link("base", ""),
            link("tip", inertial(1, 0, 0, 0).replace("0.1 0.02 0.03", "0 0 0.03")),
            joint("hinge", "base", "tip"),
        ),
        "'hinge'.* no inertia about its axis",
    ),
    "singular mass matrix": (
        arm(tip=link("tip", inertial(1, 0, 0, 0).replace("0.1 0.02 0.03", "0 0 0.03"))),
        "'elbow'.* no inertia about its axis",
    ),
    "broken inertial in a body that has mass": (
        arm(joint("fixed", "tip", "tool", kind="fixed"), link("tool", inertial(5).replace('ixy="0"', ""))),
        "link 'tool'",
    ),
}


@pytest.mark.parametrize(("urdf", "culprit"), REFUSED.values(), ids=REFUSED)
def test_refusal_names_the_culprit_in_one_line(urdf: str, culprit: str) -> None:
    with pytest.raises(RobotError, match=culprit) as refusal:
        load_robot(urdf, "tip", "xyz")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("kind", ["floating", "planar", "spherical", "screw", ""])
def test_unsupported_joint_type_is_refused(kind: str) -> None:
    with pytest.raises(RobotError, match=f"joint 'elbow' is of type '{kind}'"):
        load_robot(arm(elbow=elbow(kind=kind)), "tip", "xyz")


def test_unknown_frame_is_refused_with_those_there_are() -> None:
    with pytest.raises(RobotError, match=r"no frame 'hand'.*there are: base, upper, tip"):
        load_robot(arm(), "hand", "xyz")


@pytest.mark.parametrize("axes", ["", "xx", "xyzx", "w", "XY", "x y"])
def test_axes_other_than_letters_of_xyz_are_refused(axes: str) -> None:
    with pytest.raises(RobotError, match=f"axes '{axes}'"):
        load_robot(arm(), "tip", axes)


def test_too_many_links_are_refused_at_once() -> None:
    urdf = chain(5000)
    with pytest.raises(RobotError, match="5000 links"):
        load_robot(urdf, "link1", "xyz")


def test_any_number_of_joints_that_is_not_refused_loads_in_two_gigabytes() -> None:
    # Pinocchio's Data takes 100 GB for 1000 joints; in a process of its own, with a limit
    code = f"""
        import resource
        from twodof.plant.robot import load_robot
        resource.setrlimit(resource.RLIMIT_AS, (2 * 1024**3,) * 2)
        print(len(load_robot({chain(MAX_JOINTS + 1)!r}, "link1", "xyz").joints))
        """
    environment = {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": ":".join(sys.path)}
    child = subprocess.run(
        [sys.executable], input=textwrap.dedent(code), env=environment, capture_output=True, text=True, timeout=300
    )
    assert child.stdout == f"{MAX_JOINTS}\n", child.stderr[-300:]


# --- what is accepted ---


def angles(model: pin.Model, q: np.ndarray) -> np.ndarray:
    """Pinocchio's configuration, (cos, sin) for an angle with two numbers."""
    own: list[float] = []
    for jnt, value in zip(list(model.joints)[1:], q):
        own.extend([value] if jnt.nq == 1 else [math.cos(value), math.sin(value)])
    return np.array(own)


def assert_same_mechanism(loaded: Robot, urdf: str) -> None:
    """Assert that frames and mass matrix are those of Pinocchio's own loading of the URDF."""
    own = pin.buildModelFromXML(urdf)
    assert list(loaded.model.names) == list(own.names)
    data, own_data = loaded.model.createData(), own.createData()
    random = np.random.default_rng(1)
    for _ in range(5):
        q = random.uniform(-9.0, 9.0, loaded.model.nq)
        pin.framesForwardKinematics(loaded.model, data, q)
        pin.framesForwardKinematics(own, own_data, angles(own, q))
        for frame, placement in zip(own.frames, own_data.oMf):
            i = loaded.model.getFrameId(frame.name, frame.type)
            np.testing.assert_allclose(data.oMf[i], placement, atol=1e-12)
        M = np.triu(pin.crba(loaded.model, data, q))
        np.testing.assert_allclose(M, np.triu(pin.crba(own, own_data, angles(own, q))), rtol=1e-9, atol=1e-12)


def test_continuous_joint_has_the_angle_as_state_and_no_limits() -> None:
    urdf = arm(elbow=elbow('<limit effort="5" velocity="1"/>', kind="continuous"))
    loaded = load_robot(urdf, "tip", "xyz")
    assert loaded.model.nq == loaded.model.nv == len(loaded.joints) == 2
    assert (UNBOUNDED, loaded.q_min[1], loaded.q_max[1]) == (1.7976931348623157e308, -UNBOUNDED, UNBOUNDED)
    assert (loaded.q_min[0], loaded.q_max[0]) == (-1.0, 2.0)
    assert loaded.effort == (3.0, 5.0)
    assert_same_mechanism(loaded, urdf)


def test_continuous_joint_needs_no_limit_element() -> None:
    loaded = load_robot(arm(elbow=elbow("", kind="continuous")), "tip", "xyz")
    assert loaded.q_max == (2.0, UNBOUNDED)
    assert loaded.effort == (3.0, math.inf)


def test_limits_written_at_a_continuous_joint_are_ignored() -> None:
    loaded = load_robot(arm(elbow=elbow(kind="continuous")), "tip", "xyz")
    assert (loaded.q_min[1], loaded.q_max[1]) == (-UNBOUNDED, UNBOUNDED)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("huge", ["1e300", "1e400", "inf"])
def test_huge_limits_are_none(huge: str, kind: str) -> None:
    limit = f'<limit lower="-{huge}" upper="{huge}" effort="{huge}" velocity="{huge}"/>'
    loaded = load_robot(arm(elbow=elbow(limit, kind=kind)), "tip", "xyz")
    assert loaded.q_min[1] <= -1e300
    assert loaded.q_max[1] >= 1e300
    assert loaded.effort[1] >= 1e300
    assert abs(loaded.q_min[1]) <= UNBOUNDED >= loaded.q_max[1]


def test_prismatic_joint_moves_along_its_axis() -> None:
    urdf = arm(elbow=elbow(kind="prismatic", axis="0 2 0"))
    loaded = load_robot(urdf, "tip", "xyz")
    assert loaded.prismatic == (False, True)
    data = loaded.model.createData()
    pin.framesForwardKinematics(loaded.model, data, np.array([0.0, 0.25]))
    moved = data.oMf[loaded.frame_id].translation
    np.testing.assert_allclose(moved, [0.6, 0.4 + 0.25, 0.2], atol=1e-15)
    assert_same_mechanism(loaded, urdf)


def test_tree_is_read_with_its_branches() -> None:
    urdf = arm(link("left"), joint("branch", "upper", "left", kind="prismatic", axis="1 1 0"))
    loaded = load_robot(urdf, "tip", "xyz")
    assert sorted(loaded.joints) == ["branch", "elbow", "shoulder"]
    moves = dict(zip(loaded.joints, loaded.moves_frame(), strict=True))
    assert moves == {"shoulder": True, "branch": False, "elbow": True}
    assert dict(zip(loaded.joints, loaded.prismatic))["branch"]
    assert_same_mechanism(loaded, urdf)


def test_attributes_belong_to_their_joint_in_whatever_order() -> None:
    other = '<limit lower="-5" upper="6" effort="7" velocity="1"/><dynamics damping="0.25"/>'
    loaded = load_robot(robot(elbow(other), link("tip"), shoulder(), link("upper"), link("base", "")), "tip", "xyz")
    assert loaded.joints == ("shoulder", "elbow")
    assert loaded.q_min == (-1.0, -5.0)
    assert loaded.q_max == (2.0, 6.0)
    assert loaded.effort == (3.0, 7.0)
    assert loaded.damping == (0.0, 0.25)
    assert (loaded.name, loaded.root, loaded.frame, loaded.axes) == ("arm", "base", "tip", "xyz")
    assert loaded.warnings == ()


@pytest.mark.parametrize("effort", ['effort="0"', ""])
def test_effort_of_zero_or_none_is_unlimited(effort: str) -> None:
    limit = f'<limit lower="-1" upper="1" {effort} velocity="1"/>'
    assert load_robot(arm(elbow=elbow(limit)), "tip", "xyz").effort == (3.0, math.inf)


def test_friction_is_read_without_a_warning() -> None:
    rough = elbow(LIMIT + '<dynamics damping="0.5" friction="0.1"/>')
    loaded = load_robot(arm(elbow=rough), "tip", "xyz")
    assert (loaded.damping, loaded.friction, loaded.warnings) == ((0.0, 0.5), (0.0, 0.1), ())


@pytest.mark.parametrize(("most", "warned"), [(180.0, True), (6.3, False), (1e16, False)])
def test_limits_in_degrees_are_warned_of(most: float, warned: bool) -> None:
    wide = elbow(f'<limit lower="-{most}" upper="{most}" effort="7" velocity="1"/>')
    warnings = load_robot(arm(elbow=wide), "tip", "xyz").warnings
    assert warnings == ("limits of more than 25 rad may be in degrees: joint 'elbow'",) * warned


@pytest.mark.parametrize("inside", ["", 'lower="0.5" upper="0.5"'])
def test_a_joint_that_its_limits_freeze_is_warned_of(inside: str) -> None:
    still = elbow(f'<limit {inside} effort="7" velocity="1"/>')
    loaded = load_robot(arm(elbow=still), "tip", "xyz")
    assert loaded.q_min[1] == loaded.q_max[1]
    (warning,) = loaded.warnings
    assert "limits do not allow any motion of joint 'elbow'" in warning
    follower = elbow('<limit effort="7"/><mimic joint="shoulder"/>')
    assert not load_robot(arm(elbow=follower), "tip", "xyz").warnings


EXTRAS = {
    "transmission": '<transmission name="t"><joint name="elbow"><x/></joint></transmission>',
    "gazebo": '<gazebo><joint name="elbow" type="ball"/><link name="tip"/></gazebo>',
    "ros2_control": '<ros2_control name="c" type="system"><joint name="shoulder"/></ros2_control>',
    "material": '<material name="red"><color rgba="1 0 0 1"/></material>',
}


@pytest.mark.parametrize("extra", EXTRAS.values(), ids=EXTRAS)
def test_elements_beside_the_mechanism_are_ignored(extra: str) -> None:
    loaded = load_robot(arm(extra), "tip", "xyz")
    assert loaded.joints == ("shoulder", "elbow")
    assert_same_mechanism(loaded, arm())


UNUSED = {"safety controller": "<safety_controller/>", "unknown": "<note>x</note>"}


@pytest.mark.parametrize("unused", UNUSED.values(), ids=UNUSED)
def test_elements_of_a_joint_that_are_not_its_mechanism_are_ignored(unused: str) -> None:
    assert load_robot(arm(elbow=elbow(LIMIT + unused)), "tip", "xyz").joints[1] == "elbow"


@pytest.mark.parametrize("shape", ["", "<geometry/>", "<geometry><mesh/></geometry>"])
def test_shapes_have_no_effect_on_the_mechanism(shape: str, capfd: pytest.CaptureFixture[str]) -> None:
    visual = f"<visual>{shape}</visual>"
    for inside in (visual + inertial(), inertial() + visual):
        loaded = load_robot(arm(tip=link("tip", inside)), "tip", "xyz")
        assert loaded.model.inertias[2].mass == 1.0
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("inside", ["", '<mass value="1"/>', inertial(1).replace("izz", "i")])
def test_inertial_of_the_base_has_no_effect(inside: str, capfd: pytest.CaptureFixture[str]) -> None:
    base = link("base", inside if "inertial" in inside else f"<inertial>{inside}</inertial>")
    loaded = load_robot(arm(base=base), "tip", "xyz")
    assert [body.mass for body in loaded.model.inertias] == [0.0, 1.0, 1.0]
    assert capfd.readouterr().err == ""


def test_numbers_may_have_spaces_around_them(capfd: pytest.CaptureFixture[str]) -> None:
    """urdfdom would read them as 0."""
    spaced = re.sub(r'(value|i..|xyz)="([^"]*)"', r'\1=" \2\n"', inertial(2.0, 0.3, 0.4, 0.5))
    plain = load_robot(arm(tip=link("tip", inertial(2.0, 0.3, 0.4, 0.5))), "tip", "xyz").model
    found = load_robot(arm(tip=link("tip", spaced), elbow=elbow(axis=" 0 0  1 ")), "tip", "xyz").model
    assert found == plain
    assert capfd.readouterr().err == ""


def test_elements_may_be_nested() -> None:
    deep = "<gazebo>" * 99 + "</gazebo>" * 99
    assert load_robot(arm(deep), "tip", "xyz").joints == ("shoulder", "elbow")


def test_mass_of_a_moving_body_may_be_in_a_link_that_is_fixed_to_it() -> None:
    urdf = arm(link("tool"), joint("fixed", "tip", "tool", kind="fixed"), tip=link("tip", ""))
    assert load_robot(urdf, "tool", "xyz").joints == ("shoulder", "elbow")


def test_rod_without_inertia_about_its_length_is_accepted() -> None:
    urdf = arm(tip=link("tip", inertial(1, 0, 0.1, 0.1)))
    assert load_robot(urdf, "tip", "xyz").joints == ("shoulder", "elbow")


def test_inertia_written_with_few_digits_is_accepted() -> None:
    urdf = arm(tip=link("tip", inertial(1, 0.001, 0.002, 0.003000001)))
    assert load_robot(urdf, "tip", "xyz").joints == ("shoulder", "elbow")


def test_a_frame_that_no_joint_moves_is_refused() -> None:
    with pytest.raises(RobotError, match="no joint moves the frame 'base'"):
        load_robot(arm(), "base", "xyz")


def test_frame_is_the_link_where_a_joint_has_the_same_name() -> None:
    loaded = load_robot(arm().replace('joint name="elbow"', 'joint name="tip"'), "tip", "xyz")
    frame = loaded.model.frames[loaded.frame_id]
    assert (frame.name, frame.type) == ("tip", pin.FrameType.BODY)


EXAMPLES = {
    "asr_twodof_description/urdf/TwoDofs.urdf": None,
    "double_pendulum_description/urdf/double_pendulum.urdf": None,
    "double_pendulum_description/urdf/double_pendulum_continuous.urdf": None,
    "finger_edu_description/robots/finger_edu.urdf": 3,
    "kinova_description/robots/kinova.urdf": None,
    "panda_description/urdf/panda.urdf": 8,
    "so_arm_description/urdf/so100.urdf": 6,
    "tiago_description/robots/tiago_no_hand.urdf": None,
    "ur_description/urdf/ur3_robot.urdf": 6,
    "ur_description/urdf/ur5_robot.urdf": 6,
    "ur_description/urdf/ur10_joint_limited_robot.urdf": 6,
    "xarm_description/urdf/xarm7.urdf": 7,
    "z1_description/urdf/z1.urdf": None,
}


@pytest.mark.parametrize(("name", "n"), EXAMPLES.items(), ids=[Path(e).stem for e in EXAMPLES])
def test_example_robot_is_the_one_that_pinocchio_loads(robots: Path, name: str, n: int | None) -> None:
    urdf = (robots / name).read_text("utf-8")
    joints = ET.fromstring(urdf).findall("joint")
    (moved,) = next(j for j in joints if j.get("type") != "fixed").findall("child")
    loaded = load_robot(urdf, str(moved.get("link")), "xyz")
    assert n in (None, len(loaded.joints))
    assert_same_mechanism(loaded, urdf)


@pytest.mark.parametrize("axes", ["xyz", "xy", "xz", "z"])
def test_no_singular_value_changes_faster_than_its_bound(ur5: str, axes: str) -> None:
    robot = load_robot(ur5, "ee_link", axes)
    data, rng = robot.model.createData(), np.random.default_rng(0)
    rows = {"position": ["xyz".index(axis) for axis in axes]}
    rows["pose"] = [*rows["position"], 3, 4, 5]

    def ratios(q: np.ndarray, of: str) -> np.ndarray:
        J = pin.computeFrameJacobian(robot.model, data, q, robot.frame_id, pin.LOCAL_WORLD_ALIGNED)[rows[of]]
        sigma = np.linalg.svd(J, compute_uv=False)
        return sigma / sigma[0]

    for q in rng.uniform(-3.0, 3.0, (100, 6)):
        for i, bound in enumerate(robot.swing()):
            step = 1e-6 * np.eye(6)[i]
            for of in rows:
                assert np.abs(ratios(q + step, of) - ratios(q - step, of)).max() / 2e-6 <= bound + 1e-8
