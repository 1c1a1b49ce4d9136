"""The C engine against Pinocchio, NumPy and the Python plant."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from native_models import ROBOTS, Engine, coupling, engine, from_urdf, model

from twodof.export.bodies import joint_tree
from twodof.export.recursions import effort_bounds

# trees, prismatic joints, axes along x, y, z and none of them, joints that mimic others
EVERY_ROBOT = ("twodof", *ROBOTS)
STATES = 200


def deviation(a, b):
    return np.abs(a - b).max() / max(1.0, np.abs(b).max())


def random_states(rng, n):
    for _ in range(STATES):
        yield rng.uniform(-np.pi, np.pi, n), rng.normal(0.0, 2.0, n), rng.normal(0.0, 5.0, n)


def test_robots_cover_trees_prismatic_joints_and_every_axis():
    robots = [model(name).robot for name in EVERY_ROBOT]
    assert any(any(robot.prismatic) for robot in robots)
    assert sum(len(set(robot.model.parents[1:])) < len(robot.joints) for robot in robots) >= 2
    kinds = {joint.shortname()[10:] for robot in robots for joint in list(robot.model.joints)[1:]}
    assert kinds >= {"RX", "RY", "RZ", "PZ", "RevoluteUnaligned"}


@pytest.mark.parametrize("largest", [1e-8, 1.0, 10.0, 999999.0, 1e12])
def test_cosine_and_sine_are_right_to_rounding(largest):
    quarters = np.pi / 4 * np.arange(-9, 10)
    angle = np.append(np.random.default_rng(6).uniform(-largest, largest, 20_000), quarters)
    c, s = np.empty((2, len(angle)))
    engine("twodof").call("turn", angle, float(len(angle)), c, s)
    exact = angle.astype(np.longdouble)
    bound = 2.0**-52 if largest <= 1e6 else 2.0**-51
    assert np.abs(c - np.cos(exact)).max() <= bound
    assert np.abs(s - np.sin(exact)).max() <= bound


def test_cosine_and_sine_are_right_where_arithmetic_is_not_the_standards():
    """Importers may compile the sources with any flags."""
    angle = np.random.default_rng(6).uniform(-10.0, 10.0, 10_000)
    c, s = np.empty((2, len(angle)))
    Engine(model("twodof"), ("-mfpmath=387",)).call("turn", angle, float(len(angle)), c, s)
    exact = angle.astype(np.longdouble)
    assert np.abs(c - np.cos(exact)).max() <= 2.0**-49
    assert np.abs(s - np.sin(exact)).max() <= 2.0**-49


@pytest.mark.parametrize(
    ("name", "control"), [*((name, "task") for name in EVERY_ROBOT), ("twodof", "pose"), ("panda", "pose")]
)
def test_kinematics_equal_pinocchio(name, control):
    native, robot, (G, c) = engine(name, control), model(name).robot, coupling(name)
    data, frame = robot.model.createData(), robot.frame_id
    axes = ["xyz".index(axis) for axis in robot.axes]
    rows = [*axes, 3, 4, 5] if control == "pose" else axes
    for q, v, force in random_states(np.random.default_rng(1), native.n):
        Q = G @ q + c
        pin.forwardKinematics(robot.model, data, Q, G @ v, np.zeros(robot.model.nv))
        J = pin.computeFrameJacobian(robot.model, data, Q, frame, pin.LOCAL_WORLD_ALIGNED) @ G
        drift = pin.getFrameClassicalAcceleration(robot.model, data, frame, pin.LOCAL_WORLD_ALIGNED).vector
        expected = (data.oMf[frame].translation[axes], J[rows], drift[rows])
        for ours, theirs in zip(native.task(q, v), expected, strict=True):
            assert deviation(ours, theirs) <= 1e-11
        force = np.resize(force, 3)
        assert deviation(native.effort_of_force(q, force), J[:3].T @ force) <= 1e-11


@pytest.mark.parametrize("name", EVERY_ROBOT)
def test_dynamics_equal_pinocchio(name):
    native, robot, (G, c) = engine(name), model(name).robot, coupling(name)
    n, reference = native.n, robot.model.copy()
    data = reference.createData()
    gravity, still = np.array([0.3, -2.0, -9.81]), np.zeros(native.n)
    reference.gravity.linear = gravity
    for q, v, a in random_states(np.random.default_rng(2), n):
        Q = G @ q + c
        M = pin.crba(reference, data, Q)
        M = G.T @ (np.triu(M) + np.triu(M, 1).T) @ G
        columns = [native.inverse_dynamics(q, still, e, np.zeros(3)) for e in np.eye(n)]
        assert deviation(np.array(columns).T, M) <= 1e-11
        h = G.T @ pin.nonLinearEffects(reference, data, Q, G @ v)
        assert deviation(native.inverse_dynamics(q, v, still, gravity), h) <= 1e-11
        tau = G.T @ pin.rnea(reference, data, Q, G @ v, G @ a)
        assert deviation(native.inverse_dynamics(q, v, a, gravity), tau) <= 1e-11
        assert deviation(M @ native.acceleration_of_effort(q, a), a) <= 1e-11


@pytest.mark.parametrize("name", EVERY_ROBOT)
def test_no_effort_exceeds_its_bound(name):
    native, robot, (G, c) = engine(name), model(name).robot, coupling(name)
    reference, gravity, bound = robot.model.copy(), np.array([3.0, -9.81, 1.0]), np.empty(native.n)
    data, rng = reference.createData(), np.random.default_rng(3)
    reference.gravity.linear = gravity
    for q, v, a in random_states(rng, native.n):
        v, a = v * rng.integers(2), a * rng.integers(2)
        tau = G.T @ pin.rnea(reference, data, G @ q + c, G @ v, G @ a)
        native.call("effort_bounds", q, v, a, gravity, bound)
        assert (np.abs(tau) <= bound * (1.0 + 1e-9)).all()


def test_effort_bound_is_the_holding_effort_of_a_stretched_arm():
    robot, still = model("twodof").robot, np.zeros(2)
    constants, gravity = joint_tree(robot), np.array([0.0, -9.81, 0.0])
    reference = robot.model.copy()
    reference.gravity.linear = gravity
    data = reference.createData()
    angles = np.linspace(-np.pi, np.pi, 361)
    largest = max(abs(pin.rnea(reference, data, np.array([q, 0.0]), still, still)[0]) for q in angles)
    bound = effort_bounds(constants, constants.body, np.eye(2), still, still, still, gravity)
    assert largest <= bound[0] <= 1.02 * largest  # centres of mass lie a little off the line


@pytest.mark.parametrize("name", EVERY_ROBOT)
def test_controller_equals_pinocchio(name):
    """τ of the controller with NumPy's pseudo-inverse, where σ_min/σ_max ≥ 0.05."""
    native, robot, (G, c) = engine(name), model(name).robot, coupling(name)
    reference, plant = robot.model.copy(), model(name).plant()
    data = reference.createData()
    rng = np.random.default_rng(3)
    compared = 0
    for q, v, _ in random_states(rng, native.n):
        x, J, drift = native.task(q, v)
        sigma = np.linalg.svd(J, compute_uv=False)
        if sigma[-1] < 0.05 * sigma[0]:
            continue
        plant.q, plant.v = list(q), list(v)
        plant.x_des, plant.xd_des, plant.xdd_des = (list(rng.normal(size=native.m)) for _ in "123")
        plant.Kn = 3.0
        values = native.values(plant)
        native.call("outputs", values)
        command = np.array(plant.xdd_des) + 40.0 * (plant.xd_des - J @ v)
        command += 50.0 * (plant.x_des - x) - drift
        inverse = np.linalg.pinv(J, rcond=plant.rcond)
        a = inverse @ command - 3.0 * (v - inverse @ (J @ v))
        reference.gravity.linear = np.array(plant.gravity)
        tau = G.T @ pin.rnea(reference, data, G @ q + c, G @ v, G @ a)
        assert deviation(native.group(values, "tau"), tau) <= 1e-11
        assert deviation(native.group(values, "x"), x) == 0.0
        compared += 1
    assert compared >= 20


@pytest.mark.parametrize("name", ["finger", "twodof", "ur5"])
@pytest.mark.parametrize("singular", [1e-16, 1e-6, 0.005, 0.02, 0.5])
def test_pseudo_inverse_equals_numpy(name, singular):
    """It has one, two or three rows, and a smallest singular value below or above rcond = 0.01."""
    native = engine(name)
    rng = np.random.default_rng(4)
    for _ in range(200):
        J = rng.normal(size=(native.m, native.n))
        U, sigma, Vt = np.linalg.svd(J, full_matrices=False)
        sigma[-1] = singular * sigma[0] if native.m > 1 else sigma[0]
        J = np.ascontiguousarray(U * sigma @ Vt)
        b, result = rng.normal(size=native.m), np.empty(native.n)
        expected = np.linalg.pinv(J, rcond=0.01) @ b
        native.call("pseudo_inverse", J.copy(), b.copy(), 0.01, result)
        assert deviation(result, expected) <= 1e-11


@pytest.mark.parametrize("name", ["finger", "twodof", "ur5"])
@pytest.mark.parametrize("error", [0.0, 1e-16])
def test_pseudo_inverse_of_rounding_errors_is_zero(name, error):
    native = engine(name)
    J, result = error * np.random.default_rng(1).normal(size=(native.m, native.n)), np.full(native.n, np.nan)
    native.call("pseudo_inverse", J, np.ones(native.m), 0.01, result)
    assert not result.any()


# --- trajectories against the Python plant ---


def follow(name, changes=None, targets=(), seconds=3.0, h=0.01, of=None):
    """Largest deviation of q, v, x and tau; touched limits; smallest σ_min/σ_max."""
    native = of or engine(name)
    plant = native.model.plant()
    for group, value in (changes or {}).items():
        setattr(plant, group, value)
    plant.initialise()
    values = native.values(plant)
    steps = round(seconds / h)
    worst, touched, conditioning = 0.0, set(), 1.0
    x_des = [i for i, v in enumerate(native.model.table) if v.group == "x_des"]
    for k in range(steps):
        if targets:
            target = targets[k * len(targets) // steps]
            plant.x_des = list(map(float, target))
            values[x_des] = plant.x_des
        plant.step(h)
        assert native.call("advance", values, float(h)) == 1
        native.call("outputs", values)
        for group in ("q", "v", "x", "tau"):
            expected = np.array(getattr(plant, group))
            worst = max(worst, np.abs(native.group(values, group) - expected).max())
        for i, q in enumerate(native.group(values, "q")):
            touched |= {(i, "min")} if q == plant.q_min[i] else set()
            touched |= {(i, "max")} if q == plant.q_max[i] else set()
        J = native.task(np.array(plant.q), np.array(plant.v))[1]
        sigma = np.linalg.svd(J, compute_uv=False)
        conditioning = min(conditioning, sigma[-1] / sigma[0])
    return worst, touched, conditioning


NARROW = {"q_min": [-0.2, 0.6], "q_max": [0.6, 1.9], "q_start": [0.2, 1.2]}
TARGETS = [(0.17, 0.01), (-0.04, -0.09), (0.23, 0.27), (0.16, 0.19), (0.14, 0.27), (0.24, -0.1)]


def test_default_run():
    worst, _, conditioning = follow("twodof", seconds=5.0)
    assert worst <= 1e-9 and conditioning >= 0.05


def test_stiff_gains_make_the_integrator_reject_steps():
    changes = {"Kp": [1e4, 4e4], "Kd": [1e3, 3e3]}
    worst, _, conditioning = follow("twodof", changes, [(0.2, 0.1), (0.15, 0.15)], seconds=0.5)
    assert worst <= 1e-9 and conditioning >= 0.05


@pytest.mark.parametrize("h", [0.001, 0.01, 0.05])
def test_every_stop_and_release(h):
    worst, touched, conditioning = follow("twodof", NARROW, TARGETS, seconds=6.0, h=h)
    assert touched == {(0, "min"), (0, "max"), (1, "min"), (1, "max")}
    assert worst <= 1e-9 and conditioning >= 0.05


def test_external_effort_at_limits():
    changes = {**NARROW, "tau_ext": [0.1, -0.05]}
    worst, touched, conditioning = follow("twodof", changes, TARGETS, seconds=6.0)
    assert len(touched) >= 3
    assert worst <= 1e-9 and conditioning >= 0.05


ARMS = {
    "ur5": [(0.1, 0.0, 0.0), (0.0, 0.1, -0.1), (-0.05, -0.1, 0.05)],
    "panda": [(0.1, 0.0, 0.0), (0.0, 0.1, -0.1), (-0.05, -0.1, 0.05)],
}


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("case", ["free", "tau_ext", "limit_effort"])
def test_arms(name, case):
    n = engine(name).n
    changes = {
        "free": {},
        "tau_ext": {"tau_ext": [0.5] * n},
        "limit_effort": {"tau_ext": [0.5] * n, "limit_effort": True},
    }[case]
    x = np.array(model(name).starts["x_des"])
    targets = [x + offset for offset in ARMS[name]]
    worst, _, conditioning = follow(name, changes, targets, seconds=2.0)
    assert worst <= 1e-9 and conditioning >= 0.05


WEAK = """<robot name="weak"><link name="world"/>
<link name="l1"><inertial><origin xyz=".1 0 .02"/><mass value="2"/>
<inertia ixx=".01" iyy=".02" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="l2"><inertial><origin xyz=".1 .01 0"/><mass value="1"/>
<inertia ixx=".01" iyy=".02" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j1" type="revolute"><parent link="world"/><child link="l1"/><axis xyz="0 0 1"/>
<dynamics damping="0.4"/><limit lower="-2" upper="2" effort="4" velocity="9"/></joint>
<joint name="j2" type="{kind}"><parent link="l1"/><child link="l2"/><origin xyz=".3 0 0"/>
<axis xyz="{axis}"/><dynamics damping="0.3"/>
<limit lower="0.5" upper="2" effort="3" velocity="9"/></joint>
<link name="tool"/><joint name="t" type="fixed"><parent link="l2"/><child link="tool"/>
<origin xyz=".25 0 0"/></joint></robot>"""


@pytest.mark.parametrize("limit_effort", [False, True])
@pytest.mark.parametrize("kind, axis", [("revolute", "0 0 1"), ("prismatic", "1 0.5 0")])
def test_damping_and_saturation(kind, axis, limit_effort):
    """A damped arm is too weak for its target; τ saturates."""
    of = Engine(from_urdf(WEAK.format(kind=kind, axis=axis), "tool", "xy"))
    x = np.array(of.model.starts["x_des"])
    changes = {"gravity": [0.0, -9.81, 0.0], "limit_effort": limit_effort}
    targets = [np.add(x, offset) for offset in ((-0.02, 0.05), (0.02, -0.03))]
    worst, _, conditioning = follow("", changes, targets, seconds=2.0, of=of)
    assert worst <= 1e-9 and conditioning >= 0.05


def test_damping_changes_the_motion():
    """The motion with damping agrees with Pinocchio's forward dynamics."""
    of = Engine(from_urdf(WEAK.format(kind="prismatic", axis="1 0.5 0"), "tool", "xy"))
    plant = of.model.plant()
    plant.q, plant.v, plant.tau_ext, plant.limit_effort = [0.3, 0.5], [1.0, -2.0], [1.0, 2.0], True
    a = np.empty(2)
    of.call("acceleration", of.values(plant), a)
    state = np.array(plant.q), np.array(plant.v)
    expected, *_ = plant.equations_of_motion().acceleration(*state, None, [0, 0])
    assert deviation(a, np.array(expected)) <= 1e-11


def test_steps_across_singularities_stay_finite_and_inside():
    """Targets are reachable or not; each step ends with finite values within the limits."""
    native, plant = engine("twodof"), model("twodof").plant()
    rng = np.random.default_rng(5)
    x_des = [i for i, v in enumerate(native.model.table) if v.group == "x_des"]
    for _ in range(100):
        plant.q_start = rng.uniform(-np.pi, np.pi, 2).tolist()
        plant.initialise()
        values = native.values(plant)
        values[x_des] = rng.uniform(-0.5, 0.5, 2)
        for _ in range(100):
            assert native.call("advance", values, 0.01) == 1
            assert np.isfinite(values).all() and np.abs(native.group(values, "q")).max() <= np.pi


def test_a_value_that_is_not_finite_leaves_the_plant_unchanged():
    native, plant = engine("twodof"), model("twodof").plant()
    plant.Kp = [1e308, 1e308]
    plant.x_des = [1e300, 1.0]
    values = native.values(plant)
    before = values.copy()
    assert native.call("advance", values, 0.01) == 0
    assert (values == before).all()
