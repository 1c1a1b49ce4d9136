"""Recordings whose efforts, locks or runs do not fit: refused in a line, or named."""

from __future__ import annotations

from collections.abc import Callable
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
FRICTION = ("friction[*]", "damping[*]", "armature[*]")
LIFT = """<robot name="lift"><link name="base"/><link name="car"><inertial><mass value="5"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="car"/><axis xyz="0 0 1"/>
  <limit lower="-0.5" upper="0.5" effort="500" velocity="10"/></joint></robot>"""


def motion(
    urdf: Path, gravity: tuple[float, ...], armature: float = 0.004, last: Callable[[Any], Any] = lambda own: own
) -> tuple[Any, Any]:
    """Positions and efforts in 30 s at 100 Hz, with friction and with noise; ``last`` changes the last link."""
    model = pin.buildModelFromUrdf(str(urdf))
    model.inertias[model.njoints - 1] = last(model.inertias[model.njoints - 1])
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


def with_mass(mass: float, x: float) -> Callable[[Any], Any]:
    """Add a point mass to a link, at x in its frame."""
    return lambda own: own + pin.Inertia(mass, np.array([x, 0.0, 0.0]), np.zeros((3, 3)))


def mirrored(own: Any) -> Any:
    """The link with its centre of mass on the other side of its joint."""
    return pin.Inertia(own.mass, own.lever * [-1.0, 1.0, 1.0], own.inertia)


OPPOSITE: dict[str, tuple[Callable[[Any], Any], tuple[str, ...]]] = {
    "tool": (with_mass(0.4, -0.05), ("payload", "payload_com")),
    "long tool": (with_mass(0.4, -0.15), ("payload", "payload_com")),
    "centre": (mirrored, ("com:link2",)),
    "tool, as the link": (with_mass(0.4, -0.05), ("com:*", "mass:*")),
    "counterweight": (with_mass(1.5, -0.1), ("mass:*", "com:*")),
}
"""Last links whose load by gravity has the opposite sign of that in the URDF, and free parameters that explain it."""


@pytest.mark.parametrize("case", OPPOSITE)
def test_a_load_that_the_free_parameters_reverse_is_fitted(case, tmp_path):
    last, free = OPPOSITE[case]
    q, tau = motion(ARM, GRAVITY, last=last)
    result = twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, q, tau), (*free, *FRICTION), gravity=GRAVITY)
    assert not any(misfit.bad for misfit in result.misfits)
    assert "opposite sign" not in str(result) and "wrong sign" not in str(result)
    model = pin.buildModelFromUrdf(str(ARM))
    fitted = pin.buildModelFromXML(result.fitted_urdf.decode())
    moment, found = (each.mass * each.lever[0] for each in (last(model.inertias[2]), fitted.inertias[2]))
    values = {p.name: p.after for p in result.parameters}
    found += values.get("payload", 0.0) * (0.15 + values.get("payload_com[1]", 0.0))
    assert found == pytest.approx(moment, rel=0.02)
    assert values["friction[2]"] == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize("case", OPPOSITE)
@pytest.mark.parametrize("joint", [0, 1])
def test_reversed_efforts_are_refused_whatever_the_free_parameters(case, joint, tmp_path):
    """Friction and inertia show the sign, because they cannot be negative."""
    last, free = OPPOSITE[case]
    q, tau = motion(ARM, GRAVITY, last=last)
    tau[:, joint] *= -1.0
    with pytest.raises(InputError, match=f"efforts of joint '{JOINTS[joint]}' .* sign"):
        twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, q, tau), free, gravity=GRAVITY)


def test_a_load_whose_cause_is_not_free_is_not_refused(tmp_path):
    """Neither the recorded nor the reversed efforts are those of the URDF."""
    q, tau = motion(ARM, GRAVITY, last=with_mass(0.4, -0.05))
    result = twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, q, tau), "friction[*]", gravity=GRAVITY)
    assert not result.explains and "nor an unknown load, reverse the efforts" in str(result)


ROD = """<robot name="rod"><link name="base"/><link name="rod"><inertial><origin xyz="0.1 0 0"/><mass value="{0}"/>
  <inertia ixx="{1}" iyy="{1}" izz="{1}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
  <limit lower="-5" upper="5" effort="50" velocity="10"/></joint></robot>"""


@pytest.mark.parametrize(
    ("mass", "zero", "factor", "free", "truth", "remarked"),
    [
        (1.0, 0.0, 1000.0, "gain:*", 0.001, True),
        (0.001, 0.0, 1.0, "mass:*", 1.0, True),
        (1.0, 2.5, 1.0, "offset:*", 2.5, False),
    ],
    ids=["motor currents", "no masses in the URDF", "zero of the encoder"],
)
def test_units_and_signs_that_free_parameters_explain_are_not_refused(
    mass, zero, factor, free, truth, remarked, tmp_path
):
    """With free gains or masses, the data do not show whether the unit is wrong."""
    true, given = tmp_path / "true.urdf", tmp_path / "rod.urdf"
    true.write_text(ROD.format(1.0, 0.001), "utf-8")
    given.write_text(ROD.format(mass, 0.001 * mass), "utf-8")
    q, tau = motion(true, HORIZONTAL)
    result = twodof.fit(given, bag_of(tmp_path / "bag", ["hinge"], q - zero, factor * tau), (free, *FRICTION))
    assert next(p for p in result.parameters if p.name.startswith(free[:-1])).after == pytest.approx(truth, rel=0.02)
    assert ("an unknown load, convert them" in str(result)) is remarked


def test_a_joint_may_rest_in_one_of_two_bags_with_a_tool(tmp_path):
    model, tool = pin.buildModelFromUrdf(str(ARM)), with_mass(0.4, -0.05)
    model.gravity.linear, model.inertias[2], data = np.array(GRAVITY), tool(model.inertias[2]), model.createData()
    q, tau = motion(ARM, GRAVITY, last=tool)
    angle, still = 4.0 * 0.01 * np.arange(len(q)), np.zeros((len(q), 1))
    states = (np.hstack([still + c, 0.5 * each[:, None]]) for c, each in (
        (0.3, np.sin(angle)), (0.0, 4.0 * np.cos(angle)), (0.0, -16.0 * np.sin(angle))))  # fmt: skip
    rest, v, a = states
    load = np.array([pin.rnea(model, data, *each) for each in zip(rest, v, a)])
    load += [0.0, 0.05] * np.sign(v) + [0.0, 0.01] * v + [0.0, 0.004] * a
    bags = [bag_of(tmp_path / "a", JOINTS, q, tau), bag_of(tmp_path / "b", JOINTS, rest, load)]
    result = twodof.fit(ARM, bags, ("payload", "payload_com", *FRICTION), gravity=GRAVITY)
    assert "sign" not in str(result)
    assert next(p for p in result.parameters if p.name == "payload").after == pytest.approx(0.4, rel=0.02)


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
