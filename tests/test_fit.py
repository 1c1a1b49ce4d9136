"""Fits to recordings by MuJoCo, with masses, friction and a payload that the URDF does not have."""

from __future__ import annotations

import json
import re
import signal
import struct
import tracemalloc
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import scipy.optimize
import scipy.signal
from bags import FOOTER, HEADER, channel, chunk, message, record, texts
from motions import assert_true, bag_of, follow, move, mujoco_model, noisy

import twodof
from twodof.bag.mcap import zstd
from twodof.cli.main import main
from twodof.errors import BagError, InputError
from twodof.identification import curves as prediction_curves
from twodof.identification import estimate as estimation
from twodof.identification import fitting, parameters, stretches
from twodof.identification.estimate import estimate
from twodof.identification.fitted_urdf import fitted_urdf
from twodof.identification.fitting import read_model
from twodof.identification.inertials import dynamic_parameters
from twodof.identification.model_tests import Misfit, Suspect
from twodof.identification.regression import modelled, rows_of
from twodof.plant.urdf import read_urdf

ARM = Path(__file__).parents[1] / "urdf" / "2dof.urdf"
GRAVITY = (0.0, -9.81, 0.0)
TRUTH = {
    "friction[1]": 0.08, "friction[2]": 0.05, "damping[1]": 0.02, "damping[2]": 0.01,
    "armature[1]": 0.002, "armature[2]": 0.001, "payload": 0.15,
}  # fmt: skip
JOINTS = ("joint1", "joint2")
FREE = ("friction[*]", "damping[*]", "armature[*]", "payload")
HIDDEN: dict[str, Any] = {
    "gravity": GRAVITY, "friction": [0.08, 0.05], "damping": [0.02, 0.01], "armature": [0.002, 0.001],
}  # fmt: skip


WHEEL = """<robot name="wheel"><link name="base"/><link name="rim"><inertial><mass value="1"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hub" type="continuous"><parent link="base"/><child link="rim"/><axis xyz="0 0 1"/>
  <limit effort="10" velocity="10"/></joint></robot>"""


def arm_motion(seed: int = 0, seconds: float = 30.0, hindered: Any = None, **changed: Any) -> Any:
    hidden = {"payload": 0.15, "end": "EndEffector", **HIDDEN, **changed}
    model = mujoco_model(ARM.read_text("utf-8"), **hidden)
    return move(model, [-0.5, 0.6], 0.8, seconds, seed=seed, fastest=2.0, hindered=hindered)


@pytest.fixture(scope="module")
def motion() -> Any:
    return arm_motion()


@pytest.fixture(scope="module")
def bag(motion: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag whose joints are in another order, with a joint that the robot does not have."""
    q, effort = noisy(motion)
    other = np.zeros((len(q), 1))
    columns = [np.hstack([each[:, ::-1], other]) for each in (q, effort)]
    return bag_of(tmp_path_factory.mktemp("fit") / "bag", [*JOINTS[::-1], "gripper"], *columns)


def test_the_command_writes_a_folder_whose_robot_moves_as_recorded(bag, tmp_path, capsys):
    free = [word for pattern in FREE for word in ("--free", pattern)]
    gravity = ["--gravity", *map(str, GRAVITY)]
    assert main(["fit", str(ARM), str(bag), *free, *gravity, "-o", str(tmp_path / "fitted")]) == 0
    printed = capsys.readouterr().out
    facts = json.loads((tmp_path / "fitted" / "fit.json").read_text("utf-8"))
    assert [p["name"] for p in facts["parameters"]] == list(TRUTH) and facts["explains"]
    assert all(re.search(rf"^{re.escape(name)} +0 ", printed, re.MULTILINE) for name in TRUTH), printed
    assert "jumps" not in printed and printed.count("--gravity 0.0 -9.81 0.0") == 1
    assert "does not explain" not in printed and "--set armature=" in printed and "--set payload=" in printed
    for joint in JOINTS:
        assert facts["held_out"]["after"][joint] < 0.05 * facts["held_out"]["before"][joint]
    robot = tmp_path / "fitted" / "robot.urdf"
    fmu = twodof.build_fmu(
        tmp_path / "Fitted.fmu",
        twodof.FmuOptions(urdf=robot, mesh_dir=ARM.parents[1] / "meshes", settings=facts["settings"], control="effort"),
    )
    starts = {name: float(str(twodof.load_fmu(fmu).variables[name].start)) for name in TRUTH}
    assert starts["friction[1]"] == pytest.approx(0.08, rel=0.1)
    assert starts["payload"] == pytest.approx(0.15, rel=0.01)


def test_hidden_values_are_found(bag):
    assert_true(twodof.fit(ARM, bag, FREE, gravity=GRAVITY), TRUTH)


def test_of_a_long_recording_evenly_spread_parts_are_used(bag, monkeypatch, caplog):
    for name, value in (("MOST_FITTED", 1500), ("MOST_HELD", 300), ("PIECE", 400)):
        monkeypatch.setattr(stretches, name, value)
    result = twodof.fit(ARM, bag, FREE, gravity=GRAVITY)
    assert "samples for the fit, 1500 are used, evenly spread in pieces" in caplog.text
    for limit, curves in (
        (1500, [c for c in result.curves if not c.measured.size]),
        (300, [c for c in result.curves if c.measured.size]),
    ):
        assert 0.95 * limit < sum(len(c.t) for c in curves) <= limit
        begins = np.diff([c.t[0] for c in curves])
        assert np.ptp(begins) < 0.1 and begins.mean() > 2.0
    for p in result.parameters:
        assert abs(p.after - TRUTH[p.name]) <= 4.0 * p.deviation


@pytest.mark.parametrize(("free", "columns"), [(["friction[*]"], 0), (["mass:link1"], 10), (["payload"], 10)])
def test_rows_have_columns_of_the_links_that_vary_alone(bag, free, columns):
    """Those of all links take gigabytes for 60 joints; the efforts are the same."""
    whole = read_model(ARM, [*free, "inertia:*"]).parameters(GRAVITY)
    some = read_model(ARM, free).parameters(GRAVITY)
    fitted, _ = stretches.stretches([twodof.read_bag(bag)], some.robot)
    values = some.dynamics(some.start)
    for few, all_rows in zip(*(rows_of(each, values, fitted, 0.0, True) for each in (some, whole))):
        assert (few.Y.shape[1], all_rows.Y.shape[1]) == (columns + 1, 21)
        np.testing.assert_allclose(modelled(few, values), modelled(all_rows, values), atol=1e-12)


def test_a_derivative_recomputes_the_changed_link_alone(monkeypatch):
    """A robot may have 1000 links; the derivatives are those of all values by central differences."""
    free = ["mass:*", "com:*", "inertia:*", "payload", "payload_com", "friction[*]"]
    given = read_model(ARM, free, frame="EndEffector").parameters(GRAVITY)
    own, x, _ = given.with_errors(given.coordinates({"friction": np.ones(2)})[0] + 0.1)
    calls = count()
    monkeypatch.setattr(parameters, "dynamic_parameters", lambda *a: (next(calls), dynamic_parameters(*a))[1])
    reported, rates = own.rates(x)
    assert next(calls) <= len(x) + len(own.links) + 1
    for k, step in enumerate(1e-6 * np.eye(len(x))):
        up, down = own.values(x + step), own.values(x - step)
        np.testing.assert_allclose(reported[:, k], (own.reported(up) - own.reported(down)) / 2e-6, atol=1e-7)
        for rate, a, b in zip(rates, own.dynamics(up), own.dynamics(down)):
            np.testing.assert_allclose(rate[..., k], (a - b) / 2e-6, atol=1e-7)


def test_a_fit_needs_a_tenth_of_the_dynamics_evaluations_of_finite_differences(bag, monkeypatch):
    """An evaluation is one call of Pinocchio for one sample; with differences, each residual is an inverse dynamics."""
    model, calls, residuals = read_model(ARM, FREE, gravity=GRAVITY), count(), count()
    fitted, _ = stretches.stretches([twodof.read_bag(bag)], model.robot)
    free = model.parameters(GRAVITY)
    for name in ("computeJointTorqueRegressor", "computeRNEADerivatives"):
        own = getattr(pin, name)
        monkeypatch.setattr(pin, name, lambda *values, own=own: (next(calls), own(*values))[1])
    exact, evaluations = estimate(free, fitted), next(calls)

    def by_differences(errors: Any, inside: Any, rates: Any, **options: Any) -> Any:
        return scipy.optimize.least_squares(lambda z: (next(residuals), errors(z))[1], inside, "2-point", **options)

    monkeypatch.setattr(estimation, "least_squares", by_differences)
    other = estimate(free, fitted)
    assert np.all(np.abs(other.x - exact.x) <= 0.01 * np.sqrt(np.diag(exact.covariance)))
    assert 10 * evaluations <= next(residuals) * sum(len(each.t) for each in fitted)


def test_only_numbers_of_the_urdf_change():
    """The text has what an XML writer changes: white space outside the root, quotes, line ends, <a /> and <a></a>."""
    text = re.sub(r'(?<=link name)="link2"', "\n =\t'link2' note='> value=\"9\"'", ARM.read_text("utf-8"))
    text = text.replace("<inertial>", "<inertial><!-- > <mass value='9'/> --><![CDATA[<mass value='9'/>]]>")
    text = text.replace("<mass value=", "<mass\n value  =  ").replace("/>", " />")
    text = text.replace("<limit", "<safety_controller></safety_controller><limit")
    text = f"\ufeff{text}\n<!-- 1 -->\n\n<?x 2?>  \n".replace("\n", "\r\n")
    free, values = ("friction[*]", "mass:*", "com:link2", "inertia:link2"), []
    model = read_model(ARM, free)
    parameters, urdf = model.parameters(GRAVITY), read_urdf(text)
    for factor in (1.0, 1.01):
        x = parameters.coordinates({"friction": np.ones(2)})[0]
        values.append(parameters.values(factor * x + 0.01))
    first, second = (fitted_urdf(text, urdf, parameters, each).decode() for each in values)
    number = r"-?\d+\.?\d*(?:e[-+]?\d+)?"
    added = re.sub(r"\r\n *<dynamics friction=[^>]*/>", "", first)
    assert first.count("<dynamics friction=") == 2 and first != second
    assert re.sub(number, "#", text) == re.sub(number, "#", added)
    again = read_urdf(first)
    assert fitted_urdf(first, again, parameters, values[0]).decode() == first
    assert fitted_urdf(first, again, parameters, values[1]).decode() == second
    masses = [mass.get("value", "") for mass in again.tree.iterfind("link/inertial/mass")]
    assert [*map(float, masses)] == pytest.approx(values[0].mass)


def test_two_recordings_have_narrower_intervals_than_each(motion, bag, tmp_path):
    q, effort = noisy(arm_motion(seed=1))
    other = bag_of(tmp_path / "other", JOINTS, q, effort)
    one, two, both = (twodof.fit(ARM, bags, FREE, gravity=GRAVITY) for bags in (bag, other, [bag, other]))
    for first, second, joint in zip(one.parameters, two.parameters, both.parameters):
        together = (first.deviation**-2 + second.deviation**-2) ** -0.5
        assert joint.deviation == pytest.approx(together, rel=0.25), joint.name
        assert abs(joint.after - TRUTH[joint.name]) < 3.0 * joint.deviation


def test_a_hidden_spring_is_reported_with_its_joint(tmp_path):
    q, effort = noisy(arm_motion(stiffness=[0.0, 0.1]))
    result = twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, q, effort), FREE, gravity=GRAVITY)
    assert not result.explains
    assert any("does not explain" in line and "'joint2'" in line for line in result.remarks)
    assert "look like a spring of about 0.099 N·m/rad at joint 'joint2' (it is not part of the model); if" in str(
        result
    )


def test_a_payload_that_is_not_free_is_the_error_that_the_residuals_look_like(bag, motion, tmp_path):
    result = twodof.fit(ARM, bag, FREE[:-1], gravity=GRAVITY)
    assert "the residuals look like a payload of about +0.15 kg (free 'payload', or correct the masses); if" in str(
        result
    )
    q, effort = noisy(motion)
    sprung = bag_of(tmp_path / "bag", JOINTS, q, effort + 0.05 * q * [1.0, 0.0])
    result = twodof.fit(ARM, sprung, (*FREE, "bias:*"), gravity=GRAVITY)
    assert result.suspects[0].name == "spring:joint1"
    assert result.suspects[0].size == pytest.approx(0.05, rel=0.2)


def test_uneven_stamps_leave_values_in_their_intervals():
    """Efforts are MuJoCo's inverse dynamics and Coulomb friction, at stamps that are off by up to 40 % of a step."""
    hidden = {key: value for key, value in HIDDEN.items() if key != "friction"}
    model = mujoco_model(ARM.read_text("utf-8"), payload=0.15, end="EndEffector", **hidden)
    friction = np.array([0.4, 0.25])
    data, truth, fit = mujoco.MjData(model), np.array([*friction, *[*TRUTH.values()][2:]]), read_model(ARM, FREE)
    parameters, errors = fit.parameters(GRAVITY), []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        t = 0.02 * (np.arange(1000) + rng.uniform(-0.4, 0.4, 1000))
        w, phase = rng.uniform(0.4, 6.0, (4, 2)), rng.uniform(0.0, 2.0 * np.pi, (4, 2))
        waves = 0.25 * np.exp(1j * (w * t[:, None, None] + phase))
        q, v, a = (np.sum((1j * w) ** k * waves, axis=1).real for k in range(3))
        effort = np.sign(v) * friction
        for k in range(len(t)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
            mujoco.mj_inverse(model, data)
            effort[k] += data.qfrc_inverse
        q, effort = noisy((q, v, effort), seed, part=0.002)
        recording: Any = SimpleNamespace(path="bag", joints=JOINTS, t=t - t[0], q=q, tau=effort)
        found = estimate(parameters, stretches.stretches([recording], fit.robot)[0])
        errors.append((parameters.reported(found.values) - truth) / np.sqrt(np.diag(found.covariance)))
    assert np.mean(np.abs(errors) < 1.96) > 0.9 and np.abs(errors).max() < 4.0, np.round(errors, 1)


def test_an_error_that_the_residuals_look_like_hides_no_other_one(bag):
    """A wrong mass of a link that is not free looks like wrong efforts."""
    result = twodof.fit(ARM, bag, FREE, gravity=GRAVITY)
    suspects = (Suspect("gain:joint2", 0.6931, 1e-9),)
    remarks = replace(result, misfits=(Misfit(1, 0.01, 9.0, 1e-12, 0.007),), suspects=suspects).remarks
    assert "explains these data only roughly, worst at joint 'joint2'" in remarks[0]
    assert "look like efforts of joint 'joint2' that need about +100 %" in remarks[1]
    assert "mass or centre of a link that is not free" in remarks[1]


@pytest.mark.parametrize(
    ("name", "size", "words"),
    [
        ("gravity", 0.01, "a base that is tilted by about "),
        ("offset:joint2", 0.02, "positions of joint 'joint2' that need about +0.0"),
        ("gain:joint2", 0.02, "efforts of joint 'joint2' that need about +"),
        ("clock", 0.01, "speeds that need about +1"),
    ],
)
def test_a_small_error_of_the_model_is_named_and_widens_the_intervals(name, size, words, motion, tmp_path):
    """Each error moves a value by many deviations, and the effort by less than 2 %."""
    q, effort = noisy(motion, part=0.005)
    stamps = 10**18 + np.rint((1.0 + size * (name == "clock")) * 1e7 * np.arange(len(q))).astype(int)
    gravity = (9.81 * np.sin(size), -9.81 * np.cos(size), 0.0) if name == "gravity" else GRAVITY
    q, effort = q - [0.0, size * ("offset" in name)], effort / [1.0, 1.0 + size * ("gain" in name)]
    bag = bag_of(tmp_path / "bag", JOINTS, q, effort, stamps)
    result = twodof.fit(ARM, bag, FREE, gravity=gravity)
    (suspect,) = (each for each in result.suspects if each.name == name)
    assert abs(suspect.size) == pytest.approx(size, rel=0.3)
    assert not result.explains and "residuals are noise" not in str(result)
    assert any(words in line for line in result.remarks)
    for p in result.parameters:
        assert abs(p.after - TRUTH[p.name]) <= 3.0 * p.deviation, (p, TRUTH[p.name])
    if name != "clock":
        free = twodof.fit(ARM, bag, (*FREE, name), gravity=gravity)
        assert free.explains and "residuals are noise" in free.remarks[0]


DRY = np.array(HIDDEN["friction"])
DRAGS: dict[str, Any] = {
    "speed": lambda data, load: 0.1 * DRY * data.qvel * np.abs(data.qvel),
    "direction": lambda data, load: 0.1 * DRY,
    "load": lambda data, load: 0.03 * np.abs(load) * np.tanh(data.qvel / 1e-3),
}


@pytest.mark.parametrize(
    ("error", "words"),
    [
        ("speed", "damping of joint 'joint"),
        ("direction", ""),
        ("load", "friction of joint 'joint"),
        ("bias", ""),
        ("large bias", "efforts of joint 'joint1' that are about 0.0"),
        ("gain", "efforts of all joints that need about +"),
        ("filter", "efforts behind a filter with a time constant of about 2"),
    ],
)
def test_an_error_of_the_model_is_named_or_can_be_a_parameter(error, words, motion, tmp_path):
    """Values are 6 to 68 deviations off without both. A small bias, also of friction, looks like a payload."""
    q, v, effort = arm_motion(seconds=60.0, hindered=DRAGS[error]) if error in DRAGS else motion
    if "bias" in error:
        effort = effort + (0.005 if error == "bias" else 0.04) * np.sqrt(np.mean(effort**2, axis=0))
    elif error == "gain":
        effort = effort / 1.05
    elif error == "filter":  # of 30 ms, between samples along a line
        decay = np.exp(-0.01 / 0.03)
        mean = 3.0 * (1.0 - decay)
        effort = scipy.signal.lfilter([1.0 - mean, mean - decay], [1.0, -decay], effort - effort[0], axis=0) + effort[0]
    free = (*FREE, "bias:*") if error in ("direction", "bias") else FREE
    result = twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, *noisy((q, v, effort))), free, gravity=GRAVITY)
    assert words in str(result) and result.explains is not bool(words)
    most = 4.0 if error == "filter" else 3.0  # the test of a filter has its effect in the second order alone
    for p in (p for p in result.parameters if p.name in TRUTH):
        assert abs(p.after - TRUTH[p.name]) <= most * p.deviation, (p, TRUTH[p.name])


def paused_motion(move: float, pause: float, seconds: float) -> Any:
    """The arm's motion along sums of sines, with pauses that begin and end within 0.1 s."""
    model = mujoco_model(ARM.read_text("utf-8"), payload=0.15, end="EndEffector", **HIDDEN)
    rng = np.random.default_rng(0)
    omega, phase = 4.0 * np.pi * rng.uniform(0.1, 1.0, (5, 2)), rng.uniform(0.0, 2.0 * np.pi, (5, 2))
    reaches = 0.4 * rng.uniform(0.5, 1.0, (5, 2)) * omega.min(axis=0) / omega
    t = 1e-3 * np.arange(round(1000.0 * seconds) + 1)
    knots = np.cumsum([0.0, move, 0.1, pause, 0.1])
    speed = 0.5 + 0.5 * np.cos(np.pi * np.interp(t % knots[-1], knots, [0.0, 0.0, 1.0, 1.0, 2.0]))
    way, rate = np.cumsum(speed) * 1e-3, np.gradient(speed, 1e-3)

    def target(now: float) -> Any:
        k = round(1000.0 * now)
        waves = reaches * np.exp(1j * (omega * way[k] + phase))
        q, v, a = (np.sum((1j * omega) ** order * waves, axis=0).imag for order in range(3))
        return np.add(q, [-0.5, 0.6]), v * speed[k], a * speed[k] ** 2 + v * rate[k]

    return follow(model, target, seconds, target(0.0)[0])


def test_short_pauses_do_not_look_like_a_filter():
    """Short stretches of motion reached beyond the band, into the edge of the filter of positions."""
    q, v, effort = paused_motion(0.4, 0.1, 60.0)
    model = read_model(ARM, FREE)
    free = model.parameters(GRAVITY)
    for seed in range(3):
        measured, efforts = noisy((q, v, effort), seed, part=0.003)
        recording: Any = SimpleNamespace(path="bag", joints=JOINTS, t=0.01 * np.arange(len(q)), q=measured, tau=efforts)
        found = estimate(free, stretches.stretches([recording], model.robot)[0])
        assert not found.suspects and not found.holds
        deviations = np.sqrt(np.diag(found.covariance))
        assert (np.abs(free.reported(found.values) - [*TRUTH.values()]) <= 4.0 * deviations).all()
        assert deviations[4] < 0.012 * TRUTH["armature[1]"]


def test_a_joint_that_rests_under_more_than_its_friction_is_named(tmp_path):
    """A brake: at rest, the effort is 0.2 N·m off, and friction 0.08 N·m holds at most that on either side."""
    q, v, effort = paused_motion(1.0, 1.0, 40.0)
    rests = np.abs(v[:, 0]) < 1e-3
    braked = effort - np.outer(rests, [0.2, 0.0])
    for tau, holds in ((effort, False), (braked, True)):
        bag = bag_of(tmp_path / f"bag{holds}", JOINTS, *noisy((q, v, tau)))
        result = twodof.fit(ARM, bag, FREE, gravity=GRAVITY)
        assert_true(result, TRUTH)
        assert [JOINTS[hold.joint] for hold in result.holds] == ["joint1"] * holds
        assert ("a brake holds the joint" in str(result)) is holds is not result.explains
        assert all(0.04 < hold.excess <= 0.2 and rests[round(100 * hold.t)] for hold in result.holds)


@pytest.mark.parametrize(("load", "holds"), [(1.97, 0), (2.1, 1)])
def test_noise_of_positions_does_not_look_like_a_load_at_rest(load, holds, tmp_path):
    """A wheel with friction of 2 N·m moves and rests for 0.8 s each; samples of its acceleration have much noise."""
    urdf, rng = tmp_path / "wheel.urdf", np.random.default_rng(0)
    urdf.write_text(WHEEL.replace('izz="0.1"', 'izz="0.5"'), "utf-8")
    t = np.arange(0.0, 32.0, 0.002)[:, None]
    s, turns = np.minimum(t % 1.6, 0.8) / 0.8, np.where(t % 3.2 < 1.6, 1.0, -1.0)
    q = turns * (s**3 * (10.0 - 15.0 * s + 6.0 * s**2) - 0.5)
    a = turns * 60.0 * s * (1.0 - 3.0 * s + 2.0 * s**2) / 0.64
    tau = 0.5 * a + np.where(s < 1.0, 2.0 * turns, load) + 0.02 * rng.normal(size=t.shape)
    q += 1e-4 * rng.normal(size=t.shape)
    model = read_model(urdf, ["friction[*]", "armature[*]"])
    recording: Any = SimpleNamespace(path="bag", joints=["hub"], t=t[:, 0], q=q, tau=tau)
    found = estimate(model.parameters((0.0, 0.0, -9.81)), stretches.stretches([recording], model.robot)[0])
    assert len(found.holds) == holds and all(hold.excess == pytest.approx(0.1, abs=0.02) for hold in found.holds)


@pytest.mark.parametrize("part", [0.0, 0.5, 0.9])
def test_noise_in_proportion_to_the_effort_has_its_own_weights(part):
    rng, count = np.random.default_rng(7), 4000
    power = rng.exponential(size=count) ** 2
    truth = np.sqrt(1.0 - part + part * power / power.mean())
    rows: Any = SimpleNamespace(bin=np.arange(count) % 6, power=power, tau=np.ones(count))
    found = estimation._deviations(rows, truth * rng.normal(size=count))
    assert np.median(np.abs(found / truth - 1.0)) < 0.05


def test_a_change_that_an_error_too_small_to_see_would_make_is_named(bag):
    """An interval grows by it, if the errors are free."""
    result = twodof.fit(ARM, bag, FREE, gravity=GRAVITY)
    (narrow,) = (p for p in result.parameters if p.name == "payload")
    (wide,) = (p for p in twodof.fit(ARM, bag, (*FREE, "bias:*"), gravity=GRAVITY).parameters if p.name == "payload")
    expected = 1.96 * np.sqrt((wide.deviation / narrow.deviation) ** 2 - 1.0)
    assert result.fragile["payload"] == pytest.approx(expected, rel=0.2) and expected > 3.0
    assert "constant errors of efforts could move payload by" in str(result)


def test_a_joint_that_reverses_too_often_is_refused(bag):
    """It moves in one direction for at most 0.1 s."""
    model = read_model(ARM, FREE)
    fitted, _ = stretches.stretches([twodof.read_bag(bag)], model.robot)
    hasty = [
        each._replace(moving=np.arange(len(each.t))[:, None] % [1000, 14] < 10 * np.array([90, 1])) for each in fitted
    ]
    with pytest.raises(InputError, match="joint 'joint2' reverses too often for a fit: record slower motions of it"):
        estimate(model.parameters(GRAVITY), hasty)


def test_a_constant_error_of_the_efforts_can_be_a_parameter(motion, tmp_path):
    q, effort = noisy(motion)
    bag = bag_of(tmp_path / "bag", JOINTS, q, effort + np.array([0.2, 0.0]))
    result = twodof.fit(ARM, bag, (*FREE, "bias:joint1"), gravity=GRAVITY)
    assert result.explains
    assert_true(result, TRUTH | {"bias:joint1": 0.2})


def test_values_that_have_not_converged_are_not_known(bag, monkeypatch, tmp_path):
    monkeypatch.setattr(estimation, "STEPS", 1)
    monkeypatch.setattr(estimation, "LAST_STEPS", 1)
    result = twodof.fit(ARM, bag, FREE, gravity=GRAVITY)
    assert not result.converged and not result.explains
    assert not any(p.known for p in result.parameters) and str(result).count("not known") == 7
    assert "the fit has not converged, and no value is known" in result.remarks[0]


@pytest.mark.parametrize(("finished", "known"), [(0, None), (2, False), (8, True)])
def test_ctrl_c_leaves_the_best_values_so_far(finished, known, bag, monkeypatch, tmp_path, capsys):
    """The signal comes in a step of the estimation, or in the prediction after it."""
    where, name = (estimation, "_solve") if finished < 8 else (prediction_curves, "predict")
    own, steps = getattr(where, name), count(0 if finished < 8 else 8)

    def interrupted(*arguments: Any) -> Any:
        if next(steps) == finished:
            signal.raise_signal(signal.SIGINT)
        return own(*arguments)

    monkeypatch.setattr(where, name, interrupted)
    free = [word for pattern in FREE for word in ("--free", pattern)]
    output = tmp_path / "fitted"
    words = ["fit", str(ARM), str(bag), *free, "--gravity", *map(str, GRAVITY), "-o", str(output)]
    assert main(words) == 130
    printed = capsys.readouterr().out
    assert [*tmp_path.iterdir()] == [output] * (known is not None)
    if known is None:
        return
    facts = json.loads((output / "fit.json").read_text("utf-8"))
    assert facts["interrupted"] and facts["converged"] is known
    assert "note: the fit was interrupted: " in printed
    assert "<b>The fit was interrupted: " in (output / "fit.html").read_text("utf-8")
    assert {p["known"] for p in facts["parameters"]} == {known} and not facts["held_out"]["after"]
    for p in facts["parameters"]:
        assert p["after"] == pytest.approx(TRUTH[p["name"]], rel=0.3)


def refused(change: str, motion: Any) -> tuple[Any, Any, Any, list[str]]:
    q: Any
    effort: Any
    q, effort = noisy(motion)
    stamps = 10**18 + 10_000_000 * np.arange(len(q))
    names = [*JOINTS]
    if change == "another robot":
        names = ["left", "right"]
    elif change == "short":
        q, effort, stamps = q[:100], effort[:100], stamps[:100]
    elif change == "still":
        q[:, 1] = 0.3 + 1e-4 * np.random.default_rng(0).normal(size=len(q))
    elif change == "spikes":
        q[np.random.default_rng(0).choice(len(q), 6), 1] += 0.3
    elif change == "anew":
        q[1200:, 1] += 0.5 * np.pi
    elif change == "wrapped":
        q[:, 1] = (q[:, 1] - 0.6) % (2.0 * np.pi)
    elif change == "degrees":
        q = np.degrees(q)
    elif change == "nan":
        q[700, 1] = np.nan
    elif change == "huge":
        q[700, 1] = 1e300
    elif change == "millinewton":
        effort = 1000.0 * effort
    elif change == "millinewton of one":
        effort = effort * [1.0, 1000.0]
    elif change == "repeated":
        stamps[500:] -= stamps[500] - stamps[200]
    elif change == "set back":  # by 0.403 s, so that samples are mixed
        stamps[1500:] -= 403_000_000
    elif change == "no efforts":
        effort = None
    elif change == "bursts":  # of 50 samples within 49 ns
        stamps = 10**18 + np.arange(len(q)) + 34_000_000 * (np.arange(len(q)) // 50)
    elif change == "slow":
        stamps = 10**18 + 52_000_000 * np.arange(len(q))
    return q, effort, stamps, names


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("another robot", "has no joint 'joint1'"),
        ("short", "is too short"),
        ("still", "joint 'joint2' never moves"),
        ("spikes", "the position of joint 'joint2' in"),
        ("anew", "the position of joint 'joint2' in"),
        ("wrapped", "jumps by a turn at"),
        ("degrees", "rad: they are probably in degrees"),
        ("nan", "the position of joint 'joint2' at 7 s is not a number: leave this joint state out"),
        ("huge", "the position of joint 'joint2' at 7 s is beyond 1e+100"),
        ("millinewton", "a factor of 1000"),
        ("millinewton of one", "the recorded efforts of joint 'joint2' are"),
        ("repeated", "several joint states at one time"),
        ("set back", "was the clock set back"),
        ("no efforts", "has no efforts"),
        ("bursts", "are uneven: half of the joint states are at most 1e-09 s after the one before"),
        ("slow", "has 19.2 joint states a second; a fit needs 20"),
    ],
)
def test_a_recording_that_cannot_be_fitted_is_refused_in_a_line(change, words, motion, tmp_path, capsys):
    q, effort, stamps, names = refused(change, motion)
    bag = bag_of(tmp_path / "bag", names, q, effort, stamps)
    with pytest.raises(InputError, match=re.escape(words)):
        twodof.fit(ARM, bag, FREE, gravity=GRAVITY, output=tmp_path / "fitted")
    assert not (tmp_path / "fitted").exists()
    assert main(["fit", str(ARM), str(bag), "--free", "payload", "-o", str(tmp_path / "fitted")]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and words in error


def test_patterns_and_folders_are_checked(bag, tmp_path):
    with pytest.raises(InputError, match=r"there are: friction\[1\], friction\[2\], of joints joint1, joint2$"):
        twodof.fit(ARM, bag, "friction[joint9]")
    with pytest.raises(InputError, match=re.escape("'frictoin[1]' matches no parameter; did you mean 'friction[1]'?")):
        twodof.fit(ARM, bag, "frictoin[1]")
    with pytest.raises(InputError, match="'Kp\\*' matches no parameter"):
        twodof.fit(ARM, bag, "Kp*")
    (tmp_path / "mine").mkdir()
    with pytest.raises(InputError, match="exists, and is not replaced"):
        twodof.fit(ARM, bag, "payload", output=tmp_path / "mine")


def test_an_encoders_zero_a_torque_constant_and_a_tilted_base_are_found(motion, tmp_path):
    """Positions are 0.05 rad too small, efforts are divided by 1.1, and the base is tilted by 0.04 rad."""
    q, effort = noisy(motion)
    bag = bag_of(tmp_path / "bag", JOINTS, q - [0.0, 0.05], effort / [1.0, 1.1])
    tilted = (9.81 * np.sin(0.04), -9.81 * np.cos(0.04), 0.0)
    result = twodof.fit(ARM, bag, (*FREE, "offset:joint2", "gain:joint2", "gravity"), gravity=tilted)
    found = {p.name: p for p in result.parameters}
    truth = {**TRUTH, "offset:joint2": 0.05, "gain:joint2": 1.1, "gravity[1]": 0.0, "gravity[2]": -9.81}
    for name, value in truth.items():
        assert abs(found[name].after - value) <= 3.5 * found[name].deviation, (found[name], value)
    assert found["offset:joint2"].deviation < 6e-3 and found["gain:joint2"].deviation < 0.02


def test_a_bag_that_is_given_twice_is_refused(bag):
    with pytest.raises(InputError, match="would count twice; leave one out"):
        twodof.fit(ARM, [bag, bag], FREE, gravity=GRAVITY)
    with pytest.raises(InputError, match=r"`gravity` 0\.0, nan, 0\.0 is not three finite numbers"):
        twodof.fit(ARM, bag, FREE, gravity=(0.0, float("nan"), 0.0))


def test_the_bags_of_a_fit_share_their_limits(tmp_path, monkeypatch):
    """Each of these small bags spends 80 MB of the read budget."""
    bag = bag_of(tmp_path / "bag", JOINTS, np.zeros((10, 2)), np.zeros((10, 2)))
    schema = record(3, struct.pack("<H", 1), texts("std_msgs/msg/String", "ros2msg", ""))
    records = schema + (channel(1, "/x") + message(b"")) * 40_000
    (bag / "bag_1.mcap").write_bytes(HEADER + chunk(zstd.compress(records), len(records), "zstd") + FOOTER)
    with pytest.raises(BagError, match="unpacks to more than 1000 times its size"):
        twodof.fit(ARM, [bag] * 6, FREE)
    (bag / "bag_1.mcap").unlink()
    monkeypatch.setattr(fitting, "MAX_SAMPLES", 40 * len(JOINTS) * 8)
    with pytest.raises(InputError, match=r"the bags to '.*bag' have over 0 MiB of joint states; give fewer$"):
        twodof.fit(ARM, [bag] * 3, FREE)


@pytest.mark.parametrize(
    ("gravity", "given", "friction"),
    [
        ((0.0, 0.0, -9.81), (0.0, 0.0, -9.81), [4.0, 3.0]),
        (GRAVITY, GRAVITY, [0.1, 30.0]),
        (GRAVITY, GRAVITY, [0.5, 0.4]),
        (GRAVITY, (0.0, 0.0, 0.0), [0.5, 0.4]),
    ],
    ids=["no load", "much friction", "tiny load", "gravity of 0"],
)
def test_efforts_of_friction_are_not_taken_for_another_unit(gravity, given, friction, tmp_path):
    """Joints about the vertical carry no load, but by rounding a tiny one; gears may have more friction than load."""
    urdf, t = tmp_path / "arm.urdf", 0.01 * np.arange(3000)[:, None]
    urdf.write_text(ARM.read_text("utf-8").replace('rpy="0 0 0"', 'rpy="1e-6 2e-6 0"'), "utf-8")
    model = pin.buildModelFromUrdf(str(urdf))
    model.gravity.linear = np.array(gravity)
    data, w = model.createData(), np.array([0.9, 1.3])
    q, v, a = np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t)
    tau = np.array([pin.rnea(model, data, *each) for each in zip(q, v, a)]) + friction * np.sign(v)
    found = twodof.fit(urdf, bag_of(tmp_path / "bag", JOINTS, q, tau), "friction[*]", gravity=given)
    if given == gravity:
        assert [each.after for each in found.parameters] == pytest.approx(friction, rel=0.01)
    else:
        assert not found.explains


@pytest.mark.parametrize(("factor", "words"), [(1000.0, "a factor of 1000"), (0.0, "is 0 through")])
def test_the_bag_whose_efforts_have_another_unit_is_named(factor, words, bag, motion, tmp_path):
    q, effort = noisy(motion, 1)
    second = bag_of(tmp_path / "second", JOINTS, q[:2000], factor * effort[:2000])
    with pytest.raises(InputError, match=rf"second': .*{re.escape(words)}"):
        twodof.fit(ARM, [bag, second], FREE, gravity=GRAVITY)


def test_masses_near_zero_are_refused_in_a_line(bag, tmp_path):
    """In SciPy the prior of such masses is infinite."""
    light = tmp_path / "light.urdf"
    light.write_text(re.sub(r'mass value="[^"]*"', 'mass value="1e-300"', ARM.read_text("utf-8")), "utf-8")
    with pytest.raises(InputError, match="masses, efforts or speeds are too large or too small"):
        twodof.fit(light, bag, "*")


def test_efforts_that_jump_between_samples_are_named(tmp_path):
    """The target of a continuous controller jumps twice a second; the bag has 100 samples a second."""
    fmu = twodof.build_fmu(tmp_path / "Arm.fmu", twodof.FmuOptions(native=True, settings={"armature": [0.004, 0.004]}))
    way = np.random.default_rng(3).uniform([-2.0, 0.1], [2.0, 0.26], (20, 2))
    places = way[:, 1:] * np.column_stack([np.cos(way[:, 0]), np.sin(way[:, 0])])
    changes = [(0.5 * k, {"x_des[1]": x, "x_des[2]": y}) for k, (x, y) in enumerate(places.tolist())]
    twodof.run(fmu, twodof.Bag(tmp_path / "bag", effort=True), changes=changes, stop_time=10.0)
    result = twodof.fit(ARM, tmp_path / "bag", "armature[*]", gravity=GRAVITY)
    assert set(result.jumps) == {*JOINTS} and all((t / 0.5) % 1.0 < 0.05 for t in result.jumps.values())
    assert not result.explains
    assert "the effort of joint 'joint1' jumps between samples, most at" in str(result)


def test_damping_of_a_robot_of_one_joint_is_found(tmp_path):
    """A wheel on a vertical axis: the effort is I a + d v."""
    urdf = tmp_path / "wheel.urdf"
    urdf.write_text(WHEEL, "utf-8")
    t = np.linspace(0.0, 20.0, 2001)[:, None]
    q, v, a = np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t)
    result = twodof.fit(urdf, bag_of(tmp_path / "bag", ["hub"], q, 0.1 * a + 0.3 * v), "damping[*]")
    (damping,) = result.parameters
    assert damping.after == pytest.approx(0.3, abs=1e-3)
    wrapped = (q + 3.0 + np.pi) % (2.0 * np.pi) - np.pi  # an encoder of one turn
    assert np.ptp(np.diff(wrapped, axis=0)) > 6.0
    bag = bag_of(tmp_path / "wrapped", ["hub"], wrapped, 0.1 * a + 0.3 * v)
    assert twodof.fit(urdf, bag, "damping[*]").parameters[0].after == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize("encoder", ["one turn", "many turns"])
@pytest.mark.parametrize(("jitter", "kept"), [(0.0, 1.0), (0.4, 1.0), (0.0, 0.9)], ids=["even", "uneven", "lost"])
def test_positions_of_a_fast_joint_are_unwrapped_only_if_they_wrap(encoder, jitter, kept):
    rng = np.random.default_rng(4)
    t = 0.04 * (np.arange(500) + jitter * rng.uniform(-1.0, 1.0, 500))[rng.random(500) < kept]
    robot: Any = SimpleNamespace(joints=("j",), prismatic=(False,), q_min=(-1.8e308,), q_max=(1.8e308,))
    recording: Any = SimpleNamespace(t=t, path="bag")
    speed = 25.0 if encoder == "one turn" else 165.0  # rad/s: up to a sixth, or a turn, between two samples
    q = (speed / 1.3 * np.sin(1.3 * t) + 0.3)[:, None]
    measured = (q + np.pi) % (2.0 * np.pi) - np.pi if encoder == "one turn" else q
    found = stretches._unwrapped(recording, robot, measured)
    np.testing.assert_allclose(np.diff(found, axis=0), np.diff(q, axis=0), atol=1e-9)


def test_a_recording_of_a_very_high_rate_is_reduced_to_the_band():
    t = 1e-5 * np.arange(400_000) + 0.1
    q, tau = np.sin(3.0 * t)[:, None], np.cos(3.0 * t)[:, None]
    recording: Any = SimpleNamespace(t=t, q=q, tau=tau, joints=("j",), path="fast")
    robot: Any = SimpleNamespace(joints=("j",), prismatic=(True,), q_min=(-2.0,), q_max=(2.0,))
    fitted, _ = stretches.stretches([recording], robot)
    assert fitted[0].step == pytest.approx(1.0 / stretches.MOST_RATE)
    assert sum(len(each.t) for each in fitted) == pytest.approx(2000 * (0.8 * 4.0 - stretches.EDGE), abs=250)
    for each in fitted:
        np.testing.assert_allclose(each.v[:, 0], 3.0 * np.cos(3.0 * each.t), atol=2e-3)
        np.testing.assert_allclose(each.tau[:, 0], np.cos(3.0 * each.t), atol=1e-6)


def test_a_pause_that_a_slow_recording_has_between_all_samples_is_no_gap():
    t = 1e-3 * np.arange(10_000)
    t = t[np.arange(len(t)) % 1000 > 8]  # 9 ms are missing in each second
    q, tau = np.sin(3.0 * t)[:, None], np.cos(3.0 * t)[:, None]
    recording: Any = SimpleNamespace(t=t, q=q, tau=tau, joints=("j",), path="hurried")
    robot: Any = SimpleNamespace(joints=("j",), prismatic=(True,), q_min=(-2.0,), q_max=(2.0,))
    (fitted,), _ = stretches.stretches([recording], robot)
    np.testing.assert_allclose(fitted.v[:, 0], 3.0 * np.cos(3.0 * fitted.t), atol=2e-3)


def test_samples_near_rest_are_found_whatever_the_window() -> None:
    moving = np.random.default_rng(1).random((60, 2)) > 0.1
    for reach in (0, 1, 3, 100):
        near = [moving[max(0, k - reach) : k + reach + 1].all(axis=0) for k in range(len(moving))]
        np.testing.assert_array_equal(stretches._eroded(moving, reach), near)
    assert stretches._eroded(moving[:0], 3).shape == (0, 2)
    assert not stretches._eroded(moving, 10**13).any()  # a window of this size does not fit into memory


def test_one_of_millions_of_wrong_values_is_named_without_a_list_of_all() -> None:
    wrong = np.full((300_000, 2), np.nan)
    parts: Any = SimpleNamespace(path="bag", joints=("a", "b"), q=wrong, tau=wrong, t=np.arange(300_000.0))
    tracemalloc.start()
    with pytest.raises(InputError, match="'bag': the position of joint 'a' at 0 s is not a number"):
        stretches._columns(parts, parts)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 * wrong.nbytes
