"""Fits to bags without efforts: the control law of the run gives them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from bags import joint_message, write_third_party
from motions import assert_true, bag_of, mujoco_model, noisy
from test_fit import ARM, FREE, GRAVITY, HIDDEN, JOINTS, TRUTH, arm_motion

import twodof
from twodof.cli.main import main
from twodof.errors import InputError
from twodof.identification.commanded import commanded_efforts

SETTINGS: dict[str, Any] = {"friction": 0.05, "payload": 0.15, "limit_effort": True}
TARGETS = {"joint": {"q_des[1]": 0.9}, "task": {"x_des[1]": 0.25}, "effort": {"tau_cmd[1]": 0.3}}


@pytest.mark.parametrize("control", TARGETS)
def test_efforts_are_those_that_the_run_recorded(control, tmp_path):
    fmu = twodof.build_fmu(tmp_path / "A.fmu", twodof.FmuOptions(native=True, control=control, settings=SETTINGS))
    changes = [(0.1, TARGETS[control]), (0.3, {name: 0.9 * value for name, value in TARGETS[control].items()})]
    twodof.run(fmu, twodof.Bag(tmp_path / "bag", effort=True), changes=changes, stop_time=0.6, step=0.01)
    recorded = twodof.read_bag(tmp_path / "bag")
    before, after = commanded_efforts(recorded)
    np.testing.assert_allclose(before, recorded.tau, atol=1e-12)
    assert np.flatnonzero((before != after).any(axis=1)).tolist() == [10, 30]


def test_held_targets_of_an_own_run_do_not_look_like_a_wrong_clock(tmp_path):
    """Its recorded efforts are those at the end of each hold, up to 4 % of the inertial effort off the mean."""
    t = 0.002 * np.arange(7500)
    q = 0.3 * np.sin(np.outer(t, [5.3, 6.1])) + 0.6 * np.sin(np.outer(t, [2.1, 1.7]))
    names = ["q_des[1]", "q_des[2]", "v_des[1]", "v_des[2]"]
    rows = np.hstack([q, np.gradient(q, t, axis=0)]).tolist()
    hidden = {"friction": [0.08, 0.05], "payload": 0.15, "q_start": [0.0, 0.0]}
    fmu = twodof.build_fmu(tmp_path / "A.fmu", twodof.FmuOptions(native=True, control="joint", settings=hidden))
    changes = [(s, dict(zip(names, row))) for s, row in zip(t.tolist(), rows)]
    twodof.run(fmu, twodof.Bag(tmp_path / "bag", effort=True), changes=changes, stop_time=15.0, step=0.002)
    result = twodof.fit(ARM, tmp_path / "bag", ["friction[*]", "damping[*]", "armature[*]", "payload"], gravity=GRAVITY)
    assert result.explains and abs(result.delay[0]) < 1e-4
    truth = {name: 0.0 for name in TRUTH} | {name: TRUTH[name] for name in ("friction[1]", "friction[2]", "payload")}
    assert_true(result, truth)
    assert all(p.deviation < 1e-4 for p in result.parameters)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 30 s of MuJoCo's arm, with hidden parameters, and with noise in the controller's measurements."""
    folder = tmp_path_factory.mktemp("commanded")
    t = 0.01 * np.arange(3001)
    q = 0.3 * np.sin(np.outer(t, [5.3, 6.1])) + 0.6 * np.sin(np.outer(t, [2.1, 1.7]))
    v = np.gradient(q, t, axis=0)
    names = ["q_des[1]", "q_des[2]", "v_des[1]", "v_des[2]"]
    changes = [(s, dict(zip(names, row))) for s, row in zip(t.tolist(), np.hstack([q, v]).tolist())]
    gains = {"Kp": 400.0, "q_start": [0.0, 0.0]}
    fmu = twodof.build_fmu(folder / "Arm.fmu", twodof.FmuOptions(native=True, control="joint", settings=gains))
    twodof.run(fmu, twodof.Bag(folder / "run"), changes=changes, stop_time=30.0, step=0.01)

    known = mujoco_model(ARM.read_text("utf-8"), gravity=GRAVITY)
    model = mujoco_model(ARM.read_text("utf-8"), payload=TRUTH["payload"], end="EndEffector", **HIDDEN)
    data, own, M = mujoco.MjData(model), mujoco.MjData(known), np.zeros((2, 2))
    rng, messages = np.random.default_rng(0), []
    for k in range(60_001):
        own.qpos[:], own.qvel[:] = data.qpos + 1e-4 * rng.normal(size=2), data.qvel + 1e-2 * rng.normal(size=2)
        now = k // 20
        mujoco.mj_forward(known, own)
        mujoco.mj_fullM(known, own, M)
        tau = M @ (400.0 * (q[now] - own.qpos) + 40.0 * (v[now] - own.qvel)) + own.qfrc_bias
        if k % 20 == 0:
            stamp = 10**18 + 500_000 * k
            message = joint_message(stamp, JOINTS, own.qpos.copy(), own.qvel.copy(), ())
            messages.append(("/joint_states", stamp, message))
            command = joint_message(stamp, JOINTS, q[now], v[now], ())
            messages.append(("/joint_commands", stamp, command))
        data.qfrc_applied[:] = tau
        mujoco.mj_step(model, data, nstep=5)
    path = write_third_party(folder / "bag", messages)
    run = json.loads((folder / "run" / "run.json").read_text("utf-8"))
    (path / "run.json").write_text(json.dumps(run | {"verdict": None}), "utf-8")
    return path


def test_friction_and_payload_are_found_without_efforts(bag):
    assert not twodof.read_bag(bag).tau.size
    assert_true(twodof.fit(ARM, bag, FREE, gravity=GRAVITY), TRUTH)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (None, "its commands are no efforts: give the gains of joint control with `settings`, such as Kp=100"),
        ({"control_period": 0.01}, "its controller is sampled"),
        ({"Kp[1]": None}, "do not determine them"),
    ],
)
def test_a_bag_without_efforts_or_their_law_is_refused(change, message, bag, tmp_path):
    copy = shutil.copytree(bag, tmp_path / "bag")
    run = json.loads((copy / "run.json").read_text("utf-8"))
    if change is None:
        (copy / "run.json").unlink()
    else:
        starts = {name: value for name, value in (run["start_values"] | change).items() if value is not None}
        (copy / "run.json").write_text(json.dumps(run | {"start_values": starts}), "utf-8")
    with pytest.raises(InputError, match=message):
        twodof.fit(ARM, copy, FREE, gravity=GRAVITY)


def test_commands_and_gains_of_a_third_party_bag_give_its_efforts(bag, tmp_path, capsys):
    copy = shutil.copytree(bag, tmp_path / "bag")
    (copy / "run.json").unlink()
    words = ["fit", str(ARM), str(copy), *[w for name in FREE for w in ("--free", name)], "-o", str(tmp_path / "out")]
    words += ["--gravity", *map(str, GRAVITY)]
    assert main(words) == 1
    assert "with --set, such as Kp=100 and Kd=20" in capsys.readouterr().err
    assert main([*words, "--set", "Kp=400", "--set", "Kd=40"]) == 0
    for p in json.loads((tmp_path / "out" / "fit.json").read_text("utf-8"))["parameters"]:
        assert abs(p["after"] - TRUTH[p["name"]]) <= 3.0 * p["deviation"], p


def test_commanded_efforts_of_a_third_party_bag_are_fitted(tmp_path):
    """The first command comes after 1 s, and the last one before the end."""
    q, effort = noisy(arm_motion())
    messages = []
    for k, (position, command) in enumerate(zip(q, effort)):
        stamp = 10**18 + 10_000_000 * k
        messages.append(("/joint_states", stamp, joint_message(stamp, JOINTS, position, (), ())))
        if 100 <= k < 2900:
            messages.append(("/joint_commands", stamp, joint_message(stamp, JOINTS[::-1], (), (), command[::-1])))
    path = write_third_party(tmp_path / "bag", messages)
    result = twodof.fit(ARM, path, FREE, gravity=GRAVITY)
    assert_true(result, TRUTH)
    assert result.delay[0] == pytest.approx(-0.0045, abs=1e-3)  # the mean of two commands is half a step late


def test_a_third_party_bag_without_efforts_and_commands_is_refused(tmp_path):
    q, _ = noisy(arm_motion(seconds=5.0))
    with pytest.raises(InputError, match="record the efforts, or the topic /joint_commands"):
        twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, q, None), FREE, gravity=GRAVITY)
