"""Trajectories of a bag, followed by an arm under joint control.

The references are SciPy's splines, and the exact response of q̈ = c − Kd q̇ − Kp q to inputs held over a step. rosbags
writes the bags with its own definitions.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.interpolate import BPoly
from scipy.linalg import expm

import twodof
from twodof.bag import recorded_commands
from twodof.cli.main import main
from twodof.errors import InputError

HUMBLE = get_typestore(Stores.ROS2_HUMBLE)
JOINT_STATE, TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
NAMES = ("joint1", "joint2")
START = np.array([0.5, 0.35])  # of the default arm
KP, KD = 50.0, 40.0
BEGIN = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
Point = tuple[Any, ...]
"""Time from start, s; positions; velocities; accelerations; efforts: so many as there are."""


def trajectory(points: Sequence[Point], names: Sequence[str] = NAMES, stamp: int = 0) -> Any:
    types = HUMBLE.types

    def time(kind: str, ns: int) -> Any:
        return types[f"builtin_interfaces/msg/{kind}"](*divmod(ns, SECOND))

    make, empty = types["trajectory_msgs/msg/JointTrajectoryPoint"], ((),) * 4
    stored = [
        make(*(np.array(part, float) for part in (*parts, *empty)[:4]), time("Duration", round(after * SECOND)))
        for after, *parts in points
    ]
    header = types["std_msgs/msg/Header"](time("Time", stamp), "")
    return types[TRAJECTORY](header, [*names], stored)


def write(path: Path, *commands: tuple[float, Any], topic: str = "/go") -> Path:
    """Write a bag whose first joint state is at BEGIN, with messages some seconds after."""
    header = HUMBLE.types["std_msgs/msg/Header"](HUMBLE.types["builtin_interfaces/msg/Time"](0, 0), "")
    none = np.zeros(0)
    state = HUMBLE.types[JOINT_STATE](header, [], none, none, none)
    with Writer(path, version=8) as writer:
        states = writer.add_connection("/joint_states", JOINT_STATE, typestore=HUMBLE)
        writer.write(states, BEGIN, HUMBLE.serialize_cdr(state, JOINT_STATE))
        for t, message in commands:
            kind = message.__msgtype__
            there = [c for c in writer.connections if (c.topic, c.msgtype) == (topic, kind)]
            here = there[0] if there else writer.add_connection(topic, kind, typestore=HUMBLE)
            cdr = HUMBLE.serialize_cdr(message, kind)
            writer.write(here, BEGIN + round(t * SECOND), cdr)
    return path


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """The default arm under joint control."""
    path = tmp_path_factory.mktemp("joint") / "Joint.fmu"
    return twodof.build_fmu(path, twodof.FmuOptions(control="joint", native=True))


def held(fmu: Path, bag: Path, step: float, count: int, **options: Any) -> np.ndarray:
    """Return the inputs from each communication point on: q, v, a of both joints."""
    now: dict[str, float] = {}
    changes, k, table = twodof.read_commands(fmu, bag, step=step, **options), 0, []
    for i in range(count):
        while k < len(changes) and changes[k][0] <= (i + 1e-9) * step:
            now |= changes[k][1]
            k += 1
        table.append([[now[f"{group}[{j}]"] for j in (1, 2)] for group in ("q_des", "v_des", "a_des")])
    return np.array(table)


THERE = ((0.8, 0.1), (0.0, 0.0), (0.0, 0.0))
BACK = ((0.2, 0.5), (0.0, 0.0), (0.0, 0.0))


def spline(times: Sequence[float], points: Sequence[Any]) -> BPoly:
    """Return the spline by SciPy, through points with given parts."""
    orders = [2 * min(len(a), len(b)) - 1 for a, b in pairwise(points)]
    return BPoly.from_derivatives(times, [np.array(p, float) for p in points], orders)


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_the_held_value_is_the_mean_of_a_spline(arm, tmp_path, parts):
    """It goes from rest, through three points between communication points, to rest."""
    knots = [0.0, 0.333, 0.7, 1.111]
    numbers = np.random.default_rng(parts).normal(size=(4, 3, 2))
    numbers[0] = np.array([START, (0, 0), (0, 0)])
    points = [(t, *n[:parts]) for t, n in zip(knots[1:], numbers[1:])]
    bag = write(tmp_path / "bag", (0.0, trajectory(points)))
    table = held(arm, bag, 0.05, 30)
    path = spline(knots, [n[:parts] for n in numbers])
    for k, order in np.ndindex(table.shape[:2]):
        edges = [k * 0.05, *(t for t in knots if k * 0.05 < t < (k + 1) * 0.05), (k + 1) * 0.05]
        whole = np.zeros(2)
        for a, b in pairwise(edges):
            t, w = leggauss(4)
            if a < knots[-1]:
                values = [path((a + b + (b - a) * s) / 2, order) for s in t]
                whole += np.dot(w, values) * (b - a) / 2
            elif order == 0:
                whole += numbers[-1, 0] * (b - a)
        assert table[k, order] == pytest.approx(whole / 0.05, rel=1e-12, abs=1e-12)
    np.testing.assert_array_equal(table[-1], [numbers[-1, 0], (0, 0), (0, 0)])  # held to the bit


def test_the_robot_follows_exactly_the_held_inputs(arm, tmp_path):
    """It starts off the trajectory; in each step ë + Kd ė + Kp e = c with constant c."""
    bag = write(tmp_path / "bag", (0.0, trajectory([(0.0, *THERE), (1.0, *BACK), (1.5, *THERE)])))
    out, h = tmp_path / "model", 0.01
    options = ["--stop-time", "2", "--set", "q_start=0.7,0.2"]
    assert main(["run", str(arm), "--input", f"{bag}:/go", *options, "-o", str(out)]) == 0
    path = spline([0.0, 1.0, 1.5], [THERE, BACK, THERE])

    def mean(nu: int, k: int) -> Any:
        """Return the mean of a derivative over a step."""
        if k >= 150:
            return np.array(THERE[nu])
        whole = (path.derivative(nu) if nu else path).antiderivative()
        return (whole((k + 1) * h) - whole(k * h)) / h

    flow = expm(np.array([[0.0, 1.0, 0.0], [-KP, -KD, 1.0], [0.0, 0.0, 0.0]]) * h)
    state, q = np.array([(0.7, 0.2), (0.0, 0.0)]), [(0.7, 0.2)]
    for k in range(200):
        c = mean(2, k) + KD * mean(1, k) + KP * mean(0, k)
        state = (flow @ np.vstack([state, c]))[:2]
        q.append(state[0])
    assert np.abs(twodof.read_bag(out).q - q).max() < 1e-9


def test_the_points_of_all_trajectories_are_limited(arm, tmp_path, monkeypatch):
    several = [(0.1 * k, trajectory([(1.0, *THERE), (2.0, *BACK)])) for k in range(3)]
    bag = write(tmp_path / "bag", *several)
    monkeypatch.setattr(recorded_commands, "MAX_POINTS", 6)
    assert twodof.read_commands(arm, bag)
    monkeypatch.setattr(recorded_commands, "MAX_POINTS", 5)
    with pytest.raises(InputError, match="has trajectories of more than 5 points"):
        twodof.read_commands(arm, bag)


def test_the_robot_stays_on_the_trajectory(arm, tmp_path):
    """The deviation falls with the square of the step."""
    near = ((0.52, 0.34), (0.0, 0.0), (0.0, 0.0))
    rest = (START, (0.0, 0.0), (0.0, 0.0))
    path = spline([0.0, 1.0], [rest, near])
    bag = write(tmp_path / "bag", (0.0, trajectory([(1.0, *near)])))

    def off(step: float) -> float:
        changes = twodof.read_commands(arm, bag, step=step)
        run = twodof.samples(arm, changes=changes, stop_time=1.0, step=step)
        return max(float(np.abs(sample.q - path(sample.t)).max()) for sample in run)

    errors = [off(step) for step in (1e-2, 1e-3, 1e-4)]
    assert errors[0] < 1e-6 and errors[2] < 1e-9
    assert [a / b for a, b in pairwise(errors)] == pytest.approx([100.0, 100.0], rel=0.05)


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_a_new_one_replaces_the_old_from_the_state_that_was_wanted(arm, tmp_path, parts):
    """It replaces only its joints; two points are joined by the fields of both."""
    stops = [(START, (0.0, 0.0), (0.0, 0.0)), THERE, BACK, THERE, BACK, THERE, BACK]
    first = trajectory([(t, *stop) for t, stop in zip((1.0, 1.6, 1.7, 1.8, 1.9, 2.0), stops[1:])])
    goals = [((0.3,), (-0.2,), (0.5,))[:parts], ((0.4,), (0.0,), (0.0,))]
    points = [(0.25, *goals[0]), (0.5, *goals[1])]
    second = trajectory(points, ["joint2"], BEGIN + SECOND * 5 // 4)
    bag = write(tmp_path / "bag", (0.0, first), (1.25, second))
    old = spline([0.0, 1.0, 1.6, 1.7, 1.8, 1.9, 2.0], stops)
    at = [(old.derivative(nu) if nu else old)(1.25)[1:] for nu in range(3)]
    new = spline([1.25, 1.5, 1.75], [at, *goals])
    table, h = held(arm, bag, 0.01, 250), 0.01
    for k in range(200):
        wanted = np.diff(old.antiderivative()([k * h, (k + 1) * h]), axis=0)[0] / h
        if k >= 125:
            wanted[1:] = np.diff(new.antiderivative()([k * h, (k + 1) * h]), axis=0)[0] / h
        if k >= 175:
            wanted[1] = 0.4
        assert table[k, 0] == pytest.approx(wanted, abs=1e-12)
    np.testing.assert_array_equal(table[176, :, 1], (0.4, 0.0, 0.0))


@pytest.mark.parametrize(
    ("came", "stamp", "points", "path"),
    [
        (0.5, 0.0, [(1.0, (0.8,))], spline([0.5, 1.5], [[0.5], [0.8]])),
        (0.5, 1.0, [(1.0, (0.8,))], spline([0.5, 2.0], [[0.5], [0.8]])),
        (0.5, 0.25, [(1.0, (0.8,))], spline([0.5, 1.25], [[0.5], [0.8]])),
        # under way when it comes, and from where it is by then
        (0.5, 0.25, [(0.0, (0.5,)), (1.0, (0.9,))], spline([0.5, 1.25], [[0.6], [0.9]])),
        (0.5, 0.0, [(0.0, (0.8,))], None),
    ],
)
def test_when_it_starts(arm, tmp_path, came, stamp, points, path):
    begin = BEGIN + round(stamp * SECOND) if stamp else 0
    bag = write(tmp_path / "bag", (came, trajectory(points, ["joint1"], begin)))
    table = held(arm, bag, 0.01, 250)
    for k in range(250):
        t, start = (k + 0.5) * 0.01, path.x[0] if path else came
        end = path.x[-1] if path else came
        wanted = 0.5 if t < start else float(path(t)) if path and t < end else points[-1][1][0]
        assert table[k, 0, 0] == pytest.approx(wanted, abs=1e-12)
    assert (table[:, 0, 1] == 0.35).all() and (table[:, 1:, 1] == 0.0).all()


def test_it_begins_where_the_run_does(arm, tmp_path):
    bag = write(tmp_path / "bag", (1.0, trajectory([(1.0, (0.8,))], ["joint1"])))
    for settings in ({"q_start": (0.1, 0.2)}, {"q_start": 0.0, "q_des": (0.1, 0.2)}):
        table = held(arm, bag, 0.01, 151, settings=settings)
        np.testing.assert_array_equal(table[0], [(0.1, 0.2), (0, 0), (0, 0)])
        assert table[150, 0] == pytest.approx([0.1 + 0.505 * 0.7, 0.2], abs=1e-12)


def test_joints_of_another_robot_are_left_out(arm, tmp_path, caplog):
    """A trajectory and a joint state may name them."""
    names, none = ["finger", "joint2", "elbow"], np.zeros(0)
    message = trajectory([(1.0, (0.1, 0.2, 0.3), (0.0, 0.5, 1.0))], names)
    state = HUMBLE.types[JOINT_STATE](message.header, names, np.array([0.1, 0.2, 0.3]), none, none)
    for name, command in (("a", message), ("b", state)):
        bag = write(tmp_path / name, (0.0, command))
        last = twodof.read_commands(arm, bag)[-1][1]
        assert (last["q_des[2]"], last["v_des[2]"]) == (0.2, 0.0)
        told = "joints that this robot does not have are ignored: 'elbow, finger'"
        assert caplog.messages == [f"'{bag}': {told}"]
        caplog.clear()


NAN = float("nan")


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (trajectory([]), "has no points, or their times do not increase"),
        (trajectory([(1.0, *THERE), (1.0, *BACK)]), "has no points, or their times do not increase"),
        (trajectory([(1.0, (0.1,))]), "has 1 positions for 2 joints"),
        (trajectory([(1.0, (0.1, 0.1), (0.1,))]), "has 1 velocities for 2 joints"),
        (trajectory([(1.0, (0.1, 0.1), (), (0.1, 0.1))]), "has 0 velocities for 2 joints"),
        (trajectory([(1.0, (0.1, 0.1), (0.0, 0.0), (0.1,))]), "has 1 accelerations for 2 joints"),
        (trajectory([(1.0, (), (0.1, 0.1))]), "has 0 positions for 2 joints"),
        (trajectory([(1.0, (), (), (), (1.0, 1.0))]), "has 0 positions for 2 joints"),
        (trajectory([(1.0, (0.1, NAN))]), "is not finite"),
        (trajectory([(1.0, (0.1,))], ["elbow"]), "names no joint of this robot: 'elbow'"),
        (trajectory([(1.0, (0.1, 0.2))], ["joint1"] * 2), "names a joint twice: 'joint1, joint1'"),
        (trajectory([(-1.0, *THERE)], NAMES, BEGIN + SECOND // 2), "ends 1 s before it starts"),
        (trajectory([(1.0, *THERE)], NAMES, SECOND), "s before it starts; its stamp must be 0"),
    ],
)
def test_messages_that_cannot_be_followed(arm, tmp_path, capfd, message, reason):
    bag = write(tmp_path / "bag", (0.0, trajectory([(1.0, *THERE)])), (0.5, message))
    assert main(["run", str(arm), "--input", f"{bag}:/go", "-o", str(tmp_path / "none")]) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"twodof: error: '{bag}': the command at 0.5 s ") and reason in line
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("after", "there", "step", "reason"),
    [
        (2e9, THERE, "0.01", "its trajectories take 2e+09 s, more than 1000000 steps of 0.01 s"),
        (9000.0, THERE, "0.01", "take 9000 s, and those of 2 joints can take 7142.85 s at steps of 0.01 s"),
        (1.0, THERE, "0", "more than 1000000 steps of 0 s"),
        (1e-9, ((1e300, 0.0), (0.0, 0.0), (0.0, 0.0)), "0.01", "is not finite"),
    ],
)
def test_runs_that_would_have_no_end(arm, tmp_path, capfd, after, there, step, reason):
    bag = write(tmp_path / "bag", (0.0, trajectory([(after, *there)])))
    given = ["--input", str(bag), "--step", step, "-o", str(tmp_path / "none")]
    assert main(["run", str(arm), *given]) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("twodof: error: ") and reason in line


@pytest.mark.parametrize("control", ["effort", "task"])
def test_another_control_follows_none(tmp_path, capfd, control):
    bag = write(tmp_path / "bag", (0.0, trajectory([(1.0, *THERE)])))
    fmu = twodof.build_fmu(tmp_path / "Arm.fmu", twodof.FmuOptions(control=control))
    for given in (f"{bag}:/go", str(bag)):
        assert main(["run", str(fmu), "--input", given, "-o", str(tmp_path / "none")]) == 1
        (line,) = capfd.readouterr().err.splitlines()
        assert f"'{bag}' has no commands" in line and "for this FMU, which follows" in line


def test_a_topic_of_two_types_is_refused(arm, tmp_path):
    state = HUMBLE.types[JOINT_STATE](trajectory([]).header, ["joint1"], np.zeros(1), np.zeros(0), np.zeros(0))
    both = [(0.0, trajectory([(1.0, *THERE)])), (0.5, state)]
    for name, commands in (("a", both), ("b", [(0.0, state), (0.5, both[0][1])])):
        bag = write(tmp_path / name, *commands)
        with pytest.raises(InputError, match="has trajectories and other commands on /go"):
            twodof.read_commands(arm, bag)
