"""The verdict of a run, against closed forms, other optimisers, and runs that fail or succeed on purpose."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import failures
import numpy as np
import pytest
from failures import FAILURES, ROBOTS, Failure, fmu_of, good_runs
from numpy.typing import ArrayLike
from page_causes import page_causes
from recordings import build, chain_urdf, third_party_bag
from scipy.optimize import brute, differential_evolution
from scipy.spatial.transform import Rotation
from sinks import Memory

import twodof
from twodof.cli.main import main
from twodof.geometry import reach
from twodof.geometry.kinematics import Kinematics, Placement
from twodof.geometry.reach import nearest
from twodof.plant.urdf import Joint, read_urdf
from twodof.simulation import stepping
from twodof.simulation.cause import Cause
from twodof.simulation.judge import BLOCK, OUTPUTS, Judge
from twodof.simulation.motion import motion_of, ringing
from twodof.simulation.setup import robot_of, setup, setup_of
from twodof.simulation.verdict import conclude, judged
from twodof.simulation.verdict_text import _grouped

STEP = 0.001
LATE = {"control_period": 0.005, "control_delay": 0.0489, "Kp": 342.0, "Kd": 30.8, "x_des": (-0.107, 0.2)}
NOISY = {"q_noise": 0.01, "control_period": 0.02, "Kd": 60.0, "x_des": (0.2, 0.2)}


class Kept(twodof.Sink):
    """The run and its samples."""

    def begin(self, run: twodof.Experiment) -> Kept:
        self.run = run
        self.samples: list[twodof.Sample] = []
        return self

    def write(self, sample: twodof.Sample) -> None:
        self.samples.append(sample)


class Failed(NamedTuple):
    """A failure, its bag and verdict, and its samples."""

    failure: Failure
    bag: Path
    verdict: twodof.Verdict
    kept: Kept


@pytest.fixture(scope="module", params=list(FAILURES))
def failed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Failed:
    failure, kept = FAILURES[request.param], Kept()
    bag = tmp_path_factory.mktemp("failed") / "bag"
    return Failed(failure, bag, failures.run(failure, twodof.Bag(bag), kept).verdict, kept)


def test_the_first_line_names_the_cause_of_a_failure(failed: Failed) -> None:
    failure, _, verdict, _ = failed
    assert failure.words in verdict.lines[0]
    assert verdict.causes[0].kind == failure.kinds[0]
    assert {*failure.kinds} <= {cause.kind for cause in verdict.causes}


def test_the_page_names_the_same_first_cause(failed: Failed) -> None:
    """The samples are the same. A run in a page continues, so that an error that shrinks for 5 s more is not slow.

    The page has no masses, and names further causes by their kinds.
    """
    found = page_causes(failed.kept.run, failed.kept.samples)
    if failed.verdict.causes[0].kind == "time" and not found:
        return
    assert found[0]["kind"] == failed.verdict.causes[0].kind
    if joint := failed.verdict.causes[0].joint:
        assert any(joint in cause["text"] or "did you mean" in cause["text"] for cause in found)


@pytest.mark.parametrize(
    ("name", "cured", "same"),
    [
        ("a slow controller with limited motors", {"control_period": 0.0}, {"limit_effort": False}),
        ("a stiff law without damping", {"Kd": 180.0}, {"max_step": 0.001}),
        ("a load that presses a leg to a limit", {"payload": 0.0}, {"q_min": -20.0, "q_max": 20.0}),
        ("a load and a joint at its limit", {"payload": 0.0}, {"q_min": -20.0, "q_max": 20.0}),
        ("a slow orientation of five joints", {"Kp_rot": 50.0}, {"payload_known": True}),
        ("a joint in the way", {"q_min": -20.0}, {"payload_known": True}),
    ],
)
def test_a_run_without_its_cause_does_well(name: str, cured: dict[str, Any], same: dict[str, Any]) -> None:
    """Without another cause that the verdict might name first, it still fails."""
    failure = FAILURES[name]
    settings = [{**failure.settings, **change} for change in (cured, same)]
    outcomes = [failures.run(failure._replace(settings=each)).verdict.outcome for each in settings]
    assert outcomes == ["reached", "not reached"]


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"x_des": (0.5, 0.1)}, "note: the arm is near a singularity"),
        ({"x_des": (0.5, 0.1)}, "with Kp = 50, Kd = 40"),
        ({"x_des": (0.5, 0.1)}, "not within 2 % of the initial error of 0.282 m"),
        ({"x_des": (0.5, 0.1), "Kp": (900.0, 100.0)}, "with Kp = (900, 100), Kd = 40"),
        ({"payload": 0.35, "Kd": 1.0, "x_des": (0.2354, 0.1774)}, ", the target is passed by 0.315 m, RMS error"),
        ({"Kp": 0.5}, "joint 'joint2' still moving at"),
        ({"Kp": 1000.0, "Kd": 5.0, "x_des": (-0.107, 0.4107)}, "beyond the URDF's limit of 10 N·m, likewise 'joint2'"),
        (LATE, "at the same damping ratio it is stable below Kp = 189 with Kd = 22.9, and quickest with"),
        (
            {**NOISY, "Kp": 900.0},
            "joint 'joint1' reverses every 0.034 s: q_noise[1] = 0.01 rad: too much for the gains (Kp = 900, Kd = 60)",
        ),
        (
            {**NOISY, "Kp": (900.0, 0.0)},
            "Kp[2] (along y) = 0: the controller does not reduce the error of the position",
        ),
        ({"q_max": (0.6, 0.4)}, "at rest with 'joint1', 'joint2' at their limits"),
        ({"payload": 2.0, "limit_effort": True}, "payload = 2 kg, limit_effort = true"),
    ],
)
def test_a_failed_run_has_a_line(settings: dict[str, Any], line: str) -> None:
    lines = twodof.simulate(fmu_of("arm", "task"), settings={**settings, **failures.LARGE_STEPS}).verdict.lines
    assert any(line in each for each in lines), "\n".join(lines)
    assert not re.search(r"\d{4}\S* %|e\+\d+ %", "".join(lines))  # no percentage is large


def test_errors_of_joints_that_turn_and_slide_have_no_common_size(tmp_path: Path) -> None:
    fmu = build(tmp_path, chain_urdf("Xz"), control="joint", gravity=(0.0, 0.0, 0.0))
    settings: list[dict[str, Any]] = [
        {"q_des": (0.5, 1.0), "Kp": 1.0, "Kd": 0.1},
        {"q_des": (0.5, 1.0), "Kp": 1.0, "tau_ext": (5.0, 2.0)},
        {"q_des": (3.0, 1.0), "tau_ext": (5.0, 0.0)},
        {"q_des": (1e-3, 0.0), "Kd": 0.1, "tau_ext": (0.0, 2.0)},
    ]
    verdicts = [twodof.simulate(fmu, settings=each, stop_time=3.0).verdict for each in settings]
    for verdict in verdicts:
        assert verdict.outcome == "not reached"
        assert not re.search(r"rad or m|e\+\d+ %", "".join(verdict.lines)), "\n".join(verdict.lines)
    words = "the controller does not know tau_ext[1] (of joint 'j1') = 5 N, tau_ext[2] (of joint 'j2') = 2 N·m"
    assert any(words in line for line in verdicts[1].lines)


@pytest.mark.parametrize(
    ("robot", "control", "settings", "text"),
    [
        ("arm", "task", LATE, "note:"),  # consequences of an unstable loop
        ("arm", "task", {**NOISY, "Kp": 900.0}, " Hz"),  # of a joint that reverses with the samples
        ("panda", "pose", {"Kp": (50.0, 50.0, 0.0), "x_des": (0.36, -0.05, 0.45)}, "damping of any joint"),  # at rest
        ("arm", "joint", {"friction": (0.3, 0.1), "q_des": (1.2, 0.1), "Kd": 200.0}, "still approach"),  # it sticks
        ("ur5", "joint", {"payload": 40.0, "payload_known": True, "limit_effort": True}, "peak effort"),  # saturated
        ("so100", "task", {"x_des": (0.6, 0.2, 0.5), "Kd": 0.5}, "everything else"),  # most of it is out of reach
    ],
)
def test_a_failed_run_has_no_line(robot: str, control: str, settings: dict[str, Any], text: str) -> None:
    lines = twodof.simulate(fmu_of(robot, control), settings={**settings, **failures.LARGE_STEPS}).verdict.lines
    assert lines[0].startswith("not reached") and not any(text in line for line in lines), "\n".join(lines)


@pytest.mark.parametrize(
    ("robot", "control", "settings"),
    [
        ("panda", "joint", {"tau_ext": (0.0, -9.5, 8.0, 7.0, 1.5, 0.0, 0.2)}),
        ("arm", "task", {"tau_ext": (0.0, 0.3)}),
        ("arm", "task", {"f_ext": (0.0, -3.0, 0.0)}),
    ],
)
def test_the_page_names_the_same_joints_and_units_of_a_load(robot: str, control: str, settings: dict[str, Any]) -> None:
    kept = Kept()
    verdict = twodof.simulate(fmu_of(robot, control), kept, settings=settings).verdict
    (text,) = (cause.text for cause in verdict.causes if cause.subject == next(iter(settings)))
    found = page_causes(kept.run, kept.samples)[0]
    assert found["text"].replace("\u2212", "-") == text.partition(";")[0]
    assert found["subject"] == next(iter(settings))


def test_the_page_names_the_noise_of_a_sensor() -> None:
    settings = {"v_noise": 3.0, "control_period": 0.01, "Kd": 80.0, "Kp": 60.0, "q_des": (0.7, 0.2)}
    kept = Kept()
    lines = twodof.simulate(fmu_of("arm", "joint"), kept, settings=settings).verdict.lines
    assert (noise := re.search(r"v_noise\[\d\] = 3 rad/s", lines[0])) is not None, lines
    assert noise[0] in page_causes(kept.run, kept.samples)[0]["text"]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("a direction without a gain, and a target just out of reach", {"Kp": 50.0}),
        ("gains just below the limit of stability", {"Kp": 138.0, "Kd": 7.44}),
        ("a self-motion that is damped too strongly", {"Kn": 19.9}),
        ("an orientation that is damped too strongly", {"Kd_rot": 15.0}),
    ],
)
def test_the_remedy_removes_the_first_cause(name: str, change: dict[str, Any]) -> None:
    failure = FAILURES[name]
    cured = failures.run(failure._replace(settings={**failure.settings, **change})).verdict
    assert failure.kinds[0] not in [cause.kind for cause in cured.causes]


def test_a_load_that_slows_a_sampled_loop_makes_it_stable() -> None:
    """The gains are unstable by the model of the controller, and the error still decays."""
    settings = {"control_period": 0.1, "Kp": 14.0, "Kd": 21.2, "gravity": 0.0, "payload": 0.5}
    lines = twodof.simulate(fmu_of("arm", "task"), settings=settings, stop_time=3.0).verdict.lines
    assert "still approaches" in lines[0] and not any("unstable" in line for line in lines)


def test_a_good_run_of_a_continuous_joint_beyond_a_turn_is_not_in_degrees() -> None:
    settings = {"q_start[1]": 6.1, "q_des[1]": 6.4, "max_step": 0.01}
    verdict = twodof.simulate(fmu_of("kinova", "joint"), settings=settings).verdict
    assert verdict.outcome == "reached" and not verdict.causes


def test_a_moving_target_whose_velocity_the_controller_does_not_know() -> None:
    """The lag of a critically damped or overdamped loop is Kd/Kp for slow motions; a higher Kp follows."""
    times = np.arange(0.0, 6.0, 0.05)
    moves = [(t, {"q_des[1]": 0.5 + 0.3 * np.sin(t), "q_des[2]": 0.25}) for t in times]
    slow = twodof.simulate(fmu_of("arm", "joint"), changes=moves, stop_time=6.0).verdict
    assert "the target moves, and v_des is 0: the lag is Kd/Kp = 0.8 s; set v_des, raise Kp" in slow.lines[0]
    quick = twodof.simulate(fmu_of("arm", "joint"), changes=moves, stop_time=6.0, settings={"Kp": 2000.0}).verdict
    assert quick.outcome == "followed" and not quick.causes


def test_a_push_that_ended_before_the_end_is_named_with_the_time_that_its_error_needs() -> None:
    """The torque is 0 again at the end; its error decays with the gains."""
    push = [(4.3, {"tau_ext[1]": 2.0}), (4.6, {"tau_ext[1]": 0.0})]
    lines = twodof.simulate(fmu_of("arm", "task"), changes=push).verdict.lines
    words = "tau_ext[1] changed from 2 to 0 at 4.6 s, and an error needs about 3.03 s to decay to 2 %; stop later"
    assert words in lines[0] and lines[1].startswith("note: joint 'joint1' has a peak")
    assert twodof.simulate(fmu_of("arm", "task"), changes=push, stop_time=11.0).verdict.outcome == "reached"


def test_a_run_that_starts_at_its_target_has_a_line_for_it() -> None:
    settings = {"payload": 1.0, "q_des": (0.5, 0.3), "q_start": (0.5, 0.3)}
    lines = twodof.simulate(fmu_of("arm", "joint"), settings=settings).verdict.lines
    assert any(line.startswith("the run starts at its target, ") for line in lines), "\n".join(lines)


def test_a_reached_target_needs_no_settings() -> None:
    lines = twodof.simulate(fmu_of("arm", "task"), settings=failures.LARGE_STEPS).verdict.lines
    assert lines[0].startswith("reached") and lines[1].endswith("steady at the end") and len(lines) == 3


def test_an_arm_that_stops_short_of_the_nearest_point_is_reported() -> None:
    settings = {"q_max": (0.6, 0.4), **failures.LARGE_STEPS}
    verdict = twodof.simulate(fmu_of("arm", "task"), settings=settings).verdict
    (reach,) = (cause for cause in verdict.causes if cause.kind == "reach")
    assert verdict.numbers["final_error"] > 1.2 * reach.share
    assert re.search(r"nearest reachable point is \(.*\) m, [\d.]+ m from the end effector", reach.text)
    assert not [cause for cause in verdict.causes if cause.noted and cause.kind not in ("effort", "velocity")]


def test_an_orientation_that_is_held_may_move_by_a_milliradian() -> None:
    """The damping of a Panda's joints, which the controller does not know, disturbs it."""
    settings = {"x_des": (0.4, 0.2, 0.6), **failures.LARGE_STEPS}
    kept = Kept()
    verdict = twodof.simulate(fmu_of("panda", "pose"), kept, settings=settings, stop_time=4.0).verdict
    a, b = (Rotation.from_quat(quat) for quat in (kept.samples[-1].quat, kept.samples[-1].target_quat))
    assert 1e-4 < (a.inv() * b).magnitude() < 1e-3
    assert verdict.outcome == "reached" and not verdict.causes


def test_a_line_names_each_joint_once() -> None:
    stands = [Cause("limit", f"joint '{name}' stood", joint=name) for name in ("a", "b", "a", "c", "b")]
    for count, others in ((4, "'b', 'c'"), (3, "all other joints")):
        texts = [cause.text for cause in _grouped((Cause("gain", "a gain"), *stands), count, "")]
        assert texts == ["a gain", f"joint 'a' stood, likewise {others}"]


def test_a_bag_a_figure_and_a_page_say_the_same(
    failed: Failed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, bag, verdict, _ = failed
    assert twodof.read_bag(bag).verdict == verdict == twodof.verdict(bag)
    assert main(["info", str(bag)]) == 0
    assert f"verdict      {verdict.lines[0]}\n" in capsys.readouterr().out
    assert main(["info", str(bag), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)["verdict"]
    assert (facts["lines"], facts["causes"][0]["kind"]) == ([*verdict.lines], verdict.causes[0].kind)
    assert main(["plot", str(bag), "-o", str(tmp_path / "plot.html")]) == 0
    assert verdict.lines[0] in capsys.readouterr().out
    assert main(["view", str(bag), "--export", str(tmp_path / "view.html")]) == 0


def test_a_target_that_changed_late_is_named() -> None:
    changes = [(1.9, {"x_des": (0.1, 0.1)})]
    verdict = twodof.simulate(fmu_of("arm", "task"), changes=changes, stop_time=2.0).verdict
    assert "the target changed at 1.9 s, and the position still approaches" in verdict.lines[0]


@pytest.mark.parametrize("robot", list(ROBOTS))
def test_good_runs_have_no_cause(robot: str) -> None:
    count = 0
    for run in good_runs(robot):
        kept = Kept()
        verdict = twodof.simulate(run, kept).verdict
        assert verdict.outcome in ("reached", "followed"), verdict.lines
        assert not verdict.causes, verdict.lines
        assert page_causes(run, kept.samples) == []
        count += 1
    assert count == 4


# --- numbers, against closed forms ---


def response(t: np.ndarray, Kp: float, Kd: float) -> np.ndarray:
    """Solution of e'' + Kd e' + Kp e = 0 from e = 1 at rest, underdamped."""
    a, w = Kd / 2, np.sqrt(Kp - Kd * Kd / 4)
    return np.exp(-a * t) * (np.cos(w * t) + a / w * np.sin(w * t))


@pytest.mark.parametrize("damping", [0.05, 0.2, 0.5, 0.7])
def test_settling_overshoot_frequency_and_damping_are_those_of_second_order(native_path: Path, damping: float) -> None:
    Kp, stop = 40.0, 8.0
    Kd = 2.0 * damping * np.sqrt(Kp)
    run = twodof.simulate(native_path, settings={"Kp": Kp, "Kd": Kd}, step=STEP, stop_time=stop)
    found, w = run.verdict.numbers, np.sqrt(Kp) * np.sqrt(1.0 - damping**2)
    assert found["overshoot"] == pytest.approx(np.exp(-np.pi * damping / np.sqrt(1.0 - damping**2)), rel=1e-3)
    assert found["frequency"] == pytest.approx(w / (2.0 * np.pi), rel=1e-3)
    assert found["damping"] == pytest.approx(damping, rel=1e-3)
    t = np.linspace(0.0, stop, 800_001)
    outside = np.flatnonzero(np.abs(response(t, Kp, Kd)) > 0.02)
    settled = t[outside[-1]] if outside[-1] < len(t) - 1 else np.inf
    assert found["settling_time"] == pytest.approx(settled, abs=STEP)
    assert (run.verdict.outcome == "reached") == (damping > 0.05)


def test_a_limit_cycle_has_its_frequency_by_its_crossings() -> None:
    t = np.linspace(0.0, 3.999, 4000)
    triangle = np.abs((t * 3.7) % 1.0 - 0.5) - 0.25
    found = ringing(t, triangle)
    assert found is not None
    assert found.frequency == pytest.approx(3.7, rel=1e-3) and found.damping == pytest.approx(0.0, abs=1e-2)
    assert motion_of(t, triangle[:, None], 0.5)[0] == "oscillating"


def test_a_motion_with_one_jolt_is_no_oscillation() -> None:
    """Its error crosses its mean three times, and does not repeat."""
    t = np.linspace(0.0, 5.0, 501)
    y = 0.3 - 0.02 * t + 0.05 * np.exp(-(((t - 3.9) / 0.05) ** 2))
    assert ringing(t, y) is None
    assert motion_of(t, y[:, None], 0.14)[0] == "moving"


@pytest.mark.parametrize(
    ("rate", "motion"), [(-3.0, "steady"), (0.0, "oscillating"), (0.8, "diverging")], ids=["decays", "lasts", "grows"]
)
def test_motion_is_steady_oscillating_or_diverging(rate: float, motion: str) -> None:
    t = np.linspace(0.0, 4.995, 1000)
    y = 0.1 * np.exp(rate * t) * np.cos(2 * np.pi * 2.0 * t)
    assert motion_of(t, y[:, None], 0.1)[0] == motion


@pytest.mark.parametrize("target", [(0.5, 0.1), (0.02, -0.01), (-0.4, 0.3), (0.1, -0.28)])
def test_the_nearest_point_is_that_of_another_optimiser(target: tuple[float, float]) -> None:
    """Limits cut the ring of the default arm; the optimisers are SciPy's grid search and Nelder and Mead's simplex."""
    urdf = read_urdf((Path(__file__).parents[1] / "urdf/2dof.urdf").read_text())
    low, high = np.array([-0.5, 0.2]), np.array([2.0, 2.5])

    def far(q: np.ndarray) -> float:
        x = 0.15 * np.array([np.cos(q[0]) + np.cos(q[0] + q[1]), np.sin(q[0]) + np.sin(q[0] + q[1])])
        return float(np.linalg.norm(x - target) + 10.0 * np.clip([low - q, q - high], 0.0, None).sum())

    expected = far(brute(far, [*zip(low, high)], Ns=200))
    kinematics, q = Kinematics(urdf, ("joint1", "joint2")), np.array([0.5, 0.35])
    wanted = np.array(target)
    found = nearest(kinematics, "EndEffector", axes=(0, 1), target=wanted, quat=np.empty(0), low=low, high=high, q=q)
    assert found.distance == pytest.approx(expected, abs=1e-4 * 0.3) and far(found.q) == pytest.approx(found.distance)


def test_the_nearest_point_of_a_panda_is_that_of_an_evolution() -> None:
    fmu = twodof.load_fmu(fmu_of("panda", "pose"))
    robot = robot_of(fmu.urdf)
    assert robot is not None
    kinematics, own = Kinematics(robot, fmu.joints), [robot.joints[name] for name in fmu.joints]
    low, high = np.array([(joint.low, joint.high) for joint in own]).T
    wanted, q, none = np.array([1.5, 0.0, 0.5]), np.array(failures.AT_PANDA), np.empty(0)
    found = nearest(kinematics, fmu.frame, axes=(0, 1, 2), target=wanted, quat=none, low=low, high=high, q=q)

    def far(q: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(kinematics.path(fmu.frame, q.T) - wanted, axis=1))

    best = differential_evolution(far, [*zip(low, high)], rng=1, vectorized=True, updating="deferred", maxiter=300)
    assert found.distance == pytest.approx(best.fun, rel=1e-3)


# --- what it costs ---


class Counted(Kinematics):
    """Kinematics that count transforms of single joints."""

    count = 0

    def in_parent(self, joint: Joint, q: ArrayLike) -> Placement:
        self.count += 1
        return super().in_parent(joint, q)


def test_the_search_for_the_nearest_point_of_a_long_chain_has_a_bound() -> None:
    moving, still = 64, 400
    text = '<robot name="c"><link name="l0"/>'
    for i in range(1, moving + still + 1):
        kind = "continuous" if i <= moving else "fixed"
        text += f'<link name="l{i}"/><joint name="j{i}" type="{kind}"><parent link="l{i - 1}"/><child link="l{i}"/>'
        text += f'<origin xyz="0.1 0 0.01"/><axis xyz="0 {i % 2} {1 - i % 2}"/></joint>'
    kinematics = Counted(read_urdf(text + "</robot>"), [f"j{i}" for i in range(1, moving + 1)])
    target, free, none = np.array([100.0, 3.0, 1.0]), np.full(moving, np.inf), np.empty(0)
    end = kinematics.end(f"l{moving + still}", np.zeros((1, moving))).translation[0]
    np.testing.assert_allclose(end, [0.1 * (moving + still), 0.0, 0.01 * (moving + still)])
    search: dict[str, Any] = {"axes": (0, 1, 2), "target": target, "quat": none, "low": -free, "high": free}
    found = nearest(kinematics, f"l{moving + still}", q=np.full(moving, 0.1), **search)
    assert found.distance < np.linalg.norm(target - end) + 1.0
    assert kinematics.count < still + 2 * reach.MOST_TURNS + 5 * moving


def test_the_verdict_calls_no_function_for_each_sample(native_path: Path) -> None:
    """A sample costs only the writing of its row; the number of calls does not depend on the block size."""
    run = twodof.experiment(native_path, stop_time=1000.0)
    judge = stepping.judge_of(run, None)
    row = memoryview(bytes(8 * sum(len(run.fmu.vector(group)) for group in OUTPUTS)))

    def calls(samples: int) -> int:
        count = 0

        def called(_frame: object, event: str, _argument: object) -> None:
            nonlocal count
            count += event in ("call", "c_call")

        for _ in range(samples):
            judge.rows.write(row)
        sys.setprofile(called)
        try:
            judge.flush()
        finally:
            sys.setprofile(None)
        return count

    calls(BLOCK)  # the first block has more
    assert calls(BLOCK) == calls(BLOCK // 8) < 1000
    assert judge.metrics()["peak_velocity"] == 0.0 and judge.count == 2 * BLOCK + BLOCK // 8


def test_the_verdict_takes_no_more_memory_in_a_longer_run(native_path: Path) -> None:
    memory = Memory(50_000)
    run = twodof.simulate(native_path, memory, stop_time=4000.0)
    assert memory.growth <= 300_000
    assert run.verdict.samples == 400_001 and run.verdict.outcome == "reached"


def test_blocks_change_no_number(native_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Targets change within blocks and at their edges."""
    changes = [(0.1 * k, {"x_des": (0.2 + 0.002 * k, 0.05)}) for k in range(1, 12)]
    expected = twodof.simulate(native_path, stop_time=6.0, changes=changes, settings={"Kd": 6.0}).verdict
    for block in (1, 7, 10, 50):
        monkeypatch.setattr(stepping, "BLOCK", block)
        found = twodof.simulate(native_path, stop_time=6.0, changes=changes, settings={"Kd": 6.0}).verdict
        assert found.numbers == pytest.approx(expected.numbers, rel=1e-12, abs=1e-15)
        assert found.lines == expected.lines
    run = twodof.experiment(native_path, stop_time=6.0, changes=changes, settings={"Kd": 6.0})
    samples = [*twodof.samples(run)]
    e = np.array([np.subtract(s.target or (), s.x) for s in samples])
    assert twodof.verdict(samples, run).numbers == pytest.approx(expected.numbers, rel=1e-12, abs=1e-15)
    last = np.subtract((0.222, 0.05), [s.x for s in samples])[110:]
    outside = np.flatnonzero(np.linalg.norm(last, axis=1) > 0.02 * np.linalg.norm(last[0]))[-1]
    assert expected.numbers["settling_time"] == pytest.approx(0.01 * (outside + 1))
    assert expected.numbers["final_error"] == pytest.approx(np.linalg.norm(e[-1]))


# --- conditions, and honest answers ---


@pytest.mark.parametrize(
    ("conditions", "line"),
    [
        (["error > 1e-6"], "error > 1e-6 holds: final_error = 0.0002"),
        (["error>1e-3", "saturated>0.1", "settling > 5"], ""),
        (["rms >= 0.01 + 0.02"], "rms >= 0.01 + 0.02 holds: rms_error = 0.039"),
        (["turn_error > 1"], "turn_error > 1 cannot be decided: final_turn_error is not defined"),
        (["max(overshoot, effort_use) > 0.05"], "holds: overshoot = 0, effort_use = 0.0557"),
    ],
)
def test_a_condition_fails_a_run(
    native_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], conditions: list[str], line: str
) -> None:
    options = [option for condition in conditions for option in ("--fail-if", condition)]
    assert main(["run", str(native_path), "-o", str(tmp_path / "bag"), *options]) == (3 if line else 0)
    assert line in capsys.readouterr().err


@pytest.mark.parametrize(
    ("condition", "reason"),
    [
        ("eror > 1", "there is no metric 'eror'; did you mean"),
        ("error", "is not a comparison"),
        ("__import__('os').system('true') > 0", "is not a comparison"),
        ("error.__class__ > 0", "is not a comparison"),
        ("(lambda: 1)() > 0", "is not a comparison"),
        ("peak > 1", "did you mean peak_effort or peak_velocity?"),
        ("error > 1e-3 > 1", "is not a comparison"),
        ("(" * 300 + "error" + ")" * 300 + " > 1", "is not a comparison"),
    ],
)
def test_a_condition_is_refused_before_the_run(
    native_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], condition: str, reason: str
) -> None:
    assert main(["run", str(native_path), "-o", str(tmp_path / "bag"), "--fail-if", condition]) == 1
    assert reason in capsys.readouterr().err and not (tmp_path / "bag").exists()


def test_a_run_without_a_target_has_a_line_for_it() -> None:
    run = twodof.simulate(fmu_of("arm", "effort"), settings=failures.LARGE_STEPS, stop_time=2.0)
    assert run.verdict.outcome == "no target" and run.verdict.lines[0].startswith("no target")
    assert not {"final_error", "final_joint_error", "settling_time", "overshoot"} & {*run.verdict.numbers}


def test_a_step_at_the_stability_limit_of_an_external_controller_is_named() -> None:
    """A PD controller, sampled every 10 ms, is at its stability limit."""
    run = twodof.experiment(fmu_of("arm", "effort"), step=0.01, stop_time=1.0, settings={"gravity": (0.0, 0.0, 0.0)})
    steps, samples = twodof.samples(run), []
    samples.append(next(steps))
    for _ in range(100):
        q, v = samples[-1].q, samples[-1].v
        samples.append(steps.send({"tau_cmd": tuple(-2.0 * (a - 0.3) - 0.45 * b for a, b in zip(q, v))}))
    verdict = twodof.verdict(samples, run)
    assert "sampling" in {cause.kind for cause in verdict.causes}, verdict.lines
    assert "communication steps of 0.01 s" in str(verdict)


def test_a_bag_whose_writer_died_is_judged_by_its_samples(native_path: Path, tmp_path: Path) -> None:
    """This includes a bag with fewer messages than its verdict states."""
    run, kept = twodof.experiment(native_path, stop_time=5.0), []
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        for sample in twodof.samples(run):
            if sample.k <= 100:
                bag.write(sample)
                kept.append(sample)
    whole = twodof.simulate(run).verdict
    found = twodof.read_bag(tmp_path / "bag").verdict
    assert (whole.outcome, found.outcome, found.samples) == ("reached", "not reached", 101)
    assert found.causes[0].kind == "time" and found.numbers["final_error"] == pytest.approx(
        twodof.verdict(kept, run).numbers["final_error"], rel=1e-6
    )
    text = (tmp_path / "bag/run.json").read_text().strip()
    (tmp_path / "bag/run.json").write_text(f'{text[:-1]},"verdict":{json.dumps(whole.facts())}}}')
    assert twodof.read_bag(tmp_path / "bag").verdict.lines == found.lines
    endless = {**found.facts(), "lines": ["x"] * 30_000}  # which a figure would show
    for forged in ({"samples": 101}, endless):
        (tmp_path / "bag/run.json").write_text(f'{text[:-1]},"verdict":{json.dumps(forged)}}}')
        assert twodof.read_bag(tmp_path / "bag").verdict.lines == found.lines


def test_a_judge_of_nothing_has_no_number() -> None:
    run = twodof.experiment(fmu_of("arm", "task"))
    judge = stepping.judge_of(run, None)
    assert isinstance(judge, Judge)
    with pytest.raises(twodof.TwoDofError, match="there are no samples"):
        twodof.verdict([], run)
    with pytest.raises(twodof.TwoDofError, match="experiment"):
        twodof.verdict([])


@pytest.mark.parametrize(("target", "sticks"), [(0.8, False), (0.55, True)])
def test_a_joint_that_is_pressed_onto_its_limit_does_not_stick(target: float, sticks: bool) -> None:
    """It sticks there if friction, and not the limit, holds it."""
    settings = {"q_des": (0.5, target), "q_max": (1.0, 0.6), "q_start": (0.5, 0.6), "friction": (0.0, 1.0)}
    kept = Kept()
    causes = twodof.simulate(fmu_of("arm", "joint"), kept, settings=settings, stop_time=3.0).verdict.causes
    assert kept.samples[-1].q[1] == 0.6
    assert ("friction" in {c.kind for c in causes}) is sticks
    assert ("friction" in {c["kind"] for c in page_causes(kept.run, kept.samples)}) is sticks


def test_a_joint_sticks_from_its_last_motion_on() -> None:
    """A joint moves at first and then sticks before its target: it sticks from the first sample with speed 0."""
    fmu = fmu_of("arm", "joint")
    settings = {"q_des": (0.9, 0.35), "friction": (0.03, 0.0), "Kp": 20.0, "Kd": 2.0, "max_step": 0.01}
    kept = Kept()
    run = twodof.simulate(fmu, kept, settings=settings, stop_time=5.0)
    still = np.array([sample.v[0] == 0.0 for sample in kept.samples])
    stopped = np.flatnonzero(~still)[-1]
    (cause,) = [cause for cause in run.verdict.causes if cause.kind == "friction"]
    assert 10 < stopped < 400 and still[stopped + 1 :].all()
    assert cause.joint == "joint1" and cause.time == pytest.approx(0.01 * stopped)
    assert cause.share == pytest.approx((5.0 - 0.01 * stopped) / 5.0)
    assert cause is run.verdict.causes[0] and "sticks" in run.verdict.lines[0]
    creeping = twodof.simulate(fmu, settings={**settings, "friction": (0.05, 0.0), "Kd": 10.0}, stop_time=5.0)
    assert 0.0 < creeping.last.v[0] < 1e-6  # overdamped, its speed only decays
    assert "'joint1' sticks: its friction of 0.05 N·m stops it short" in creeping.verdict.lines[0]
    freed = twodof.simulate(fmu, settings={**settings, "friction": 0.0, "Kd": 10.0}, stop_time=5.0).verdict
    assert freed.outcome == "reached" and not freed.causes


SWING = np.sin(np.arange(200) / 10)
REPEATED = 0.01 * np.r_[0:50, 49, 50:199]
OTHERS = {
    "repeated stamp": (REPEATED, SWING, "oscillating"),
    "one stamp": (np.zeros(200), SWING, "steady"),
    "one message": (np.zeros(1), SWING[:1], "steady"),
    "huge": (0.01 * np.arange(200), 1.7e308 * (-1.0) ** np.arange(200), "diverging"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("velocities", [False, True])
@pytest.mark.parametrize("form", OTHERS)
def test_bags_of_others_with_odd_stamps_and_numbers_are_judged_without_a_warning(form, velocities, tmp_path):
    t, q, motion = OTHERS[form]
    q = np.column_stack([q, np.zeros(len(q))])
    bag = third_party_bag(tmp_path / "bag", ["a", "b"], t, q, np.zeros_like(q) if velocities else None)
    verdict = twodof.read_bag(bag).verdict
    assert verdict.motion == motion and "nan" not in " ".join(verdict.lines)


@pytest.mark.parametrize("tau", [0, 2])
@pytest.mark.parametrize("starts", [{}, {"Kp[1]": 0.0, "Kp[2]": 5.0, "Kp[3]": 0.0, "damping[1]": 1.0}])
def test_a_run_of_others_with_fewer_or_more_parameters_than_joints_is_judged(tau, starts):
    """The robot has damping, which the run may not state, and the controller is another's."""
    text = (Path(__file__).parents[1] / "urdf/2dof.urdf").read_text("utf-8")
    text = text.replace("<limit", '<dynamics damping="0.5"/><limit')
    robot, t, q = read_urdf(text), np.arange(0.0, 2.0, 0.01), np.zeros((200, 2))
    assert [joint.damping for joint in robot.joints.values()].count(0.5) == 2
    sizes = {"q": 2, "v": 2, "x": 0, "tau": tau, "quat": 0}
    values = {name: np.ones((200, size)) for name, size in sizes.items()}
    made = setup(joints=[*robot.joints][:2], robot=robot, frame="", axes="", step=0.01, starts=starts)
    verdict = judged(made, t, values, {"q": q})
    zero = [cause.text for cause in verdict.causes if cause.kind == "gain"]
    assert verdict.outcome == "not reached" and "drag" not in {cause.kind for cause in verdict.causes}
    assert [text[:15] for text in zero] == ["Kp[1], Kp[3] = "][: bool(starts)]


EXTREME = (5e-324, 1e-300, 1e154, 1e308, -1.7e308)


@pytest.mark.parametrize("value", EXTREME)
@pytest.mark.parametrize("name", ["q", "v", "x", "tau"])
@pytest.mark.parametrize("count", [1, 2, 9, 300])
@pytest.mark.filterwarnings("error")
def test_extreme_outputs_of_a_run_have_a_verdict(name: str, value: float, count: int) -> None:
    """A master passes any finite number to the judge."""
    setup = setup_of(fmu := twodof.load_fmu(fmu_of("arm", "task")), robot_of(fmu.urdf), 0.01, fmu.start_values)
    sizes = {"q": 2, "v": 2, "x": 2, "tau": 2, "quat": 0}
    rows = {each: np.full((count, size), 0.1) for each, size in sizes.items()}
    rows[name][:] = value * np.sin(0.7 * np.arange(count) + 1.0)[:, None]
    judge = Judge(setup, [*sizes.values()])
    judge.rows.write(np.hstack([*rows.values()]).tobytes())
    verdict = conclude(judge)
    json.dumps(verdict.facts(), allow_nan=False)
    assert ("beyond 1e+100 at" in " ".join(verdict.lines)) == (abs(value) > 1e100)


@pytest.mark.parametrize("name", ["Kp[1]", "f_ext[1]", "gravity[2]", "payload", "friction[2]", "x_des[1]"])
@pytest.mark.filterwarnings("error")
def test_a_setting_beyond_what_is_judged_is_named(name: str) -> None:
    setup = setup_of(
        fmu := twodof.load_fmu(fmu_of("arm", "task")), robot_of(fmu.urdf), 0.01, {**fmu.start_values, name: 1e307}
    )
    judge = Judge(setup, [2, 2, 2, 2, 0])
    judge.rows.write(np.full((300, 8), 0.1).tobytes())
    expected = (
        "a value is beyond 1e+100 at 0 s" if name == "x_des[1]" else f"{name} = 1e+307: with a value beyond 1e+100"
    )
    assert expected in conclude(judge).lines[0]


def test_times_that_repeat_have_a_verdict() -> None:
    setup = setup_of(fmu := twodof.load_fmu(fmu_of("arm", "task")), robot_of(fmu.urdf), 0.01, fmu.start_values)
    waves = 0.1 * np.sin(np.arange(50.0))[:, None] * np.ones((50, 2))
    rows = {"q": waves, "v": waves, "x": waves, "tau": waves, "quat": np.empty((50, 0))}
    verdict = judged(setup, np.zeros(50), rows, {"x": np.full((50, 2), 0.2)})
    assert (verdict.motion, verdict.duration) == ("steady", 0.0)


def test_percentages_add_up_to_the_whole() -> None:
    """The load and the limit have 150 % of the error; what reduces it is on the line after them."""
    summary = twodof.simulate(
        fmu_of("arm", "task"), settings={"payload": 0.3, "f_ext": (0.0, 2.0, 0.0), "q_min": (-0.2, -3.0)}
    )
    lines = summary.verdict.lines
    shares = [float(size) for line in lines for size in re.findall(r"\((?:[^()]*, )?([\d.]+) % of the error\)", line)]
    reduced = [float(size) for line in lines for size in re.findall(r"reduces the error by ([\d.]+) %", line)]
    rest = [float(size) for line in lines for size in re.findall(r"^everything else: ([\d.]+) %", line)]
    assert len(shares) >= 1 and sum(shares) + sum(rest) - sum(reduced) == pytest.approx(100.0, abs=3.0), lines


def test_an_arm_that_never_moved_and_an_error_that_grew_are_named() -> None:
    held = twodof.simulate(fmu_of("arm", "joint"), settings={"q_des": (0.6, 0.4), "friction": 9.0}).verdict
    assert "no joint ever moved" in " ".join(held.lines) and "holds it during the whole run" in held.lines[0]
    pushed = twodof.simulate(fmu_of("arm", "joint"), settings={"q_des": (0.51, 0.35), "tau_ext": (-3.0, 0.0)})
    first, last = (f"{np.hypot(0.51 - q[0], 0.35 - q[1]):.3g} rad" for q in ((0.5, 0.35), pushed.last.q))
    assert f"the error of the joints grew from {first} to {last}" in " ".join(pushed.verdict.lines)


def test_a_peak_effort_of_a_run_that_reaches_its_target_has_no_error() -> None:
    settings = {"q_des": (0.7, -1.2, 1.4, 0.2, -1.0, 1.2), "Kp": 4000.0, "Kd": 126.0}
    verdict = twodof.simulate(fmu_of("ur5", "joint"), settings=settings, stop_time=1.0).verdict
    assert verdict.outcome == "reached" and verdict.causes[0].kind == "effort"
    assert "error" not in verdict.lines[0].partition("; ")[2]


def test_the_joint_with_the_largest_error_leads_its_line() -> None:
    settings = {"q_des": (0.55, 0.8), "friction": (3.0, 2.0)}
    first = twodof.simulate(fmu_of("arm", "joint"), settings=settings).verdict.lines[0]
    assert re.search(r"\('joint2'\); joint 'joint2' sticks: .*, likewise 'joint1'", first), first


def test_an_error_that_grows_under_a_load_is_not_a_matter_of_time() -> None:
    """The arm starts at its target; with weak gains its motion under the force has not settled at the end."""
    settings = {"Kp[3]": 0.1, "f_ext": (5.0, 0.0, 0.0), "x_des": None}
    panda = fmu_of("panda", "task")
    start = tuple(twodof.load_fmu(panda).start_values[f"x_des[{i}]"] for i in (1, 2, 3))
    run, kept = twodof.experiment(panda, settings={**settings, "x_des": start}), Kept()
    summary = twodof.simulate(run, kept)
    assert summary.repeat is None and summary.verdict.causes[0].subject == "f_ext", summary.verdict
    assert page_causes(run, kept.samples)[0]["subject"] == "f_ext"
