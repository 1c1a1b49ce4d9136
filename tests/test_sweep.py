"""Sweeps: metrics against closed forms, the design, and the outcome of each run."""

import shlex
import sys
from collections import Counter
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import oracles
import pytest
from harness import changed_step, python
from tables import BEGUN, SMALL, same

import twodof
from twodof import sweep
from twodof.cli.main import main
from twodof.errors import SimulationError
from twodof.fmu import Fmu
from twodof.simulation.experiments import ExperimentOptions
from twodof.simulation.setup import robot_of
from twodof.simulation.stepping import judge_of
from twodof.simulation.verdict import METRICS
from twodof.sweeps import runner as runner_module
from twodof.sweeps.runner import Job, Runner

Q0, TARGET = np.array([0.5, 0.35]), np.array([0.2, 0.05])
STEP, STOP = 0.01, 5.0

# --- metrics ---


def response(kp: float, kd: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """φ and φ' of φ'' + kd φ' + kp φ = 0, φ(0) = 1, φ'(0) = 0; accurate at critical damping too."""
    a = kd / 2
    w = np.sqrt(complex(a * a - kp))
    z = w * t
    small = np.abs(z) < 1e-4
    sinhc = np.where(small, 1 + z * z / 6, np.sinh(z) / np.where(small, 1, z))
    phi = np.exp(-a * t) * (np.cosh(z) + a * t * sinhc)
    slope = -kp * t * np.exp(-a * t) * sinhc
    return phi.real, slope.real


def gains() -> list[tuple[float, float]]:
    """60 pairs: under-, over- and critically damped."""
    rng = np.random.default_rng(7)
    pairs = []
    for i in range(60):
        kp = rng.uniform(10.0, 250.0)
        damping = (rng.uniform(0.15, 0.95), 1.0, rng.uniform(1.05, 4.0))[i % 3]
        pairs.append((kp, 2 * damping * np.sqrt(kp)))
    return pairs


@pytest.fixture(scope="module")
def judged(native_path):
    """The metrics of the pairs, by single runs."""
    options: ExperimentOptions = {"stop_time": STOP, "step": STEP, "settings": {}}
    job = Job(native_path.read_bytes(), "a.fmu", ("Kp", "Kd"), options, None)
    with Runner(job) as runner:
        rows = [runner.run((i, pair)) for i, pair in enumerate(gains())]
    assert {row[-2] for row in rows} == {"finished"}
    return [dict(zip(METRICS, row[3:])) for row in rows]


def test_metrics_are_those_of_the_closed_form(judged):
    t = np.arange(501) * STEP
    e0 = TARGET - oracles.position(Q0)
    size = np.linalg.norm(e0)
    settled = 0
    for (kp, kd), found in zip(gains(), judged):
        phi, _ = response(kp, kd, t)
        error = np.abs(phi) * size
        close: dict[str, Any] = {"rel": 1e-6, "abs": 1e-9}
        assert found["final_error"] == pytest.approx(error[-1], **close)
        assert found["rms_error"] == pytest.approx(np.sqrt((error**2).sum() / 501), **close)
        assert found["overshoot"] == pytest.approx(max(0.0, -phi.min()), **close)
        assert found["time_at_limits"] == 0.0
        late = [k for k in range(501) if abs(phi[k]) > 0.02]
        if late[-1] == 500:
            assert np.isnan(found["settling_time"])
        else:
            settled += 1
            assert abs(found["settling_time"] - (late[-1] + 1) * STEP) <= STEP
    assert 40 < settled < 60


def test_peaks_are_those_of_the_closed_form(judged):
    """Joint velocities are by the inverse Jacobian, torques by the textbook's dynamics."""
    t = np.arange(501) * STEP
    start = oracles.position(Q0)
    arm = oracles.TwoLinkArm(Path(__file__).parents[1] / "urdf/2dof.urdf", 9.81)
    for (kp, kd), found in list(zip(gains(), judged))[::5]:
        phi, slope = response(kp, kd, t)
        speed, effort = 0.0, 0.0
        for p, s in zip(phi, slope):
            x = TARGET - p * (TARGET - start)
            c2 = (x @ x) / (2 * oracles.LINK**2) - 1.0
            q2 = np.arccos(c2)  # the elbow stays on the side on which it starts
            q = np.array([np.arctan2(x[1], x[0]) - q2 / 2, q2])
            v = np.linalg.solve(oracles.jacobian(q), -s * (TARGET - start))
            a_cmd = -kd * -s * (TARGET - start) + kp * p * (TARGET - start)
            a = np.linalg.solve(oracles.jacobian(q), a_cmd - oracles.drift(q, v))
            tau = arm.mass_matrix(q) @ a + arm.nonlinear_effects(q, v)
            speed, effort = max(speed, *np.abs(v)), max(effort, *np.abs(tau))
        assert found["peak_velocity"] == pytest.approx(speed, rel=1e-6)
        assert found["peak_effort"] == pytest.approx(effort, rel=1e-6)


def test_time_at_limits_is_that_of_the_samples(native_path):
    """The first joint would pass 0.2 rad on its way down; samples show how long it stays there."""
    settings = {"q_min": (0.2, -3.0)}
    (row,) = sweep(native_path, grid={"Kp": [50.0]}, settings=settings).to_dict("records")
    samples = list(twodof.samples(native_path, settings={**settings, "Kp": 50.0}))
    at_limit = sum(sample.q[0] == 0.2 for sample in samples)
    assert at_limit > 50
    assert row["time_at_limits"] == pytest.approx(at_limit * STEP)


def test_undefined_metrics_are_null(native_path):
    at_rest = {"x_des": tuple(oracles.position(Q0))}
    (row,) = sweep(native_path, grid={"Kp": [50.0]}, settings=at_rest).to_dict("records")
    assert np.isnan(row["settling_time"]) and np.isnan(row["overshoot"])
    assert row["final_error"] < 1e-12 and row["outcome"] == "finished"


@pytest.mark.parametrize("max_step", [1e-3, 1e-9], ids=["finished", "discarded"])
@pytest.mark.parametrize("flavour", ["python", "native"])
def test_a_run_of_a_sweep_has_the_numbers_of_its_samples(fmu_path, native_path, flavour, max_step):
    """Sums over samples differ by rounding; if a run fails, both fail at the same step for the same reason."""
    fmu = {"python": fmu_path, "native": native_path}[flavour]
    settings = {"max_step": max_step}
    with Runner(Job(fmu.read_bytes(), fmu.name, ("Kp",), {"stop_time": 0.5, "settings": settings}, None)) as runner:
        _, _, *numbers, end, outcome, message = runner.run((0, (80.0,)))
    run = twodof.experiment(fmu, stop_time=0.5, settings={**settings, "Kp": 80.0})
    judge = judge_of(run, robot_of(run.fmu.urdf))
    try:
        for sample in twodof.samples(run):
            judge.rows.write(np.array([*sample.q, *sample.v, *sample.x, *sample.tau, *sample.quat]).tobytes())
    except SimulationError as error:
        assert max_step < 1e-3 and (end, outcome, message) == (run.time(error.k), "discarded", str(error))
        return
    expected = [judge.metrics().get(name, np.nan) for name in METRICS]
    expected = [value if np.isfinite(value) else np.nan for value in expected]
    assert (end, outcome, message) == (0.5, "finished", None) and max_step == 1e-3
    np.testing.assert_allclose(numbers, expected, rtol=1e-12)


# --- the design ---


def test_design_is_the_product_of_grids_with_the_same_draws(native_path):
    options: dict[str, Any] = {"grid": SMALL, "ranges": {"tau_ext[2]": (-0.01, 0.02)}, "random": 4, "seed": 5}
    table = sweep(native_path, stop_time=0.05, **options)
    assert list(table["run"]) == list(range(24))
    draws = np.random.default_rng(5).uniform(-0.01, 0.02, 4)
    expected = [(kp, kd, d) for kp in SMALL["Kp"] for kd in SMALL["Kd"] for d in draws]
    assert table[["Kp", "Kd", "tau_ext[2]"]].to_numpy() == pytest.approx(np.array(expected), abs=0)
    same(sweep(native_path, stop_time=0.05, **options), table)


def test_a_name_without_an_index_sets_all_elements(native_path):
    both = sweep(native_path, grid={"Kp": [80.0]})
    one = sweep(native_path, grid={"Kp[1]": [80.0]}, settings={"Kp[2]": 80.0})
    columns = list(METRICS)
    same(both[columns], one[columns])
    assert not sweep(native_path, grid={"Kp[1]": [80.0]})[columns].equals(one[columns])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--grid", "Kpp=1:2:3"], "there is no variable 'Kpp'; did you mean 'Kp"),
        (["--grid", "q=1:2:3"], "q[1] is of causality 'output' and cannot be set"),
        (["--grid", "Kp=5:1:3"], "LOW 5 must be below HIGH 1"),
        (["--grid", "Kp=1:2:0"], "COUNT 0 must be a whole number of at least 2"),
        (["--grid", "Kp=1:nan:3"], "its numbers must be finite"),
        (["--grid", "Kp=1:2:3", "--grid", "Kp=1:2:3"], "--grid Kp is given twice"),
        (
            ["--grid", "Kp=1:2:3", "--range", "Kp[2]=1:2", "--random", "2"],
            "Kp[2] gets values from the design of Kp and from Kp[2]",
        ),
        (["--grid", "Kp=1:2:3", "--set", "Kp[1]=4"], "Kp[1] gets values from the settings and from Kp"),
        (["--range", "Kp=1:2"], "0 random draws of Kp; give at least 1 with --random"),
        (["--range", "Kp=2:1", "--random", "3"], "LOW 2 must be below HIGH 1"),
        (["--grid", "Kp=1:2:3", "--random", "3"], "--random 3 needs a range"),
        ([], "there is nothing to vary"),
        (["--grid", "Kp=1:2:3", "--stop-time", "-1"], "stop time -1 s must be after"),
        (["--grid", "Kp=1:2:99999", "--grid", "Kd=1:2:99"], "runs; at most"),
        (
            [*(f"--range=v{i}=1:2" for i in range(17)), "--random", "1000000"],
            "a table of 1000000 runs over 17 variables exceeds 256 MiB",
        ),
        (["--grid", "limit_effort=0:1:2"], "limit_effort = 0.0: expected true or false"),
        (["--grid", "Kp=1:2:3", "--resume"], "--resume has no effect without -o"),
        (["--grid", "Kp=1:2:3", "--resume", "-o", "none"], "there is no sweep 'none' to resume"),
        (["--grid", "Kp=1:2:3", "-o", "taken"], "'taken' exists and is not a sweep; choose another"),
        (["--grid", "Kp=1:2:3", "--workers", "0"], "0 workers; at least 1 is needed"),
        (
            ["--grid", "Kp=1:2:3", "--scheduler", "tcp://127.0.0.1:9"],
            "the scheduler 'tcp://127.0.0.1:9' does not answer",
        ),
        (["--grid", "Kp=1:2:3", "--scheduler", "nonsense://x"], "does not answer"),
    ],
)
def test_bad_input_gets_one_line(arguments, said, native_path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if "--scheduler" in arguments:
        monkeypatch.setattr("twodof.sweeps.cluster.SCHEDULER_TIMEOUT", 0.5)
    (tmp_path / "taken").mkdir()
    assert main(["sweep", str(native_path), *arguments]) in (1, 2)
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith("twodof: error: ") and said in line
    assert [path.name for path in tmp_path.iterdir()] in (["taken"], [])


@pytest.mark.parametrize(
    ("package", "extra", "options"),
    [("pyarrow", "sweep", []), ("distributed", "cluster", ["--scheduler", "tcp://127.0.0.1:9"])],
)
def test_a_missing_extra_is_named(package, extra, options, native_path, tmp_path):
    missing = f"import sys; sys.modules[{package!r}] = None; "
    code = missing + "from twodof.__main__ import main; sys.exit(main())"
    done = python("-c", code, "sweep", native_path, "--grid", "Kp=1:2:2", *options, cwd=tmp_path)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert package in line and f"install the extra '{extra}': {sys.executable} -m pip" in line
    assert line.endswith(f"[{extra}]'")  # of the folder that it comes from, not of an index
    assert Path(shlex.split(line)[-1].removesuffix(f"[{extra}]"), "pyproject.toml").is_file()
    assert list(tmp_path.iterdir()) == []


# --- one instance, any outcome ---


def test_a_runner_instantiates_once_and_repeats_bit_for_bit(native_path, monkeypatch):
    """In any order, a run gives the results of a new instance."""
    made = []
    instantiate = runner_module.instantiate

    def counted(fmu: Fmu) -> AbstractContextManager[Any]:
        made.append(fmu)
        return instantiate(fmu)

    monkeypatch.setattr(runner_module, "instantiate", counted)
    options: ExperimentOptions = {"stop_time": 1.0, "step": STEP, "settings": {}}
    points = [(i, pair) for i, pair in enumerate(gains()[:5])]
    job = Job(native_path.read_bytes(), "a.fmu", ("Kp", "Kd"), options, None)
    with Runner(job) as runner:
        forth = [runner.run(point) for point in points]
        back = [runner.run(point) for point in reversed(points)]
    assert len(made) == 1
    alone = []
    for point in points:
        with Runner(job) as runner:
            alone.append(runner.run(point))
    assert forth == back[::-1] == alone
    made.clear()
    with Runner(Job(job.content, job.file, ("rtol",), options, None)) as runner:
        outcomes = [runner.run((0, (rtol,)))[-2] for rtol in (1e-3, -1.0, 1e-3, 1e-4)]
    assert outcomes == ["finished", "failed", "finished", "finished"]
    assert len(made) == 2  # after a failure a new one, whatever state the old one is in


ODD = """
if self.Kp[0] == 2.0:
    raise DiscardError('broken inside')
if self.Kp[0] == 3.0:
    self.v = [float('nan')] * 2; return
if self.Kp[0] == 4.0:
    import os, signal; os.kill(os.getpid(), signal.SIGKILL)
if self.Kp[0] == 5.0:
    raise RuntimeError('fatal, after which the standard allows no call')
"""


def test_each_run_has_its_outcome_and_harms_no_other(fmu_path, tmp_path):
    odd = changed_step(fmu_path, tmp_path, ODD)
    grid = {"Kp": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], "rtol": [1e-3, -1.0]}
    table = sweep(odd, grid=grid, stop_time=0.05)
    wanted = []
    for kp in grid["Kp"]:
        odd_one = {2.0: "discarded", 3.0: "diverged", 4.0: "crashed", 5.0: "failed"}
        wanted += [odd_one.get(kp, "finished"), "failed"]
    assert list(table["outcome"]) == wanted
    finished = table["outcome"] == "finished"
    assert table[list(METRICS)][~finished].isna().all(axis=None)
    assert table["final_error"][finished].notna().all()
    assert table["message"][finished].isna().all() and table["message"][~finished].notna().all()
    said = dict(zip(table["outcome"], table["message"], strict=True))
    assert "broken inside" in said["discarded"] and "rtol = -1 must be > 0" in said["failed"]
    assert list(table["end_time"][finished]) == [0.05] * finished.sum()
    expected = sweep(fmu_path, grid={"Kp": [1.0, 6.0, 7.0]}, stop_time=0.05)
    columns = list(METRICS)
    assert table[columns][finished].to_numpy() == pytest.approx(expected[columns].to_numpy(), nan_ok=True, abs=0)


def test_a_run_that_kills_is_given_up_alone(fmu_path, tmp_path, monkeypatch):
    """It starts three times, runs of its batch at most twice, and all others once.

    Runs that kill are more than a batch apart, so that each starts.
    """
    fmu = changed_step(fmu_path, tmp_path, BEGUN)
    monkeypatch.setenv("BEGUN", str(tmp_path / "begun"))
    grid = {"Kp": np.arange(1.0, 601.0)}
    table = sweep(fmu, grid=grid, stop_time=0.01, workers=2)
    assert list(table["Kp"][table["outcome"] == "crashed"]) == [300.0, 600.0]
    assert (table["outcome"] == "finished").sum() == 598
    begun = Counter(map(float, (tmp_path / "begun").read_text().split()))
    assert {kp for kp in begun if begun[kp] == 3} == {300.0, 600.0}
    assert max(begun[kp] for kp in begun if kp % 300) <= 2


def test_bags_hold_the_runs(native_path, tmp_path):
    table = sweep(native_path, grid=SMALL, stop_time=0.5, output=tmp_path / "s", bags=True)
    for run in table.to_dict("records"):
        bag = twodof.read_bag(tmp_path / "s/bags" / f"{run['run']:06d}")
        assert np.abs(bag.v).max() == run["peak_velocity"]
        assert bag.provenance["start_values"]["Kp[2]"] == run["Kp"]
    assert len(list((tmp_path / "s/bags").iterdir())) == 6
