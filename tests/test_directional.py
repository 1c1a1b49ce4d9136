"""Directional derivatives: against Pinocchio's, closed forms, and central differences."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from native_models import ROBOTS, Engine, Reduced, from_urdf, model, urdf_path
from scipy.spatial.transform import Rotation

from twodof.plant.stops import CLAMPED, FREE, STOPPED, STUCK


class Derivatives(Engine):
    """An engine with the function for derivatives."""

    def __init__(self, of, flags=()):
        super().__init__(of, flags)
        self.count = len(of.table)
        self.names = [v.name for v in of.table]
        self.computed = [i for i, v in enumerate(of.table) if v.causality in ("output", "local")]
        self.known = [i for i in range(self.count) if i < of.index("x")]

    def jacobian(self, values, held=None, slip=None):
        """∂ computed/∂ known, one row per variable from q to the parameters."""
        held, slip = (np.zeros(self.n, dtype=np.int32) if x is None else x for x in (held, slip))
        columns = []
        for k in self.known:
            change, derivative = np.zeros(self.count), np.zeros(self.count)
            change[k] = 1.0
            self.call("differentiate", values, held, slip, change, derivative)
            columns.append(derivative[self.computed])
        jacobian = np.array(columns).T
        if held.any():
            jacobian[-self.n :] = self.slopes(values, held, slip)
        return jacobian

    def slopes(self, values, held=None, slip=None):
        """∂ accelerations/∂ known, by the Jacobian."""
        held, slip = (np.zeros(self.n, dtype=np.int32) if x is None else x for x in (held, slip))
        slopes = np.zeros((len(self.known), self.n))
        self.call("slopes", values.copy(), held, slip, slopes)
        return slopes.T

    def differences(self, values, held=None, slip=None):
        """The same by central differences, extrapolated."""
        held, slip = (np.zeros(self.n, dtype=np.int32) if x is None else x for x in (held, slip))

        def slope(k, h):
            ends = []
            for sign in (1.0, -1.0):
                near = values.copy()
                near[k] += sign * h
                self.call("compute", near, held, slip)
                ends.append(near[self.computed])
            return (ends[0] - ends[1]) / (2.0 * h)

        h = 1e-4
        return np.array([(4.0 * slope(k, h / 2) - slope(k, h)) / 3.0 for k in self.known]).T

    def part(self, jacobian, rows, columns):
        names = [self.names[i] for i in self.computed]
        known = [self.names[i] for i in self.known]
        r = [i for i, name in enumerate(names) if re.fullmatch(rows, name)]
        c = [i for i, name in enumerate(known) if re.fullmatch(columns, name)]
        return jacobian[np.ix_(r, c)]


def at_random(engine, rng, **settings):
    """Random values of all variables, inside the joints' ranges."""
    of = engine.model
    plant = of.plant()
    low, high = np.maximum(plant.q_min, -2.0), np.minimum(plant.q_max, 2.0)
    plant.q = rng.uniform(low, high).tolist()
    plant.v = rng.uniform(-1.5, 1.5, engine.n).tolist()
    for group in {v.group for v in of.table if v.causality == "input"}:
        value = getattr(plant, group)
        if isinstance(value, list):
            setattr(plant, group, (np.array(value) + rng.uniform(-0.3, 0.3, len(value))).tolist())
    for name, value in settings.items():
        setattr(plant, name, value)
    return engine.values(plant)


def derivatives(reduced: Reduced, q, v, effort):
    """Return the derivatives of q̈ with respect to q, v and τ.

    They are Pinocchio's of the forward dynamics or, with mimic joints, those of the inverse dynamics in the coordinates
    of the independent joints.
    """
    model, data, G = reduced.model, reduced.data, reduced.G
    if model.nv == len(q):
        by_q, by_v, by_tau = pin.computeABADerivatives(model, data, q, v, effort)
        return by_q, by_v, np.triu(by_tau) + np.triu(by_tau, 1).T
    Q, A = G @ q + reduced.c, G @ reduced.forward_dynamics(q, v, effort)
    tau_by_q, tau_by_v, _ = pin.computeRNEADerivatives(model, data, Q, G @ v, A)
    by_tau = np.linalg.inv(reduced.mass_matrix(q))
    return -by_tau @ G.T @ tau_by_q @ G, -by_tau @ G.T @ tau_by_v @ G, by_tau


@pytest.mark.parametrize("name", ["twodof", *ROBOTS])
def test_the_bare_plants_are_pinocchios(name):
    engine = Derivatives(model(name, "effort"))
    robot, rng = engine.model.robot, np.random.default_rng(1)
    reference = robot.model.copy()
    reduced = Reduced(reference, name)
    for _ in range(10):
        values = at_random(engine, rng, f_ext=[0.0, 0.0, 0.0])
        reference.gravity.linear = engine.group(values, "gravity")
        q, v = engine.group(values, "q"), engine.group(values, "v")
        damping = np.array(robot.damping)
        effort = engine.group(values, "tau_cmd") + engine.group(values, "tau_ext") - damping * v
        by_q, by_v, by_tau = derivatives(reduced, q, v, effort)
        ours = engine.jacobian(values)
        for columns, theirs in ((r"q\[\d+\]", by_q), (r"v\[\d+\]", by_v - by_tau * damping), (r"tau_cmd.*", by_tau)):
            part = engine.part(ours, r"der\(v.*", columns)
            assert np.abs(part - theirs).max() <= 1e-10 * max(1.0, np.abs(theirs).max())
        J = reduced.jacobian(q, robot.frame_id)[:3]
        by_force = engine.part(ours, r"der\(v.*", r"f_ext.*")
        assert np.abs(by_force - by_tau @ J.T).max() <= 1e-9 * np.abs(by_tau).max()


def test_task_control_at_rest_has_the_poles_of_its_gains():
    """The polynomial is s² + Kd s + Kp, on both axes of the default arm and three of the UR5."""
    for name, extra in (("twodof", 0), ("ur5", 3)):
        engine = Derivatives(model(name))
        plant = engine.model.plant()
        plant.x_des, plant.Kp = list(plant.x), [50.0 + 10.0 * k for k in range(engine.m)]
        if name == "twodof":
            plant.Kn = 0.0
        values = engine.values(plant)
        ours = engine.jacobian(values)
        A = engine.part(ours, r"der.*", r"[qv]\[\d+\]")
        poles = np.linalg.eigvals(A)
        expected = [root for Kp, Kd in zip(plant.Kp, plant.Kd) for root in np.roots([1.0, Kd, Kp])]
        for root in expected:
            assert np.abs(poles - root).min() <= 1e-10 * abs(root)
        assert len(poles) == len(expected) + 2 * extra


CASES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "twodof task": ("twodof", "task", {}),
    "payload": ("twodof", "task", {"payload": 0.7, "payload_com": [0.02, 0.01, 0.03]}),
    "known payload": ("twodof", "task", {"payload": 0.7, "payload_known": True}),
    "dropped": ("twodof", "task", {"rcond": 0.9}),
    "orthogonal rows, dropped": ("twodof", "task", {"q": [0.0, 0.0]}),
    "by the sweeps": ("twodof", "task", {"rcond": 0.0, "q": [0.3, 0.01]}),
    "clamped effort": ("twodof", "joint", {"limit_effort": True, "Kp": [4000.0, 1.0]}),
    "joint": ("twodof", "joint", {"payload": 0.2}),
    "ur5 task": ("ur5", "task", {"Kn": 3.0, "payload": 2.0}),
    "ur5 dropped": ("ur5", "task", {"rcond": 0.7}),
    "ur5 dropped two": ("ur5", "task", {"rcond": 0.95, "Kn": 1.0}),
    "sliding joints": ("tiago", "task", {"Kn": 1.0, "limit_effort": True}),
    "pose": ("ur5", "pose", {"payload": 1.0}),
    "pose, dropped": ("ur5", "pose", {"rcond": 0.3}),
    "pose, rows that depend on others": ("twodof", "pose", {"payload": 0.5}),
    "pose, mimic": ("panda", "pose", {"Kn": 1.0}),
    "panda": ("panda", "effort", {"payload": 1.0}),
    "panda joint": ("panda", "joint", {"limit_effort": True, "payload": 1.0}),
    "anymal, a tree": ("anymal_c", "task", {"Kn": 2.0}),
    "z1, two axes": ("z1", "task", {"Kn": 2.0, "rcond": 0.3}),
}


@pytest.mark.parametrize(
    ("case", "complex_numbers"),
    [*((case, True) for case in CASES), ("known payload", False), ("ur5 dropped two", False)],
)
def test_derivatives_are_those_of_central_differences(case, complex_numbers):
    name, control, settings = CASES[case]
    flags = () if complex_numbers else ("-DNO_COMPLEX",)
    engine = Derivatives(model(name, control), flags)
    rng = np.random.default_rng(3)
    for _ in range(3):
        values = at_random(engine, rng, **settings)
        ours, theirs = engine.jacobian(values), engine.differences(values)
        scale = np.maximum(1.0, np.abs(theirs).max(axis=1, keepdims=True))
        assert (np.abs(ours - theirs) / scale).max() <= (1e-6 if complex_numbers else 1e-5)


@pytest.mark.parametrize("case", CASES)
def test_the_jacobian_is_that_of_complex_steps(case, length):
    name, control, settings = CASES[case]
    engine, rng = Derivatives(model(name, control)), np.random.default_rng(8)
    first = 0 if control == "effort" else engine.model.index("tau_ext")
    for _ in range(length(500, 25)):
        values = at_random(engine, rng, **{"f_ext": rng.normal(0, 5, 3).tolist()} | settings)
        ours, steps = engine.slopes(values)[:, first:], engine.jacobian(values)[-engine.n :, first:]
        assert np.abs(ours - steps).max() <= 1e-12 * np.abs(steps).max()


def test_the_jacobian_of_a_robot_with_a_gear_in_its_arm_is_that_of_complex_steps():
    urdf = urdf_path("ur5").read_text()
    wrist, _transmission = re.findall(r'<joint name="wrist_2_joint".*?</joint>', urdf, re.DOTALL)
    geared = wrist.replace("</joint>", '<mimic joint="shoulder_lift_joint" multiplier="-0.5"/></joint>')
    engine = Derivatives(from_urdf(urdf.replace(wrist, geared), "tool0", "xyz"))
    rng = np.random.default_rng(5)
    for _ in range(10):
        values = at_random(engine, rng, Kn=2.0, gravity=[3.0, -2.0, -9.0])
        ours, steps = engine.slopes(values), engine.jacobian(values)[-engine.n :]
        assert engine.n == 5
        assert np.abs(ours - steps)[:, engine.model.index("q") :].max() <= 1e-12 * np.abs(steps).max()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.1, 0.199, 0.201, 3.0])
def test_the_jacobian_is_that_of_complex_steps_for_errors_of_any_angle(angle):
    """The rate of the rotation error is a series at small angles."""
    engine, rng = Derivatives(model("ur5", "pose")), np.random.default_rng(4)
    plant, axis = engine.model.plant(), rng.normal(size=3)
    plant.q = rng.uniform(-1.0, 1.0, 6).tolist()
    plant.initialise()
    target = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)) * Rotation.from_quat(plant.quat)
    values = at_random(engine, rng, q=plant.q, quat_des=target.as_quat().tolist())
    ours, steps = engine.slopes(values), engine.jacobian(values)[-6:]
    assert np.abs(ours - steps)[:, engine.model.index("q") :].max() <= 1e-12 * np.abs(steps).max()


@pytest.mark.parametrize("rigid", [False, True])
def test_a_joint_at_rest_at_its_stop_stays_there(rigid):
    engine = Derivatives(model("ur5", "effort"))
    values = at_random(engine, np.random.default_rng(4), rigid_stops=rigid)
    held = np.array([0, 1, 0, 0, 1, 0], dtype=np.int32) * (STOPPED if rigid else CLAMPED)
    ours, theirs = engine.jacobian(values, held), engine.differences(values, held)
    assert np.abs(ours - theirs).max() <= 1e-6 * max(1.0, np.abs(theirs).max())
    rates = engine.part(ours, r"der\(v.*", r".*")
    assert not rates[[1, 4]].any() and rates[0].any()


@pytest.mark.parametrize(("control", "period"), [("effort", 0.0), ("joint", 0.0), ("joint", 0.01)])
def test_joints_that_stick_and_slip_have_pinocchios_derivatives(control, period):
    """M q̈ + h = τ + λ gives, in the rows of moving joints, M_mm δq̈ = δτ − ∂(M q̈ + h) at constant q̈."""
    engine = Derivatives(model("ur5", control))
    robot, rng = engine.model.robot, np.random.default_rng(6)
    reference, n = robot.model.copy(), engine.n
    for _ in range(10):
        friction, damping, armature = rng.uniform(0.1, 20, (3, n)).tolist()
        settings = {"f_ext": [0.0] * 3, "friction": friction, "damping": damping, "armature": armature}
        values = at_random(engine, rng, **settings, control_period=period)
        values[[i for i, v in enumerate(engine.model.table) if v.group == "tau"]] = rng.normal(0, 30, n)
        slip = rng.choice([-1, 0, 1], n).astype(np.int32)
        held = np.where(slip == 0, STUCK, FREE).astype(np.int32)
        reference.gravity.linear = engine.group(values, "gravity")
        ours, moves = engine.jacobian(values, held, slip), slip != 0
        engine.call("compute", values, held, slip)
        q, v, a = (engine.group(values, group) for group in ("q", "v", "der_v"))
        assert not a[~moves].any()
        data = reference.createData()
        by_q, by_v, M = (np.array(x) for x in pin.computeRNEADerivatives(reference, data, q, v, a))
        M = np.triu(M) + np.triu(M, 1).T + np.diag(armature)
        effort = {"q": -by_q, "v": -by_v - np.diag(damping), "tau_ext": np.eye(n)}
        if control == "joint" and not period:  # τ = M q̈_cmd + h, of which the armature is a part; else it is held
            Kp, Kd = engine.group(values, "Kp"), engine.group(values, "Kd")
            wanted = engine.group(values, "a_des") + Kd * (engine.group(values, "v_des") - v)
            wanted += Kp * (engine.group(values, "q_des") - q)
            law_q, law_v, _ = (np.array(x) for x in pin.computeRNEADerivatives(reference, data, q, v, wanted))
            effort["q"] = effort["q"] + law_q - M @ np.diag(Kp)
            effort["v"] = effort["v"] + law_v - M @ np.diag(Kd)
        for group, change in effort.items():
            expected = np.zeros((n, n))
            expected[moves] = np.linalg.solve(M[np.ix_(moves, moves)], change[moves])
            part = engine.part(ours, r"der\(v.*", rf"{group}\[\d+\]")
            assert np.abs(part - expected).max() <= 1e-10 * max(1.0, np.abs(expected).max())


def test_a_direction_of_any_size_has_its_derivative():
    engine = Derivatives(model("twodof", "effort"))
    values = at_random(engine, np.random.default_rng(5))
    held, k = np.zeros(2, dtype=np.int32), engine.model.index("q")
    results = []
    for size in (1.0, 1e-250, 1e250):
        change, derivative = np.zeros(engine.count), np.zeros(engine.count)
        change[k] = size
        engine.call("differentiate", values, held, held, change, derivative)
        results.append(derivative[engine.computed] / size)
    np.testing.assert_allclose(results[1:], [results[0]] * 2, rtol=1e-12)
