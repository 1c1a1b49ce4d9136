"""Steps across singularities and stops are right, compared with SciPy, or refused.

The oracle integrates equations of motion written with Pinocchio and NumPy from event to event: SciPy's ``solve_ivp`` at
a tight tolerance, between events with fixed joints at limits and a fixed rank of J⁺.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import pytest
from native_models import Engine, damped_arm, engine, from_urdf, model, shipped
from scipy.integrate import solve_ivp

import twodof
from twodof.plant import regime
from twodof.plant.plant import Plant

STEP = 0.01
MANY_EVALUATIONS = 3
EDGE = 1e-13  # beyond an event, so that the next piece begins on its other side


class Regime(NamedTuple):
    held: frozenset[int]
    rank: int


class Oracle:
    """The motion of a plant under the clamp of the tutorial, event by event."""

    def __init__(self, plant: Plant, method: str = "DOP853", max_step: float = 1e-3) -> None:
        self.plant, self.method, self.max_step = plant, method, max_step
        self.rcond = plant.rcond if plant.control == "task" else 0.0
        self.model = plant.robot.model.copy()
        self.model.gravity.linear = np.array(plant.gravity)
        self.data = self.model.createData()
        self.axes = ["xyz".index(axis) for axis in plant.robot.axes]
        self.n = len(plant.q)
        self.low, self.high = np.array(plant.q_min), np.array(plant.q_max)
        self.damping = np.array(plant.robot.damping)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        frame = self.plant.robot.frame_id
        pin.forwardKinematics(self.model, self.data, q)
        world = pin.LOCAL_WORLD_ALIGNED
        return pin.computeFrameJacobian(self.model, self.data, q, frame, world)[self.axes]

    def ratios(self, q: np.ndarray) -> np.ndarray:
        if self.plant.control != "task":
            return np.zeros(0)
        sigma = np.linalg.svd(self.jacobian(q), compute_uv=False)
        return sigma / sigma[0]

    def rank(self, q: np.ndarray) -> int:
        return int((self.ratios(q) > self.rcond).sum())

    def free_acceleration(self, q: np.ndarray, v: np.ndarray, rank: int) -> np.ndarray:
        """q̈ without stops."""
        M = pin.crba(self.model, self.data, q)
        M = np.triu(M) + np.triu(M, 1).T
        if self.plant.control == "effort":
            h = pin.nonLinearEffects(self.model, self.data, q, v)
            return np.linalg.solve(M, np.array(self.plant.tau_cmd) - self.damping * v - h)
        plant, frame = self.plant, self.plant.robot.frame_id
        pin.forwardKinematics(self.model, self.data, q, v, np.zeros(self.n))
        drift = pin.getFrameClassicalAcceleration(self.model, self.data, frame, pin.LOCAL_WORLD_ALIGNED).linear[
            self.axes
        ]
        J = self.jacobian(q)
        x = self.data.oMf[frame].translation[self.axes]
        wanted = np.array(plant.Kp) * (plant.x_des - x) - np.array(plant.Kd) * (J @ v) - drift
        U, sigma, Vt = np.linalg.svd(J)
        command = Vt[:rank].T @ ((U[:, :rank].T @ wanted) / sigma[:rank])
        return command - np.linalg.solve(M, self.damping * v)

    def after(self, seconds: float) -> np.ndarray:
        """(q, v) after some time."""
        y, t = np.array([*self.plant.q, *self.plant.v]), 0.0
        regime = self.regime(y, self.rank(y[: self.n]))
        for _ in range(400):
            events = self.events(regime)
            solved = solve_ivp(
                lambda _, y, regime=regime: self.rates(y, regime),
                (t, seconds),
                y,
                self.method,
                rtol=1e-10,
                atol=1e-13,
                max_step=self.max_step,
                events=list(events.values()),
            )
            t, y = solved.t[-1], solved.y[:, -1].copy()
            if t >= seconds:
                return y
            happened = [name for name, times in zip(events, solved.t_events) if times.size]
            rank = regime.rank
            for kind, i in happened:
                if kind == "limit":
                    y[i], y[self.n + i] = np.clip(y[i], self.low[i], self.high[i]), 0.0
                elif kind == "rank":
                    rank += i
            regime = self.regime(y, rank, released={i for kind, i in happened if kind == "free"})
        raise AssertionError("the oracle meets too many events")

    def regime(self, y: np.ndarray, rank: int, released: frozenset | set = frozenset()) -> Regime:
        q, v = y[: self.n], y[self.n :]
        a = self.free_acceleration(q, v, rank)
        held = set()
        for i in range(self.n):
            out = 1.0 if q[i] >= self.high[i] else -1.0
            if self.low[i] < q[i] < self.high[i] or i in released:
                continue
            if out * v[i] > 0.0:
                v[i] = 0.0  # y changes with it
            if v[i] == 0.0 and out * a[i] >= 0.0:
                held.add(i)
        return Regime(frozenset(held), rank)

    def rates(self, y: np.ndarray, regime: Regime) -> np.ndarray:
        a = self.free_acceleration(y[: self.n], y[self.n :], regime.rank)
        a[list(regime.held)] = 0.0
        return np.concatenate([y[self.n :], a])

    def events(self, regime: Regime) -> dict[tuple[str, int], Any]:
        n, found = self.n, {}  # type: int, dict[tuple[str, int], Any]
        for i in range(n):
            if i in regime.held:
                found["free", i] = lambda _, y, i=i: self.press(y, i, regime)
            else:
                found["limit", i] = lambda _, y, i=i: EDGE + min(self.high[i] - y[i], y[i] - self.low[i])
        if self.plant.control == "task":
            rcond, rank = self.rcond, regime.rank
            if rank:
                found["rank", -1] = lambda _, y: self.ratios(y[:n])[rank - 1] - rcond + EDGE
            if rank < len(self.axes):
                found["rank", 1] = lambda _, y: rcond - self.ratios(y[:n])[rank] + EDGE
        for event in found.values():
            event.terminal, event.direction = True, -1
        return found

    def press(self, y: np.ndarray, i: int, regime: Regime) -> float:
        a = self.free_acceleration(y[: self.n], y[self.n :], regime.rank)
        return (a[i] if y[i] >= self.high[i] else -a[i]) + EDGE


def both(of: Engine, plant: Plant, steps: int, h: float) -> np.ndarray:
    """(q, v) of both flavours after some communication steps."""
    values = of.values(plant)
    for _ in range(steps):
        assert of.call("advance", values, h) == 1
        plant.step(h)
    return np.array([[*of.group(values, "q"), *of.group(values, "v")], [*plant.q, *plant.v]])


CASES: dict[str, Any] = {
    # damping, changes, communication step, steps, implicit, error
    "across the fold": (
        0.0,
        {"x_des": [-0.49722099942765074, -0.31582739208468036], "Kp": [200.0] * 2, "Kd": [28.0] * 2},
        0.01,
        15,
        False,
        1e-5,
    ),
    "damping 10000": (
        10000.0,
        {
            "q_start": [-1.648928452962053, 1.1692017583875287],
            "v_start": [-0.7871927421571577, 0.5802844167243075],
            "x_des": [0.10636684709554894, 0.16612958404470635],
        },
        0.01,
        1,
        True,
        1e-9,
    ),
    "damping 300, long steps": (
        300.0,
        {
            "q_start": [0.5478467488258172, -0.8935307702805146],
            "x_des": [0.16510223091108872, 0.042654310306871945],
            "max_step": 0.1,
        },
        0.1,
        1,
        True,
        1e-9,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_no_joint_is_thrown_where_the_pseudo_inverse_jumps(case):
    damping, changes, h, steps, implicit, error = CASES[case]
    of = damped_arm(damping)
    plant = shipped(of, **changes)
    n = len(plant.q)
    expected = Oracle(plant, "Radau" if implicit else "DOP853").after(steps * h)[:n]
    found = both(of, plant, steps, h)[:, :n]
    np.testing.assert_allclose(found, [expected] * 2, atol=error)


def test_oscillation_across_the_singularity_is_not_held():
    """Ordinary gains move joint 2 across the fold every 13 µs; holding the rank would move the arm by a radian."""
    plant = shipped(
        engine("twodof"),
        q_start=[np.pi, 0.237],
        v_start=[0.0, -678.0],
        x_des=[-0.49722099942765074, -0.31582739208468036],
        Kp=[200.0] * 2,
        Kd=[28.0] * 2,
        rtol=1e-9,
        atol=1e-12,
        max_step=0.01,
    )
    expected = Oracle(plant, max_step=1e-6).after(3e-4)[:2]
    np.testing.assert_allclose(both(engine("twodof"), plant, 1, 3e-4)[:, :2], [expected] * 2, atol=1e-5)


@pytest.mark.parametrize("h", [1e-2, 1e-3, 1e-4])
def test_oscillation_across_the_singularity_gains_no_energy(h):
    """The arm cannot reach its target and flips every 14 µs; its end moves straight on, slowed down by Kd alone."""
    of = engine("twodof")
    changes = {"q_start": [-1.5335428759485492, 0.063866274443934], "v_start": [1365.2510595711951, 4591.271768668014]}
    changes |= {"x_des": [-0.4005888820673592, -0.049415464448237856], "Kp": [200.0] * 2, "Kd": [20.0] * 2}
    speeds = []
    for tolerances in ({}, {"rtol": 1e-9, "atol": 1e-12}):
        plant = shipped(of, **changes, **tolerances)
        values = of.values(plant)
        assert all(of.call("advance", values, h) == 1 for _ in range(round(STEP / h)))
        speeds.append(np.linalg.norm(Oracle(plant).jacobian(of.group(values, "q")) @ of.group(values, "v")))
    assert speeds[0] == pytest.approx(speeds[1], rel=0.05)


def test_thousands_of_flips_across_the_singularity_are_those_of_any_communication_step():
    """The target is 0.2 m out of reach; joints 1 and 2 flip 6,000 times in the step of 10 ms that begins at 60 ms."""
    of, found = engine("twodof"), []
    changes = {"x_des": [-0.42349075823212745, -0.26782836995624004], "Kp": [1000.0] * 2, "Kd": [32.0] * 2}
    for h, tolerances in ((1e-2, {}), (1e-2, {"rtol": 1e-11, "atol": 1e-14}), (1e-3, {"rtol": 1e-11, "atol": 1e-14})):
        values = of.values(shipped(of, **changes, **tolerances))
        assert all(of.call("advance", values, h) == 1 for _ in range(round(0.07 / h)))
        found.append(of.group(values, "q"))
    np.testing.assert_allclose(found[2], found[1], atol=1e-5)


@pytest.mark.parametrize("steps", [1, 2, 12])
def test_gains_that_whip_the_arm_within_nanoseconds_are_right_or_refused_at_every_communication_step(steps):
    """A change of the start by 1e-12 rad changes the end by 4e-10 rad: the motion is determined."""
    x_des, of, found = [-0.44590624212903474, -0.13071369390558008], engine("twodof"), []
    for rtol, parts in ((1e-10, 12), (1e-8, steps)):
        plant = shipped(of, x_des=x_des, Kp=[1e8] * 2, Kd=[1e4] * 2, rtol=rtol, atol=1e-3 * rtol)
        values = of.values(plant)
        if not all(of.call("advance", values, 2.4e-4 / parts) == 1 for _ in range(parts)):
            assert of.failure()[0] == MANY_EVALUATIONS and parts < 12
            return
        found.append(of.group(values, "q"))
    np.testing.assert_allclose(found[1], found[0], atol=2e-4)


@pytest.mark.parametrize("gains", [(1e18, 1e9), (1e20, 1e10)])
def test_gains_beyond_the_budget_are_refused(gains):
    of = engine("twodof")
    plant = shipped(of, x_des=[-0.3739811484848894, -0.08483538711664651], Kp=[gains[0]] * 2, Kd=[gains[1]] * 2)
    assert of.call("advance", of.values(plant), 1e-3) == 0
    assert of.failure()[0] == MANY_EVALUATIONS


GAINS = [(50.0, 40.0), (50.0, 10.0), (200.0, 20.0), (1000.0, 60.0), (1.0, 1.0), (5000.0, 200.0), (5000.0, 71.0)]
"""Kd ≥ √Kp."""


def at_the_singularity(rng: np.random.Generator) -> dict[str, list[float]]:
    """A stretched or folded arm, with joint 2 at the jump of J⁺ or some angle away from it."""
    Kp, Kd = GAINS[rng.integers(len(GAINS))]
    q = [rng.uniform(-3.0, 3.0), rng.choice([0.0, 0.0, 3.1]) + rng.uniform(-0.1, 0.1)]
    return {
        "q_start": np.clip(q, -np.pi, np.pi).tolist(),
        "v_start": rng.uniform(-8.0, 8.0, 2).tolist(),
        "x_des": rng.uniform(-0.5, 0.5, 2).tolist(),
        "Kp": [Kp] * 2,
        "Kd": [Kd] * 2,
    }


@pytest.mark.long
def test_short_steps_at_the_singularity_are_those_of_the_oracle(length):
    """Each takes a millisecond: over longer times the motion is chaotic."""
    rng, of, crossed = np.random.default_rng(5), engine("twodof"), 0
    for _ in range(length(600, 40)):
        plant = shipped(of, **at_the_singularity(rng), rtol=1e-9, atol=1e-12)
        oracle, n = Oracle(plant, max_step=1e-5), len(plant.q)
        values, before = of.values(plant), oracle.rank(np.array(plant.q))
        expected = oracle.after(1e-3)
        assert of.call("advance", values, 1e-3) == 1
        found = np.array([*of.group(values, "q"), *of.group(values, "v")])
        crossed += oracle.rank(expected[:n]) != before
        scale = max(1.0, np.abs(expected[n:]).max())
        np.testing.assert_allclose(found, expected, atol=1e-6 * scale, err_msg=repr(vars(plant)))
    assert crossed >= length(60, 4)


@pytest.mark.long
@pytest.mark.parametrize("gains", [(50.0, 10.0), (200.0, 20.0), (5000.0, 71.0)])
def test_motions_across_the_singularity_do_not_depend_on_the_communication_step(gains, length):
    """Joints oscillate, and hit their limits, within microseconds: none may be held there."""
    rng, of, whips = np.random.default_rng(2), engine("twodof"), 0
    plant = shipped(of, Kp=[gains[0]] * 2, Kd=[gains[1]] * 2)
    start, target = of.values(plant), [of.model.index("x_des") + k for k in (0, 1)]
    tolerances = [of.model.index(name) for name in ("rtol", "atol")]
    while whips < length(40, 12):
        values = start.copy()
        values[target] = rng.uniform(-0.5, 0.5, 2)
        for _ in range(60):
            long = values.copy()
            assert of.call("advance", values, STEP) == 1
            if np.abs(of.group(values, "q") - of.group(long, "q")).max() > 1.0:
                whips += 1
                long[tolerances] = 1e-9, 1e-12
                short = long.copy()
                assert of.call("advance", long, 2e-3) == 1
                assert all(of.call("advance", short, 1e-6) for _ in range(2000))
                np.testing.assert_allclose(of.group(long, "q"), of.group(short, "q"), atol=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("gains", GAINS)
def test_no_step_to_any_target_is_refused(gains, length):
    rng, of = np.random.default_rng(6), engine("twodof")
    plant = shipped(of, Kp=[gains[0]] * 2, Kd=[gains[1]] * 2)
    start, target = of.values(plant), [of.model.reference(f"x_des[{k}]") for k in (1, 2)]
    for _ in range(length(600, 30)):
        values = start.copy()
        values[target] = rng.uniform(-0.5, 0.5, 2)
        for _ in range(300):
            assert of.call("advance", values, STEP) == 1
            assert (np.abs(of.group(values, "q")) <= np.pi).all()


@pytest.mark.long
def test_falls_between_narrow_stops_miss_none(length):
    """The joints of the bare arm are stopped and released at both ends, also within one step."""
    rng, of = np.random.default_rng(7), engine("twodof", "effort")
    stopped = 0
    for _ in range(length(300, 20)):
        width = np.exp(rng.uniform(np.log(0.003), np.log(0.6), 2))
        middle = rng.uniform(-1.0, 1.0, 2)
        plant = shipped(
            of,
            q_min=(middle - width).tolist(),
            q_max=(middle + width).tolist(),
            q_start=(middle + width * rng.uniform(-1.0, 1.0, 2)).tolist(),
            v_start=rng.uniform(-3.0, 3.0, 2).tolist(),
            rigid_stops=False,
            rtol=1e-8,
            atol=1e-11,
        )
        expected = Oracle(plant).after(0.4)
        stopped += (expected[2:] == 0.0).any()
        for max_step in (0.001, 0.01, 0.05):
            plant.max_step = max_step
            values = of.values(plant)
            for _ in range(8):
                assert of.call("advance", values, 0.05) == 1
            found = np.array([*of.group(values, "q"), *of.group(values, "v")])
            np.testing.assert_allclose(found, expected, atol=1e-5)
    assert stopped >= length(100, 8)


@pytest.mark.parametrize("max_step", [0.001, 0.01, 0.05])
def test_a_limit_that_is_touched_between_two_ends_of_a_step_stops_the_joint(max_step):
    """Joint 1 would pass its limit early in the step and return; joint 2 passes its limit at the end."""
    rng, of = np.random.default_rng(8), engine("twodof", "effort")
    for _ in range(8):
        start = {"q_start": rng.uniform(-1.0, 1.0, 2).tolist()}
        a = Oracle(shipped(of, **start)).free_acceleration(np.array(start["q_start"]), np.zeros(2), 0)
        start["v_start"] = [-a[0] * max_step * rng.uniform(0.1, 0.4), 0.02 / max_step]
        q = [Oracle(shipped(of, **start)).after(part * max_step)[:2] for part in np.arange(20) / 20]
        first, second = np.transpose(q)
        low, high = [-3.0, -3.0], [3.0, float(second[19])]
        turn = (first.max if a[0] < 0.0 else first.min)()
        (low if a[0] > 0.0 else high)[0] = float(first[0] + rng.uniform(0.1, 0.9) * (turn - first[0]))
        plant = shipped(of, **start, q_min=low, q_max=high, rigid_stops=False, max_step=max_step)
        expected = Oracle(plant, max_step=max_step / 50).after(max_step)
        np.testing.assert_allclose(both(of, plant, 1, max_step), [expected] * 2, atol=1e-4, rtol=1e-4)


ROTOR = """
<robot name="rotor">
  <link name="world"/>
  <joint name="slide" type="prismatic"><parent link="world"/><child link="carriage"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="1" effort="0" velocity="0"/></joint>
  <link name="carriage"><inertial><mass value="0.009"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="continuous"><parent link="carriage"/><child link="disc"/><axis xyz="0 0 1"/></joint>
  <link name="disc"><inertial><origin xyz="0.1 0 0"/><mass value="0.001"/>
    <inertia ixx="10" iyy="10" izz="10" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""
"""A carriage of 10 g that a rotating imbalance of 1e-4 kg·m moves; a disc so heavy that its speed stays constant."""


@pytest.mark.parametrize("rigid", [True, False])
def test_a_release_that_ends_between_two_looks_at_the_effort_is_found_by_both_flavours(rigid):
    """The imbalance pulls the carriage off its stop for 80 mrad, once within a step: q̈ = k (cos θ − cos θ*)."""
    width, speed, k = 0.04, 100.0, 100.0
    h = (0.875 + 2.0 * width) / speed
    of = Engine(from_urdf(ROTOR, "disc", "xy", "effort"))
    plant = of.model.plant()
    plant.q_start, plant.v_start, plant.tau_cmd = [0.0, -0.875], [0.0, speed], [-0.01 * k * np.cos(width), 0.0]
    plant.atol, plant.max_step, plant.rigid_stops = 1e-3, h, rigid
    plant.initialise()
    turned, end = 3.0 * width, 2.0 * width  # since the release, and θ at the end
    v = np.sin(end) + np.sin(width) - np.cos(width) * turned
    q = np.cos(width) - np.cos(end) + np.sin(width) * turned - np.cos(width) * turned**2 / 2.0
    found = both(of, plant, 1, h)
    np.testing.assert_allclose(found[:, 0], k / speed**2 * q, rtol=1e-4)
    np.testing.assert_allclose(found[:, 2], k / speed * v, atol=1e-4 * k / speed * width**3)


@pytest.mark.parametrize("friction", [True, False])
@pytest.mark.parametrize("name", ["tiago", "tiago_dual"])
def test_many_joints_at_stops_need_few_evaluations(name, friction, monkeypatch):
    """Bare robots with hands fall onto rigid stops; a step needs at least 60 evaluations."""
    monkeypatch.setattr(regime, "BUDGET", 390)
    plant = bare(name, friction)
    for _ in range(30):
        plant.step(STEP)


def bare(name: str, friction: bool) -> Plant:
    plant = model(f"tiago_description/robots/{name}.urdf", "effort").plant()
    limits = list(zip(plant.q_min, plant.q_max))
    plant.q_start = [0.0 if low <= 0.0 <= high else 0.5 * (low + high) for low, high in limits]
    plant.friction = plant.friction if friction else [0.0] * len(limits)
    plant.initialise()
    return plant


@pytest.mark.parametrize("friction", [True, False])
def test_many_joints_at_stops_err_by_less_than_the_tolerance(friction):
    """A joint that leaves its stop is not stopped by the error of the dense output, 1e-7 rad in the first case."""
    plant, exact = bare("tiago_dual", friction), bare("tiago_dual", friction)
    exact.rtol, exact.atol, exact.max_step = 1e-7, 1e-10, 2e-4
    plant.step(STEP)
    exact.step(STEP)
    np.testing.assert_allclose(plant.q, exact.q, rtol=0.0, atol=6e-8)


def test_a_stop_is_released_where_its_effort_is_a_rounding_error(tmp_path: Path) -> None:
    """A saturated motor releases joint2 at 0.52 s, where the reaction of the stop is a difference of large efforts."""
    fmu = twodof.build_fmu(tmp_path / "arm.fmu", twodof.FmuOptions(native=True, control="joint"))
    settings = {"q_des": (0.9, 0.8), "q_max": (3.0, 0.78), "limit_effort": True, "payload": 6.0, "payload_known": True}
    runs = [
        [sample.q for sample in twodof.samples(fmu, step=h, stop_time=1.0, settings=settings)][:: round(0.02 / h)]
        for h in (0.001, 0.01, 0.02)
    ]
    assert min(q[1] for q in runs[0]) < 0.7 and max(q[1] for q in runs[0]) == 0.78
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-12)
    np.testing.assert_allclose(runs[2], runs[0], atol=1e-12)
