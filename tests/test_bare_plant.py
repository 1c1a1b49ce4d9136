"""The plant without a controller: its accelerations, stops and energy.

The oracles are Pinocchio and MuJoCo; each reads the robot from the URDF.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
from native_models import ROBOTS, Reduced, coupling, deviation, engine, loaded, model, random_plant, urdf_path

from twodof.plant.stops import STUCK

EVERY_ROBOT = ("twodof", *ROBOTS)


@pytest.mark.parametrize("name", EVERY_ROBOT)
def test_the_bare_plant_agrees_with_pinocchio(name, length):
    """q̈ with efforts, a force at the frame, damping and a payload, in both flavours."""
    native, rng = engine(name, "effort"), np.random.default_rng(1)
    for _ in range(length(1000, 30)):
        plant = random_plant(name, "effort", rng)
        plant.tau_cmd = rng.normal(0, 20, native.n).tolist()
        plant.prepare()
        q, v = np.array(plant.q), np.array(plant.v)
        reference = Reduced(loaded(plant), name, plant.armature)
        J = reference.jacobian(q, plant.robot.frame_id)[:3]
        effort = np.add(plant.tau_cmd, plant.tau_ext) + J.T @ plant.f_ext
        effort -= np.array(plant.damping) * v
        expected = reference.forward_dynamics(q, v, effort)
        ours, *_ = plant.equations_of_motion().acceleration(q, v, None, [0] * native.n)
        theirs = np.empty(native.n)
        native.call("acceleration", native.values(plant), theirs)
        M = reference.mass_matrix(q)
        assert deviation(M @ ours, M @ expected) <= 1e-11
        assert deviation(M @ theirs, M @ expected) <= 1e-11


# Robots whose inertias MuJoCo takes as they are.
MUJOCO = (
    "twodof",
    "ur5",
    "panda",
    "z1",
    "double_pendulum",
    "baxter",
    "ur_description/urdf/ur10_robot.urdf",
    "kinova_description/robots/kinova.urdf",
    "xarm_description/urdf/xarm7.urdf",
    "so_arm_description/urdf/so101.urdf",
    "a1_description/urdf/a1.urdf",
    "talos_data/robots/talos_left_arm.urdf",
)


@pytest.mark.parametrize("name", MUJOCO)
def test_the_bare_plant_agrees_with_mujoco(name, length, tmp_path, monkeypatch):
    """MuJoCo's inverse dynamics of our q̈, with damping, returns the applied efforts.

    Without mimic joints, its q̈ equals ours.
    """
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its warnings
    root = ET.parse(urdf_path(name)).getroot()
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", {"balanceinertia": "false"})
    theirs = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    G, c = coupling(name, names := [theirs.joint(i).name for i in range(theirs.njnt)])
    data, rng = mujoco.MjData(theirs), np.random.default_rng(5)
    ours = model(name, "effort").plant().robot.joints
    order = np.array([ours.index(joint) for joint in names if joint in ours])
    for _ in range(length(1000, 30)):
        plant = random_plant(name, "effort", rng)
        plant.payload, plant.f_ext = 0.0, [0.0] * 3
        theirs.opt.gravity[:] = plant.gravity
        leading = [joint in ours for joint in names]
        theirs.dof_damping[:], theirs.dof_armature[:] = 0.0, 0.0
        theirs.dof_damping[leading] = np.array(plant.damping)[order]
        theirs.dof_armature[leading] = np.array(plant.armature)[order]
        plant.tau_cmd = rng.normal(0, 20, len(ours)).tolist()
        plant.prepare()
        q, v = np.array(plant.q), np.array(plant.v)
        acceleration, *_ = plant.equations_of_motion().acceleration(q, v, None, [0] * len(ours))
        data.qpos, data.qvel = G @ q[order] + c, G @ v[order]
        data.qacc = G @ np.array(acceleration)[order]
        mujoco.mj_inverse(theirs, data)
        effort = np.add(plant.tau_cmd, plant.tau_ext)[order]
        assert deviation(G.T @ data.qfrc_inverse, effort) <= 1e-9
        if len(G) == len(ours):
            data.qfrc_applied = effort
            mujoco.mj_forward(theirs, data)
            assert deviation(np.array(acceleration)[order], data.qacc) <= 1e-9


# --- rigid stops ---


def constrained(M, stopped, right):
    """Return x of M x − E λ = b, Eᵀ x = 0, where E selects the stopped joints."""
    E = np.eye(len(M))[:, stopped.astype(bool)]
    matrix = np.block([[M, -E], [E.T, np.zeros((E.shape[1],) * 2)]])
    return np.linalg.solve(matrix, right)[: len(M)]


def conditions(reference, q, v, a_free, W, a, low, high, held):
    """The complementarity conditions of stops, with M by Pinocchio."""
    for i in np.flatnonzero((q <= low) | (q >= high)).tolist():
        side = -1.0 if q[i] >= high[i] else 1.0
        assert side * v[i] >= -1e-12
        if v[i] == 0.0:
            assert side * a[i] >= -1e-9 * max(1.0, np.abs(a_free).max())
    force = np.linalg.solve(W, a - a_free)
    size = max(1.0, np.abs(force).max())
    for i in range(len(q)):
        side = -1.0 if q[i] >= high[i] else 1.0
        if held[i]:
            assert a[i] == 0.0 and side * force[i] >= -1e-9 * size
        else:
            assert abs(force[i]) <= 1e-9 * size


@pytest.mark.parametrize("name", EVERY_ROBOT)
def test_stops_satisfy_their_complementarity_conditions(name):
    """Several joints at their limits move and are pressed in both directions; impulses are included."""
    native, rng = engine(name, "effort"), np.random.default_rng(3)
    several = 0
    for _ in range(50):
        plant = model(name, "effort").plant()
        q = rng.uniform(-1, 1, native.n)
        v = rng.normal(0, 1, native.n) * (rng.random(native.n) < 0.7)
        at = rng.integers(-1, 2, native.n)  # at the lower limit, at none, at the upper one
        low, high = np.where(at < 0, q, q - 1.0), np.where(at > 0, q, q + 1.0)
        plant.q, plant.v, plant.q_min, plant.q_max = (list(part) for part in (q, v, low, high))
        plant.tau_cmd, plant.friction = rng.normal(0, 50, native.n).tolist(), [0.0] * native.n
        values, a, held = native.values(plant), np.empty(native.n), np.empty(native.n)
        native.call("stopped", values, np.zeros(native.n, np.int32), a, held)
        after = native.group(values, "v")
        reference = plant.robot.model.copy()
        reference.gravity.linear = np.array(plant.gravity)
        reference = Reduced(reference, name)
        M = reference.mass_matrix(q)
        impulse = M @ (after - v)
        size = max(1.0, np.abs(impulse).max())
        for i in range(native.n):
            if at[i] == 0:
                assert abs(impulse[i]) <= 1e-11 * size
            else:
                assert -at[i] * impulse[i] >= -1e-11 * size
                assert impulse[i] * after[i] == pytest.approx(0.0, abs=1e-10 * size)
        damping = np.array(plant.robot.damping)
        effort = plant.tau_cmd - damping * after
        free = reference.forward_dynamics(q, after, effort)
        conditions(reference, q, after, free, np.linalg.inv(M), a, low, high, held)
        kkt = constrained(M, held, np.r_[M @ free, np.zeros(int(held.sum()))])
        assert deviation(M @ a, M @ kkt) <= 1e-11
        struck = (at != 0) & (after == 0.0)
        plastic = constrained(M, struck, np.r_[M @ v, np.zeros(struck.sum())])
        assert deviation(M @ after, M @ plastic) <= 1e-11
        several += held.sum() > 1
        kinetic = 0.5 * after @ M @ after - 0.5 * v @ M @ v
        assert kinetic <= 1e-9 * max(1.0, 0.5 * v @ M @ v)
    assert several or native.n < 3


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.parametrize("name", ["twodof", "ur5", "panda"])
def test_stops_are_the_same_in_both_flavours(name, rigid):
    """This includes friction, joints without range, and held joints."""
    native, rng = engine(name, "effort"), np.random.default_rng(6)
    for _ in range(50):
        plant = model(name, "effort").plant()
        plant.rigid_stops, n = rigid, native.n
        q = rng.uniform(-1, 1, n)
        v = rng.normal(0, 1, n) * (rng.random(n) < 0.7)
        at = rng.integers(-1, 3, n)  # at the lower limit, at none, at the upper one, at both
        low, high = np.where(np.abs(at) == 1, q - (at > 0), q - 1.0), q + (at <= 0)
        low = np.where(at == 2, q, low)
        plant.q, plant.v, plant.q_min, plant.q_max = (list(part) for part in (q, v, low, high))
        plant.tau_cmd = rng.normal(0, 50, n).tolist()
        plant.friction = (rng.uniform(0, 30, n) * (rng.random(n) < 0.7)).tolist()
        kept = rng.random(n) < 0.2
        values, a, held = native.values(plant), np.empty(n), np.empty(n)
        native.call("stopped", values, kept.astype(np.int32), a, held)
        stops, y = plant.stops(), [*q, *v]
        stops.impact(y, kept.tolist())
        if any(0.0 < abs(speed) < 1e-12 for speed in y[n:]):
            continue  # rounding says whether it rests
        slip = stops.slide(y[n:])
        rates = list(plant.equations_of_motion().acceleration(np.array(y[:n]), np.array(y[n:]), None, slip)[0])
        grips = stops.hold(y, rates, kept.tolist())
        assert deviation(y[n:], native.group(values, "v")) <= 1e-9
        assert stops.held == np.flatnonzero(held).tolist()
        rubs = [not rigid and (rest == STUCK or slips != 0) for rest, slips in zip(stops.rest, stops.slip)]
        assert stops.watched == [i for i in stops.held if not kept[i] and (low[i] < high[i] or rubs[i])]
        assert deviation(rates, a) <= 1e-9
        assert len(grips) == 2 * len(stops.watched)
        largest = max((grip for grip in grips if grip < np.inf), default=0.0)
        assert not [grip for grip in grips if grip < -1e-9 * largest]


@pytest.mark.parametrize(("name", "together"), [("twodof", 2), ("ur5", 4), ("panda", 5)])
def test_joints_pressed_and_released_in_any_order_do_not_depend_on_the_step(name, together):
    """Efforts reverse at random in a narrow range; no joint passes its limit at any step."""
    native, rng = engine(name, "effort"), np.random.default_rng(0)
    plant = model(name, "effort").plant()
    q = rng.uniform(-1, 1, native.n)
    plant.q, plant.q_min, plant.q_max = q.tolist(), (q - 0.1).tolist(), (q + 0.1).tolist()
    plant.rtol, plant.atol = 1e-10, 1e-12
    inertia = np.diag(Reduced(plant.robot.model, name).mass_matrix(q))
    turns = rng.choice([-1, 1], (8, native.n)) * rng.uniform(5, 20, (8, native.n)) * inertia
    at = [i for i, variable in enumerate(native.model.table) if variable.group == "tau_cmd"]
    runs, patterns = [], set()
    for parts in (1, 4):
        values, rows = native.values(plant), []
        for values[at] in turns:
            for k in range(1, 10 * parts + 1):
                assert native.call("advance", values, 0.01 / parts) == 1
                q, v = native.group(values, "q"), native.group(values, "v")
                assert (q >= plant.q_min).all() and (q <= plant.q_max).all()
                patterns.add(tuple((q == plant.q_min) | (q == plant.q_max)))
                rows += [] if k % parts else [[*q, *v]]
        runs.append(rows)
    assert max(map(sum, patterns)) >= together and len(patterns) > native.n
    np.testing.assert_allclose(runs[0], runs[1], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", EVERY_ROBOT)
def test_a_fall_into_stops_never_gains_energy(name, length):
    native, rng = engine(name, "effort"), np.random.default_rng(4)
    plant = model(name, "effort").plant()
    reference = plant.robot.model.copy()
    reference.gravity.linear = np.array(plant.gravity)
    reference = Reduced(reference, name)
    plant.rtol, plant.atol = 1e-10, 1e-12
    falls, at_stops = length(100, 10 if name in ("twodof", "ur5", "panda") else 1), 0
    for _ in range(falls):
        q = rng.uniform(-1, 1, native.n)
        plant.q_min, plant.q_max = (q - 0.3).tolist(), (q + 0.3).tolist()
        plant.q, plant.v = q.tolist(), rng.normal(0, 2, native.n).tolist()
        values, before, stopped = native.values(plant), np.inf, False
        for _ in range(100):
            assert native.call("advance", values, 0.01) == 1
            q, v = native.group(values, "q").copy(), native.group(values, "v").copy()
            assert (q >= plant.q_min).all() and (q <= plant.q_max).all()
            stopped |= bool(((q == plant.q_min) | (q == plant.q_max)).any())
            energy = reference.energy(q, v)
            scale = max(1.0, abs(energy))
            assert energy <= before + 1e-9 * scale
            before = energy
        at_stops += stopped
    assert at_stops > 0.9 * falls
