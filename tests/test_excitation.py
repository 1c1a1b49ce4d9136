"""Designed motions: their limits, and fits to MuJoCo's recordings of them."""

from __future__ import annotations

import re
from typing import Any

import mujoco
import numpy as np
import pytest
from bags import STORE
from motions import assert_true, bag_of, follow, mujoco_model
from rosbags.rosbag2 import Reader
from scipy.interpolate import make_interp_spline
from test_fit import ARM, FREE, GRAVITY, HIDDEN, JOINTS, TRUTH

import twodof
from twodof.bag.trajectory_bag import TOPIC
from twodof.cli.main import main
from twodof.errors import InputError
from twodof.identification import excitation


def test_a_motion_is_smooth_and_within_the_limits(tmp_path):
    """Efforts are MuJoCo's. The limits are so narrow that each of them is active."""
    text = ARM.read_text("utf-8")
    for low, high, effort, speed in ((-0.2, 1.0, 0.5, 1.5), (0.1, 0.9, 0.004, 20.0)):
        limit = f'lower="{low}" upper="{high}" effort="{effort}" velocity="{speed}"'
        text = re.sub(r"<limit [^@]*?/>", f"<limit @ {limit}/>", text, count=1)
    (tmp_path / "arm.urdf").write_text(text.replace("<limit @", "<limit"), "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(excitation, "GENERATIONS", 1)
        motion = twodof.excite(tmp_path / "arm.urdf", 10.0, "friction[*]", gravity=(0, 0, 0))
    model = mujoco_model(text.replace("<limit @", "<limit"), gravity=(0, 0, 0))
    data, efforts = mujoco.MjData(model), []
    for q, v, a in zip(motion.q, motion.v, motion.a):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(model, data)
        efforts.append(data.qfrc_inverse.copy())
    used = [
        np.abs(motion.q - [0.4, 0.5]).max(axis=0) / [0.6, 0.4],
        np.abs(motion.v).max(axis=0) / [1.5, 20.0],
        np.abs(efforts).max(axis=0) / [0.5, 0.004],
    ]
    assert np.max(used) <= 0.9 + 1e-6 and (np.max(used, axis=0) > 0.85).any(), used
    spline = make_interp_spline(motion.t, motion.q, 5)
    np.testing.assert_allclose(spline(motion.t, 1), motion.v, atol=1e-4)
    np.testing.assert_allclose(spline(motion.t, 2)[5:-5], motion.a[5:-5], atol=1e-2)
    for each in (motion.v, motion.a, motion.q - [0.4, 0.5]):
        np.testing.assert_allclose(each[[0, -1]], 0.0, atol=1e-9)


def test_intervals_are_narrower_than_with_random_motions(tmp_path, monkeypatch):
    """The noise of efforts is the same for all motions."""
    monkeypatch.setattr(excitation, "GENERATIONS", 40)
    designed = twodof.excite(ARM, 20.0, FREE, gravity=GRAVITY)
    rng, recorded = np.random.default_rng(5), []
    k, t, path = np.array([1, 2, 3, 7, 11, 20]), designed.t[::5], designed.q[::5]
    for number in range(4):
        q = path
        if number:  # random, within the same limits of position
            waves = np.sin(np.pi / 10.0 * np.outer(t, k)) @ rng.normal(size=(6, 2))
            q = waves * np.abs(path).max(axis=0) / np.abs(waves).max(axis=0)
        splines = [make_interp_spline(t, q, 5).derivative(order) for order in range(3)]
        model = mujoco_model(ARM.read_text("utf-8"), payload=0.15, end="EndEffector", **HIDDEN)
        recorded.append(follow(model, lambda t, splines=splines: [each(t) for each in splines], 20.0, q[0]))
    noise = 0.02 * np.sqrt(np.mean(recorded[1][2] ** 2, axis=0))
    deviations = []
    for number, (q, _, effort) in enumerate(recorded):
        q, effort = q + 1e-4 * rng.normal(size=q.shape), effort + noise * rng.normal(size=q.shape)
        result = twodof.fit(ARM, bag_of(tmp_path / f"bag{number}", JOINTS, q, effort), FREE, gravity=GRAVITY)
        assert_true(result, TRUTH) if not number else None
        deviations.append([p.deviation for p in result.parameters])
    gain = np.exp(np.mean(np.log(np.array(deviations[1:]) / deviations[0]), axis=1))
    assert designed.factor > 1.9 and gain.min() > 1.25, (designed.factor, gain)


def test_the_command_writes_inputs_of_a_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(excitation, "GENERATIONS", 1)
    motion = twodof.excite(ARM, 20.0, FREE, gravity=GRAVITY, output=tmp_path / "motion.csv")
    free = [word for pattern in FREE for word in ("--free", pattern)]
    output, gravity = tmp_path / "excite.csv", [*map(str, GRAVITY)]
    assert main(["fit", str(ARM), "--design", "20", *free, "--gravity", *gravity, "-o", str(output)]) == 0
    printed = capsys.readouterr().out
    assert f"intervals {motion.factor:.3g} times narrower" in printed
    assert output.read_bytes() == (tmp_path / "motion.csv").read_bytes()
    assert "--control joint --set q_start=0,0 " in printed
    options = twodof.FmuOptions(native=True, control="joint", q_start=(0.0, 0.0), settings={"friction": [0.08, 0.05]})
    fmu = twodof.build_fmu(tmp_path / "Arm.fmu", options)
    command = [
        "run",
        str(fmu),
        "--input",
        str(output),
        "--stop-time",
        "20",
        "--step",
        "0.002",
        "--effort",
        "-o",
        str(tmp_path / "bag"),
    ]
    assert main(command) == 0
    fit = twodof.fit(ARM, tmp_path / "bag", "friction[*]", gravity=GRAVITY)
    assert [p.after for p in fit.parameters] == pytest.approx([0.08, 0.05], rel=0.02)


def test_a_bag_has_the_motion_as_a_trajectory_that_a_run_follows(tmp_path, monkeypatch, capsys):
    """rosbags reads it by its own types."""
    monkeypatch.setattr(excitation, "GENERATIONS", 1)
    motion, words = twodof.excite(ARM, 5.0, "friction[*]", gravity=GRAVITY), ["--gravity", *map(str, GRAVITY)]
    words = ["fit", str(ARM), "--design", "5", "--free", "friction[*]", *words, "-o", str(tmp_path / "excite")]
    assert main(words) == 0
    with Reader(tmp_path / "excite") as reader:
        ((connection, _, data),) = reader.messages()
        message: Any = STORE.deserialize_cdr(data, connection.msgtype)
    assert (connection.topic, connection.msgtype) == (TOPIC, "trajectory_msgs/msg/JointTrajectory")
    times = [point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in message.points]
    assert message.joint_names == [*JOINTS] and times == pytest.approx(motion.t[::5].tolist(), abs=1e-9)
    for name, values in (("positions", motion.q), ("velocities", motion.v), ("accelerations", motion.a)):
        np.testing.assert_array_equal([getattr(point, name) for point in message.points], values[::5])
    fmu = twodof.build_fmu(tmp_path / "Arm.fmu", twodof.FmuOptions(native=True, control="joint", q_start=(0.0, 0.0)))
    command = ["run", str(fmu), "--input", str(tmp_path / "excite"), "--stop-time", "5", "--step", "0.002"]
    assert main([*command, "-o", str(tmp_path / "bag")]) == 0
    np.testing.assert_allclose(twodof.read_bag(tmp_path / "bag").q, motion.q, atol=1e-4)
    capsys.readouterr()
    assert main(words) == 1
    assert "exists, and is not replaced" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--design", "2"], "a motion of 2 s is not possible: between 5 and 120 s"),
        (["--design", "nan"], "a motion of nan s is not possible"),
        (["bag", "--design", "20"], "and not both"),
        ([], "name bags of the robot, or a motion to record with --design S"),
        (["--design", "20", "-o", "missing/excite.csv"], "cannot write 'missing/excite.csv'"),
        (["--design", "20", "-o", "missing/excite"], "cannot write 'missing/excite'"),
        (["--design", "20", "--gravity", "nan", "0", "0"], "is not three finite numbers"),
        (["--design", "20", "--gravity", "0", "-999", "0"], "does not hold the robot in the middle of its range"),
    ],
)  # fmt: skip
def test_a_design_that_is_not_possible_is_refused_in_a_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(excitation, "GENERATIONS", 1)
    monkeypatch.chdir(tmp_path)
    assert main(["fit", str(ARM), *words, "--free", "payload"]) in (1, 2)
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not [*tmp_path.iterdir()]


def test_a_joint_whose_range_is_0_is_named(tmp_path):
    """Many URDFs have limits of 0 as placeholders."""
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(re.sub('lower="[^"]*" upper="[^"]*"', 'lower="0" upper="0"', ARM.read_text("utf-8"), count=1))
    with pytest.raises(InputError, match="joint 'joint1', with the joints that mimic it, has a range of 0"):
        twodof.excite(urdf, 5.0, "payload")


def test_the_work_of_a_search_is_limited(monkeypatch, caplog):
    """Two seconds of processor time for each step would be hours for a humanoid."""
    steps: list[tuple[int, int]] = []
    monkeypatch.setattr(excitation, "MOST_WORK", 30 * 5 * 50 * 2 * 2 * 22)

    def design() -> None:
        twodof.excite(ARM, 5.0, "friction[*]", gravity=GRAVITY, progress=lambda *of: steps.append(of))

    design()
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert "the search for the motion ends after 3 of 60 steps, because 2 parameters of 2 joints" in caplog.text
    monkeypatch.setattr(excitation, "MOST_WORK", 30 * 3 * 50 * 2 * 2 * 22 - 1)
    with pytest.raises(InputError, match="2 parameters of 2 joints takes too long to design; `free` fewer"):
        design()
