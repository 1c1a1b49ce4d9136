"""Motions that are too fast for an explicit integrator: right or refused, never silently wrong.

The oracle is SciPy's implicit Radau on separately written equations of motion.
"""

from __future__ import annotations

import functools
import re
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from native_models import Engine, damped_arm, engine, from_urdf, robots_folder, shipped
from scipy.integrate import solve_ivp

from twodof.plant.plant import DiscardError, Plant

STEP = 0.01
TIGHT, DEFAULT = (1e-9, 1e-12), (1e-3, 1e-6)
WITHIN = {TIGHT: 1e-6, DEFAULT: 1e-3}  # rad
NOT_FINITE, MANY_STEPS, SHORT_PERIOD, MANY_EVALUATIONS, SMALL_STEPS = range(5)


def radau(plant: Plant, seconds: float) -> np.ndarray:
    """q after some time, by an implicit method."""
    robot = plant.robot
    model, n = robot.model.copy(), len(robot.joints)
    model.gravity.linear = np.array(plant.gravity)
    data, axes = model.createData(), ["xyz".index(axis) for axis in robot.axes]
    x_des, Kp, Kd, D = map(np.array, (plant.x_des, plant.Kp, plant.Kd, plant.damping))

    def rates(_t: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:n], y[n:]
        pin.forwardKinematics(model, data, q, v, np.zeros(n))
        J = pin.computeFrameJacobian(model, data, q, robot.frame_id, pin.LOCAL_WORLD_ALIGNED)[axes]
        drift = pin.getFrameClassicalAcceleration(model, data, robot.frame_id, pin.LOCAL_WORLD_ALIGNED).linear[axes]
        command = Kp * (x_des - data.oMf[robot.frame_id].translation[axes]) - Kd * (J @ v)
        commanded = np.linalg.pinv(J, plant.rcond) @ (command - drift + plant.Kn * J @ v)
        M = pin.crba(model, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        return np.concatenate([v, commanded - plant.Kn * v - np.linalg.solve(M, D * v)])

    start = [*plant.q, *plant.v]
    solved = solve_ivp(rates, (0.0, seconds), start, "Radau", rtol=1e-10, atol=1e-13)
    assert solved.success
    return solved.y[:n, -1]


def advanced(of: Engine, plant: Plant, steps: int) -> np.ndarray:
    """q of the native engine after some communication steps."""
    values = of.values(plant)
    for _ in range(steps):
        assert of.call("advance", values, STEP) == 1
    return of.group(values, "q")


def both_axes(gains: tuple[float, float]) -> dict[str, list[float]]:
    return {"Kp": [gains[0]] * 2, "Kd": [gains[1]] * 2}


@functools.cache
def damped_motion(damping: float, gains: tuple[float, float], steps: int) -> np.ndarray:
    """q of the shipped arm after some communication steps, by the implicit method."""
    return radau(shipped(damped_arm(damping), **both_axes(gains)), steps * STEP)


@pytest.mark.parametrize("tolerances", [TIGHT, DEFAULT], ids=["tight", "default"])
@pytest.mark.parametrize("gains", [(50.0, 40.0), (4000.0, 100.0)], ids=["soft", "hard"])
@pytest.mark.parametrize("damping", [1.0, 600.0, 10_000.0])
def test_damped_arms_move_as_an_implicit_solver_says(damping, gains, tolerances):
    of, (rtol, atol) = damped_arm(damping), tolerances
    plant = shipped(of, rtol=rtol, atol=atol, **both_axes(gains))
    expected = damped_motion(damping, gains, 5)
    assert np.abs(advanced(of, plant, 5) - expected).max() <= WITHIN[tolerances]
    plant.step(STEP)
    expected = damped_motion(damping, gains, 1)
    assert np.abs(plant.q - expected).max() <= WITHIN[tolerances]


def test_no_step_of_a_strongly_damped_arm_is_refused(length):
    rng, of = np.random.default_rng(9), damped_arm(30_000.0)
    for i in range(30):
        start = {"q_start": rng.uniform(-3.0, 3.0, 2).tolist(), "v_start": rng.uniform(-1.0, 1.0, 2).tolist()}
        plant = shipped(of, **start, x_des=rng.uniform(-0.4, 0.4, 2).tolist())
        found = advanced(of, plant, 1)
        if i < length(30, 3):
            assert found == pytest.approx(radau(plant, STEP), abs=1e-3), plant.q_start


def test_a_motion_beyond_the_budget_is_refused_with_its_joint_and_rate(length):
    of = damped_arm(1e6)
    plant = shipped(of, integrator=1)
    values = of.values(plant)
    before = values.copy()
    assert of.call("advance", values, STEP) == 0
    assert (values == before).all()
    # D (M⁻¹)₂₂, what joint 2 answers to its own speed with
    inertia = pin.crba(plant.robot.model, plant.robot.model.createData(), np.array(plant.q))
    rate = 1e6 * np.linalg.inv(np.triu(inertia) + np.triu(inertia, 1).T)[1, 1]
    *failure, found = of.failure()
    assert failure == [MANY_EVALUATIONS, 1] and found == pytest.approx(rate, rel=1e-3)
    if length(1, 0):  # two million evaluations in Python
        with pytest.raises(DiscardError, match="joint 'joint2' changes at a rate") as told:
            plant.step(STEP)
        named = float(re.findall(r"rate of (\S+)", str(told.value))[0])
        assert named == pytest.approx(rate, rel=0.01)
        assert plant.q == [0.5, 0.35]


@pytest.mark.parametrize("max_step", [1e-12, 1e-300, 2.2250738585072014e-308, 5.9e-9])
def test_a_largest_step_beyond_the_budget_is_refused_at_once(max_step):
    of = damped_arm(0.0)
    plant = shipped(of, max_step=max_step)
    values = of.values(plant)
    before = values.copy()
    assert of.call("advance", values, STEP) == 0
    assert (values == before).all()
    assert of.failure()[0] == MANY_STEPS
    with pytest.raises(DiscardError, match=f"max_step = {max_step:g} s divides .*; increase max_step"):
        plant.step(STEP)
    assert plant.q == [0.5, 0.35]


@pytest.mark.parametrize("tolerance", [1e-300, 1e-25])
def test_tolerances_that_nothing_satisfies_are_named(tolerance, length):
    of = damped_arm(0.0)
    plant = shipped(of, rtol=tolerance, atol=tolerance)
    values = of.values(plant)
    assert of.call("advance", values, STEP) == 0
    assert of.failure()[0] in (MANY_EVALUATIONS, SMALL_STEPS)
    if length(1, 0):
        with pytest.raises(DiscardError, match=f"^rtol = {tolerance:g} and atol = .* increase rtol"):
            plant.step(STEP)


def test_a_hand_of_small_inertias_and_strong_damping_moves_as_an_implicit_solver_says():
    """The allegro hand has D/M up to 8e5 1/s; impossible inertias are replaced by those of a cube."""
    urdf = robots_folder() / "allegro_hand_description" / "urdf" / "allegro_left_hand.urdf"
    tree = ET.fromstring(urdf.read_text())
    for inertia in tree.iter("inertia"):
        moments = sorted(float(inertia.attrib[key]) for key in ("ixx", "iyy", "izz"))
        for key in ("ixx", "iyy", "izz"):
            inertia.set(key, repr(moments[2]))
        for key in ("ixy", "ixz", "iyz"):
            inertia.set(key, "0")
    of = Engine(from_urdf(ET.tostring(tree, encoding="unicode"), "link_3.0_tip", "xyz"))
    plant = of.model.plant()
    plant.x_des, plant.friction = np.add(plant.x, [0.0, 0.01, -0.01]).tolist(), [0.0] * len(plant.q)
    expected = radau(plant, 3 * STEP)
    found = advanced(of, plant, 3)
    assert np.abs(found - plant.q).max() > 1e-7  # it moves
    assert np.abs(found - expected).max() <= 1e-6


@pytest.mark.parametrize("name", ["tiago", "twodof"])
def test_rounding_of_the_target_moves_no_joint(name):
    native = engine(name)
    plant = native.model.plant()
    plant.x_des = [x + ulp for x, ulp in zip(plant.x, (4e-16, -4e-16, 4e-16))]
    values = native.values(plant)
    assert native.call("advance", values, STEP) == 1
    assert not native.group(values, "v").any()
    assert (native.group(values, "q") == plant.q).all()
