"""Joint friction in both flavours: closed forms, an event-driven oracle, MuJoCo, energy, and extremes."""

from __future__ import annotations

import functools

import numpy as np
import pinocchio as pin
import pytest
from friction_oracle import Rubbing
from native_models import Engine, Model, from_urdf

TIGHT = {"rtol": 1e-10, "atol": 1e-12}
SLIDER = """<robot name="slider"><link name="base"/><link name="body"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="body"/><axis xyz="1 0 0"/>
<limit lower="-5" upper="5" effort="0" velocity="0"/><dynamics friction="1.3"/></joint></robot>"""
MASS, FRICTION, KP, START = 2.0, 1.3, 40.0, 0.37


def chain(rng, n):
    """The URDF of a random chain of joints that turn and slide."""
    text = ['<robot name="chain"><link name="link0"/>']
    for i in range(1, n + 1):
        x = rng.normal(0, 1, (3, 3))
        inertia = 0.02 * (x @ x.T + 3 * np.eye(3))
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
    """q and v after each of so many steps, by one flavour."""
    if python:
        for _ in range(count):
            plant.step(h)
            yield np.array(plant.q), np.array(plant.v)
        return
    values = native.values(plant)
    for _ in range(count):
        assert native.call("advance", values, h) == 1, native.failure()
        yield native.group(values, "q").copy(), native.group(values, "v").copy()


def sticks(plant):
    """Whether each joint of a plant rests by its friction."""
    stops, y = plant.stops(), [*plant.q, *plant.v]
    equations, slip = plant.equations_of_motion(), stops.slide(plant.v)
    a = list(equations.acceleration(np.array(plant.q), np.array(plant.v), None, slip)[0])
    stops.hold(y, a, [False] * len(plant.q))
    return [rest == 1 for rest in stops.rest]


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
@pytest.mark.parametrize("h", [1e-3, 7e-3, 5e-2])
def test_a_coulomb_oscillator_turns_where_and_when_its_closed_form_does(h, python):
    native = slider("joint")
    plant = native.model.plant()
    assert plant.friction == [FRICTION]
    changes = {"gravity": [0.0] * 3, "q": [START], "v": [0.0], "Kp": [KP], "Kd": [0.0], "q_des": [0.0], **TIGHT}
    for name, value in changes.items():
        setattr(plant, name, value)
    plant.prepare()
    turns, end = np.pi / np.sqrt(KP), 6.0 if h > 1e-3 or not python else 1.2
    signs, last = [], 0.0
    for k, (q, v) in enumerate(states(native, plant, h, round(end / h), python=python), start=1):
        assert (*q, *v) == pytest.approx(oscillation(k * h), abs=1e-9)
        if v[0] and np.sign(v[0]) != last:
            last = np.sign(v[0])
            signs.append(k * h)
    assert all(abs(t - i * turns) <= h + 1e-12 for i, t in enumerate(signs))
    if end == 6.0:
        assert v[0] == 0.0 and len(signs) == 11  # and it stays exactly where it is


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
