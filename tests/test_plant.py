"""The plant against closed forms, finite differences and MuJoCo."""

import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from native_models import model
from oracles import LINK, REST, TwoLinkArm, drift, jacobian, position, task_error

from twodof.export.composition import DEFAULT_ARM
from twodof.files import data_file
from twodof.plant import task_control
from twodof.plant.plant import DiscardError, ParameterError, Plant
from twodof.plant.robot import load_robot
from twodof.plant.variables import variable_table

KP, KD = 50.0, 40.0
URDF = Path(data_file("urdf", "2dof.urdf"))
FRAMES = {"ur5": "ee_link", "panda": "panda_hand_tcp"}


def default_arm(urdf: str | None = None) -> Plant:
    robot = load_robot(urdf or URDF.read_text(), "EndEffector", "xy")
    plant = Plant(robot, variable_table(robot, DEFAULT_ARM))
    plant.initialise()
    return plant


def arm(name: str, request) -> Plant:
    robot = load_robot(request.getfixturevalue(name), FRAMES[name], "xyz")
    starts = {"q_start": REST[name], "x_des": (0.0, 0.0, 0.0)}
    plant = Plant(robot, variable_table(robot, starts))
    plant.initialise()
    return plant


def mujoco_model(urdf: str) -> mujoco.MjModel:
    """The mechanism of a URDF in MuJoCo, without its shapes; gravity along −z."""
    tree = ET.fromstring(urdf)
    for link in tree.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    options = ET.SubElement(ET.SubElement(tree, "mujoco"), "compiler")
    options.set("fusestatic", "false")
    model = mujoco.MjModel.from_xml_string(ET.tostring(tree, encoding="unicode"))
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    return model


def regular_states(count: int, seed: int):
    """Random states of the two-link arm with σ_min/σ_max ≥ 0.05."""
    rng = np.random.default_rng(seed)
    while count:
        q, v = rng.uniform(-np.pi, np.pi, 2), rng.uniform(-5, 5, 2)
        sigma = np.linalg.svd(jacobian(q), compute_uv=False)
        if sigma[1] >= 0.05 * sigma[0]:
            count -= 1
            yield rng, q, v


def test_default_run_follows_the_closed_form():
    plant = default_arm()
    start = position(np.array(plant.q))
    target = np.array(plant.x_des)
    t = 0.01 * np.arange(501)
    q = [plant.q]
    for _ in t[1:]:
        plant.step(0.01)
        q.append(plant.q)
    error = target - position(np.array(q))
    assert np.abs(error - task_error(target - start, KP, KD, t)).max() <= 1e-12


def test_moving_target_is_followed():
    """With feed-forward velocity and acceleration, the only tracking error is the decaying initial one."""
    plant = default_arm()
    centre, radius, omega = np.array([0.15, 0.1]), 0.03, 4.0
    e0 = None
    h = 1e-3
    for k in range(4000):
        # held over a step, a circle is followed up to its arc over the step
        angle = omega * (k + 0.5) * h
        turn = np.array([np.cos(angle), np.sin(angle)])
        plant.x_des = (centre + radius * turn).tolist()
        plant.xd_des = (radius * omega * np.array([-turn[1], turn[0]])).tolist()
        plant.xdd_des = (-radius * omega**2 * turn).tolist()
        if e0 is None:
            e0 = np.linalg.norm(np.array(plant.x_des) - plant.x)
        plant.step(h)
    left = np.linalg.norm(task_error(np.array([e0]), KP, KD, np.array([4.0])))
    assert e0 is not None and e0 > 0.05
    assert np.linalg.norm(np.array(plant.x_des) - plant.x) < 2 * left + radius * omega * h


def test_torque_is_the_closed_form_of_the_two_link_arm():
    plant = default_arm()
    arm_form = TwoLinkArm(URDF, gravity=9.81)
    worst = 0.0
    for rng, q, v in regular_states(1000, seed=1):
        plant.q, plant.v = q.tolist(), v.tolist()
        plant.x_des = rng.uniform(-0.3, 0.3, 2).tolist()
        plant.xd_des = rng.uniform(-1, 1, 2).tolist()
        plant.xdd_des = rng.uniform(-5, 5, 2).tolist()
        command = (
            np.array(plant.xdd_des)
            + KD * (np.array(plant.xd_des) - jacobian(q) @ v)
            + KP * (np.array(plant.x_des) - position(q))
        )
        qdd = np.linalg.solve(jacobian(q), command - drift(q, v))
        tau = arm_form.mass_matrix(q) @ qdd + arm_form.nonlinear_effects(q, v)
        error = np.abs(plant.tau - tau).max() / max(1.0, np.abs(tau).max())
        worst = max(worst, error)
    assert worst <= 1e-10


def test_external_torque_damping_and_effort_limits_act_as_in_the_closed_form():
    """One short step from many states agrees with the equations of motion."""
    text = URDF.read_text().replace("<limit ", '<dynamics damping="0.2"/><limit ')
    text = text.replace('effort="10"', 'effort="0.5"')
    plant = default_arm(text)
    plant.limit_effort = True
    arm_form = TwoLinkArm(URDF, gravity=9.81)
    saturated = 0
    h = 1e-6
    for rng, q, v in regular_states(200, seed=2):
        plant.q, plant.v = q.tolist(), v.tolist()
        plant.tau_ext = rng.uniform(-1, 1, 2).tolist()
        tau = np.array(plant.tau)
        assert np.abs(tau).max() <= 0.5
        saturated += bool((np.abs(tau) == 0.5).any())
        nonlinear = arm_form.nonlinear_effects(q, v)
        effort = tau + plant.tau_ext - 0.2 * v - nonlinear
        qdd = np.linalg.solve(arm_form.mass_matrix(q), effort)
        plant.step(h)
        assert (np.array(plant.v) - v) / h == pytest.approx(qdd, rel=1e-2, abs=1e-2)
    assert saturated > 50


@pytest.mark.parametrize("name", FRAMES)
def test_jacobian_and_drift_against_finite_differences(name, request):
    """J v and J̇ v of the controller, from x(q) alone."""
    plant = arm(name, request)
    n = len(plant.q)
    rng = np.random.default_rng(3)

    def x(q):
        plant.q = list(q)
        return np.array(plant.x)

    def central(function, q, v, eps):
        return (function(q + eps * v) - function(q - eps * v)) / (2 * eps)

    model, data, frame = plant.robot.model, plant.robot.model.createData(), plant.robot.frame_id

    def jacobian_of(q):
        return pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)[:3].copy()

    for _ in range(50):
        q, v = rng.uniform(-1.5, 1.5, n), rng.uniform(-1, 1, n)
        columns = [central(x, q, unit, 1e-6) for unit in np.eye(n)]
        assert np.abs(jacobian_of(q) - np.array(columns).T).max() <= 1e-7
        # the commanded acceleration contains J̇v: J q̈_cmd = a_cmd − J̇v
        plant.q, plant.v, plant.Kn = q.tolist(), v.tolist(), 0.0
        plant.x_des, plant.rcond = x(q).tolist(), 0.0
        plant.q = q.tolist()
        qdd, *_ = task_control.command(plant)[0](q, v, None)
        found = -KD * jacobian_of(q) @ v - jacobian_of(q) @ qdd
        expected = central(lambda p: jacobian_of(p) @ v, q, v, 1e-6)  # noqa: B023
        assert np.abs(found - expected).max() <= 1e-6


@pytest.mark.parametrize("name", FRAMES)
def test_mass_matrix_and_nonlinear_effects_against_mujoco(name, request):
    """They enter τ: with J q̈ = a, the controller's τ is M q̈_cmd + h."""
    plant = arm(name, request)
    model = mujoco_model(request.getfixturevalue(name))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(4)
    n = len(plant.q)
    assert [model.joint(i).name for i in range(n)] == list(plant.robot.joints)
    for _ in range(100):
        q, v = rng.uniform(-2, 2, n), rng.uniform(-2, 2, n)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        plant.q, plant.v = q.tolist(), v.tolist()
        tau = np.array(plant.tau)
        qdd = np.array(task_control.command(plant)[0](q, v, None)[0])
        M = np.zeros((n, n))
        mujoco.mj_fullM(model, data, M)
        expected = M @ qdd + data.qfrc_bias
        assert np.abs(tau - expected).max() <= 1e-9 * max(1.0, np.abs(expected).max())
        assert np.abs(plant.known.mass_matrix(q) - M).max() <= 1e-9
        h = plant.known.inverse_dynamics(q, v, np.zeros(n))
        assert np.abs(h - data.qfrc_bias).max() <= 1e-9


def test_self_motion_comes_to_rest(request):
    """Seven joints have three task axes: with Kn the null-space velocity decays as exp(−Kn t)."""
    plant = arm("panda", request)
    assert plant.Kn == 10.0
    plant.x_des = plant.x
    model = plant.robot.model
    J = pin.computeFrameJacobian(
        model, model.createData(), np.array(plant.q), plant.robot.frame_id, pin.LOCAL_WORLD_ALIGNED
    )[:3]
    null = np.linalg.svd(J)[2][3:]
    plant.v = (0.3 * null[0]).tolist()
    for _ in range(200):
        plant.step(0.01)
    assert np.abs(plant.v).max() < 1e-6
    assert np.linalg.norm(np.array(plant.x_des) - plant.x) < 1e-3


def stops_and_releases(h: float):
    """A run into narrowed limits, at both of which each joint is stopped and released."""
    plant = default_arm()
    plant.q_min, plant.q_max = [-0.2, 0.8], [0.8, 1.9]
    plant.q_start = [0.3, 1.3]
    plant.initialise()
    plant.Kp = [400.0, 400.0]
    x, y = (0.14, -0.13, 0.22, 0.12, 0.09, 0.22), (-0.03, -0.14, 0.26, 0.18, 0.27, -0.15)
    seen, states = [], []
    before: list[str | None] = [None, None]
    smallest = 1.0
    for target in zip(x, y):
        plant.x_des = list(target)
        for _ in range(round(0.4 / h)):
            plant.step(h)
            for i in range(2):
                q, low, high = plant.q[i], plant.q_min[i], plant.q_max[i]
                assert low <= q <= high
                at = "low" if q == low else "high" if q == high else None
                if at != before[i]:
                    seen.append((i, at or f"left {before[i]}"))
                before[i] = at
            sigma = np.linalg.svd(jacobian(np.array(plant.q)), compute_uv=False)
            smallest = min(smallest, sigma[1] / sigma[0])
        states.append([*plant.q, *plant.v])
    return seen, np.array(states), smallest


def test_trajectories_into_limits_do_not_depend_on_the_step():
    reference, expected, smallest = stops_and_releases(1e-3)
    for i in range(2):
        for end in ("low", "high"):
            assert (i, end) in reference
            assert (i, f"left {end}") in reference
    assert smallest >= 0.05
    for h in (5e-3, 0.05):
        seen, states, _ = stops_and_releases(h)
        assert set(seen) == set(reference)
        assert np.abs(states - expected)[:, :2].max() <= 1e-4


@pytest.mark.long
def test_unreachable_targets_and_singularities_never_fail(length):
    rng = np.random.default_rng(5)
    plant = default_arm()
    for _ in range(length(100, 10)):
        plant.q_start = rng.uniform(-np.pi, np.pi, 2).tolist()
        plant.x_des = rng.uniform(-0.5, 0.5, 2).tolist()
        plant.initialise()
        for _ in range(200):
            plant.step(0.01)
            assert np.isfinite([*plant.q, *plant.v]).all()
            assert np.abs(plant.q).max() <= np.pi
        assert np.isfinite(plant.tau).all()


def test_a_joint_that_grazes_its_limit_at_the_fold_does_not_chatter(monkeypatch):
    """The arm is folded at both limits; −5e-24 rad/s² would release joint 1 and stop it at once, without end."""
    plant = default_arm()
    plant.q, plant.v = [np.pi, -3.1352186957606243], [0.0, -1.4880270052931837]
    plant.x_des = [-0.11596721002411503, -0.17468495304859388]
    calls = 0
    equations = plant.equations_of_motion()

    def counted(*state):
        nonlocal calls
        calls += 1
        return equations.acceleration(*state)

    monkeypatch.setattr(plant, "equations_of_motion", lambda: replace(equations, acceleration=counted))
    plant.step(0.01)
    assert calls < 10_000
    assert np.isfinite([*plant.q, *plant.v]).all()


def test_target_at_the_reach_and_stretched_start():
    plant = default_arm()
    plant.q_start, plant.x_des = [0.0, 0.0], [2 * LINK, 0.0]
    plant.initialise()
    for _ in range(100):
        plant.step(0.01)
    assert np.isfinite([*plant.q, *plant.v]).all()


def test_start_outside_the_limits_is_clamped_with_a_warning():
    plant = default_arm()
    plant.q_start, plant.v_start = [4.0, 0.35], [1.0, -1.0]
    (warning,) = plant.initialise()
    assert "q_start[1] = 4 of joint 'joint1' is outside its limits" in warning
    assert plant.q == [np.pi, 0.35]
    assert plant.v == [0.0, -1.0]


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("rtol", 0.0, "rtol = 0 must be > 0"),
        ("atol", -1.0, "atol = -1 must be > 0"),
        ("max_step", 0.0, "max_step = 0 must be > 0"),
        ("rcond", 1.0, r"rcond = 1 must be in \[0, 1\)"),
        ("q_min", [4.0, 0.0], r"q_min\[1\] = 4 > q_max\[1\] = 3.14159 \(joint 'joint1'\)"),
    ],
)
def test_parameters_without_sense_are_refused(name, value, message):
    plant = default_arm()
    setattr(plant, name, value)
    with pytest.raises(ParameterError, match=message):
        plant.initialise()


def test_gravity_is_a_parameter():
    plant = default_arm()
    plant.q, plant.v, plant.gravity = [0.3, 0.6], [0.0, 0.0], [0.0, 0.0, 0.0]
    plant.prepare()
    plant.x_des = plant.x
    assert plant.tau == pytest.approx([0.0, 0.0], abs=1e-15)
    plant.gravity = [0.0, -9.81, 0.0]
    plant.prepare()
    weight = TwoLinkArm(URDF, 9.81).nonlinear_effects(np.array([0.3, 0.6]), np.zeros(2))
    assert plant.tau == pytest.approx(weight, abs=1e-14)


@pytest.mark.parametrize("gain", [1e308, -1e308])
def test_speeds_beyond_all_bounds_are_reported_by_the_exception_alone(gain: float) -> None:
    plant = default_arm()
    plant.Kp = [gain] * 2
    before = plant.q, plant.v
    with warnings.catch_warnings(), pytest.raises(DiscardError, match="not finite"):
        warnings.simplefilter("error")
        plant.step(0.01)
    assert (plant.q, plant.v) == before


@pytest.mark.parametrize(
    ("control", "settings"),
    [
        ("pose", {"Kp": [1e308] * 3, "x_des": [1e300] * 3}),  # a J⁺ of what is not finite
        ("effort", {"f_ext": [-1e38] * 3}),  # a mass matrix of what is not
    ],
)
def test_a_matrix_without_an_inverse_discards_the_step(control, settings):
    """The Panda's fingers are coupled; another kind of exception would end the process of a Python FMU."""
    plant = model("panda", control).plant()
    vars(plant).update(settings)
    before = plant.q, plant.v
    with pytest.raises(DiscardError, match="not finite: inputs, payload or speeds"):
        plant.step(0.01)
    assert (plant.q, plant.v) == before


def test_a_damped_robot_at_rest_on_its_target_does_not_move_at_all() -> None:
    """Rounding would move the light, strongly damped wrist of TIAGo."""
    plant = model("tiago").plant()
    assert max(plant.robot.damping) > 0.0
    q = list(plant.q)
    plant.step(0.01)
    assert plant.q == q and not any(plant.v)


def test_unset_variables_have_the_documented_start() -> None:
    task, bare = model("twodof").plant(), model("twodof", "effort").plant()
    assert (task.rtol, task.atol, task.max_step, task.rcond) == (1e-3, 1e-6, 1e-3, 0.01)
    assert bare.tau_cmd == bare.tau_ext == [0.0, 0.0] and bare.f_ext == bare.payload_com == [0.0] * 3
