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
from motions import assert_true, mujoco_model
from test_fit import ARM, FREE, GRAVITY, HIDDEN, JOINTS, TRUTH

import twodof
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
    held = ~np.isin(np.arange(61), [0, 10, 30])  # a run records the effort before a change
    np.testing.assert_allclose(commanded_efforts(recorded)[held], recorded.tau[held], atol=1e-12)


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
        (None, "record the effort of each JointState, or a run with `effort`"),
        ({"control_period": 0.01}, "its controller is sampled"),
        ({"Kp[1]": None}, "does not"),
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
