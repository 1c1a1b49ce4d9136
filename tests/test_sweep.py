"""Sweeps: the metrics against closed forms, the table whatever dies, the map by what it draws."""

from __future__ import annotations

import io
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event

import browser
import duckdb
import numpy as np
import oracles
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from harness import asked, changed_plant, children_of, lay_traps, lives, needs, wait_until
from PIL import Image

import twodof
from twodof import TwoDofError, sweep
from twodof.cli.main import main
from twodof.fmu import Instance, instantiate
from twodof.plots.figure import drawn, save
from twodof.plots.sweeps import drawing
from twodof.sweeps import runner as runner_module
from twodof.sweeps.metrics import METRICS
from twodof.sweeps.results import read_sweep
from twodof.sweeps.runner import Job, Runner, trace

Q0, TARGET = np.array([0.5, 0.35]), np.array([0.2, 0.05])
STEP, STOP = 0.01, 5.0
COMMAND = [sys.executable, "-m", "twodof"]
SMALL = {"Kp": (20.0, 60.0, 180.0), "Kd": (8.0, 30.0)}
GRIDS = ["--grid", "Kp=10:200:20", "--grid", "Kd=5:80:16", "--stop-time", "10"]


def table_of(path: Path) -> pandas.DataFrame:
    """A sweep's table, as it lies in its files, by another reader of Parquet."""
    return duckdb.sql(f"select * from '{path}/*.parquet'").df()


def same(found: pandas.DataFrame, expected: pandas.DataFrame) -> None:
    """Equal to the bit, row by row."""
    pandas.testing.assert_frame_equal(found, expected, check_exact=True, check_dtype=False)


# --- metrics ---


def response(kp: float, kd: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """φ and φ' of φ'' + kd φ' + kp φ = 0, φ(0) = 1, φ'(0) = 0; sound at critical damping too."""
    a = kd / 2
    w = np.sqrt(complex(a * a - kp))
    z = w * t
    small = np.abs(z) < 1e-4
    sinhc = np.where(small, 1 + z * z / 6, np.sinh(z) / np.where(small, 1, z))
    phi = np.exp(-a * t) * (np.cosh(z) + a * t * sinhc)
    slope = -kp * t * np.exp(-a * t) * sinhc
    return phi.real, slope.real


def gains() -> list[tuple[float, float]]:
    """200 pairs: under-, over- and critically damped."""
    rng = np.random.default_rng(7)
    pairs = []
    for i in range(200):
        kp = rng.uniform(10.0, 250.0)
        damping = (rng.uniform(0.15, 0.95), 1.0, rng.uniform(1.05, 4.0))[i % 3]
        pairs.append((kp, 2 * damping * np.sqrt(kp)))
    return pairs


@pytest.fixture(scope="module")
def judged(native_path: Path) -> list[dict[str, float]]:
    """The metrics of the pairs, by the runs themselves."""
    options = {"stop_time": STOP, "step": STEP, "settings": {}}
    job = Job(native_path.read_bytes(), "a.fmu", ("Kp", "Kd"), options, None)
    with Runner(job) as runner:
        rows = [runner.run((i, pair)) for i, pair in enumerate(gains())]
    assert {row[-2] for row in rows} == {"finished"}
    return [dict(zip(METRICS, row[3:])) for row in rows]


def test_metrics_are_those_of_the_closed_form(judged: list[dict[str, float]]) -> None:
    t = np.arange(501) * STEP
    e0 = TARGET - oracles.position(Q0)
    size = np.linalg.norm(e0)
    settled = 0
    for (kp, kd), found in zip(gains(), judged):
        phi, _ = response(kp, kd, t)
        error = np.abs(phi) * size
        close = {"rel": 1e-6, "abs": 1e-9}
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
    assert 150 < settled < 200


def test_peaks_are_those_of_the_closed_form(judged: list[dict[str, float]]) -> None:
    """Joint velocities by the inverse of the Jacobian, torques by the textbook's dynamics."""
    t = np.arange(501) * STEP
    start = oracles.position(Q0)
    arm = oracles.TwoLinkArm(Path(__file__).parents[1] / "urdf/2dof.urdf", 9.81)
    for (kp, kd), found in list(zip(gains(), judged))[::10]:
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


def test_time_at_limits_is_that_of_the_samples(native_path: Path) -> None:
    """The first joint would pass 0.2 rad on its way down; samples tell how long it stays there."""
    settings = {"q_min": (0.2, -3.0)}
    (row,) = sweep(native_path, grid={"Kp": [50.0]}, settings=settings).to_dict("records")
    samples = list(twodof.samples(native_path, settings={**settings, "Kp": 50.0}))
    at_limit = sum(sample.q[0] == 0.2 for sample in samples)
    assert at_limit > 50
    assert row["time_at_limits"] == pytest.approx(at_limit * STEP)


def test_what_is_not_defined_is_null(native_path: Path) -> None:
    at_rest = {"x_des": tuple(oracles.position(Q0))}
    (row,) = sweep(native_path, grid={"Kp": [50.0]}, settings=at_rest).to_dict("records")
    assert np.isnan(row["settling_time"]) and np.isnan(row["overshoot"])
    assert row["final_error"] < 1e-12 and row["outcome"] == "finished"


# --- the design ---


def test_design_is_the_product_of_grids_with_the_same_draws(native_path: Path) -> None:
    options = {"grid": SMALL, "ranges": {"tau_ext[2]": (-0.01, 0.02)}, "random": 4, "seed": 5}
    table = sweep(native_path, stop_time=0.05, **options)
    assert list(table["run"]) == list(range(24))
    draws = np.random.default_rng(5).uniform(-0.01, 0.02, 4)
    expected = [(kp, kd, d) for kp in SMALL["Kp"] for kd in SMALL["Kd"] for d in draws]
    assert table[["Kp", "Kd", "tau_ext[2]"]].to_numpy() == pytest.approx(np.array(expected), abs=0)
    same(sweep(native_path, stop_time=0.05, **options), table)


def test_a_name_without_an_index_sets_all_elements(native_path: Path) -> None:
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
        (["--grid", "Kp=1:2:0"], "COUNT 0 is no whole number from 2 on"),
        (["--grid", "Kp=1:2:2.5"], "COUNT 2.5 is no whole number from 2 on"),
        (["--grid", "Kp=1:2"], "--grid Kp=1:2: expected NAME=LOW:HIGH:COUNT"),
        (["--grid", "Kp=1:nan:3"], "its numbers must be finite"),
        (["--grid", "Kp=1:2:3", "--grid", "Kp=1:2:3"], "--grid Kp is given twice"),
        (["--grid", "Kp=1:2:3", "--range", "Kp[2]=1:2", "--random", "2"],
         "Kp[2] gets values from the design of Kp and from Kp[2]"),
        (["--grid", "Kp=1:2:3", "--set", "Kp[1]=4"],
         "Kp[1] gets values from the settings and from Kp"),
        (["--range", "Kp=1:2"], "0 random draws of Kp; at least 1 is needed"),
        (["--range", "Kp=2:1", "--random", "3"], "LOW 2 must be below HIGH 1"),
        (["--random", "3"], "there is nothing to vary"),
        (["--grid", "Kp=1:2:3", "--random", "3"], "3 random draws of nothing; give a range"),
        ([], "there is nothing to vary"),
        (["--grid", "Kp=1:2:3", "--stop-time", "-1"], "stop time -1 s must be after"),
        (["--grid", "Kp=1:2:99999", "--grid", "Kd=1:2:99"], "runs; at most"),
        (["--grid", "limit_effort=0:1:2"], "limit_effort = 0.0: expected true or false"),
        (["--grid", "Kp=1:2:3", "--resume"], "--resume does nothing without -o"),
        (["--grid", "Kp=1:2:3", "--resume", "-o", "none"], "there is no sweep 'none' to resume"),
        (["--grid", "Kp=1:2:3", "-o", "taken"], "'taken' exists and is no sweep; choose another"),
        (["--grid", "Kp=1:2:3", "--workers", "0"], "0 workers; at least 1 is needed"),
        (["--grid", "Kp=1:2:3", "--scheduler", "tcp://127.0.0.1:9"],
         "the scheduler 'tcp://127.0.0.1:9' does not answer"),
        (["--grid", "Kp=1:2:3", "--scheduler", "nonsense://x"], "does not answer"),
    ],
)  # fmt: skip
def test_bad_input_gets_one_line(
    arguments: list[str], said: str, native_path: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    begin = time.process_time()
    assert main(["sweep", str(native_path), *arguments]) in (1, 2)
    assert time.process_time() - begin < 5.0
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith("twodof: error: ") and said in line
    assert [path.name for path in tmp_path.iterdir()] in (["taken"], [])


MISSING = [
    ("pandas", "sweep", []),
    ("pyarrow", "sweep", []),
    ("distributed", "cluster", ["--scheduler", "tcp://127.0.0.1:9"]),
]


@pytest.mark.parametrize(("package", "extra", "options"), MISSING)
def test_a_missing_extra_is_named(
    package: str, extra: str, options: list[str], native_path: Path, tmp_path: Path
) -> None:
    missing = f"import sys; sys.modules[{package!r}] = None; "
    code = missing + "from twodof.__main__ import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, "sweep", str(native_path), "--grid", "Kp=1:2:2", *options],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert package in line and f"install the extra '{extra}'" in line
    assert list(tmp_path.iterdir()) == []


# --- one instance, any outcome ---


def test_a_runner_instantiates_once_and_repeats_to_the_bit(
    native_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In any order, what a run gives is what a fresh instance gives."""
    made = []
    instantiate = runner_module.instantiate
    monkeypatch.setattr(
        runner_module, "instantiate", lambda fmu: made.append(fmu) or instantiate(fmu)
    )
    options = {"stop_time": 1.0, "step": STEP, "settings": {}}
    points = [(i, pair) for i, pair in enumerate(gains()[:12])]
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


ODD = b"""        if self.Kp[0] == 2.0:
            raise DiscardError('broken inside')
        if self.Kp[0] == 3.0:
            self.v = [float('nan')] * 2; return
        if self.Kp[0] == 4.0:
            import os, signal; os.kill(os.getpid(), signal.SIGKILL)
        if self.Kp[0] == 5.0:
            raise RuntimeError('fatal, after which the standard allows no call')
        stops = self._stops()"""


def test_each_run_has_its_outcome_and_harms_no_other(fmu_path: Path, tmp_path: Path) -> None:
    odd = changed_plant(fmu_path, tmp_path, b"        stops = self._stops()", ODD)
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
    assert table[columns][finished].to_numpy() == pytest.approx(
        expected[columns].to_numpy(), nan_ok=True, abs=0
    )


BEGUN = b"""        import os, signal
        with open(os.environ['BEGUN'], 'a') as file:
            file.write(f'{self.Kp[0]:g} ')
        if self.Kp[0] % 300 == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        stops = self._stops()"""


def test_a_run_that_kills_is_given_up_alone(
    fmu_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is begun three times; what was in its batch, twice at most; all else once.

    Those that kill are further apart than a batch is long: in one, the second would not begin.
    """
    fmu = changed_plant(fmu_path, tmp_path, b"        stops = self._stops()", BEGUN)
    monkeypatch.setenv("BEGUN", str(tmp_path / "begun"))
    grid = {"Kp": np.arange(1.0, 601.0)}
    table = sweep(fmu, grid=grid, stop_time=0.01, workers=2)
    assert list(table["Kp"][table["outcome"] == "crashed"]) == [300.0, 600.0]
    assert (table["outcome"] == "finished").sum() == 598
    begun = Counter(map(float, (tmp_path / "begun").read_text().split()))
    assert {kp for kp in begun if begun[kp] == 3} == {300.0, 600.0}
    assert max(begun[kp] for kp in begun if kp % 300) <= 2


def test_flavours_agree(fmu_path: Path, native_path: Path) -> None:
    grid = {"Kp": [20.0, 90.0], "Kd": [15.0, 30.0]}
    python, native = (sweep(path, grid=grid, stop_time=2.0) for path in (fmu_path, native_path))
    for name in METRICS:
        assert python[name].to_numpy() == pytest.approx(
            native[name].to_numpy(), rel=1e-9, abs=1e-9, nan_ok=True
        )


def test_bags_hold_the_runs(native_path: Path, tmp_path: Path) -> None:
    table = sweep(native_path, grid=SMALL, stop_time=0.5, output=tmp_path / "s", bags=True)
    for run in table.to_dict("records"):
        bag = twodof.read_bag(tmp_path / "s/bags" / f"{run['run']:06d}")
        assert np.abs(bag.v).max() == run["peak_velocity"]
        assert bag.provenance["start_values"]["Kp[2]"] == run["Kp"]
    assert len(list((tmp_path / "s/bags").iterdir())) == 6


# --- the table ---


def test_table_is_parquet_with_units_and_provenance(native_path: Path, tmp_path: Path) -> None:
    table = sweep(
        native_path, grid=SMALL, stop_time=0.5, output=tmp_path / "s", command_line="by hand"
    )
    assert [path.name for path in (tmp_path / "s").iterdir()] == ["runs.parquet"]
    same(table_of(tmp_path / "s"), table)
    unsettled = f"select count(*) from '{tmp_path}/s/runs.parquet' where settling_time is null"
    ((count,),) = duckdb.sql(unsettled).fetchall()
    assert count == table["settling_time"].isna().sum() > 0
    found = duckdb.sql(f"select key, value from parquet_kv_metadata('{tmp_path}/s/runs.parquet')")
    (text,) = [value for key, value in found.fetchall() if key == b"twodof"]
    made = json.loads(text)
    fmu = twodof.load_fmu(native_path)
    assert made["fmu"]["guid"] == fmu.guid and made["command_line"] == "by hand"
    assert made["design"]["grids"] == {name: list(values) for name, values in SMALL.items()}
    assert made["versions"]["twodof"] == twodof.__version__
    types = dict(duckdb.sql(f"select * from '{tmp_path}/s/runs.parquet'").description and [
        (row[0], str(row[1])) for row in
        duckdb.sql(f"describe select * from '{tmp_path}/s/runs.parquet'").fetchall()
    ])  # fmt: skip
    assert types["run"] == "BIGINT" and types["outcome"] == types["message"] == "VARCHAR"
    assert {types[name] for name in ("Kp", "Kd", *METRICS, "end_time")} == {"DOUBLE"}


def begin(fmu: Path, output: Path, *options: str) -> subprocess.Popen[str]:
    command = [*COMMAND, "sweep", str(fmu), *GRIDS, "-o", str(output), *options]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


@pytest.fixture(scope="module")
def undisturbed(native_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of 320 runs that nothing disturbs."""
    path = tmp_path_factory.mktemp("sweep") / "whole"
    done = begin(native_path, path)
    out, err = done.communicate(timeout=120)
    assert (done.returncode, err) == (0, "")
    assert "320 of 320 runs: 320 finished" in out and f"twodof plot {path}" in out
    return path


@pytest.mark.long
def test_what_is_interrupted_is_resumed(
    native_path: Path, undisturbed: Path, tmp_path: Path, length: Callable[[int, int], int]
) -> None:
    """By Ctrl-C to all processes of the terminal, or by the death of the sweep's own."""
    rng = random.Random(3)
    expected = table_of(undisturbed)
    kept = []
    for i in range(length(20, 2)):
        path = tmp_path / f"s{i}"
        process = begin(native_path, path)
        while not any(path.glob("part-000001*")):
            assert process.poll() is None, process.communicate()
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.5))
        if i % 2:
            process.kill()
            process.communicate()
        else:
            os.killpg(process.pid, signal.SIGINT)
            out, err = process.communicate(timeout=120)
            assert err == "", err
            if len(table_of(path)) < 320:
                assert process.returncode == 130
                assert re.search(r"^  twodof sweep .* --resume$", out, re.M)
        kept.append(len(table_of(path)))
        os.utime(path)
        again = begin(native_path, path, "--resume")
        out, err = again.communicate(timeout=120)
        assert (again.returncode, err) == (0, ""), err
        same(table_of(path), expected)
        assert [file.name for file in path.iterdir()] == ["runs.parquet"]
    print(f"rows kept of 320 when interrupted: {kept}")
    assert 0 < min(kept) < 320


def test_resuming_repeats_nothing(native_path: Path, tmp_path: Path) -> None:
    stop = Event()
    path, done = tmp_path / "s", []

    def progress(count: int, runs: int) -> None:
        done.append(count)
        if count >= 3:
            stop.set()

    options = {"grid": {"Kp": np.linspace(10, 90, 40)}, "stop_time": 20.0, "output": path}
    table = sweep(native_path, workers=1, progress=progress, stop=stop.is_set, **options)
    assert 3 <= len(table) < 40
    parts = {file: file.read_bytes() for file in path.iterdir()}
    counts: list[int] = []
    resumed = sweep(
        native_path, resume=True, progress=lambda count, runs: counts.append(count), **options
    )
    assert counts[0] == len(table) and len(parts) > 1
    same(resumed, sweep(native_path, **{**options, "output": None}))
    made = {file.name: file.read_bytes() for file in path.iterdir()}
    sweep(native_path, resume=True, **options)  # is finished: nothing is run, nothing changes
    assert {file.name: file.read_bytes() for file in path.iterdir()} == made


def test_what_is_another_sweep_is_not_resumed(
    native_path: Path, tmp_path: Path, fmu_path: Path
) -> None:
    path = tmp_path / "s"
    options = {"grid": {"Kp": [1.0, 2.0]}, "stop_time": 0.05, "output": path, "resume": True}
    sweep(native_path, **{**options, "resume": False})
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    for change, said in (
        ({"grid": {"Kp": [1.0, 3.0]}}, r'was begun with grids {"Kp": \[1.0, 2.0\]};'),
        (
            {"stop_time": 0.06},
            "was begun with stop time 0.05; begin this sweep in another `output`",
        ),
        ({"bags": True}, "was begun with `bags=False`;"),
        ({"resume": False}, "exists; resume it with `resume=True`, or choose another `output`"),
    ):
        with pytest.raises(TwoDofError, match=said):
            sweep(native_path, **{**options, **change})
    with pytest.raises(TwoDofError, match=r"was begun with another FMU, TwoDof-native.fmu \("):
        sweep(fmu_path, **options)
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before


def test_damaged_and_foreign_tables_get_one_line(native_path: Path, tmp_path: Path) -> None:
    for name, content in (("cut", None), ("empty", b""), ("other", b"PAR1 no")):
        path = tmp_path / name
        sweep(native_path, grid={"Kp": [1.0]}, stop_time=0.02, output=path)
        file = path / "runs.parquet"
        file.write_bytes(file.read_bytes()[:-100] if content is None else content)
        with pytest.raises(TwoDofError, match=f"cannot read '.*{name}/runs.parquet'"):
            read_sweep(path)
    pandas.DataFrame({"run": [1]}).to_parquet(tmp_path / "cut/runs.parquet")
    with pytest.raises(TwoDofError, match="was not written by twodof"):
        read_sweep(tmp_path / "cut")
    with pytest.raises(TwoDofError, match="is no sweep"):
        read_sweep(tmp_path)
    with pytest.raises(TwoDofError, match=r"cannot read '.*none': No such file or directory"):
        read_sweep(tmp_path / "none")


def endless(table: pa.Table) -> pa.Table:
    """Two million rows in some kilobytes."""
    return table.take(pa.array(np.zeros(2_000_000, dtype=np.int64)))


def of_one_text(table: pa.Table) -> pa.Table:
    """A text of a megabyte, stored once, in each of a thousand rows."""
    provenance = json.loads(table.schema.metadata[b"twodof"])
    provenance["design"]["draws"] = 1000
    rows = table.take(pa.array(np.zeros(1000, dtype=np.int64)))
    rows = changed(rows, "run", pa.array(range(1000)))
    rows = changed(rows, "message", pa.array(["x" * 1024**2] * 1000))
    return rows.replace_schema_metadata({b"twodof": json.dumps(provenance)})


def changed(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    place = table.schema.get_field_index(name)
    field = table.schema.field(name)
    return table.set_column(place, field.with_type(values.type), values)


def described(table: pa.Table, key: str, value: object) -> pa.Table:
    provenance = {**json.loads(table.schema.metadata[b"twodof"]), key: value}
    return table.replace_schema_metadata({b"twodof": json.dumps(provenance)})


HOSTILE_TABLES: dict[str, Callable[[pa.Table], pa.Table]] = {
    "without outcomes": lambda table: table.drop(["outcome"]),
    "without runs": lambda table: table.drop(["run"]),
    "runs beyond the design": lambda table: changed(table, "run", pa.array([0, 10**9])),
    "runs before the first": lambda table: changed(table, "run", pa.array([0, -1])),
    "a run twice": lambda table: changed(table, "run", pa.array([1, 1])),
    "text for numbers": lambda table: changed(table, "settling_time", pa.array(["a", "b"])),
    "not finite": lambda table: changed(table, "Kp", pa.array([1.0, np.inf])),
    "no design": lambda table: described(table, "design", []),
    "no FMU": lambda table: described(table, "fmu", {}),
    "a long number": lambda table: described(
        table, "options", {"stop_time": 10**400, "step": 1, "settings": {}}
    ),
    "endless": endless,
    "one text for all": of_one_text,
}


READING = pa.proxy_memory_pool(pa.default_memory_pool())  # which outlives what lies in it


@pytest.fixture(scope="module")
def sound(native_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "s"
    sweep(native_path, grid={"Kp": [1.0, 2.0]}, stop_time=0.02, output=path, workers=1)
    return path / "runs.parquet"


@pytest.mark.parametrize("make", HOSTILE_TABLES.values(), ids=HOSTILE_TABLES)
def test_hostile_table_gets_one_line_in_little_memory(
    sound: Path, tmp_path: Path, make: Callable[[pa.Table], pa.Table]
) -> None:
    assert len(read_sweep(sound.parent)[0]) == 2
    pq.write_table(make(pq.read_table(sound)), tmp_path / "runs.parquet")
    usual = pa.default_memory_pool()
    pa.set_memory_pool(READING)
    try:
        with pytest.raises(TwoDofError, match=r"runs\.parquet' was not written|it is damaged"):
            read_sweep(tmp_path)
    finally:
        pa.set_memory_pool(usual)
    assert READING.max_memory() < 64 * 1024**2


@pytest.mark.long
def test_memory_of_the_coordinator_is_flat(
    native_path: Path, tmp_path: Path, length: Callable[[int, int], int]
) -> None:
    """Once pyarrow has written its first rows, for which it takes some 15 MiB."""
    code = """
import sys, twodof
from pathlib import Path
from sinks import resident
def look(done, runs):
    seen.append((len(list(Path(output).glob("part-*"))), done, resident() / 2**20))
if __name__ == "__main__":
    fmu, output, runs = sys.argv[1], sys.argv[2], int(sys.argv[3])
    seen = []
    twodof.sweep(fmu, ranges={"Kp": (10, 90)}, random=runs, stop_time=0.5, output=output,
                 progress=look)
    late = [row for row in seen if row[0] >= 2]
    print(late[0][1], max(row[2] for row in late) - late[0][2], seen[-1][2] - seen[1][2])
"""
    runs = length(10_000, 3_000)
    done = subprocess.run(
        [sys.executable, "-c", code, str(native_path), str(tmp_path / "s"), str(runs)],
        cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=500,
    )  # fmt: skip
    first, growth, all_growth = map(float, done.stdout.split())
    print(f"coordinator: {growth:.1f} MiB from run {first:.0f} to {runs}; {all_growth:.1f} in all")
    assert first < 0.9 * runs
    assert growth < 8.0  # it goes up and down by 5


# --- workers ---


def doors(process: int) -> list[str]:
    """What the kernel says of its sockets that others could connect or send to."""
    own = set()
    for entry in Path(f"/proc/{process}/fd").iterdir():
        with suppress(OSError):
            own.add(re.sub(r"socket:\[(\d+)\]", r"\1", os.readlink(entry)))
    found = []
    for kind in ("tcp", "tcp6", "udp", "udp6"):
        lines = Path(f"/proc/{process}/net/{kind}").read_text().splitlines()[1:]
        found += [f"{kind} {line}" for line in lines if line.split()[9] in own]
    for line in Path(f"/proc/{process}/net/unix").read_text().splitlines()[1:]:
        _, _, _, flags, _, _, inode, *name = line.split()
        if inode in own and (name or int(flags, 16) & 0x10000):  # it listens
            found.append(f"unix {line}")
    return found


def test_nobody_else_can_talk_to_workers(native_path: Path) -> None:
    """No socket has a port or a name, no other user can write where they read; one thread each."""
    before, seen = doors(os.getpid()), {}

    def look(done: int, runs: int) -> None:
        for worker in children_of(os.getpid()):
            assert (doors(worker), doors(os.getpid())) == ([], before)
            status = Path(f"/proc/{worker}/status").read_text()
            threads = int(re.search(r"Threads:\s+(\d+)", status)[1])
            environment = Path(f"/proc/{worker}/environ").read_text().split("\0")
            (folder,) = [Path(line[7:]) for line in environment if line.startswith("TMPDIR=")]
            if threads > 1:  # it has started
                seen[worker] = threads, folder.stat().st_mode & 0o077

    grid = {"Kp": np.linspace(10.0, 90.0, 2000)}
    sweep(native_path, grid=grid, workers=2, progress=look, stop=lambda: len(seen) == 2)
    assert [*seen.values()] == 2 * [(2, 0)]  # one thread runs, the other waits for our end


PROGRAM = """
import sys
import twodof
def run():
    return twodof.sweep(sys.argv[-1], grid={"Kp": [20.0, 60.0]}, stop_time=0.1, workers=1)
expected = run()
sys.path.append(sys.argv[-2])
from harness import lay_traps
lay_traps(".")  # only now: this process itself may import from here
assert run().equals(expected)
assert not {"dask", "distributed"} & {*sys.modules}
"""


@pytest.mark.parametrize(
    ("way", "variables"),
    [  # what a way puts on the path and what a variable does are independent of each other
        (["-c", PROGRAM], {}), (["program.py"], {}), (["-m", "program"], {}),
        (["program.py"], {"PYTHONPATH": ":."}), (["-c", PROGRAM], {"PYTHONSAFEPATH": "1"}),
    ],
)  # fmt: skip
def test_workers_import_nothing_from_the_working_directory(
    way: list[str], variables: dict[str, str], native_path: Path, tmp_path: Path
) -> None:
    """Nor the program itself, which shields nothing by ``if __name__ == "__main__"``."""
    (tmp_path / "program.py").write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, *way, str(Path(__file__).parent), str(native_path)], cwd=tmp_path,
        env={**os.environ, **variables}, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "numpy.py").exists() and not list(tmp_path.glob("*.sprung"))


def test_the_command_imports_nothing_from_the_working_directory(
    native_path: Path, tmp_path: Path
) -> None:
    lay_traps(tmp_path)
    done = subprocess.run(
        [sys.executable, "-I", *COMMAND[1:], "sweep", str(native_path), "--grid", "Kp=20:60:3"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": ":."}, capture_output=True, text=True,
        check=False, timeout=120,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert "3 of 3 runs: 3 finished" in done.stdout and not list(tmp_path.glob("*.sprung"))


def test_workers_run_the_package_that_the_program_runs(native_path: Path, tmp_path: Path) -> None:
    """Another one than is installed, in the working directory."""
    shutil.copytree(Path(twodof.__file__).parent, tmp_path / "twodof")
    with (tmp_path / "twodof/sweeps/metrics.py").open("a") as file:
        file.write("measure = lambda *arrays: dict.fromkeys(METRICS, 17.0)\n")
    code = "import sys, twodof; print(*twodof.sweep(sys.argv[1], grid={'Kp': [9.0]})['overshoot'])"
    done = subprocess.run(
        [sys.executable, "-c", code, str(native_path)],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("17.0\n", "")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("raise ImportError('no such luck')", "a child process failed: ImportError: no such luck"),
        ("import os; os._exit(3)", "workers die as they start: exit status 3"),
        ("import os; os.kill(os.getpid(), 9)", "workers die as they start: exit status -9"),
    ],
)
def test_workers_that_cannot_start_tell_why(
    text: str, said: str, native_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(TwoDofError, match=said):
        sweep(native_path, grid={"Kp": [1.0, 2.0, 3.0]}, output=tmp_path / "s", workers=3)
    assert not (tmp_path / "s").exists() and children_of(os.getpid()) == []


def test_an_fmu_that_workers_cannot_load_is_named(native_path: Path, tmp_path: Path) -> None:
    broken = tmp_path / "Broken.fmu"
    with zipfile.ZipFile(native_path) as archive, zipfile.ZipFile(broken, "w") as changed:
        for name in archive.namelist():
            content = archive.read(name)
            changed.writestr(name, bytes(4096) if name.endswith(".so") else content)
    with pytest.raises(TwoDofError, match=r"Broken.fmu' cannot be loaded: .*invalid ELF"):
        sweep(broken, grid={"Kp": [1.0]})


@pytest.mark.long
def test_workers_that_are_killed_cost_no_run(
    native_path: Path, length: Callable[[int, int], int]
) -> None:
    runs, pause, part = length(2000, 100), length(5, 0), length(1, 30)
    grid = {"Kp": np.linspace(10.0, 200.0, runs)}
    expected = sweep(native_path, grid=grid, stop_time=8)
    killed = [(time.monotonic(), 0)]
    rng = random.Random(1)

    def kill(done: int, runs: int) -> None:
        """Each so many seconds, and runs that are done."""
        now = time.monotonic()
        workers = children_of(os.getpid())
        if workers and now >= killed[-1][0] + pause and done >= killed[-1][1] + part:
            os.kill(rng.choice(workers), signal.SIGKILL)
            killed.append((now, done))

    found = sweep(native_path, grid=grid, stop_time=8, progress=kill)
    print(f"{len(killed) - 1} workers killed during {runs} runs")
    assert len(killed) > 2
    assert list(found["run"]) == list(range(runs))
    same(found, expected)


SLEEP = b"""        if self.Kp[0] == 4.0:
            import os, time
            open(os.environ['ASLEEP'], 'w').close()
            time.sleep(1e6)
        stops = self._stops()"""


@contextmanager
def asleep(fmu_path: Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A sweep, in folder/s, whose third run takes days and has begun; and its workers."""
    fmu = changed_plant(fmu_path, folder, b"        stops = self._stops()", SLEEP)
    grid = ["--grid", "Kp=2:6:5", "--stop-time", "0.05", "--workers", "1"]
    process = subprocess.Popen(
        [*COMMAND, "sweep", str(fmu), *grid, "-o", str(folder / "s")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "ASLEEP": str(folder / "asleep")},
    )  # fmt: skip
    try:
        wait_until(lambda: (folder / "asleep").exists())
        yield process, children_of(process.pid)
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_a_sweep_in_the_midst_of_a_long_run(
    number: signal.Signals, fmu_path: Path, tmp_path: Path
) -> None:
    """What is done is stored, and nothing is left running."""
    with asleep(fmu_path, tmp_path) as (process, workers):
        process.send_signal(number)
        out, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (130, "")
    done = list(table_of(tmp_path / "s")["Kp"])
    assert done in ([2.0], [2.0, 3.0])  # the latter may be in one batch with what sleeps
    assert f"{len(done)} of 5 runs: {len(done)} finished" in out and "--resume" in out
    assert len(workers) == 1 and not lives(workers[0])


def test_workers_end_with_the_sweep_whatever_they_are_at(fmu_path: Path, tmp_path: Path) -> None:
    with asleep(fmu_path, tmp_path) as (process, workers):
        process.kill()
        process.communicate()
        assert len(workers) == 1
        wait_until(lambda: not lives(workers[0]))


def test_a_sweep_can_be_stopped_while_its_workers_start(
    native_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("import time; time.sleep(1e6)")
    monkeypatch.syspath_prepend(tmp_path)
    table = sweep(native_path, grid={"Kp": [1.0, 2.0]}, output=tmp_path / "s", stop=asked(5))
    assert len(table) == len(table_of(tmp_path / "s")) == 0
    assert children_of(os.getpid()) == []


def test_a_sweep_can_be_stopped_while_a_scheduler_does_not_answer(native_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        table = sweep(native_path, grid={"Kp": [1.0]}, scheduler=address, stop=asked(5))
    assert len(table) == 0


@contextmanager
def cluster(
    folder: Path, workers: int, options: Sequence[str] = (), **environment: str
) -> Iterator[tuple[str, int]]:
    """Address and process of a scheduler, with workers that have joined it."""
    file, log = folder / "scheduler.json", folder / "cluster.log"
    programs = [["scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1"]]
    programs += [["worker", "--nthreads", "2", "--no-dashboard"]] * workers
    with log.open("a") as told:
        processes = [
            subprocess.Popen(
                [sys.executable, "-m", "dask", *program, "--scheduler-file", str(file), *options],
                stdout=told, stderr=told, start_new_session=True,
                env={**os.environ, **environment},
            )
            for program in programs
        ]  # fmt: skip
    try:
        while (
            not file.exists()
            or not file.read_text()
            or log.read_text().count("Registered to:") < workers
        ):
            assert all(process.poll() is None for process in processes), log.read_text()
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"], processes[0].pid
    finally:
        for process in processes[::-1]:
            os.killpg(process.pid, signal.SIGTERM)
        for process in processes:
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:  # a nanny whose worker dies while it is asked to end
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def test_a_sweep_can_be_stopped_when_its_scheduler_is_suspended(
    native_path: Path, tmp_path: Path
) -> None:
    suspended, looks = [], asked(5)
    with cluster(tmp_path, 1) as (address, scheduler):

        def suspend(done: int, runs: int) -> None:
            if done and not suspended:
                os.kill(scheduler, signal.SIGSTOP)
                suspended.append(done)

        try:
            grid = {"Kp": np.linspace(10.0, 200.0, 2000)}
            table = sweep(
                native_path, grid=grid, scheduler=address, progress=suspend,
                stop=lambda: bool(suspended) and looks(),
            )  # fmt: skip
        finally:
            os.kill(scheduler, signal.SIGCONT)
    assert suspended[0] <= len(table) < 2000


def test_a_cluster_that_asks_for_keys(native_path: Path, tmp_path: Path) -> None:
    """By Dask's own configuration; who has none is not let in."""
    key, certificate = str(tmp_path / "key.pem"), str(tmp_path / "certificate.pem")
    subprocess.run(
        [needs("openssl"), "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=cluster",
         "-days", "2", "-keyout", key, "-out", certificate],
        check=True, capture_output=True,
    )  # fmt: skip
    names = (("--tls-ca-file", certificate), ("--tls-cert", certificate), ("--tls-key", key))
    options = ["--protocol", "tls", *(word for pair in names for word in pair)]
    files = {"CA_FILE": certificate, "CLIENT__KEY": key, "CLIENT__CERT": certificate}
    keys = {f"DASK_DISTRIBUTED__COMM__TLS__{name}": file for name, file in files.items()}
    grid = {"Kp": [20.0, 60.0]}
    with cluster(tmp_path, 1, options) as (address, _):
        assert address.startswith("tls://")
        command = ["sweep", str(native_path), "--grid", "Kp=20:60:2", "--scheduler", address]
        done = subprocess.run(
            [*COMMAND, *command, "-o", str(tmp_path / "s")],
            env={**os.environ, **keys}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        same(table_of(tmp_path / "s"), sweep(native_path, grid=grid))
        for stranger in (address, address.replace("tls", "tcp")):
            with pytest.raises(TwoDofError, match="does not answer"):
                sweep(native_path, grid=grid, scheduler=stranger)


def test_a_cluster_gives_the_table_of_local_workers(native_path: Path, tmp_path: Path) -> None:
    grid = {"Kp": np.linspace(10.0, 200.0, 30), "Kd": [10.0, 40.0]}
    expected = sweep(native_path, grid=grid)
    with cluster(tmp_path, 2) as (address, _):
        for _ in range(2):  # the workers stay, and nothing of a sweep stays with them
            same(sweep(native_path, grid=grid, scheduler=address), expected)


def test_a_run_that_kills_is_given_up_by_a_cluster(fmu_path: Path, tmp_path: Path) -> None:
    """And not what its worker has in hand beside it, of which Dask thinks no better."""
    fmu = changed_plant(fmu_path, tmp_path, b"        stops = self._stops()", BEGUN)
    variables = {
        "BEGUN": str(tmp_path / "begun"), "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"
    }  # fmt: skip
    with cluster(tmp_path, 1, **variables) as (address, _):
        grid = {"Kp": [298.0, 299.0, 300.0, 301.0]}
        table = sweep(fmu, grid=grid, stop_time=0.01, scheduler=address)
    assert list(table["outcome"]) == ["finished", "finished", "crashed", "finished"]
    assert (tmp_path / "begun").read_text().split().count("300") == 3


BLOCK = """
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "twodof":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Blocker())
"""


def test_workers_without_the_package_are_named(native_path: Path, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(BLOCK)
    with (
        cluster(tmp_path, 1, PYTHONPATH=str(tmp_path)) as (address, _),
        pytest.raises(TwoDofError, match=r"a worker cannot take the job: .*; install twodof \d"),
    ):
        sweep(native_path, grid={"Kp": [1.0]}, scheduler=address)


def test_a_scheduler_without_workers_is_named(native_path: Path, tmp_path: Path) -> None:
    with cluster(tmp_path, 0) as (address, _), pytest.raises(TwoDofError, match="has no workers"):
        sweep(native_path, grid={"Kp": [1.0]}, scheduler=address)


# --- the map ---


def panels(path: Path) -> dict[str, object]:
    table, provenance = read_sweep(path)
    figure = drawn(drawing(table, provenance, "a"))
    return {axes.get_label(): axes for axes in figure.axes if " over " in axes.get_label()}


LINES = """() => [...document.querySelectorAll(".runs td")].map(cell => {
    const words = document.createRange();
    words.selectNodeContents(cell);
    return new Set([...words.getClientRects()].map(box => box.top)).size;
})"""


def test_a_page_of_maps_has_their_colours_in_the_dark_and_whole_numbers_on_a_phone(
    undisturbed: Path, tmp_path: Path
) -> None:
    page = save(drawing(*read_sweep(undisturbed), "a"), tmp_path / "a.html")
    seen = []
    with browser.chromium() as chromium:
        for scheme in ("light", "dark"):
            with chromium.new_context(color_scheme=scheme, offline=True) as context:
                shown = context.new_page()
                shown.set_viewport_size({"width": 390, "height": 844})
                shown.goto(page.as_uri())
                seen.append(shown.locator("body > svg").screenshot())
                ground = shown.evaluate("getComputedStyle(document.body).backgroundColor")
                assert max(shown.evaluate(LINES)) == 1
                assert shown.evaluate("document.documentElement.scrollWidth") == 390
    assert ground == "rgb(20, 20, 20)"
    light, dark = (np.asarray(Image.open(io.BytesIO(picture))) for picture in seen)
    np.testing.assert_array_equal(light[2:-2, 2:-2], dark[2:-2, 2:-2])  # the edge is mixed


def test_map_of_two_variables_holds_the_table_and_marks_the_best(undisturbed: Path) -> None:
    table = table_of(undisturbed)
    found = panels(undisturbed)
    assert list(found) == [
        f"{metric} over Kp and Kd" for metric in METRICS if metric != "time_at_limits"
    ]
    for label, axes in found.items():
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("Kp, s⁻²", "Kd, s⁻¹")
        metric = label.split()[0]
        (mesh,) = (c for c in axes.collections if hasattr(c, "get_coordinates"))
        cells = np.ma.filled(mesh.get_array(), np.nan).reshape(16, 20)
        assert np.asarray(cells).T.ravel() == pytest.approx(
            table[metric].to_numpy(), nan_ok=True, abs=0
        )
        (best,) = axes.collections[-1].get_offsets()
        least = table[metric].min()
        chosen = table[(table["Kp"] == best[0]) & (table["Kd"] == best[1])]
        assert chosen[metric].item() == least
        edges = np.asarray(mesh.get_coordinates())
        x, y = edges[0, :, 0], edges[:, 0, 1]
        assert (x[:-1] + x[1:]) / 2 == pytest.approx(np.linspace(10, 200, 20))
        assert (y[:-1] + y[1:]) / 2 == pytest.approx(np.linspace(5, 80, 16))
        critical = axes.get_lines()[0].get_xydata()
        assert critical[:, 1] ** 2 == pytest.approx(4 * critical[:, 0])


def test_map_of_one_variable_is_curves(native_path: Path, tmp_path: Path) -> None:
    table = sweep(native_path, grid={"Kp": np.linspace(10, 90, 9)}, output=tmp_path / "s")
    for label, axes in panels(tmp_path / "s").items():
        metric = label.split()[0]
        x, y = axes.get_lines()[0].get_data()
        assert np.array(x) == pytest.approx(np.linspace(10, 90, 9))
        assert np.array(y) == pytest.approx(table[metric].to_numpy(), nan_ok=True, abs=0)


def test_map_of_three_variables_is_the_best_over_the_third(
    native_path: Path, tmp_path: Path
) -> None:
    grid = {**SMALL, "tau_ext[1]": [-0.05, 0.0, 0.05]}
    table = sweep(native_path, grid=grid, stop_time=2.0, output=tmp_path / "s")
    found = panels(tmp_path / "s")
    assert len(found) == 9
    (mesh,) = (
        c for c in found["overshoot over Kp and Kd"].collections if hasattr(c, "get_coordinates")
    )
    cells = mesh.get_array().reshape(2, 3)
    for i, kd in enumerate(SMALL["Kd"]):
        for j, kp in enumerate(SMALL["Kp"]):
            runs = table[(table["Kp"] == kp) & (table["Kd"] == kd)]
            assert len(runs) == 3 and cells[i, j] == runs["overshoot"].min()


def test_map_of_random_values_is_dots(native_path: Path, tmp_path: Path) -> None:
    ranges = {"Kp": (10, 90), "Kd": (10, 30)}
    table = sweep(native_path, ranges=ranges, random=25, stop_time=2.0, output=tmp_path / "s")
    axes = panels(tmp_path / "s")["peak_effort over Kp and Kd"]
    dots = axes.collections[1]
    assert np.asarray(dots.get_offsets()) == pytest.approx(table[["Kp", "Kd"]].to_numpy(), abs=0)
    assert np.asarray(dots.get_array()) == pytest.approx(table["peak_effort"].to_numpy(), abs=0)


def test_plot_of_a_sweep_prints_the_best_runs(
    undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["plot", str(undisturbed)]) == 0
    out = capsys.readouterr().out
    assert "plot  whole.png" in out and (tmp_path / "whole.png").stat().st_size > 20_000
    table = table_of(undisturbed)
    best = table.sort_values(["settling_time", "peak_effort"]).iloc[0]
    row = out.splitlines()[5].split()
    assert [float(cell) for cell in row[:4]] == pytest.approx(
        [best["run"], best["Kp"], best["Kd"], best["settling_time"]]
    )
    assert main(["plot", str(undisturbed), str(undisturbed)]) == 2
    assert "is a sweep; it is drawn alone" in capsys.readouterr().err
    found = drawing(*read_sweep(undisturbed), "a")
    assert f"{best['Kp']:g}" in save(found, tmp_path / "a.html").read_text("utf-8")


@pytest.mark.parametrize("max_step", [1e-3, 1e-9], ids=["finished", "discarded"])
def test_a_trace_has_the_numbers_of_the_samples(native_path: Path, max_step: float) -> None:
    """To the bit; where a run fails, so do both, at the same step and for the same reason."""
    run = twodof.experiment(native_path, stop_time=2.0, settings={"max_step": max_step})
    ends = []

    def whole(read: Callable[[Instance], object]) -> object:
        try:
            with instantiate(run.fmu) as instance:
                return read(instance)
        except twodof.TwoDofError as error:
            ends.append((str(error), error.k, error.outcome))
            return None

    samples = whole(lambda instance: [*twodof.samples(run, instance=instance)])
    outputs = whole(lambda instance: trace(run, instance))
    if max_step < 1e-3:
        assert len(ends) == 2 and ends[0] == ends[1] and ends[0][2] == "discarded"
        return
    for name, values in outputs.items():
        np.testing.assert_array_equal(values, [getattr(sample, name) for sample in samples])
