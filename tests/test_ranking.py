"""Errors and exceeded limits of a run, and the ranking of a sweep's runs."""

import json
import math
import xml.etree.ElementTree as ET
from math import inf, nan

import numpy as np
import pytest
from native_models import robots_folder
from scipy.spatial.transform import Rotation
from sinks import Collector

import twodof
from twodof.cli.main import main
from twodof.sweeps.ranking import ranks

UR5 = "ur_description/urdf/ur5_robot.urdf"
GOAL = (0.9, 0.1, 0.3, 0.2)


@pytest.fixture(scope="module")
def ur5(tmp_path_factory):
    """FMUs of the UR5 by control."""
    folder = tmp_path_factory.mktemp("ur5")
    return {
        control: twodof.build_fmu(
            folder / f"{control}.fmu",
            twodof.FmuOptions(
                urdf=robots_folder() / UR5,
                frame="ee_link",
                control=control,
                native=True,
                meshes=False,
                q_start=(0.1, -1.2, 1.4, 0.2, -1.0, 0.3),
            ),
        )
        for control in ("pose", "joint")
    }


def angle(sample: twodof.Sample) -> float:
    """From the target orientation, rad, by SciPy."""
    return float((Rotation.from_quat(sample.quat).inv() * Rotation.from_quat(sample.target_quat or ())).magnitude())


def limits(quantity: str) -> np.ndarray:
    """Limits of the URDF's joints, in its order."""
    joints = ET.parse(robots_folder() / UR5).getroot().findall("joint[@type='revolute']")
    found = [joint.find("limit") for joint in joints]
    return np.array([float(limit.attrib[quantity]) for limit in found if limit is not None])


@pytest.mark.parametrize("count", [3, 5000])
def test_a_summary_has_the_errors_of_all_that_is_controlled(ur5, count):
    kept = Collector()
    settings = {"quat_des": GOAL, "Kp": 400.0, "Kp_rot": 400.0}
    run = twodof.simulate(ur5["pose"], kept, settings=settings, step=0.002, stop_time=0.002 * count)
    last = kept[-1]
    apart = Rotation.from_quat(last.quat).inv() * Rotation.from_quat(GOAL)
    assert run.turn_error == pytest.approx(apart.magnitude(), abs=1e-12)
    assert run.joint_error is None
    peaks = np.abs([[*sample.tau, *sample.v] for sample in kept]).max(axis=0)
    share = peaks / [*limits("effort"), *limits("velocity")]
    kinds = [(kind, joint) for kind in ("effort", "velocity") for joint in twodof.load_fmu(ur5["pose"]).joints]
    beyond = {of: pytest.approx(use, rel=1e-12) for use, of in zip(share, kinds) if use > 1.0}
    found = [cause for cause in run.verdict.causes if cause.kind in ("effort", "velocity")]
    assert {(cause.kind, cause.joint): cause.share for cause in found} == beyond and beyond
    shares = [cause.share for cause in found if cause.kind == "effort"]
    assert shares == sorted(shares, reverse=True)


def test_a_run_of_joints_has_the_largest_error_and_saturation_is_within_limits(ur5):
    goal = (0.3, -1.0, 1.2, 0.9, -0.8, 0.3)
    settings = {"q_des": goal, "Kp": 60.0, "Kd": 10.0, "limit_effort": True}
    run = twodof.simulate(ur5["joint"], settings=settings, stop_time=0.1)
    assert run.joint_error == np.abs(np.array(goal) - run.last.q).max() > 0.01
    assert run.error is None and run.turn_error is None
    assert not [cause for cause in run.verdict.causes if cause.kind == "effort"]


def test_a_run_prints_all_of_its_errors_and_limits(ur5, tmp_path, capsys):
    sets = ["--set", "quat_des=0.9,0.1,0.3,0.2", "--set", "Kp_rot=400", "--stop-time", "0.3"]
    bag = str(tmp_path / "bag")
    assert main(["run", str(ur5["pose"]), "-o", bag, "--effort", *sets]) == 0
    out = capsys.readouterr().out
    assert " rad from the target orientation" in out
    assert " N·m, beyond the URDF's limit of 28 N·m" in out
    assert main(["plot", bag, "-o", str(tmp_path / "plot.png")]) == 0
    out = capsys.readouterr().out
    assert " rad from the target orientation" in out and "beyond the URDF's limit of 28" in out
    summary = twodof.simulate(ur5["pose"], settings={"quat_des": GOAL, "Kp_rot": 400.0}, stop_time=0.3)
    assert f" {summary.turn_error:.3g} rad from the target orientation" in out
    assert main(["run", str(ur5["joint"]), "-o", bag, "--overwrite", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["error"], facts["turn_error"], facts["joint_error"]) == (None, None, 0.0)
    assert main(["plot", bag, "-o", str(tmp_path / "plot.png")]) == 0
    assert "reached: joint errors of up to 0 rad ('shoulder_pan_joint')" in capsys.readouterr().out


def test_metrics_of_a_pose_are_those_of_its_samples(ur5, tmp_path):
    settings = {
        "quat_des": tuple(2.0 * np.array(GOAL)),
        "x_des": (0.4, 0.2, 0.5),
        "Kp": 100.0,
        "Kd": 20.0,
        "Kd_rot": 20.0,
    }
    grid = {"Kp_rot": [1.0, 30.0, 100.0]}
    table = twodof.sweep(ur5["pose"], grid=grid, settings=settings, stop_time=4.0)
    for row in table.to_dict("records"):
        chosen = {**settings, "Kp_rot": row["Kp_rot"]}
        samples = [*twodof.samples(ur5["pose"], settings=chosen, stop_time=4.0)]
        errors = np.array([(math.dist(s.x, s.target or ()), angle(s)) for s in samples])
        assert row["final_turn_error"] == pytest.approx(errors[-1, 1], abs=1e-12)
        assert np.isnan(row["final_joint_error"])
        use = np.abs([sample.tau for sample in samples]) / limits("effort")
        assert row["effort_use"] == pytest.approx(use.max(), rel=1e-12)
        use = np.abs([sample.v for sample in samples]) / limits("velocity")
        assert row["velocity_use"] == pytest.approx(use.max(), rel=1e-12)
        late = np.flatnonzero((errors > 0.02 * errors[0]).any(axis=1))[-1] + 1
        if late == len(samples):
            assert np.isnan(row["settling_time"])
        else:
            assert row["settling_time"] == pytest.approx(0.01 * late)
    assert table["settling_time"].isna().tolist() == [True, False, False]


def test_joint_control_settles_too(ur5):
    """Each joint obeys e'' + Kd e' + Kp e = 0, critically damped: e = e0 (1 + 5 t) exp(-5 t)."""
    settings = {"q_des": (0.3, -1.0, 1.2, 0.4, -0.8, 0.5), "Kd": 10.0}
    (row,) = twodof.sweep(ur5["joint"], grid={"Kp": [25.0]}, settings=settings).to_dict("records")
    t = np.arange(501) * 0.01
    shape = (1.0 + 5.0 * t) * np.exp(-5.0 * t)
    assert row["settling_time"] == pytest.approx(t[np.flatnonzero(shape > 0.02)[-1] + 1])
    assert row["final_joint_error"] == pytest.approx(0.2 * shape[-1], rel=1e-3)
    assert row["overshoot"] == 0.0 and np.isnan(row["final_error"])


def test_no_run_beyond_the_limits_is_best(ur5, tmp_path, capsys):
    arguments = ["--set", "q_des=0.3,-1.0,1.2,0.4,-0.8,0.5", "--set", "Kd=20", "--json"]
    folder = str(tmp_path / "some")
    assert main(["sweep", str(ur5["joint"]), "--grid", "Kp=20:4000:5", "-o", folder, *arguments]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert 0 < facts["beyond_limits"] < 5
    assert len(facts["best"]) == 5 - facts["beyond_limits"]
    assert all(max(run["effort_use"], run["velocity_use"]) <= 1.0 for run in facts["best"])
    assert main(["info", folder]) == 0
    out = capsys.readouterr().out
    said = f"note: {facts['beyond_limits']} of 5 finished runs exceed the URDF's effort or velocity"
    assert f"{said} limits and are not ranked\n" in out
    folder = str(tmp_path / "all")
    assert main(["sweep", str(ur5["joint"]), "--grid", "Kp=4000:5000:2", "-o", folder, *arguments]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["beyond_limits"] == len(facts["best"]) == 2
    assert main(["plot", folder, "-o", str(tmp_path / "map.png")]) == 0
    said = "all 2 finished runs exceed the URDF's effort or velocity limits, the best too\n"
    assert said in capsys.readouterr().out


def test_runs_that_differ_by_rounding_rank_equally(native_path, tmp_path, capsys):
    """These external torques change the metrics by rounding."""
    grid = ["--grid", "tau_ext=0:1e-14:3", "--stop-time", "0.3", "-o", str(tmp_path / "s")]
    assert main(["sweep", str(native_path), *grid]) == 0
    assert "\nno single best run: 3 are equal up to rounding\n" in capsys.readouterr().out
    errors = twodof.read_sweep(tmp_path / "s")["final_error"]
    assert len({*errors}) > 1 and np.ptp(errors) < 1e-13


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((), ()),
        ((2.0, 1.0, 1.0), (1, 0, 0)),
        ((1e-15, 3e-16, 1e-3), (0, 0, 1)),
        ((1000.0 + 1e-10, 1000.0, 1000.0 + 1e-8), (0, 0, 1)),
        ((nan, 0.5, nan, 0.25), (2, 1, 2, 0)),
        ((nan, nan), (0, 0)),
        ((inf, 1.0, inf), (1, 0, 1)),
        ((0.0, 0.9e-12, 1.8e-12, 2.7e-12), (0, 0, 1, 1)),
    ],
)
def test_places_are_those_of_the_values(values, expected):
    assert tuple(ranks(np.array(values))) == expected
    shuffled = np.random.default_rng(1).permutation(len(values))
    assert tuple(ranks(np.array(values)[shuffled])) == tuple(np.array(expected, int)[shuffled])


def test_a_cost_ranks_the_runs(native_path, tmp_path, capsys):
    """The reference is pandas' own expressions."""
    folder, cost = str(tmp_path / "s"), "settling + 0.1*peak_effort"
    grid = ["--grid", "Kp=20:200:4", "--grid", "Kd=10:30:2", "--stop-time", "2"]
    assert main(["sweep", str(native_path), *grid, "-o", folder, "--cost", cost, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    table = twodof.read_sweep(folder)
    values = table.eval("settling_time + 0.1 * peak_effort")
    expected = table.assign(cost=values).dropna(subset="cost").sort_values("cost").head(5)
    assert facts["cost"] == cost
    assert [run["run"] for run in facts["best"]] == expected["run"].tolist() != table.head(5)["run"].tolist()
    assert [run["cost"] for run in facts["best"]] == pytest.approx(expected["cost"].tolist(), rel=1e-12)
    assert [run["run"] for run in facts["best"]] != [run["run"] for run in best_of(folder, "peak_effort", capsys)]
    for command in (["info", folder], ["plot", folder, "-o", str(tmp_path / "map.png")]):
        assert main([*command, "--cost", cost]) == 0
        lines = capsys.readouterr().out.splitlines()
        title = lines.index(f"best: least cost, {cost}")
        assert lines[title + 1].split()[:2] == ["run", "cost"]
        assert [int(line.split()[0]) for line in lines[title + 3 : title + 8]] == expected["run"].tolist()


def best_of(folder: str, cost: str, capsys: pytest.CaptureFixture[str]) -> list[dict[str, float]]:
    assert main(["info", folder, "--cost", cost, "--json"]) == 0
    best: list[dict[str, float]] = json.loads(capsys.readouterr().out)["best"]
    return best


@pytest.mark.parametrize("cost", ["turn_error", "peak_effort/0"])
def test_a_cost_that_no_run_has_ranks_none(cost, native_path, tmp_path, capsys):
    folder = str(tmp_path / "s")
    grid = ["--grid", "Kp=20:40:2", "--stop-time", "0.1"]
    assert main(["sweep", str(native_path), *grid, "-o", folder, "--cost", cost]) == 0
    said = f"\nno run is best: the cost '{cost}' is not a finite number for any of them\n"
    assert said in capsys.readouterr().out
    assert main(["info", folder, "--cost", cost]) == 0
    assert said in capsys.readouterr().out


@pytest.mark.parametrize(
    ("cost", "said"),
    [
        ("setling", "did you mean settling_time?"),
        ("settling > 1", "is not a value, as 'settling + 0.1*peak_effort'"),
        ("peak", "there is no metric 'peak'; did you mean peak_effort or peak_velocity?"),
        ("__import__('os')", "is not a value"),
        ("1/0", "'1/0' names no metric; there are: settling_time, overshoot, "),
    ],
)
def test_a_cost_is_refused_before_the_sweep(cost, said, native_path, tmp_path, capsys):
    folder = tmp_path / "s"
    assert main(["sweep", str(native_path), "--grid", "Kp=20:40:2", "-o", str(folder), "--cost", cost]) == 1
    assert said in capsys.readouterr().err and not folder.exists()
