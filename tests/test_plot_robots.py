"""Figures of other robots and of third-party bags, against Pinocchio; refusals."""

import copy
import math
import re
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import oracles
import pinocchio as pin
import pytest
from figures import heights, legend_of, lines, only, panels, points, texts
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from recordings import LINK, UR5_JOINTS, bare, build, chain_urdf, record, third_party_bag, waves

import twodof
from twodof.bag.provenance import Provenance
from twodof.errors import PlotError, TwoDofError
from twodof.geometry.kinematics import quaternions
from twodof.pages.replay import replay
from twodof.plots import runs, words
from twodof.plots.figure import save
from twodof.plots.linkage import load_linkage
from twodof.plots.runs import drawing, plot
from twodof.plots.track import read_tracks
from twodof.simulation.setup import setup

ARM = Path(__file__).parents[1] / "urdf/2dof.urdf"


def seen(folder: Path, urdf: str, names: Sequence[str], *motion: Any, frame: str | None = None) -> Figure:
    """A bag from third_party_bag, drawn with a robot."""
    (folder / "robot.urdf").write_text(urdf)
    bag = third_party_bag(folder / "bag", names, *motion)
    return plot(bag, urdf=folder / "robot.urdf", frame=frame)


def kinematics(urdf: str, frame: str, names: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Path of a frame by Pinocchio directly from the URDF, N × 3."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    path = []
    for row in q:
        configuration = pin.neutral(model)
        for name, value in zip(names, row, strict=True):
            if model.existJointName(name):
                configuration[model.joints[model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(model, data, configuration)
        path.append(data.oMf[model.getFrameId(frame)].translation.copy())
    return np.array(path)


def test_a_robot_in_space_is_seen_from_above_and_from_the_side(ur5, tmp_path):
    fmu = build(tmp_path, bare(ur5), frame="tool0", q_start=oracles.REST["ur5"])
    recording = record(tmp_path / "bag", fmu, stop_time=0.3, settings={"x_des": (0.3, 0.35, 0.5)})
    found = panels(plot(recording.bag))
    model = pin.buildModelFromXML(bare(ur5))
    path = kinematics(bare(ur5), "tool0", list(model.names)[1:], recording.q)
    data = model.createData()
    pin.forwardKinematics(model, data, recording.q[-1])
    places = np.array([*(place.translation for place in data.oMi), path[-1]])  # root, joints, end
    assert [(v.get_xlabel(), v.get_ylabel()) for v in found.views] == [("x in m", "y in m"), ("x in m", "z in m")]
    for view, columns in zip(found.views, ([0, 1], [0, 2]), strict=True):
        np.testing.assert_allclose(only(view, "path"), path[:, columns], rtol=0.0, atol=1e-12)
        target = np.array([0.3, 0.35, 0.5])[columns]
        np.testing.assert_array_equal(only(view, "target"), [target])
        arm = only(view, "arm at the end")
        np.testing.assert_allclose(arm, places[:, columns], rtol=0.0, atol=1e-12)
        assert not [line for line in view.get_lines() if "reach" in str(line.get_label())]
    assert found.error is not None
    start = recording.x[0] - (0.3, 0.35, 0.5)
    expected = np.linalg.norm(oracles.task_error(start, 50.0, 40.0, recording.t), axis=1)
    np.testing.assert_allclose(only(found.error, "closed form")[:, 1], expected, rtol=1e-10)
    assert len(found.q) == len(found.v) == 6
    assert heights(found.q[2], "limit") == pytest.approx([-math.pi, math.pi], rel=1e-3)


def test_a_single_joint_has_its_position_above_its_velocity(tmp_path):
    """The target is a height; the end effector may be anywhere across it."""
    fmu = build(tmp_path, chain_urdf("z"), axes="y", q_start=(-0.3,))
    recording = record(tmp_path / "bag", fmu, stop_time=1.0, settings={"x_des": 0.2})
    figure = plot(recording.bag)
    found = panels(figure)
    (above,), (below,) = found.q, found.v
    assert above.get_position().y0 > below.get_position().y1
    assert above.get_position().x0 == pytest.approx(below.get_position().x0)
    assert above.get_title("left") == "Position of j1 in rad"
    assert below.get_title("left") == "Velocity of j1 in rad/s"
    (view,) = found.views
    assert set(only(view, "target")[:, 1]) == {0.2}
    circle = only(view, "reach 0.4 m")
    np.testing.assert_allclose(np.hypot(*circle.T), 0.4)
    assert found.error is not None
    height = 0.4 * np.sin(recording.q[:, 0])
    np.testing.assert_allclose(only(found.error, "bag")[:, 1], np.abs(height - 0.2), rtol=1e-9, atol=1e-15)


def test_rounding_errors_of_a_target_are_0_and_a_difference_has_a_unit(fmu_path, tmp_path):
    bags: list[Path] = []
    for target in ((-2.69e-16, 0.2), (1e-15, 0.2000001)):
        bags.append(tmp_path / f"bag{len(bags)}")
        twodof.simulate(
            fmu_path,
            twodof.Bag(bags[-1]),
            stop_time=0.02,
            settings={"x_des": target, "q_noise": 1e-12, "control_period": 0.01},
        )
    first, other = read_tracks(bags)
    assert first.settings["x_des"] == "(0, 0.2) m" and first.settings["q_noise"] == "1e−12"
    assert re.search(r"; RMS \S+ rad$", words.difference(first, other))


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("jointGripper", "joint\nGripper"),
        ("elbowflexion", "elbowflex\nion"),
        ("panda_joint1", "panda_\njoint1"),
        ("a" * 11, "a" * 11),
        ("shoulder_pan_joint", "shoulder_\npan_joint"),
    ],
)
def test_a_joint_name_is_broken_between_words(name, shown):
    assert runs._wrapped(name, 2.0) == shown


def test_joints_that_slide_have_metres(tmp_path):
    figure = seen(tmp_path, chain_urdf("zX"), ["j1", "j2"], *waves(2))
    found = panels(figure)
    assert found.q[0].get_title("left") == "Position in rad or m"
    assert found.v[0].get_title("left") == "Velocity in rad/s or m/s"
    assert {"j1", "j2", "(m)"} <= set(texts(figure))
    assert not [t for t in texts(figure) if "reach" in t]  # it has no bound of this kind


PLANES = {
    "z": ("xy", 0.4),
    "y": ("xz", 0.4),
    "zz": ("xy", 0.8),
    "X": ("xz", None),
    "zX": ("xy", None),
    "yZ": ("xz", None),
    "yy": ("xz", 0.8),
}


@pytest.mark.parametrize(("axes", "expected"), PLANES.items(), ids=list(PLANES))
def test_motion_in_a_plane_is_seen_in_that_plane(axes, expected, tmp_path):
    """The reach circle is drawn if all joints rotate."""
    names = [f"j{i + 1}" for i in range(len(axes))]
    (view,) = panels(seen(tmp_path, chain_urdf(axes), names, *waves(len(axes)))).views
    plane, reach = expected
    assert view.get_xlabel()[0] + view.get_ylabel()[0] == plane
    circles = [line for line in view.get_lines() if "reach" in str(line.get_label())]
    assert len(circles) == (reach is not None)
    if reach is not None:
        np.testing.assert_allclose(np.hypot(*points(circles[0]).T), reach)
        farthest = np.hypot(*only(view, "path").T).max()
        assert farthest <= reach + 1e-12


def test_only_points_in_the_plane_count_for_the_circle(tmp_path):
    """Joints of links of 0.24 × 0.32 × 0.1 m rotate about z: only the top view is drawn."""
    urdf = chain_urdf("zz").replace('<origin xyz="0.4 0 0"/>', '<origin xyz="0.24 0.32 0.1"/>')
    above, beside = panels(seen(tmp_path, urdf, ["j1", "j2"], *waves(2))).views
    np.testing.assert_allclose(np.hypot(*only(above, "reach 0.8 m").T), 0.8)
    assert not lines(beside, "reach 0.8 m")
    assert "reach 0.8 m" in legend_of(beside)


def test_joints_that_turn_about_skew_axes_have_no_circle(tmp_path):
    urdf = chain_urdf("zz").replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0.1 1"/>', 1)
    figure = seen(tmp_path, urdf, ["j1", "j2"], *waves(2))
    assert len(panels(figure).views) == 2
    assert not [text for text in texts(figure) if "reach" in text]


@pytest.mark.parametrize(("count", "low", "high"), [(16, 0.67, 1.41), (30, 0.67, 1.5)])
def test_many_joints_fit_on_a_page(count, low, high, tmp_path):
    """Sixteen fit in one column on an A4 page, thirty on a screen."""
    names = [f"j{i + 1}" for i in range(count)]
    figure = seen(tmp_path, chain_urdf("zy" * (count // 2), length=0.1), names, *waves(count))
    width, height = figure.get_size_inches()
    assert low < height / width < high
    assert len(panels(figure).q) == len(panels(figure).v) == count


# --- third-party bags ---


def test_a_third_party_bag_is_drawn_as_far_as_its_data_allow(foreign):
    t, q, v = waves(6)
    figure = plot(foreign)
    found = panels(figure)
    assert (len(found.q), len(found.v), found.error, found.views) == (6, 6, None, [])
    for i in range(6):
        line = only(found.q[i], "ur5_log")
        np.testing.assert_allclose(line, np.column_stack([t, q[:, i]]), rtol=0.0, atol=1e-9)
        np.testing.assert_array_equal(only(found.v[i], "ur5_log")[:, 1], v[:, i])
        assert not lines(found.q[i], "limit")
    assert found.q[0].get_title("left") == "Position in rad or m"
    assert "ur5_log" in texts(figure)


def test_with_a_urdf_it_has_limits_path_and_arm(foreign, ur5, tmp_path):
    (tmp_path / "ur5.urdf").write_text(ur5)
    found = panels(plot(foreign, urdf=tmp_path / "ur5.urdf"))
    assert found.error is None
    path = kinematics(bare(ur5), "tool0", UR5_JOINTS, waves(6)[1])
    for view in found.views:
        columns = ["xyz".index(label[0]) for label in (view.get_xlabel(), view.get_ylabel())]
        np.testing.assert_allclose(only(view, "path"), path[:, columns], rtol=0.0, atol=1e-12)
    assert found.views[0].get_title("left") == "Path of tool0 in world"
    assert heights(found.q[0], "limit") == pytest.approx([-math.pi, math.pi], rel=1e-3)
    assert heights(found.q[2], "limit") == pytest.approx([-2 * math.pi, 2 * math.pi], rel=1e-3)
    assert found.q[0].get_title("left") == "Position in rad"


def test_another_frame_needs_only_the_joints_that_move_it(foreign, ur5, tmp_path):
    t, q, v = waves(6)
    names = UR5_JOINTS[:4]  # those up to the forearm and one more
    figure = seen(tmp_path, ur5, names, t, q[:, :4], v[:, :4], frame="forearm_link")
    path = kinematics(bare(ur5), "forearm_link", names, q[:, :4])
    view = panels(figure).views[0]
    np.testing.assert_allclose(only(view, "path"), path[:, :2], rtol=0.0, atol=1e-12)


def test_a_urdf_that_cannot_be_simulated_can_be_drawn(robots, tmp_path):
    """One of the Panda's fingers mimics the other, and its links have no masses here."""
    urdf = bare((robots / "panda_description/urdf/panda.urdf").read_text())
    massless = re.sub("<inertial>.*?</inertial>", "", urdf, flags=re.S)
    names = [f"panda_{name}" for name in ("finger_joint1", "finger_joint2")]
    names += [f"panda_joint{i}" for i in range(1, 8)]
    t, q, v = waves(9)
    figure = seen(tmp_path, massless, names, t, q, v, frame="panda_rightfinger")
    alone = re.sub("<mimic[^>]*/>", "", urdf)
    path = kinematics(alone, "panda_rightfinger", names, q)
    np.testing.assert_allclose(only(panels(figure).views[0], "path"), path[:, :2], rtol=0.0, atol=1e-12)


def test_bags_without_velocities_or_with_gaps(tmp_path):
    t, q, _ = waves(2, 50)
    q[10:20, 0] = math.nan
    q[:, 1] = math.nan
    q[3, 1] = math.inf
    figure = plot(third_party_bag(tmp_path / "bag", ["a", "b"], t, q, None))
    found = panels(figure)
    assert (len(found.q), found.v) == (2, [])
    drawn = only(found.q[0], "bag")[:, 1]
    np.testing.assert_array_equal(np.isnan(drawn), np.isnan(q[:, 0]))
    FigureCanvasAgg(figure).draw()


def test_a_bag_of_one_sample_is_a_point(foreign, ur5, tmp_path):
    t, q, v = waves(6, 2)
    figure = seen(tmp_path, ur5, UR5_JOINTS, t[:1], q[:1], v[:1])
    (line,) = lines(panels(figure).q[0], "bag")
    assert line.get_marker() == "o"
    FigureCanvasAgg(figure).draw()


def test_a_urdf_may_replace_that_of_the_bag(default, tmp_path):
    """Its links are longer, as after a calibration; limits and target remain those of the run."""
    urdf = ARM.read_text()
    longer = urdf.replace('<origin xyz="0.15 0 0"', '<origin xyz="0.3 0 0"')
    (tmp_path / "longer.urdf").write_text(longer.replace("3.141592653589793", "1.5"))
    found = panels(plot(default.bag, urdf=tmp_path / "longer.urdf"))
    path = only(found.views[0], "path")
    np.testing.assert_allclose(path, 2 * oracles.position(default.q), rtol=0.0, atol=1e-14)
    assert {*heights(found.q[0], "limit")} == {-math.pi, math.pi}
    assert found.error is not None
    distance = np.linalg.norm(path - (0.2, 0.05), axis=1)
    np.testing.assert_allclose(only(found.error, "Kp50")[:, 1], distance, rtol=1e-12)


def test_a_xacro_file_may_be_the_robot_of_a_bag(default, tmp_path):
    """It is expanded as for a build."""
    urdf = ARM.read_text()
    named = urdf.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    length = '<xacro:property name="length" value="${0.1 * 3}"/><link name="world"/>'
    text = named.replace('<link name="world"/>', length).replace('"0.15 0 0"', '"${length} 0 0"')
    (tmp_path / "longer.urdf.xacro").write_text(text)
    found = panels(plot(default.bag, urdf=tmp_path / "longer.urdf.xacro"))
    path = only(found.views[0], "path")
    np.testing.assert_allclose(path, 2 * oracles.position(default.q), rtol=0.0, atol=1e-14)
    page, _ = replay(default.bag, urdf=tmp_path / "longer.urdf.xacro")
    assert b"${length}" not in page


def test_for_another_frame_there_is_no_target(default):
    found = panels(plot(default.bag, frame="link2"))
    assert found.error is None
    elbow = LINK * np.column_stack([np.cos(default.q[:, 0]), np.sin(default.q[:, 0])])
    np.testing.assert_allclose(only(found.views[0], "path"), elbow, rtol=0.0, atol=1e-14)


def test_a_recovered_bag_with_a_gap(default):
    """Samples 100 to 199 are lost; the others keep their times."""
    run = twodof.read_bag(default.bag)
    kept = np.r_[0:100, 200:501]
    short = replace(run, stamps=run.stamps[kept], q=run.q[kept], v=run.v[kept])
    error = panels(plot(short)).error
    assert error is not None
    found, closed = only(error, "Kp50"), only(error, "closed form")
    np.testing.assert_allclose(found[:, 0], default.t[kept], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(closed[:, 1], found[:, 1], rtol=1e-6)


# --- what is wrong ---


BAD: dict[str, tuple[str | bytes, dict[str, Any], str]] = {
    "no XML": ("a: 1", {}, r"u\.urdf: the URDF is not XML"),
    "no text": (b"\xff\x00", {}, r"the URDF '.*u\.urdf' is not UTF-8"),
    "another root": ("<model/>", {}, r"root element is <model>"),
    "entities": (
        '<!DOCTYPE robot [<!ENTITY a "b">]>' + chain_urdf("zz"), {}, "document type declaration",
    ),
    "no joints": ('<robot name="r"><link name="a"/></robot>', {}, "no joint moves the frame"),
    "a planar joint": (chain_urdf("zz").replace("revolute", "planar"), {}, "'j1' is of type 'plan"),
    "no such frame": (chain_urdf("zz"), {"frame": "hand"}, "no frame 'hand'.*: base, l1, l2, tip$"),
    "a frame at rest": (chain_urdf("zz"), {"frame": "base"}, "no joint moves the frame 'base'"),
    "joints of another robot": (
        chain_urdf("zzz"), {},
        r"'.*bag' has no joint 'j3', which the robot 'chain' needs to move 'tip';"
        " its joints are: j1, j2$",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("urdf", "options", "message"), BAD.values(), ids=list(BAD))
def test_a_urdf_that_is_wrong_is_named(urdf, options, message, tmp_path):
    path = tmp_path / "u.urdf"
    path.write_bytes(urdf if isinstance(urdf, bytes) else urdf.encode())
    bag = third_party_bag(tmp_path / "bag", ["j1", "j2"], *waves(2))
    with pytest.raises(PlotError, match=message) as caught:
        plot(bag, urdf=path, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("error")
def test_a_joint_at_infinity_leaves_a_gap(tmp_path):
    """A revolute, prismatic or mimicked joint leaves a gap in the path and on the replay, without a warning."""
    (tmp_path / "arm.urdf").write_text(chain_urdf("zXy"))
    t, q, v = waves(3)
    q[3:6] = np.diag([np.inf, -np.inf, np.inf])
    bag = third_party_bag(tmp_path / "bag", ["j1", "j2", "j3"], t, q, v)
    track = read_tracks([bag], urdf=tmp_path / "arm.urdf")[0]
    assert track.motion is not None
    np.testing.assert_array_equal(np.isnan(track.motion.path).any(axis=1).nonzero()[0], [3, 4, 5])
    plot(bag, urdf=tmp_path / "arm.urdf")
    replay(bag, urdf=tmp_path / "arm.urdf")


def test_more_joints_than_a_figure_can_show_are_refused(tmp_path):
    t, q, v = waves(150)
    bag = third_party_bag(tmp_path / "bag", [f"j{i}" for i in range(150)], t, q, v)
    with pytest.raises(PlotError, match=r"150 joints are too many for a figure, which shows 128"):
        plot(bag)
    assert save(drawing(read_tracks([bag])), tmp_path / "all.html").exists()


UNSOUND: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no step": lambda run: run.update(step=0.0),
    "a step that is not a number": lambda run: run.update(step=math.nan),
    "a step back": lambda run: run.update(step=-0.01),
    "a step without end": lambda run: run.update(step=math.inf),
    "a step that would take all memory": lambda run: run.update(step=1e-9),
    "half a target": lambda run: run["start_values"].pop("x_des[2]"),
    "half a gain": lambda run: run["start_values"].pop("Kp[2]"),
    "a target nowhere": lambda run: run["start_values"].update({"x_des[1]": math.nan}),
    "a target too far": lambda run: run["start_values"].update({"x_des[1]": 1e308}),
    "a target beyond": lambda run: run["start_values"].update({"x_des[1]": 10**400}),
    "a limit that is not a number": lambda run: run["start_values"].update({"q_min[1]": math.nan}),
    "a change at the end of time": lambda run: run["input_changes"].append([math.inf, {}]),
    "a change nowhere": lambda run: run["input_changes"].append([0.1, {"x_des[1]": math.inf}]),
    "a change at no time": lambda run: run["input_changes"].append([math.nan, {}]),
    "a change of nothing": lambda run: run["input_changes"].append([0.1, {"y": 1.0}]),
    "no beginning": lambda run: run.update(start_time=math.nan, input_changes=[[0.1, {}]]),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("spoil", UNSOUND.values(), ids=list(UNSOUND))
def test_a_bag_whose_provenance_makes_no_sense_is_refused(spoil, default):
    run = twodof.read_bag(default.bag)
    provenance = copy.deepcopy(run.provenance)
    spoil(cast(dict[str, Any], provenance))
    with pytest.raises(TwoDofError, match=r"^the run.json in '.*Kp50' does not fit its samples$"):
        plot(replace(run, provenance=provenance))


def test_a_bag_whose_robot_makes_no_sense_is_refused(default):
    run = twodof.read_bag(default.bag)
    for spoilt, message in (
        ({"urdf": "<robot/>"}, "the URDF in '.*Kp50': "),
        ({"axes": "xq"}, "the URDF in '.*Kp50': axes 'xq'"),
        ({"frame": "hand"}, "the URDF in '.*Kp50': no frame 'hand'"),
    ):
        with pytest.raises(PlotError, match=message):
            plot(replace(run, provenance=cast(Provenance, {**run.provenance, **spoilt})))


def test_memory_of_a_long_chain_is_that_of_the_result():
    names, frame = [f"j{i + 1}" for i in range(100)], "tip"
    linkage = load_linkage(chain_urdf("z" * 100), frame, "xyz", names)
    robot = setup(joints=names, robot=linkage.urdf, frame=frame, axes="xyz", step=0.01, starts={})
    q = np.random.default_rng(4).normal(size=(20_000, 100))
    for function, values in ((robot.orientations, 4), (linkage.skeletons, 3 * 102)):
        tracemalloc.start()
        function(q)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 8 * len(q) * values + 64 * 1024**2
    every = [*linkage.kinematics.along(linkage.urdf.chain(frame), q[:9])]
    np.testing.assert_allclose(robot.orientations(q[:9]), quaternions(every[-1].rotation), atol=1e-13)
    np.testing.assert_allclose(linkage.skeletons(q[:9])[:, -1], every[-1].translation, atol=1e-13)
