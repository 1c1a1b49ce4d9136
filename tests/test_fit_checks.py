"""Recordings whose efforts, locks or runs do not fit: refused in a line, or named."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from motions import bag_of
from test_fit import ARM, GRAVITY, JOINTS

import twodof
from twodof.errors import InputError
from twodof.identification.recording_checks import check_external

HORIZONTAL = (0.0, 0.0, -9.81)
LIFT = """<robot name="lift"><link name="base"/><link name="car"><inertial><mass value="5"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="car"/><axis xyz="0 0 1"/>
  <limit lower="-0.5" upper="0.5" effort="500" velocity="10"/></joint></robot>"""


def motion(urdf: Path, gravity: tuple[float, ...], armature: float = 0.004) -> tuple[Any, Any]:
    """Positions and efforts in 30 s at 100 Hz, with friction and with noise."""
    model = pin.buildModelFromUrdf(str(urdf))
    model.gravity.linear = np.array(gravity)
    data, t, rng = model.createData(), 0.01 * np.arange(3000)[:, None], np.random.default_rng(0)
    w, phase = rng.uniform(1.0, 7.0, (4, model.nv)), rng.uniform(0.0, 6.0, (4, model.nv))
    waves = np.exp(1j * (t[:, None] * w + phase)) * 0.5 / w
    q, v, a = (np.sum((1j * w) ** k * waves, axis=1).real for k in range(3))
    tau = np.array([pin.rnea(model, data, *each) for each in zip(q, v, a)])
    tau += 0.05 * np.sign(v) + 0.01 * v + armature * a
    return q + 1e-4 * rng.normal(size=q.shape), tau * (1.0 + 0.02 * rng.normal(size=q.shape))


@pytest.mark.parametrize("gravity", [HORIZONTAL, GRAVITY], ids=["no load", "load"])
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda tau: 1000.0 * tau, "times those of the URDF's masses: they are probably not in N·m, but for example"),
        (lambda tau: 0.001 * tau, "for example in kN·m, a factor of 1000"),
        (lambda tau: tau * [1.0, -1.0], "efforts of joint 'joint2' have the opposite sign"),
        (lambda tau: -tau, "efforts of joints 'joint1', 'joint2' have the opposite sign"),
        (lambda tau: tau[:, ::-1], "of joints 'joint1', 'joint2' seem to be those of joints 'joint2', 'joint1', in"),
    ],
    ids=["N·mm", "kN·m", "one sign", "all signs", "order"],
)
def test_efforts_in_another_unit_sign_or_order_are_refused(gravity, wrong, words, tmp_path):
    """Without a load by gravity, the inertial effects that an armature does not have are compared."""
    q, tau = motion(ARM, gravity)
    with pytest.raises(InputError, match="bag': the recorded efforts ") as caught:
        twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, q, wrong(tau)), "friction[*]", gravity=gravity)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("length", "force", "words"),
    [
        (1000.0, 1.0, "and its limits -0.5 and 0.5 m: they are probably in mm; convert them"),
        (1.0, 0.001, "they are probably not in N, but for example in kN, a factor of 1000"),
        (1.0, 1.0, ""),
        (1.0, -1.0, ""),
    ],
    ids=["mm", "kN", "right", "counterweight"],
)
def test_units_of_a_sliding_joint_are_checked(length, force, words, tmp_path):
    """A counterweight may be heavier than the URDF's masses."""
    urdf = tmp_path / "lift.urdf"
    urdf.write_text(LIFT, "utf-8")
    q, tau = motion(urdf, HORIZONTAL, armature=2.0)
    bag = bag_of(tmp_path / "bag", ["rail"], length * q, force * tau)
    if not words:
        twodof.fit(urdf, bag, "friction[*]")
        return
    with pytest.raises(InputError) as caught:
        twodof.fit(urdf, bag, "friction[*]")
    assert words in str(caught.value)


def test_efforts_that_are_late_at_one_joint_are_named(tmp_path):
    q, tau = motion(ARM, GRAVITY)
    t = 0.01 * np.arange(len(q))
    tau[:, 1] = np.interp(t - 0.004, t, tau[:, 1])
    free = ["friction[*]", "damping[*]", "armature[*]"]
    result = twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, q, tau), free, gravity=GRAVITY)
    assert {each.name for each in result.suspects} >= {"delay:joint1", "delay:joint2"} and not result.explains
    assert "stamps of the efforts of joint 'joint2' that need about -" in str(result)


@pytest.mark.parametrize(("angle", "named"), [(0.3, False), (-0.2, True)])
def test_a_lock_at_another_position_is_named(angle, named, tmp_path):
    q, tau = motion(ARM, GRAVITY)
    q[:, 1] = 0.3
    result = twodof.fit(
        ARM, bag_of(tmp_path / "bag", JOINTS, q, tau), "friction[1]", gravity=GRAVITY, lock={"joint2": angle}
    )
    assert (f"joint 'joint2' is locked at {angle:g}, but is between 0.3 and 0.3 in" in str(result)) is named


def test_runs_with_external_efforts_or_different_gravity_are_refused(tmp_path):
    fmu = twodof.build_fmu(tmp_path / "Arm.fmu", twodof.FmuOptions(control="joint"))

    def run(name: str, *changes: Any, **settings: Any) -> Path:
        bag = twodof.Bag(tmp_path / name, effort=True)
        twodof.run(fmu, bag, changes=changes, settings=settings, stop_time=0.05)
        return tmp_path / name

    for bag, effort in (
        (run("a", tau_ext=[0.0, 0.1]), "tau_ext[2]"),
        (run("b", (0.03, {"f_ext[2]": 1.0})), "f_ext[2]"),
    ):
        with pytest.raises(InputError) as caught:
            twodof.fit(ARM, bag, "friction[*]")
        assert f"the run has an external effort, {effort}, which a fit does not know: repeat" in str(caught.value)
    with pytest.raises(InputError, match=r"gravity, \(0, -9.81, 0\) m/s² and \(0, 0, -9.81\) m/s²: fit them"):
        twodof.fit(ARM, [run("c"), run("d", gravity=[*HORIZONTAL], q_start=[0.1, 0.2])], "friction[*]", gravity=GRAVITY)
    system = {"start_values": {"plant.tau_ext[1]": 0.0}, "system": {"connections": ["wind.force -> plant.f_ext"]}}
    joined: Any = SimpleNamespace(path=Path("bag"), provenance=system)
    with pytest.raises(InputError, match=r"wind\.force -> plant\.f_ext, which a fit does not know"):
        check_external(joined)
