"""Recordings of a robot by MuJoCo, with masses, friction and a payload that its URDF does not have."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from bags import joint_message, write_third_party

import twodof

Array = np.ndarray


def mujoco_model(
    text: str, *, payload: float = 0.0, end: str = "", com: Sequence[float] = (0, 0, 0), **dof: Any
) -> Any:
    """MuJoCo's model of a URDF, in steps of 0.1 ms; ``dof`` are friction, damping, armature, stiffness and gravity."""
    root = ET.fromstring(text)
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    if payload:
        inertial = ET.SubElement(ET.SubElement(root, "link", name="hidden"), "inertial")
        ET.SubElement(inertial, "mass", value=repr(payload))
        ET.SubElement(inertial, "inertia", ixx="1e-9", iyy="1e-9", izz="1e-9", ixy="0", ixz="0", iyz="0")
        joint = ET.SubElement(root, "joint", name="hidden_joint", type="fixed")
        ET.SubElement(joint, "parent", link=end)
        ET.SubElement(joint, "child", link="hidden")
        ET.SubElement(joint, "origin", xyz=" ".join(str(float(c)) for c in com))
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", {"balanceinertia": "false"})
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    model.opt.timestep, model.opt.gravity[:] = 1e-4, dof.get("gravity", (0, 0, -9.81))
    model.dof_frictionloss[:], model.dof_solref[:, 0] = dof.get("friction", 0.0), 1e-3
    model.dof_damping[:], model.dof_armature[:] = dof.get("damping", 0.0), dof.get("armature", 0.0)
    model.jnt_stiffness[:], model.jnt_limited[:] = dof.get("stiffness", 0.0), 0
    # friction yields in proportion to the compiled inverse inertia, which does not include the armature
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def move(
    model: Any,
    home: Sequence[float],
    reach: float,
    seconds: float,
    *,
    seed: int = 0,
    fastest: float = 1.0,
    hindered: Callable[[Any, Array], Array] | None = None,
) -> Any:
    """Positions, velocities and efforts at 100 Hz while a controller with a period of 1 ms follows sums of sines.

    Args:
        model: MuJoCo's.
        home: positions about which joints move.
        reach: of the slowest sine of each joint, rad.
        seconds: duration.
        seed: of frequencies and phases.
        fastest: frequency, Hz.
        hindered: as for ``follow``.
    """
    rng, n = np.random.default_rng(seed), model.nv
    omega = 2.0 * np.pi * rng.uniform(0.1, 1.0, (5, n)) * fastest
    phase = rng.uniform(0.0, 2.0 * np.pi, (5, n))
    reaches = 0.5 * reach * rng.uniform(0.5, 1.0, (5, n)) * omega.min(axis=0) / omega

    def target(t: float) -> tuple[Array, Array, Array]:
        ramp, angle = min(1.0, t / 2.0), omega * t + phase
        q = home + ramp * (reaches * np.sin(angle)).sum(axis=0)
        v = ramp * (reaches * omega * np.cos(angle)).sum(axis=0)
        return q, v, -ramp * (reaches * omega**2 * np.sin(angle)).sum(axis=0)

    return follow(model, target, seconds, home, hindered)


def follow(
    model: Any,
    target: Any,
    seconds: float,
    home: Sequence[float],
    hindered: Callable[[Any, Array], Array] | None = None,
) -> Any:
    """Positions, velocities and efforts at 100 Hz while a controller with a period of 1 ms follows a target.

    Args:
        model: MuJoCo's.
        target: function of the time, s, to positions and their two derivatives.
        seconds: duration.
        home: positions at the beginning.
        hindered: function of MuJoCo's data and of the load, the effort of the links, that returns what the robot takes
            from the efforts, each 1 ms.
    """
    data, M, samples = mujoco.MjData(model), np.zeros((model.nv, model.nv)), []
    data.qpos[:] = home
    for k in range(round(seconds * 1000)):
        q, v, a = target(data.time)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        effort = M @ (a + 40.0 * (v - data.qvel) + 400.0 * (q - data.qpos)) + data.qfrc_bias
        if k % 10 == 0:
            samples.append(np.array([data.qpos, data.qvel, effort]))
        load = (M - np.diag(model.dof_armature)) @ a + data.qfrc_bias
        data.qfrc_applied[:] = effort - (hindered(data, load) if hindered else 0.0)
        mujoco.mj_step(model, data, nstep=10)
    return np.array(samples).transpose(1, 0, 2)


def noisy(motion: Any, seed: int = 0, part: float = 0.02) -> tuple[Array, Array]:
    """Positions and efforts with the noise of encoders, 1e-4 rad, and of torque sensors, a part of the effort."""
    rng, (q, _, effort) = np.random.default_rng(seed), motion
    return q + 1e-4 * rng.normal(size=q.shape), effort * (1.0 + part * rng.normal(size=q.shape))


def bag_of(path: Path, joints: Sequence[str], q: Array, effort: Array | None, stamps: Array | None = None) -> Path:
    """A bag by rosbags, of positions and efforts at 100 Hz or at stamps, ns."""
    stamps = 10**18 + 10_000_000 * np.arange(len(q)) if stamps is None else stamps
    efforts = np.empty((len(q), 0)) if effort is None else effort
    rows = zip(stamps.tolist(), q, efforts)
    return write_third_party(path, [("/joint_states", t, joint_message(t, joints, a, (), b)) for t, a, b in rows])


def assert_true(result: twodof.Fit, truth: dict[str, float]) -> None:
    """Assert that each parameter is within three standard deviations, and within 3 % if these are smaller."""
    assert truth.keys() == {p.name for p in result.parameters}
    for p in result.parameters:
        assert p.known and abs(p.after - truth[p.name]) <= 3.0 * p.deviation, (p, truth[p.name])
        if 3.0 * p.deviation <= 0.03 * abs(truth[p.name]):
            assert abs(p.after / truth[p.name] - 1.0) <= 0.03, (p, truth[p.name])
