"""Joint friction in both flavours: closed forms, an event-driven oracle, MuJoCo, energy, and extremes."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from friction_oracle import Rubbing
from native_models import Engine, Model, Reduced, engine, from_urdf, model, robots_folder, urdf_path

from twodof.export import native as header
from twodof.plant import regime
from twodof.plant.plant import DiscardError

MANY_EVALUATIONS = 3
TIGHT = {"rtol": 1e-10, "atol": 1e-12}
SLIDER = """<robot name="slider"><link name="base"/><link name="body"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="body"/><axis xyz="1 0 0"/>
<limit lower="-5" upper="5" effort="0" velocity="0"/><dynamics friction="1.3"/></joint></robot>"""
MASS, FRICTION, KP, START = 2.0, 1.3, 40.0, 0.37


def chain(rng, n):
    """The URDF of a random chain of revolute and prismatic joints."""
    text = ['<robot name="chain"><link name="link0"/>']
    for i in range(1, n + 1):
        x = rng.normal(0, 1, (3, 3))
        second = 0.01 * (x @ x.T + np.eye(3))  # moments of the mass, of which the inertia consists
        inertia = np.trace(second) * np.eye(3) - second
        keys = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        tensor = " ".join(f'{key}="{inertia[place]!r}"' for key, place in keys.items())
        text.append(
            f'<link name="link{i}"><inertial><origin xyz="{_xyz(rng.normal(0, 0.1, 3))}"/>'
            f'<mass value="{rng.uniform(0.3, 2)!r}"/><inertia {tensor}/></inertial></link>'
            f'<joint name="joint{i}" type="{rng.choice(["revolute", "revolute", "prismatic"])}">'
            f'<parent link="link{i - 1}"/><child link="link{i}"/><axis xyz="{_xyz(rng.normal(0, 1, 3))}"/>'
            f'<origin xyz="{_xyz(rng.normal(0, 0.2, 3))}" rpy="{_xyz(rng.normal(0, 1, 3))}"/>'
            '<limit lower="-9" upper="9" effort="0" velocity="0"/></joint>'
        )
    return "".join([*text, "</robot>"]).replace("np.float64(", "").replace(")", "")


def _xyz(values):
    return " ".join(map(repr, np.asarray(values).tolist()))


@functools.cache
def slider(control: str) -> Engine:
    return Engine(from_urdf(SLIDER, "body", "x", control))


def states(native: Engine, plant, h: float, count: int, *, python: bool):
    """q and v after each of some steps, by one flavour."""
    if python:
        for _ in range(count):
            plant.step(h)
            yield np.array(plant.q), np.array(plant.v)
        return
    values = native.values(plant)
    for _ in range(count):
        assert native.call("advance", values, h) == 1, native.failure()
        yield native.group(values, "q").copy(), native.group(values, "v").copy()


# --- the Coulomb oscillator ---


def oscillation(t):
    """Position and velocity from rest at START: half periods about ∓F/(m Kp), until the joint sticks for good."""
    omega, offset, x = np.sqrt(KP), FRICTION / (MASS * KP), START
    for half in range(1000):
        if abs(x) <= offset:
            return x, 0.0
        centre, passed = np.sign(x) * offset, t - half * np.pi / omega
        if passed <= np.pi / omega:
            return (centre + (x - centre) * np.cos(omega * passed), -(x - centre) * omega * np.sin(omega * passed))
        x = -(x - 2 * centre)
    raise AssertionError


@pytest.mark.parametrize("python", [False, True])
@pytest.mark.parametrize("h", [1e-3, 7e-3, 2e-2, 5e-2])
def test_a_coulomb_oscillator_turns_where_and_when_its_closed_form_does(h, python):
    """Turn k is at kπ/ω and ±(x₀ − 2kF/(m Kp)); the last one is within ±F/(m Kp), where the joint stays."""
    native = slider("joint")
    plant = native.model.plant()
    assert plant.friction == [FRICTION]
    changes = {"gravity": [0.0] * 3, "Kp": [KP], "Kd": [0.0], "q_des": [0.0], **TIGHT}
    for name, value in changes.items():
        setattr(plant, name, value)
    plant.prepare()

    def after(state, passed):
        plant.q, plant.v = map(list, state)
        return next(states(native, plant, passed, 1, python=python))

    turns = np.arange(1, 12) * np.pi / np.sqrt(KP)
    places = [(-1) ** k * (START - 2 * k * FRICTION / (MASS * KP)) for k in range(1, 12)]
    assert abs(places[-1]) < FRICTION / (MASS * KP) < abs(places[-2])
    state, end, passed = ([START], [0.0]), 6.0 if h > 1e-3 or not python else 1.2, 0
    for k in range(round(end / h)):
        while passed < len(turns) and turns[passed] < (k + 1) * h:
            for late in (-1e-9, 1e-9):
                q, v = after(state, turns[passed] - k * h + late)
                assert q[0] == pytest.approx(places[passed], abs=1e-9)
                stays = late > 0.0 and passed == len(turns) - 1
                assert np.sign(v[0]) == (0.0 if stays else (-1) ** (passed + (late < 0.0)))
            passed += 1
        state = after(state, h)
        assert np.ravel(state) == pytest.approx(oscillation((k + 1) * h), abs=1e-9)
    assert passed == (len(turns) if end == 6.0 else 2)
    if end == 6.0:
        assert np.ravel(state) == pytest.approx([places[-1], 0.0], abs=1e-9)
        assert (np.ravel(after(state, h)) == np.ravel(state)).all() and state[1][0] == 0.0


# --- against the oracle ---


def rubbing(plant, urdf):
    """The oracle of a plant, with Pinocchio's own model of the URDF."""
    reference = pin.buildModelFromXML(urdf)
    reference.gravity.linear = np.array(plant.gravity)

    def effort(q, v, M, h):
        external = np.array(plant.tau_ext)
        if plant.control == "effort":
            return external + plant.tau_cmd
        wanted = np.array(plant.a_des) + np.multiply(plant.Kp, np.subtract(plant.q_des, q))
        return external + M @ (wanted + np.multiply(plant.Kd, np.subtract(plant.v_des, v))) + h

    parts = map(np.array, (plant.friction, plant.damping, plant.armature, plant.q_min, plant.q_max))
    return Rubbing(reference, effort, *parts)


def random_case(seed):
    """A random robot with friction, stops and loads, and its plant."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 8))
    urdf = chain(rng, n)
    plant = from_urdf(urdf, f"link{n}", "xyz", control := rng.choice(["joint", "effort"]).item()).plant()
    plant.q, span = rng.normal(0, 0.5, n).tolist(), rng.uniform(0.02, 0.5, (2, n))
    span[:, rng.random(n) < 0.6] = 5.0
    plant.q_min, plant.q_max = (plant.q - span[0]).tolist(), (plant.q + span[1]).tolist()
    plant.v = (rng.normal(0, 1, n) * (rng.random(n) < 0.6)).tolist()
    at = rng.random(n) < 0.2
    plant.q = np.where(at, plant.q_max, plant.q).tolist()
    plant.v = np.where(at, -np.abs(plant.v), plant.v).tolist()
    plant.friction = (rng.uniform(0.2, 4, n) * (rng.random(n) < 0.8)).tolist()
    plant.damping = (rng.uniform(0, 1, n) * (rng.random(n) < 0.5)).tolist()
    plant.armature = (rng.uniform(0, 0.5, n) * (rng.random(n) < 0.5)).tolist()
    plant.gravity, plant.tau_ext = rng.normal(0, 4, 3).tolist(), rng.normal(0, 1, n).tolist()
    if control == "joint":
        plant.q_des, plant.Kp = rng.normal(0, 0.5, n).tolist(), rng.uniform(0, 200, n).tolist()
        plant.Kd = (rng.uniform(0, 20, n) * (rng.random(n) < 0.7)).tolist()
    else:
        plant.tau_cmd = rng.normal(0, 4, n).tolist()
    plant.rtol, plant.atol = TIGHT["rtol"], TIGHT["atol"]
    # it bounds the error of the anti-chatter where impacts repeat without end: seed 134
    plant.max_step = 1e-3 if seed < 6 else 1e-4
    plant.prepare()
    return urdf, plant


def test_sticking_slipping_and_stopping_together_is_the_oracles(length):
    worst, kinds = 0.0, set()
    for seed in range(length(200, 6)):
        urdf, plant = random_case(seed)
        times = np.linspace(0.0, 0.5, 51)
        rows, modes = rubbing(plant, urdf).run(plant.q, plant.v, times)
        native = Engine(Model(plant.robot, plant._table, {}, plant.control))
        at_start = list(plant.q), list(plant.v)
        for python in (False, True):
            plant.q, plant.v = map(list, at_start)
            got = [np.r_[q, v] for q, v in states(native, plant, 0.01, 50, python=python)]
            off = np.abs(np.array(got) - rows).max() / max(1.0, np.abs(rows).max())
            assert off <= 1e-7, (seed, python, off)
            worst = max(worst, off)
        for _, mode in modes:
            kinds |= {(bool((mode == 0).any()), bool((mode != 0).any()))}
    assert {(True, True), (False, True)} <= kinds


# --- energy, MuJoCo, extremes ---


@pytest.mark.parametrize("name", ["twodof", "ur5", "panda"])
def test_energy_never_grows(name, length):
    native, rng = engine(name, "effort"), np.random.default_rng(8)
    plant = model(name, "effort").plant()
    reference = plant.robot.model.copy()
    reference.gravity.linear = np.array(plant.gravity)
    reduced, stuck = Reduced(reference, name), 0
    plant.rtol, plant.atol = 1e-10, 1e-12
    for case in range(500):
        q = rng.uniform(-1, 1, native.n)
        plant.q_min, plant.q_max = (q - 0.4).tolist(), (q + 0.4).tolist()
        plant.q, plant.v = q.tolist(), rng.normal(0, 2, native.n).tolist()
        plant.friction = (rng.uniform(0, 40, native.n) * (rng.random(native.n) < 0.7)).tolist()
        if case >= length(500, 15) and case != 273:  # a Panda's joint stops by an impact of another, and never moves
            continue
        before = reduced.energy(q, np.array(plant.v))
        for q, v in states(native, plant, 0.01, 60, python=False):
            energy = reduced.energy(q, v)
            assert energy <= before + 1e-9 * max(1.0, abs(before))
            before = energy
            stuck += bool(((v == 0.0) & (plant.q_min < q) & (q < plant.q_max)).any())
    assert stuck


@pytest.mark.parametrize("seed", range(3))
def test_mujoco_agrees_when_each_joint_sticks(seed):
    """Steps are 0.1 ms; MuJoCo's friction is soft, so a slow joint counts as sticking."""
    rng = np.random.default_rng(seed)
    n, urdf = 3, chain(rng, 3)
    plant = from_urdf(urdf, "link3", "xyz", "effort").plant()
    plant.gravity, plant.q, plant.v = [0.0] * 3, [0.0] * n, rng.uniform(-1, 1, n).tolist()
    plant.friction, plant.armature = rng.uniform(1, 4, n).tolist(), [0.1] * n
    plant.prepare()
    theirs = mujoco.MjModel.from_xml_string(urdf)
    theirs.opt.timestep, theirs.opt.gravity[:] = 1e-4, 0.0
    theirs.dof_frictionloss[:], theirs.dof_armature[:] = plant.friction, plant.armature
    theirs.dof_solref[:, 0] = 1e-3
    data, when = mujoco.MjData(theirs), np.full((2, n), np.inf)
    data.qvel[:] = plant.v
    for k in range(10_000):
        mujoco.mj_step(theirs, data)
        when[0] = np.where(np.abs(data.qvel) < 2e-3, np.minimum(when[0], k * 1e-4), np.inf)
    for k in range(1000):
        plant.step(1e-3)
        when[1] = np.where(np.array(plant.v) == 0.0, np.minimum(when[1], k * 1e-3), np.inf)
    assert np.isfinite(when).all() and np.abs(when[0] - when[1]).max() <= 1e-2
    assert np.abs(data.qpos - plant.q).max() <= 1e-2


@pytest.mark.parametrize("friction", [1e-300, 1e-12, 1e12, 1e300])
@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize("control", ["effort", "joint"])
def test_friction_of_any_size_is_right(friction, speed, control):
    native, ends = engine("ur5", control), []
    for python in (False, True):
        plant = model("ur5", control).plant()
        plant.friction, plant.v = [friction] * 6, [speed] * 6
        if control == "joint":
            plant.Kp = plant.Kd = [0.0] * 6
        q, v = list(states(native, plant, 0.01, 5, python=python))[-1]
        ends.append(np.r_[q, v])
        if friction > 1.0:
            assert not v.any() and np.abs(q - model("ur5", control).plant().q).max() <= 1e-9
    if friction < 1.0:  # as without
        plant = model("ur5", control).plant()
        plant.v, plant.Kp, plant.Kd = [speed] * 6, [0.0] * 6, [0.0] * 6
        ends.append(np.concatenate(list(states(native, plant, 0.01, 5, python=False))[-1]))
    assert all(np.abs(end - ends[0]).max() <= 1e-9 for end in ends)


def test_a_robot_that_sticks_stays_bit_for_bit_and_costs_nothing(monkeypatch):
    plant = model("ur5", "joint").plant()
    plant.friction, plant.q_des = [1e3] * 6, [1.0] * 6
    start, calls = list(plant.q), []
    equations = plant.equations_of_motion()

    def counted(*state):
        calls.append(state)
        return equations.acceleration(*state)

    monkeypatch.setattr(plant, "equations_of_motion", lambda: replace(equations, acceleration=counted))
    for _ in range(10):
        plant.step(0.01)
    assert (plant.q, plant.v, len(calls)) == (start, [0.0] * 6, 10)


@pytest.mark.parametrize("python", [False, True])
def test_short_steps_count_in_the_budget(python, monkeypatch):
    """Friction stops the joint after 20 µs, to which a short step leads."""
    monkeypatch.setattr(regime, "BUDGET", 1)
    monkeypatch.setattr(header, "BUDGET", 1)
    of = Engine(from_urdf(SLIDER, "body", "x", "effort"))
    plant = of.model.plant()
    plant.gravity, plant.v_start, plant.friction = [0.0] * 3, [1e-3], [50.0 * MASS]
    plant.initialise()
    if python:
        with pytest.raises(DiscardError, match="evaluations"):
            plant.step(1e-4)
    else:
        assert of.call("advance", of.values(plant), 1e-4) == 0
        assert of.failure()[0] == MANY_EVALUATIONS


@pytest.mark.parametrize("rigid", [False, True])
def test_friction_and_stops_do_not_depend_on_the_communication_step(rigid):
    runs = []
    for parts in (1, 2, 5, 10):
        native, plant = engine("twodof", "joint"), model("twodof", "joint").plant()
        changes: dict[str, Any] = {
            "q_min": [0.2, -0.4],
            "q_max": [0.9, 0.5],
            "q_des": [1.5, -1.0],
            "Kp": [90.0, 70.0],
            "Kd": [1.0, 0.0],
        }
        changes |= {"friction": [0.05, 0.02], "rtol": 1e-10, "atol": 1e-12, "rigid_stops": rigid, "tau_ext": [0.0, 0.1]}
        for name, value in changes.items():
            setattr(plant, name, value)
        rows = list(states(native, plant, 0.01 / parts, 200 * parts, python=False))
        runs.append(np.array([np.r_[q, v] for q, v in rows[parts - 1 :: parts]]))
    for other in runs[1:]:
        np.testing.assert_allclose(other, runs[0], rtol=0.0, atol=1e-7)


def test_rigid_stops_at_default_tolerances_do_not_depend_on_the_communication_step(length):
    """Impacts drive joints off their stops, to which some return within microseconds and leave again.

    In the last motion, a hold of all joints at limits follows one that bounds it.
    """
    urdf = chain(np.random.default_rng(2), 4)
    for control in ("joint", "effort"):
        native = Engine(from_urdf(urdf, "link4", "xyz", control))
        for seed in sorted({*range(length(3000, 300)), 345}):
            plant, ends = thrown(native.model, np.random.default_rng(seed)), []
            for h in (1e-3, 5e-2):
                *_, (q, _) = states(native, plant, h, round(0.1 / h), python=False)
                ends.append(q)
            assert np.abs(ends[0] - ends[1]).max() <= 1e-4, (control, seed)


def thrown(of: Model, rng) -> Any:
    """A plant that moves between near limits, of which it touches some."""
    plant: Any = of.plant()
    n, plant.rigid_stops = 4, True
    plant.q, span = rng.normal(0, 0.5, n), 10 ** rng.uniform(-3, 0, (2, n))
    plant.q_min, plant.q_max = plant.q - span[0], plant.q + span[1]
    plant.q = np.where(rng.random(n) < 0.3, plant.q_max, plant.q)
    plant.v = rng.normal(0, 1, n) * 10 ** rng.uniform(-2, 1.3) * (rng.random(n) < 0.7)
    plant.friction = 10 ** rng.uniform(-4, 1, n) * (rng.random(n) < rng.choice([0.0, 0.8]))
    plant.armature = 10 ** rng.uniform(-5, -0.5, n) * (rng.random(n) < 0.5)
    plant.gravity = rng.normal(0, 6, 3)
    if of.control == "joint":
        plant.q_des, plant.Kp = rng.normal(0, 1, n), 10 ** rng.uniform(0, 4, n)
        plant.Kd = 2 * np.sqrt(plant.Kp) * rng.uniform(0, 1, n)
    else:
        plant.tau_cmd = rng.normal(0, 4, n)
    return plant


LIGHT = """<robot name="light"><link name="base"/><link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="wheel"><inertial>
<mass value="1e-3"/><inertia ixx="1e-7" iyy="1e-7" izz="1e-7" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="0.5" effort="0" velocity="0"/></joint>
<joint name="axle" type="revolute"><parent link="arm"/><child link="wheel"/><origin xyz="1 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="0" velocity="0"/></joint></robot>"""


@pytest.mark.parametrize("python", [False, True])
@pytest.mark.parametrize("friction", [0.03, 0.3, 3.0])
@pytest.mark.parametrize("max_step", [1e-3, 1e-2])
def test_a_light_joint_that_an_impact_throws_rolls_to_its_rest(max_step, friction, python):
    """A wheel goes on at the arm's velocity v when the arm hits its stop, and turns by I v²/(2F)."""
    native = Engine(from_urdf(LIGHT, "wheel", "xyz", "effort"))
    plant = native.model.plant()
    plant.gravity, plant.rigid_stops, plant.max_step = [0.0] * 3, True, max_step
    plant.q, plant.v, plant.friction = [0.45, 0.0], [20.0, 0.0], [0.0, friction]
    *_, (q, v) = states(native, plant, 0.01, 2, python=python)
    np.testing.assert_allclose(q, [0.5, 1e-7 * 20.0**2 / (2 * friction)], rtol=1e-9)
    assert not v.any()


@pytest.mark.parametrize("python", [False, True])
@pytest.mark.parametrize("friction", [0.005, 0.2, 5.0])
def test_a_clamped_joint_without_a_range_falls_against_its_friction(friction, python):
    """By Pinocchio: the other joint accelerates as if this one slipped against its friction or, if it can, rested."""
    native, text = engine("twodof", "effort"), urdf_path("twodof").read_text("utf-8")
    plant = native.model.plant()
    plant.gravity, plant.friction, plant.rigid_stops = [0.0, -9.81, 0.0], [0.0, friction], False
    plant.q, plant.v, plant.tau_cmd = [0.5, 0.35], [0.0, 0.0], [0.0, 0.0]
    plant.q_min[1] = plant.q_max[1] = 0.35
    plant.prepare()
    reference = pin.buildModelFromXML(text)
    reference.gravity.linear = np.array(plant.gravity)
    data, q = reference.createData(), np.array(plant.q)
    M, h = pin.crba(reference, data, q), pin.computeGeneralizedGravity(reference, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    held = -h[0] / M[0, 0]
    holding = M[1, 0] * held + h[1]
    falling = np.linalg.solve(M, -h + [0.0, np.sign(holding) * friction])[0]
    expected = held if abs(holding) <= friction else falling
    h = 1e-4
    ((_, v),) = states(native, plant, h, 1, python=python)
    assert v[0] == pytest.approx(expected * h, rel=1e-4) and v[1] == 0.0


@pytest.mark.parametrize("python", [False, True])
def test_a_clamped_joint_without_a_range_moves_others_as_one_with_the_smallest_range(python):
    """Its friction holds it at times, and it slips in both directions."""
    ends = []
    for top in (0.35, 0.35 + 1e-9):
        native = engine("twodof", "effort")
        plant = native.model.plant()
        plant.gravity, plant.friction, plant.rigid_stops = [0.0, -9.81, 0.0], [0.0, 0.05], False
        plant.q, plant.q_min[1], plant.q_max[1], plant.tau_cmd = [0.5, 0.35], 0.35, top, [0.0, 0.0]
        plant.v, plant.rtol, plant.atol = [0.0, 0.0], 1e-10, 1e-12
        plant.prepare()
        ends.append([q[0] for q, _ in states(native, plant, 0.01, 60, python=python)])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


def test_stock_robots_with_friction_run_in_both_flavours(length):
    """They build without a warning of friction, and all move 0.05 m away against it for a second."""
    rough = [
        str(path.relative_to(robots_folder()))
        for path in sorted(robots_folder().rglob("*.urdf"))
        if re.search(r'friction="0*\.?0*[1-9]', path.read_text("utf-8", "ignore"))
    ]
    assert len(rough) >= 18
    moved = set()
    for name in rough[:: length(1, 4)]:
        of, ends = model(name), []
        assert any(of.robot.friction) and not any("friction" in warning for warning in of.robot.warnings)
        for python in (True, False):
            plant = of.plant()
            plant.x_des = [x + 0.05 for x in plant.x]
            *_, end = states(engine(name), plant, 0.01, 100, python=python)
            ends.append(np.concatenate(end))
        np.testing.assert_allclose(ends[0], ends[1], rtol=1e-9, atol=1e-9)
        moved |= {name} if np.abs(ends[0] - np.concatenate([plant.q_start, plant.v_start])).max() > 1e-3 else set()
    assert len(moved) > len(rough[:: length(1, 4)]) // 2
