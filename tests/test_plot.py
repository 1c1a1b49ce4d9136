"""The artists of a figure of runs, against the FMU's samples and closed forms."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import oracles
import pytest
from figures import assert_legible, heights, key, key_of, legend_of, lines, notes, only, panels, points, texts
from matplotlib.backends.backend_agg import FigureCanvasAgg
from recordings import LINK, build, chain_urdf, long_run, record
from sinks import Collector

import twodof
from twodof.bag.provenance import Provenance
from twodof.plots.interactive import over_time
from twodof.plots.runs import plot
from twodof.plots.strokes import line_styles
from twodof.plots.track import read_tracks
from twodof.plots.words import labels, outcome

# --- the default arm ---


@pytest.fixture(scope="module")
def figure(default):
    return plot(default.bag)


def test_joints_are_drawn_as_the_fmu_gave_them(default, figure):
    found = panels(figure)
    assert len(found.q) == len(found.v) == 2
    for i in range(2):
        for axes, values in ((found.q[i], default.q), (found.v[i], default.v)):
            line = only(axes, default.bag.name)
            np.testing.assert_allclose(line[:, 0], default.t, rtol=0.0, atol=1e-9)
            np.testing.assert_array_equal(line[:, 1], values[:, i])
            low, high = axes.get_ylim()
            assert low < values[:, i].min() <= values[:, i].max() < high
            assert axes.get_xlim() == (0.0, 5.0)


def test_units_and_settings_are_printed(figure):
    found = panels(figure)
    assert found.q[0].get_title("left") == "Position in rad"
    assert found.v[0].get_title("left") == "Velocity in rad/s"
    assert found.q[1].get_xlabel() == found.v[1].get_xlabel() == "time in s"
    assert found.error is not None
    assert found.error.get_title("left") == "Distance from the target in m"
    (view,) = found.views
    assert (view.get_xlabel(), view.get_ylabel()) == ("x in m", "y in m")
    assert view.get_title("left") == "Path of EndEffector in world"
    told = texts(figure)
    assert "2dof" in told
    assert "joint1" in told
    (settings,) = [text for text in told if "Kp" in text]
    assert settings == ("x_des = (0.2, 0.05) m, Kp = 50 s⁻², Kd = 40 s⁻¹, step 10 ms, TwoDof.fmu, bag Kp50")
    assert key_of(figure) == []


def test_path_and_arm_are_those_of_the_closed_form(default, figure):
    (view,) = panels(figure).views
    q = default.q
    path = only(view, "path")
    np.testing.assert_allclose(path, oracles.position(q), rtol=0.0, atol=1e-14)
    for label, angle in (("arm at the start", q[0]), ("arm at the end", q[-1])):
        elbow = LINK * np.array([math.cos(angle[0]), math.sin(angle[0])])
        root, end = (0.0, 0.0), oracles.position(angle)  # where the first joint is too
        joints = np.array([root, root, elbow, end])
        np.testing.assert_allclose(only(view, label), joints, rtol=0.0, atol=1e-14)
    np.testing.assert_array_equal(only(view, "target"), [(0.2, 0.05)])
    circle = only(view, "reach 0.3 m")
    np.testing.assert_allclose(np.hypot(*circle.T), 2 * LINK, rtol=1e-12)
    angles = np.sort(np.unwrap(np.arctan2(circle[:, 1], circle[:, 0])))
    assert angles[-1] - angles[0] == pytest.approx(2 * math.pi)


def test_a_metre_is_as_long_up_as_across(default):
    figure = plot(default.bag)
    (view,) = panels(figure).views
    FigureCanvasAgg(figure).draw()
    origin, x, y = view.transData.transform([(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)])
    assert x[0] - origin[0] == pytest.approx(y[1] - origin[1], rel=1e-9)
    (left, right), (low, high) = view.get_xlim(), view.get_ylim()
    for label in ("path", "arm at the start", "arm at the end", "target"):
        xs, ys = only(view, label).T
        assert left < xs.min() <= xs.max() < right
        assert low < ys.min() <= ys.max() < high
    assert left > -LINK  # of the circle of reach a part


def test_error_is_that_of_the_fmus_outputs_and_of_the_closed_form(default, figure):
    error = panels(figure).error
    assert error is not None
    assert error.get_yscale() == "log"
    target = np.array([0.2, 0.05])
    run = only(error, default.bag.name)
    np.testing.assert_allclose(run[:, 1], np.linalg.norm(default.x - target, axis=1), rtol=1e-9, atol=1e-15)
    closed = only(error, "closed form")
    expected = oracles.task_error(default.x[0] - target, 50.0, 40.0, default.t)
    np.testing.assert_allclose(closed[:, 1], np.linalg.norm(expected, axis=1), rtol=1e-12)
    low, high = error.get_ylim()
    assert low <= run[:, 1].min() <= run[:, 1].max() <= high
    assert legend_of(error) == ["closed form"]


def test_the_outcome_is_printed(default, figure):
    left = np.linalg.norm(default.x[-1] - (0.2, 0.05))
    told = "\n".join(texts(figure))
    found = re.search(r"^reached: (\S+) m from the target .*^at most (\S+) m from the closed form", told, re.M | re.S)
    assert found is not None
    assert float(found[1]) == pytest.approx(left, rel=2e-3)
    assert float(found[2]) < 1e-12


# --- limits and targets ---


def test_limits_are_lines_that_are_in_view_where_they_are_near(fmu_path, tmp_path):
    """The second joint stops at 1.2 rad, far from its lower limit."""
    recording = record(tmp_path / "bag", fmu_path, settings={"q_max": (0.9, 1.2), "x_des": (-0.1, 0.2)})
    assert recording.q[-1, 1] == 1.2
    found = panels(plot(recording.bag))
    second = found.q[1]
    assert heights(second, "limit") == [-math.pi, 1.2]
    low, high = second.get_ylim()
    assert low > -1.0
    assert high > 1.2
    assert notes(second) == ["limits −3.14, 1.2"]
    assert notes(found.q[0]) == ["limits −3.14, 0.9"]
    assert recording.q[:, 0].max() == 0.5
    assert found.q[0].get_ylim()[1] > 0.9  # near enough to be in view
    assert not any(lines(axes, "limit") for axes in found.v)


def test_equal_limits_are_printed_once(figure):
    first = panels(figure).q[0]
    assert heights(first, "limit") == [-math.pi, math.pi]
    assert notes(first) == ["limits ±3.14"]
    low, high = first.get_ylim()
    assert -math.pi < low < high < math.pi  # both far away


def test_efforts_are_drawn_with_their_limits(fmu_path, tmp_path):
    bag, samples = tmp_path / "bag", Collector()
    twodof.simulate(fmu_path, samples, twodof.Bag(bag, effort=True), stop_time=0.3)
    figure = plot(bag)
    axes = {axes.get_title("left"): axes for axes in figure.axes}["Effort in N·m"]
    tau = np.array([sample.tau for sample in samples])
    np.testing.assert_array_equal(only(axes, "bag")[:, 1], tau[:, 0])
    assert heights(axes, "limit") == [-10.0, 10.0]
    assert notes(axes) == ["limits ±10"]
    assert_legible(figure)


def test_efforts_of_a_bare_plant_are_known_without_being_in_the_bag(tmp_path):
    """They equal the FMU's output, limited to 9 N·m or not."""
    fmu = build(tmp_path, chain_urdf("zz"), control="effort")
    (tmp_path / "in.csv").write_text("time,tau_cmd[1]\n0,1\n0.02,12\n0.04,-2\n")
    for limited in (False, True):
        recording = record(
            tmp_path / f"{limited}",
            fmu,
            stop_time=0.06,
            input_file=tmp_path / "in.csv",
            settings={"limit_effort": limited},
        )
        (track,) = read_tracks([recording.bag])
        for j, joint in enumerate(track.joints):
            np.testing.assert_array_equal(joint.tau[1:], recording.tau[1:, j])
        assert track.joints[0].tau.max() == (9.0 if limited else 12.0)


def test_targets_of_joints_are_dashed_lines(tmp_path):
    """Each bag's own target is visible, named, and legible next to limits and efforts, also on a page."""
    fmu = build(tmp_path, chain_urdf("zz", low=-1.5), control="joint")
    (tmp_path / "in.csv").write_text("time,q_des[1],q_des[2]\n0,0.8,1\n0.2,1.2,-0.1\n")
    bags = [tmp_path / "one", tmp_path / "two"]
    first, second = Collector(), Collector()
    run = twodof.experiment(fmu, stop_time=0.4, input_file=tmp_path / "in.csv")
    twodof.simulate(run, first, twodof.Bag(bags[0], effort=True))
    still = {"q_des": (0.6, 0.0)}
    twodof.simulate(fmu, second, twodof.Bag(bags[1]), stop_time=0.4, settings=still)
    alone, both = plot(bags[0]), plot(*bags)
    for figure in (alone, both):
        assert_legible(figure)
        position = [axes for axes in figure.axes if lines(axes, "target")]
        for i, axes in enumerate(position):
            drawn = [points(line)[:, 1] for line in lines(axes, "target")]
            expected = [[s.inputs[f"q_des[{i + 1}]"] for s in each] for each in (first, second)]
            np.testing.assert_array_equal(drawn, expected[: len(drawn)])
            low, high = axes.get_ylim()
            assert low < np.min(drawn) <= np.max(drawn) < high
    over = over_time(read_tracks(bags))
    assert "Position in rad; thin dashes: target" in [a["text"] for a in over["layout"]["annotations"]]


def test_stretches_in_which_friction_holds_a_joint_are_marked(tmp_path):
    fmu = build(tmp_path, chain_urdf("zz", low=-1.5), control="joint")
    settings = {"friction": (3.0, 0.0), "q_des": (1.4, -0.5), "Kd": (0.0, 1.0), "gravity": (0.0, 0.0, 0.0)}
    recording = record(tmp_path / "bag", fmu, stop_time=1.5, settings=settings)
    figure, label = plot(recording.bag), "grey band: held by friction"
    first, second = panels(figure).q
    band, rests = only(first, label)[:, 1], recording.v[:, 0] == 0.0
    assert 10 < rests.sum() < len(rests) - 10
    lone = rests & ~np.append(rests[1:], False) & ~np.append(False, rests[:-1])
    np.testing.assert_array_equal(band, np.where(rests & ~lone, recording.q[:, 0], np.nan))
    assert not lines(second, label) and label in texts(figure)
    over = over_time(read_tracks([recording.bag]))
    assert any(label in a["text"] for a in over["layout"]["annotations"])


@pytest.mark.parametrize(
    ("settings", "label", "title"),
    [
        ({"q_min": (0.2, -3.0)}, "at its limit", "Position in rad"),
        ({"limit_effort": True, "payload": 10.0, "payload_known": True}, "saturated", "Effort in N·m"),
    ],
)
def test_the_first_sample_at_a_limit_is_marked(native_path, tmp_path, settings, label, title):
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag", effort=True), settings=settings, stop_time=3.0)
    recording = twodof.read_bag(tmp_path / "bag")
    signal, reached = recording.q[:, 0], recording.q[:, 0] <= 0.2
    if label == "saturated":
        signal, reached = recording.tau[:, 0], np.abs(recording.tau[:, 0]) >= 10.0 * (1.0 - 1e-12)
    first = int(reached.argmax())
    (panel,) = (axes for axes in plot(tmp_path / "bag").axes if axes.get_title("left") == title)
    np.testing.assert_array_equal(only(panel, label), [[recording.t[first], signal[first]]])
    assert 0 < first < 300


def test_measured_velocities_mark_no_stretches_in_which_friction_holds_a_joint(tmp_path):
    """A coarse encoder shows a velocity of 0 while the joint moves."""
    fmu = build(tmp_path, chain_urdf("zz", low=-1.5), control="joint")
    seen = {"control_period": 0.01, "q_resolution": 0.05, "v_from_q": True}
    settings = {"friction": (3.0, 0.0), "q_des": (1.4, -0.5), "gravity": (0.0, 0.0, 0.0), **seen}
    bag = twodof.Bag(tmp_path / "bag", measured=True)
    twodof.simulate(fmu, bag, stop_time=1.5, settings=settings)
    recording = twodof.read_bag(bag.path)
    assert (recording.v[:, 0] == 0.0).mean() > 0.5 and recording.measured
    assert not lines(panels(plot(bag.path)).q[0], "grey band: held by friction")
    provenance = recording.provenance.copy()
    del provenance["verdict"]
    again = replace(recording, provenance=provenance).verdict
    assert "friction" not in [cause.kind for cause in again.causes]


def test_targets_of_many_joints_are_legible(tmp_path):
    """They are next to limits with long names and efforts; the legend has one entry for them."""
    fmu = build(tmp_path, chain_urdf("zyx" * 4, 0.1, low=-1.234, high=2.345), control="joint")
    bag, target = twodof.Bag(tmp_path / "bag", effort=True), {"q_des": 0.1}
    twodof.simulate(fmu, bag, stop_time=0.05, settings=target)
    figure = plot(bag.path)
    assert_legible(figure)
    assert "".join(texts(figure)).count("thin dashes: target") == 1


def test_a_bag_may_have_the_name_of_a_limit(default):
    run = replace(twodof.read_bag(default.bag), path=Path("limit"))
    figure = plot(run)
    curves = [line for line in lines(panels(figure).q[0], "limit") if len(points(line)) > 2]
    assert [line.get_color() for line in curves] == [line_styles(["limit"])[0].colour]


# --- inputs over time ---


def test_changes_are_where_the_master_makes_them(changing):
    """Distances follow from the FMU's x and the samples' inputs, and the closed form from its x."""
    figure = plot(changing.bag)
    found = panels(figure)
    assert found.error is not None
    targets = np.array([[s.inputs[f"x_des[{k}]"] for k in (1, 2)] for s in changing.samples])
    assert len(np.unique(targets, axis=0)) == 3
    expected = np.linalg.norm(changing.x - targets, axis=1)
    run, closed = only(found.error, "bag"), only(found.error, "closed form")
    np.testing.assert_allclose(run[:, 1], expected, rtol=1e-9)
    np.testing.assert_allclose(closed[:, 1], expected, rtol=0.0, atol=1e-10)
    marked = only(found.views[0], "target")
    np.testing.assert_array_equal(marked, [(0.2, 0.05), (0.1, 0.2), (0.05, 0.2)])
    (told,) = [text for text in texts(figure) if "step" in text]
    assert told == ("x_des varied, xdd_des varied, Kp varied, Kd = 40 s⁻¹, step 10 ms, TwoDof.fmu, bag bag")


def test_a_target_on_a_path_is_drawn_as_a_path(fmu_path, tmp_path):
    t = np.arange(100) * 0.01
    circle = np.column_stack([0.15 + 0.05 * np.cos(t), 0.1 + 0.05 * np.sin(t)])
    rows = "".join(f"{a},{x!r},{y!r}\n" for a, (x, y) in zip(t.tolist(), circle.tolist()))
    (tmp_path / "in.csv").write_text("time,x_des[1],x_des[2]\n" + rows)
    recording = record(tmp_path / "bag", fmu_path, stop_time=1.0, input_file=tmp_path / "in.csv")
    (view,) = panels(plot(recording.bag)).views
    (line,) = lines(view, "target")
    assert line.get_linestyle() == "-"
    np.testing.assert_array_equal(points(line), circle)


# --- where the closed form does not hold ---


DAMPED = chain_urdf("zz").replace("<limit", '<dynamics damping="0.3"/><limit')


DISTURBED: dict[str, tuple[str, dict[str, Any], str]] = {
    "external torque": (chain_urdf("zz"), {"tau_ext": (0.0, 1.0)}, "closed form without external torque"),
    "singularities": (chain_urdf("zz"), {"x_des": (1.0, 0.2)}, "closed form without singularities"),
    "joint limits": (chain_urdf("zz"), {"q_max": (2.0, 0.6)}, "closed form without joint limits"),
    "two of them": (DAMPED, {"limit_effort": True}, "closed form without effort limits,\ndamping"),
}


@pytest.mark.parametrize(("urdf", "settings", "label"), DISTURBED.values(), ids=list(DISTURBED))
def test_the_closed_form_names_the_omitted_parts(urdf, settings, label, tmp_path):
    fmu = build(tmp_path, urdf, axes="xy", q_start=(0.3, 0.5))
    settings = {"x_des": (0.3, 0.6), **settings}
    recording = record(tmp_path / "bag", fmu, stop_time=0.5, settings=settings)
    error = panels(plot(recording.bag)).error
    assert error is not None
    closed = only(error, label)
    away = recording.x[0] - settings["x_des"]
    expected = oracles.task_error(away, 50.0, 40.0, recording.t)
    np.testing.assert_allclose(closed[:, 1], np.linalg.norm(expected, axis=1), rtol=1e-10)
    assert legend_of(error) == [label]


@pytest.mark.parametrize(("joints", "control"), [("z", "task"), ("zz", "pose")])
def test_a_task_that_the_joints_cannot_follow_has_no_closed_form(joints, control, tmp_path):
    """One joint has two axes; two joints have two axes and an orientation."""
    start = (0.3, 0.5)[: len(joints)]
    fmu = build(tmp_path, chain_urdf(joints), axes="xy", q_start=start, control=control)
    recording = record(tmp_path / "bag", fmu, stop_time=0.5, settings={"x_des": (0.3, 0.3)})
    (track,) = read_tracks([recording.bag])
    error = panels(plot(recording.bag)).error
    assert error is not None and not lines(error, "closed form without singularities")
    assert error.get_legend() is None and notes(error) == [""]
    away = np.linalg.norm(recording.x - (0.3, 0.3), axis=1)
    np.testing.assert_allclose(only(error, "bag")[:, 1], away, rtol=1e-12)
    turned = abs(recording.q[-1].sum() - sum(start))
    angle = f", {turned:.3g} rad from the target orientation" if control == "pose" else ""
    assert re.match(rf"not reached: \S+ m from the target \(0.3, 0.3\) m{angle}; ", outcome(track)[0])


def test_very_many_changes_of_inputs_have_no_closed_form(changing, monkeypatch):
    before = read_tracks([changing.bag])[0].task
    assert before is not None and before.closed_form is not None
    monkeypatch.setattr("twodof.plots.track.MOST_HELD", 2)
    monkeypatch.setattr("twodof.plots.track.task_error", None)
    task = read_tracks([changing.bag])[0].task
    assert task is not None and task.closed_form is None
    np.testing.assert_array_equal(task.error, before.error)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("gains", [(0.0, 40.0), (0.0, 0.0), (50.0, 0.0)])
def test_a_controller_without_a_gain_is_drawn(gains, fmu_path, tmp_path):
    Kp, Kd = gains
    recording = record(
        tmp_path / "bag",
        fmu_path,
        stop_time=0.3,
        settings={"Kp": Kp, "Kd": Kd, "v_start": (0.1, 0.2), "xd_des": (0.01, 0.0)},
    )
    error = panels(plot(recording.bag)).error
    assert error is not None
    distance = np.linalg.norm(recording.x - (0.2, 0.05), axis=1)
    np.testing.assert_allclose(only(error, "closed form")[:, 1], distance, rtol=0.0, atol=1e-9)


def test_an_arm_at_its_target_has_an_error_panel_too(fmu_path, tmp_path):
    at_rest = oracles.position(np.array([0.5, 0.35]))
    recording = record(tmp_path / "bag", fmu_path, stop_time=0.1, settings={"x_des": tuple(at_rest)})
    figure = plot(recording.bag)
    FigureCanvasAgg(figure).draw()
    error = panels(figure).error
    assert error is not None
    low, high = error.get_ylim()
    assert 0.0 < low < high <= 1e-9
    assert error.get_legend() is None  # of curves that are not seen
    assert [text.get_text() for text in error.texts] == ["less than 1e-12 m throughout"]
    (page,) = [
        a["text"] for a in over_time(read_tracks([recording.bag]))["layout"]["annotations"] if "Distance" in a["text"]
    ]
    assert page == "Distance from the target in m: less than 1e-12 m throughout"


@pytest.mark.parametrize("at", [4321.987, -1e-3])
def test_ticks_of_a_constant_curve_differ(default, at):
    run = long_run(default, np.full((200, 2), at))
    figure = plot(replace(run, v=run.q, tau=run.q))
    FigureCanvasAgg(figure).draw()
    joints = [axes for axes in figure.axes if axes not in panels(figure).views][:6]
    for axes in joints:
        low, high = axes.get_ylim()
        ticks = [t.get_text() for t in axes.get_yticklabels() if low <= t.get_position()[1] <= high]
        assert len({*ticks}) == len(ticks) >= 2


# --- several bags ---


def test_labels_of_bags_that_differ_in_a_gain_contain_it(gains):
    """Each has one line style in all panels."""
    figure = plot(*(recording.bag for recording in gains.values()))
    names = ["Kp = 20 s⁻²", "Kp = 50 s⁻²", "Kp = 400 s⁻²"]
    assert key_of(figure) == names
    assert "x_des = (0.2, 0.05) m, Kd = 40 s⁻¹, step 10 ms, TwoDof.fmu" in texts(figure)
    found = panels(figure)
    assert found.error is not None
    paths = lines(found.views[0], "path")
    for name, recording, handle, path in zip(names, gains.values(), key(figure).get_lines(), paths, strict=True):
        np.testing.assert_array_equal(only(found.q[1], name)[:, 1], recording.q[:, 1])
        np.testing.assert_array_equal(only(found.v[0], name)[:, 1], recording.v[:, 0])
        distance = np.linalg.norm(recording.x - (0.2, 0.05), axis=1)
        np.testing.assert_allclose(only(found.error, name)[:, 1], distance, rtol=1e-9, atol=1e-15)
        expected = oracles.position(recording.q)
        np.testing.assert_allclose(points(path), expected, rtol=0.0, atol=1e-14)
        curves = [lines(axes, name)[0] for axes in (*found.q, *found.v, found.error)]
        seen = {(line.get_color(), line.get_linestyle()) for line in (handle, path, *curves)}
        assert len(seen) == 1
    assert len(lines(found.error, "closed form")) == 3
    assert len(lines(found.views[0], "arm at the start")) == 1  # all start alike
    words = legend_of(found.views[0])
    assert words == ["arm at the start", "arm at the end", "path", "target", "reach 0.3 m"]


def test_line_styles_differ_and_colours_are_those_of_okabe_and_ito():
    """Black, orange, sky blue, bluish green, blue, vermillion and reddish purple, as published."""
    found = [look[1:] for look in line_styles(map(str, range(28)))]
    assert len(set(found)) == 28
    published = [(0, 0, 0), (230, 159, 0), (86, 180, 233), (0, 158, 115), (0, 114, 178), (213, 94, 0), (204, 121, 167)]
    colours = {matplotlib.colors.to_rgb(colour) for colour, _ in found}
    assert colours == {tuple(value / 255 for value in colour) for colour in published}
    assert len({dashes for _, dashes in found[:4]}) == 4  # on paper without colours


BAG, OTHER = {"path": Path("one/bag")}, {"path": Path("two/other")}
LABELS: dict[str, tuple[list[dict[str, Any]], list[str]]] = {
    "a vector": (
        [{"x_des[1]": 0.25, "x_des[2]": 0.1}, {"x_des[2]": -0.1}],
        ["x_des = (0.25, 0.1) m", "x_des = (0.2, −0.1) m"],
    ),
    "two gains": (
        [{}, {"Kp[2]": 30.0, "Kd[1]": 9.0, "Kd[2]": 9.0}],
        ["Kp = 50 s⁻², Kd = 40 s⁻¹", "Kp = (50, 30) s⁻², Kd = 9 s⁻¹"],
    ),
    "the step": ([{}, {"step": 0.02}], ["step 10 ms", "step 20 ms"]),
    "a switch": ([{}, {"limit_effort": True}], ["limit_effort = false", "limit_effort = true"]),
    "a flavour": ([{}, {"file": "B.fmu"}], ["TwoDof.fmu", "B.fmu"]),
    "nothing": ([BAG, OTHER], ["bag", "other"]),
    "not even their names": ([BAG, {"path": Path("two/bag")}], ["one/bag", "two/bag"]),
    "too much": ([BAG, {**OTHER, "Kp[1]": 9.0, "Kd[1]": 8.0, "Kn": 7.0, "rcond": 0.1}], ["bag", "other"]),
    "not all of them": ([BAG, OTHER, {"path": Path("c"), "Kp[1]": 9.0}], ["bag", "other", "c"]),
    "a digit that is not told": ([BAG, {**OTHER, "Kp[1]": 50.0000001}], ["bag", "other"]),
}


@pytest.mark.parametrize(("runs", "expected"), LABELS.values(), ids=list(LABELS))
def test_labels_name_the_differences(runs, expected, default):
    bag = twodof.read_bag(default.bag)
    bags = []
    for run in runs:
        changed = {**run}
        path, step = changed.pop("path", bag.path), changed.pop("step", 0.01)
        fmu = {**bag.provenance["fmu"], "file": changed.pop("file", "TwoDof.fmu")}
        starts = bag.provenance["start_values"]
        assert changed.keys() <= starts.keys()
        provenance: Provenance = {**bag.provenance, "fmu": fmu, "step": step, "start_values": starts | changed}
        bags.append(replace(bag, path=path, provenance=provenance))
    assert labels(read_tracks(bags)) == expected
