"""Runs that are repeated without each of the causes of a failure."""

from __future__ import annotations

import itertools
import json
import re
from functools import partial
from math import cos, sin
from pathlib import Path
from typing import Any

import pytest
from failures import AT_UR5, UR5
from native_models import robots_folder

import twodof
from twodof.cli.main import main
from twodof.errors import SimulationError
from twodof.simulation.judge import Judge
from twodof.simulation.remedies import Repetition
from twodof.simulation.repetition import TOO_LONG, Repeater

CIRCLE = 0.06  # m
FOLDED = (0.0, 1.5, -1.5, 0.0, 0.0, 0.0, -0.5)
REACHED_OUT = {"q_des": (0.3, 1.2, -1.2, 0.2, 0.2, 0.2, -0.3)}
"""A start and a target of a Z1, whose URDF has friction and damping."""


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Build native FMUs of the default arm under both controls, its system of two FMUs, and a UR5's pose control."""
    folder = tmp_path_factory.mktemp("native")
    ur5 = {"urdf": robots_folder() / UR5, "frame": "ee_link", "q_start": AT_UR5, "meshes": False}
    z1 = {"urdf": robots_folder() / "z1_description/urdf/z1.urdf", "q_start": FOLDED, "meshes": False}
    options: dict[str, dict[str, Any]] = {
        "task": {}, "joint": {"control": "joint"}, "pose": {"control": "pose", **ur5}, "z1": {"control": "joint", **z1},
    }  # fmt: skip
    built = {
        name: twodof.build_fmu(folder / f"{name}.fmu", twodof.FmuOptions(**own, native=True))
        for name, own in options.items()
    }
    return {**built, "system": twodof.build_fmu(folder / "arm.ssp", twodof.FmuOptions(part="split", native=True))}


def error(summary: twodof.Summary) -> float:
    """Return the error at the end of a run, m or rad."""
    found = summary.joint_error if summary.error is None else summary.error
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("fmu", "settings", "kind", "without"),
    [
        ("task", {"payload": 0.3}, "load", {"payload_known": True}),
        ("task", {"f_ext": (0.0, 3.0, 0.0)}, "load", {"f_ext": 0.0}),
        ("task", {"x_des": (0.5, 0.1)}, "reach", None),
        ("task", {"Kd": 1.0}, "damping", {"Kd": 2.0 * 50.0**0.5}),
        ("task", {"Kp": (0.0, 50.0)}, "gain", {"Kp": 50.0}),
        ("task", {"Kp": 0.0}, "gain", {"Kp": 50.0}),
        ("task", {"xdd_des": (0.0, 1.0)}, "feedforward", {"xdd_des": 0.0}),
        ("task", {"q_min": (0.2, -3.0)}, "limit", {"q_min": -1e9, "q_max": 1e9}),
        ("joint", {"q_des": (90.0, 0.35)}, "degrees", {"q_des": (1.5707963267948966, 0.35)}),
        ("joint", {"q_des": (45.0, 30.0)}, "degrees", {"q_des": (0.7853981633974483, 0.5235987755982988)}),
        ("joint", {"q_des": (45.0, 5.0)}, "degrees", {"q_des": (0.7853981633974483, 0.08726646259971647)}),
        ("joint", {"q_des": (0.9, 0.8), "friction": (0.3, 0.1)}, "friction", {"friction": 0.0}),
        ("joint", {"q_des": (0.9, 0.8), "control_period": 0.06, "Kd": 60.0}, "unstable", {"control_period": 0.0}),
        ("joint", {"q_des": (0.9, 0.8), "damping": 20.0}, "load", {"damping": 0.0}),
        ("z1", {**REACHED_OUT, "friction": 0.0}, "drag", {"damping": 0.0}),
        ("joint", {"q_des": (0.9, 0.8), "limit_effort": True, "payload": 10.0, "payload_known": True}, "saturation",
         {"limit_effort": False}),
        ("system", {"plant.payload": 1.0}, "load", {"controller.payload_known": True, "controller.payload": 1.0}),
        ("system", {"controller.armature": (0.0321, 0.00376)}, "load", {"controller.armature": 0.0}),
    ],
)  # fmt: skip
def test_the_error_without_the_first_cause_is_that_of_a_run_without_it(
    fmus: dict[str, Path], fmu, settings, kind, without
) -> None:
    cause = twodof.simulate(fmus[fmu], settings=settings).verdict.causes[0]
    without = {"x_des": cause.point[:2]} if without is None else without
    cured = twodof.simulate(fmus[fmu], settings={**settings, **without})
    assert cause.kind == kind and not cause.noted
    (size,) = re.findall(r"([\d.e-]+) (?:m|rad), (?:still not )?reached$", cause.tried)
    assert float(size) == pytest.approx(error(cured), rel=6e-3)
    assert cause.removes is not None and cause.removes > 0.5


def test_the_remaining_time_is_tried(fmus: dict[str, Path]) -> None:
    first = twodof.simulate(fmus["task"], stop_time=1.0).verdict.lines[0]
    left, tried, size = re.findall(r"about ([\d.]+) s more \(after ([\d.]+) s: error ([\d.e-]+) m, reached\)", first)[0]
    assert float(tried) == pytest.approx(1.0 + float(left), abs=0.01)
    assert float(size) <= 0.02 * twodof.simulate(fmus["task"], stop_time=1.0).judge.aims["x"].first


@pytest.mark.parametrize(
    ("fmu", "settings", "words"),
    [
        # a load and a target out of reach, which is more of the error
        (
            "task",
            {"x_des": (1.0, 0.05), "payload": 0.3},
            ["out of reach by 0.7012 m", "payload of 0.3 kg", "^without both causes: error 0.000"],
        ),
        # a load that moves joints without a gain: the gain alone cures nothing
        ("joint", {"q_des": (0.9, 0.8), "Kp": 0.0, "f_ext": (0.0, -0.93, 0.0)}, ["know f_ext", "also Kp = 0"]),
        # joints are thrown to their limits by a wrong model; the small feedforward has no part
        ("system", {"controller.armature": (0.0321, 0.00376), "xd_des": (0.001, 0.0)}, ["model has armature"]),
        # a limit that a coarse encoder throws a joint to
        (
            "task",
            {"control_period": 0.001, "q_resolution": 0.05, "v_from_q": True, "f_ext": (0.0, 0.02, 0.0)},
            ["acts with control_period = 0.001, q_resolution = 0.05, v_from_q = 1 .with a continuous controller"],
        ),
        # the joint that is far off is slow; the load moves the other one
        (
            "joint",
            {"q_des": (0.9, 0.8), "friction": (0.3, 0.1), "payload": 0.2},
            ["payload of 0.2 kg", "also seen when the run is repeated without the first cause: joint 'joint1' creeps"],
        ),
        # gains that are too slow for the duration show when the load is gone
        (
            "task",
            {"payload": 1.0, "Kp": 15.0},
            [
                "payload of 1 kg",
                "also seen when the run is repeated without the first cause: the position still approaches",
            ],
        ),
        (
            "pose",
            {"x_des": (0.4, 0.1, 0.4), "quat_des": (0.3, 0.9, 0.1, 0.2), "payload": 0.2, "Kp_rot": 5.0},
            [
                "the orientation still approaches.*: error 0.0103 m and 0.048",
                "",
                "payload.*: error 0.000181 m and 0.583 rad",
            ],
        ),
    ],
)
def test_several_causes_are_ranked_by_the_errors_without_each(fmus: dict[str, Path], fmu, settings, words) -> None:
    lines = twodof.simulate(fmus[fmu], settings=settings).verdict.lines
    for line, expected in zip(lines, words):
        assert re.search(expected, line), lines
    assert "xd_des" not in " ".join(line for line in lines if not line.startswith("with "))


@pytest.mark.parametrize(
    ("fmu", "settings", "first"),
    [
        # friction holds a joint, and gains damp too little; the payload has nearly all of the error
        ("system", {"plant.payload": 0.3, "friction": 0.1, "Kd": 0.3}, "payload of 0.3 kg .if it is known: error 0.0"),
        ("task", {"q_min": (-0.2, -3.0), "payload": 0.05}, "payload of 0.05 kg .if it is known: error 0.09"),
        # a noisy encoder with a small payload
        (
            "joint",
            {"q_des": (0.9, 0.8), "control_period": 0.01, "q_noise": 0.2, "v_from_q": True, "payload": 0.05},
            "acts with control_period = 0.01, q_noise = 0.2, v_from_q = 1",
        ),
    ],
)
def test_settings_that_the_forces_at_the_end_do_not_show_are_tried(fmus: dict[str, Path], fmu, settings, first) -> None:
    assert re.search(first, twodof.simulate(fmus[fmu], settings=settings).verdict.lines[0])


def test_the_first_cause_does_not_depend_on_the_communication_step(fmus: dict[str, Path]) -> None:
    settings = {"x_des": (1.0, 0.05), "payload": 0.3}
    lines = [twodof.simulate(fmus["task"], settings=settings, step=step).verdict.lines for step in (0.01, 0.001)]
    words = "out of reach by 0.7012 m (with a target in reach: error 0.231 m, still not reached)"
    assert all(words in line[0] for line in lines)
    assert all("(if it is known: error 0.701 m, still not reached)" in line[1] for line in lines)
    assert all(line[2].startswith("without both causes: error 0.000") for line in lines)


def test_a_load_that_changes_is_absent_from_the_start(fmus: dict[str, Path], tmp_path: Path) -> None:
    """The last change would otherwise leave the torque before it."""
    (tmp_path / "a.csv").write_text("time,tau_ext[1],tau_ext[2]\n1,1,0.2\n4,0,0.2\n")
    verdict = twodof.simulate(fmus["joint"], settings={"q_des": (0.9, 0.8)}, input_file=tmp_path / "a.csv").verdict
    assert "(without it: error 0.00073 rad, reached)" in verdict.lines[0]


def test_gains_that_are_far_too_slow_are_not_tried_for_hours(fmus: dict[str, Path]) -> None:
    settings = {"Kp": 0.01, "Kd": 20.0}
    verdict = twodof.simulate(fmus["task"], settings=settings, step=10.0, stop_time=10.0).verdict
    tried = [cause.tried for cause in verdict.causes if cause.kind == "time"]
    assert len(tried) == 1 and tried[0].startswith("with Kp = 50 and Kd = 40: ")


def test_a_run_with_a_locked_joint_has_a_verdict(fmus: dict[str, Path]) -> None:
    verdict = twodof.simulate(fmus["task"], settings={"q_min": (0.0, 0.0), "q_max": (0.0, 3.0)}).verdict
    assert verdict.outcome == "not reached" and verdict.causes


def test_a_verdict_is_strict_json_if_a_repetition_diverges(fmus: dict[str, Path]) -> None:
    settings = {"control_period": 0.1, "Kp": 300.0, "payload": 0.1, "q_des": (0.9, 0.8)}
    verdict = twodof.simulate(fmus["joint"], settings=settings, stop_time=40.0).verdict
    json.dumps(verdict.facts(), allow_nan=False)


def test_causes_that_keep_the_error_only_together_are_all_named(fmus: dict[str, Path]) -> None:
    """Without one of them the error is as large: friction holds one joint, and a torque would move the other."""
    both: dict[str, Any] = {"q_des": (0.9, 0.8), "friction": (0.1, 0.05), "tau_ext": (0.1, 0.0)}
    still, smooth, without = (
        error(twodof.simulate(fmus["joint"], settings=both | one))
        for one in ({"tau_ext": 0.0}, {"friction": 0.0}, {"tau_ext": 0.0, "friction": 0.0})
    )
    text = str(twodof.simulate(fmus["joint"], settings=both).verdict)
    assert f"(without friction: error {smooth:.3g} rad" in text and f"(without it: error {still:.3g} rad" in text
    assert f"several causes act together (without both causes: error {without:.3g} rad, reached), first: " in text
    assert still > 0.4 and smooth > 0.4 and without < 1e-3


def test_what_follows_from_degrees_is_a_note(fmus: dict[str, Path]) -> None:
    lines = twodof.simulate(fmus["joint"], settings={"q_des": (90.0, 0.8)}).verdict.lines
    first = "q_des[1] is 90 rad (read as degrees: error 0.00174 rad, reached); did you mean 90°, which is 1.5708 rad?"
    assert first in lines[0]
    assert lines[1].startswith("note: joint 'joint1' stood at its upper limit")
    both = twodof.simulate(fmus["joint"], settings={"q_des": (45.0, 40.0)}).verdict.lines
    assert "q_des[1] is 45 rad, likewise 'joint2' (" in both[0] and both[0].endswith("which is 0.7854 rad?")
    assert not any(line.startswith("also joint") for line in both)


def test_inputs_after_the_end_are_not_played_in_a_longer_repetition(fmus: dict[str, Path]) -> None:
    verdicts = [
        twodof.simulate(fmus["task"], stop_time=1.0, changes=changes).verdict.lines[0]
        for changes in ([], [(2.0, {"tau_ext[1]": 5.0})])
    ]
    assert verdicts[0] == verdicts[1]


def test_a_target_that_changed_is_not_replaced_from_the_start(fmus: dict[str, Path]) -> None:
    changes = [(4.5, {"x_des": (1.0, 0.05)})]
    causes = twodof.simulate(fmus["task"], changes=changes).verdict.causes
    assert [cause.tried for cause in causes if cause.kind == "reach"] == [""]


def test_a_limit_on_the_way_of_a_moving_target_is_named(fmus: dict[str, Path], tmp_path: Path) -> None:
    rows = ["time,x_des[1],x_des[2],xd_des[1],xd_des[2],xdd_des[1],xdd_des[2]"]
    for t in (0.01 * k for k in range(600)):
        c, s = CIRCLE * cos(t), CIRCLE * sin(t)
        rows.append(",".join(f"{value:.9g}" for value in (t, 0.2 + c, 0.05 + s, -s, c, -c, -s)))
    (tmp_path / "circle.csv").write_text("\n".join(rows))
    follow = partial(twodof.simulate, fmus["task"], stop_time=6.0, input_file=tmp_path / "circle.csv")
    assert follow().verdict.outcome == "followed"
    first = follow(settings={"q_max": (3.0, 1.6)}).verdict.lines[0]
    assert "'joint2' stood at its upper limit 1.6 rad" in first and "without joint limits: error 0.000" in first


class Steering(twodof.Sink):
    """A sink that commands no inputs."""

    def command(self, *_: object) -> None:
        return None


@pytest.mark.parametrize(
    "options", [{"steer": lambda: None}, {"stop_time": 51.0}, {"stop": iter([False] * 3 + [True] * 9).__next__}]
)
def test_a_run_that_cannot_be_repeated_has_no_trial(fmus: dict[str, Path], options) -> None:
    causes = twodof.simulate(fmus["task"], settings={"payload": 0.3}, **options).verdict.causes
    assert causes and not any(cause.tried or cause.removes is not None for cause in causes)


def test_a_run_with_a_steering_sink_and_one_of_a_python_fmu_have_no_trial(
    fmus: dict[str, Path], fmu_path: Path
) -> None:
    steered = twodof.simulate(fmus["task"], Steering(), settings={"payload": 0.3})
    python = twodof.simulate(fmu_path, settings={"payload": 0.3})
    assert not any(cause.tried for summary in (steered, python) for cause in summary.verdict.causes)
    assert [c.kind for c in python.verdict.causes] == [c.kind for c in steered.verdict.causes]


def test_a_repetition_that_fails_is_left_out_and_logs_nothing(
    fmus: dict[str, Path], caplog: pytest.LogCaptureFixture
) -> None:
    settings = {"f_ext": (1e9, 0.0, 0.0), "q_max": (0.6, 0.4)}
    with pytest.raises(SimulationError, match="need more than 10000000 evaluations"):
        twodof.simulate(fmus["task"], settings={**settings, "q_max": 10.0}, stop_time=0.5)
    caplog.clear()
    summary = twodof.simulate(fmus["task"], settings=settings, stop_time=0.5)
    assert any(cause.kind == "limit" and not cause.tried for cause in summary.verdict.causes)
    assert not [record for record in caplog.records if "evaluations" in record.getMessage()]


def test_a_replaced_fmu_leaves_the_causes_as_they_are(fmus: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "arm.fmu"
    path.write_bytes(fmus["task"].read_bytes())
    summary = twodof.simulate(path, settings={"payload": 0.3})
    path.write_bytes(fmus["joint"].read_bytes())
    assert [(cause.kind, cause.tried) for cause in summary.verdict.causes] == [("load", "")]


def test_a_bag_has_the_errors_without_the_causes(
    fmus: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "bag"
    assert main(["run", str(fmus["task"]), "--set", "payload=0.3", "-o", str(bag)]) == 0
    printed = capsys.readouterr().out
    assert main(["info", str(bag)]) == 0
    line = "(if it is known: error 0.000224 m, reached); set payload_known=true"
    assert line in printed and line in capsys.readouterr().out
    assert twodof.verdict(bag).causes[0].removes == pytest.approx(1.0, abs=0.01)


def test_an_instance_that_cannot_be_reset_leaves_the_causes_as_they_are(
    fmus: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: object) -> None:
        raise SimulationError("fatal")

    summary = twodof.simulate(fmus["task"], settings={"payload": 0.3})
    monkeypatch.setattr("twodof.fmu.instance.Instance.reset", refuse)
    assert [(cause.kind, cause.tried) for cause in summary.verdict.causes] == [("load", "")]


def test_a_number_of_a_joint_that_the_largest_error_hides_is_named(fmus: dict[str, Path]) -> None:
    settings = {"q_des": (0.9, 0.8), "Kd": (0.1, 40.0), "friction": (0.0, 0.05)}
    lines = twodof.simulate(fmus["joint"], settings=settings).verdict.lines
    cured = twodof.simulate(fmus["joint"], settings={**settings, "Kd": (2.0 * 50.0**0.5, 40.0)})
    first, second = (abs(wanted - q) for wanted, q in zip((0.9, 0.8), cured.last.q))
    texts = re.findall(
        r"with critical damping: error ([\d.e-]+) rad of joint 'joint2', ([\d.e-]+) rad of joint 'joint1'", lines[1]
    )
    assert [*map(float, texts[0])] == pytest.approx([second, first], rel=6e-3), lines


@pytest.mark.parametrize(
    ("settings", "without"),
    [
        # the joint that the payload does not move is held by friction; without friction the payload moves it further
        ({"q_des": (0.9, 0.8), "friction": (0.1, 0.05), "payload": 0.05}, {"payload_known": True, "friction": 0.0}),
        ({"q_des": (0.9, 0.8), "friction": (0.1, 0.05), "payload": 0.1}, {"payload_known": True, "friction": 0.0}),
    ],
)
def test_a_cause_that_acts_without_the_first_one_is_no_note(fmus: dict[str, Path], settings, without) -> None:
    lines = twodof.simulate(fmus["joint"], settings=settings).verdict.lines
    cured = twodof.simulate(fmus["joint"], settings={**settings, **without})
    assert "payload" in lines[0] and lines[1].startswith("also joint"), lines
    assert float(re.findall(r"without both causes: error ([\d.e-]+) rad, ", "\n".join(lines))[0]) == pytest.approx(
        error(cured), rel=6e-3
    )


def test_gains_that_need_longer_than_ten_runs_are_tried_with_the_usual_ones(fmus: dict[str, Path]) -> None:
    target = {"x_des": (0.4, 0.1, 0.4), "quat_des": (0.3, 0.9, 0.1, 0.2), "Kp_rot": 1.0}
    first = twodof.simulate(fmus["pose"], settings=target).verdict.lines[0]
    cured = twodof.simulate(fmus["pose"], settings={**target, "Kp_rot": 50.0})
    words = r"still approaches.* about \d+ s more \(with Kp_rot = 50: error ([\d.e-]+) rad, reached\); raise Kp_rot"
    texts = re.findall(words, first)
    assert texts, first
    assert float(texts[0]) == pytest.approx(cured.turn_error, rel=6e-3)


def test_a_limit_beyond_which_the_target_is_stays_a_note(fmus: dict[str, Path]) -> None:
    coarse = {"q_des": (0.9, 0.8), "q_max": (3.0, 0.7848), "control_period": 0.01, "q_resolution": 0.0186}
    causes = twodof.simulate(fmus["joint"], settings=coarse).verdict.causes
    assert {cause.kind: cause.noted for cause in causes} == {"sampling": False, "reach": False, "limit": True}


def test_slow_gains_are_a_cause_if_no_other_removal_helps(fmus: dict[str, Path]) -> None:
    model = {"controller.payload": 0.00672, "controller.payload_known": True}
    slow = {**model, "xdd_des": (0.99, -0.729), "Kp": 1.06, "Kd": 20.0}
    first = twodof.simulate(fmus["system"], settings=slow).verdict.causes[0]
    cured = twodof.simulate(fmus["system"], settings={**slow, "Kp": 50.0, "Kd": 40.0})
    assert first.text.startswith("the gains are Kp = 1.06 and Kd = 20")
    assert float(re.findall(r"([\d.e-]+) m, still not reached$", first.tried)[0]) == pytest.approx(
        error(cured), rel=6e-3
    )


@pytest.mark.parametrize(
    ("fmu", "settings", "helps"),
    [
        ("task", {"friction": 0.1}, True),
        ("joint", {"q_des": (0.9, 0.8), "tau_ext": (0.3, 0.0)}, True),
        ("task", {"friction": 0.1, "q_min": (-0.2, -3.0)}, False),  # a joint stands at its limit, at any gain
        ("joint", {"q_des": (0.9, 0.8), "friction": 0.1, "control_period": 0.05, "Kp": 100.0}, False),  # unstable
    ],
)
def test_the_advice_to_raise_a_gain_is_tried(fmus: dict[str, Path], fmu, settings, helps) -> None:
    first = twodof.simulate(fmus[fmu], settings=settings).verdict.lines[0]
    gains = {"Kp": 10.0 * settings.get("Kp", 50.0), "Kd": 10.0**0.5 * 40.0}
    stiffer = twodof.simulate(fmus[fmu], settings={**settings, **gains})
    advised = r"raise Kp \(with Kp = (\d+) and Kd = 126.5: error ([\d.e-]+) (?:m|rad), (?:still not )?reached\)"
    advice = re.findall(advised, first)
    assert ("raise Kp" in first) == helps, first
    if helps:
        assert [*map(float, advice[0])] == [gains["Kp"], pytest.approx(error(stiffer), rel=6e-3)]


def test_joints_that_creep_are_named_apart_from_joints_that_stick(fmus: dict[str, Path]) -> None:
    summary = twodof.simulate(fmus["z1"], settings=REACHED_OUT)
    sticks, creeps, *_ = summary.verdict.lines
    joints = summary.judge.setup.joints
    moving = {name for name, v in zip(joints, summary.last.v) if v}
    assert {*re.findall(r"'(\w+)'", creeps)} == moving and 0 < len(moving) < 7
    named = {*re.findall(r"'(\w+)'", sticks.partition(" sticks")[0][-20:] + sticks.partition("likewise")[2])}
    assert named == {*joints} - moving
    assert "without friction" in sticks and "without friction" not in creeps  # the same run


@pytest.mark.parametrize("steered", [False, True])
def test_the_error_of_a_step_has_the_cause_that_is_seen_until_then(fmus: dict[str, Path], steered) -> None:
    unstable: dict[str, Any] = {
        "control_period": 0.05,
        "control_delay": 0.1,
        "Kp": 3e5,
        "Kd": 2e4,
        "q_min": -1e9,
        "q_max": 1e9,
    }
    steer: dict[str, Any] = {"steer": lambda: None} if steered else {}
    cause = r"; until then: Kp = 300000 .* are too high for control_period = 0.05 s and control_delay = 0.1 s: the loop"
    with pytest.raises(SimulationError, match=cause) as refusal:
        twodof.simulate(fmus["task"], settings=unstable, **steer)
    assert refusal.value.outcome == "discarded"


def test_a_request_to_stop_ends_the_repetitions(fmus: dict[str, Path]) -> None:
    summary = twodof.simulate(fmus["task"], settings={"payload": 0.3})
    repeater = summary.repeat
    assert isinstance(repeater, Repeater) and not repeater.stop()
    plan = Repetition("", (("payload", 0.0),))
    assert isinstance(repeater([plan])[0], Judge)
    assert Repeater(repeater.run, lambda: True)([plan]) == [""]


def test_all_repetitions_of_a_run_share_their_evaluations(fmus: dict[str, Path]) -> None:
    run = twodof.simulate(fmus["task"], settings={"payload": 0.3}).repeat.run  # type: ignore[union-attr]
    repeater, plan = Repeater(run, lambda: False), Repetition("", (("payload", 0.0),))
    before = repeater.left
    assert isinstance(repeater([plan])[0], Judge)
    spent = before - repeater.left
    assert spent >= 2 * 6 * 10 * 500  # two joints; six evaluations in each ms, the largest step
    for share, allowed in ((1.99, False), (2.0, True)):  # a run may take half of what is left
        repeater.left = share * spent
        assert (repeater([plan]) != [TOO_LONG]) == allowed


def test_a_slow_repetition_does_not_prevent_the_others(fmus: dict[str, Path]) -> None:
    repeat = twodof.simulate(fmus["task"], settings={"payload": 0.3}).repeat
    assert isinstance(repeat, Repeater)
    slow = Repetition("", (("max_step", 1e-6),))
    results = repeat([slow, Repetition("", (("payload", 0.0),))])
    assert results[0] == TOO_LONG and isinstance(results[1], Judge)


def test_a_verdict_does_not_depend_on_the_load_of_the_machine(
    fmus: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"x_des": (1.0, 0.05), "payload": 0.3}
    quick = twodof.simulate(fmus["task"], settings=settings).verdict.lines
    summary = twodof.simulate(fmus["task"], settings=settings)
    clock = itertools.count(0.0, 3600.0)  # each look at the clock takes an hour
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    assert summary.verdict.lines == quick


def test_a_cause_that_takes_too_long_to_test_is_named(fmus: dict[str, Path]) -> None:
    summary = twodof.simulate(fmus["task"], settings={"payload": 0.3})
    assert isinstance(summary.repeat, Repeater)
    summary.repeat.left = 1.0
    assert "payload of 0.3 kg (not tested: the run takes too long); set payload_known=true" in summary.verdict.lines[0]
