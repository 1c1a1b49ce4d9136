"""Settings of a run: constants and inputs over time, and their effect."""

from typing import Any

import numpy as np
import pytest

import twodof
from twodof.cli.options import parse_settings
from twodof.errors import InputError
from twodof.fmu import Fmu
from twodof.simulation.input_values import read_changes, resolve
from twodof.simulation.sample import Sample


@pytest.fixture(scope="module")
def fmu(native_path):
    return twodof.load_fmu(native_path)


# --- constants ---

PARSED = {
    "a number": (["Kp=80"], {"Kp": 80.0}),
    "an exponent": (["Kp=1e2"], {"Kp": 100.0}),
    "a negative number": (["x_des=-0.1"], {"x_des": -0.1}),
    "a vector": (["x_des=0.25,0.1"], {"x_des": [0.25, 0.1]}),
    "an element": (["x_des[1]=0.25"], {"x_des[1]": 0.25}),
    "true": (["limit_effort=true"], {"limit_effort": True}),
    "False": (["limit_effort=False"], {"limit_effort": False}),
    "spaces": ([" Kp = 80 ", "x_des = 0.25, 0.1"], {"Kp": 80.0, "x_des": [0.25, 0.1]}),
    "several": (["Kp=80", "Kd=20"], {"Kp": 80.0, "Kd": 20.0}),
    "none": ([], {}),
}


@pytest.mark.parametrize(("texts", "settings"), PARSED.values(), ids=PARSED)
def test_setting_is_parsed(texts, settings):
    parsed = parse_settings(texts)
    assert parsed == settings
    assert [type(value) for value in parsed.values()] == [type(v) for v in settings.values()]


UNPARSED = {
    "no equals sign": (["Kp"], "Kp: expected NAME=VALUE"),
    "no name": (["=5"], "=5: expected NAME=VALUE"),
    "no value": (["Kp="], "Kp=: '' is not a number"),
    "a word": (["Kp=high"], "Kp=high: 'high' is not a number"),
    "a word in a vector": (["x_des=0.1,y"], "x_des=0.1,y"),
    "an empty element": (["x_des=0.1,"], "x_des=0.1,"),
    "two equals signs": (["Kp=5=6"], "Kp=5=6"),
    "twice": (["Kp=80", "Kp=90"], "Kp is given twice"),
}


@pytest.mark.parametrize(("texts", "culprit"), UNPARSED.values(), ids=UNPARSED)
def test_setting_that_cannot_be_parsed_is_refused(texts, culprit):
    with pytest.raises(InputError, match=f"--set {culprit}"):
        parse_settings(texts)


RESOLVED = {
    "all elements": ({"Kp": 80}, {"Kp[1]": 80.0, "Kp[2]": 80.0}),
    "a vector": ({"x_des": (0.25, 0.1)}, {"x_des[1]": 0.25, "x_des[2]": 0.1}),
    "a list": ({"q_start": [0.1, 0.2]}, {"q_start[1]": 0.1, "q_start[2]": 0.2}),
    "one element": ({"x_des[2]": 0.1}, {"x_des[2]": 0.1}),
    "a scalar": ({"Kn": 5}, {"Kn": 5.0}),
    "a scalar as a vector of one": ({"Kn": [5]}, {"Kn": 5.0}),
    "a vector of three": (
        {"gravity": [0, 0, -9.81]},
        {f"gravity[{i}]": g for i, g in ((1, 0.0), (2, 0.0), (3, -9.81))},
    ),
    "a Boolean": ({"limit_effort": True}, {"limit_effort": True}),
    "an element after its vector": ({"Kp": 80, "Kp[2]": 90}, {"Kp[1]": 80.0, "Kp[2]": 90.0}),
    "an array": ({"x_des": np.array([0.25, 0.1])}, {"x_des[1]": 0.25, "x_des[2]": 0.1}),
    "a number of numpy": ({"Kn": np.float64(5)}, {"Kn": 5.0}),
    "a Boolean of numpy": ({"limit_effort": np.bool_(True)}, {"limit_effort": True}),
}


@pytest.mark.parametrize(("settings", "values"), RESOLVED.values(), ids=RESOLVED)
def test_setting_gives_values_of_variables(fmu, settings, values):
    resolved = resolve(fmu, settings)
    assert resolved == values
    assert {type(value) for value in resolved.values()} <= {float, bool}


UNRESOLVED = {
    "unknown, a near name": ({"Kpp": 1}, "no variable 'Kpp'; did you mean 'Kp'"),
    "unknown, other case": ({"KP": 1}, "no variable 'KP'; did you mean 'Kp'"),
    "unknown, a near vector": ({"xdes": 1}, "no variable 'xdes'; did you mean 'x_des'"),
    "unknown, a near parameter": ({"qstart": 1}, "'qstart'; did you mean 'q_start'"),
    "unknown, nothing near": ({"#####": 1}, "no variable '#####'; there are: .*Kd"),
    "no such element": ({"x_des[3]": 1}, r"no variable 'x_des\[3\]'"),
    "index 0": ({"x_des[0]": 1}, r"no variable 'x_des\[0\]'"),
    "an output": ({"q": 1}, r"q\[1\] is of causality 'output'"),
    "an output's element": ({"tau[2]": 1}, r"tau\[2\] is of causality 'output'"),
    "too few": ({"x_des": [1]}, "x_des has 2 elements, 1 were given"),
    "too many": ({"x_des": [1, 2, 3]}, "x_des has 2 elements, 3 were given"),
    "several for an element": ({"x_des[1]": [1, 2]}, r"x_des\[1\] has 1 elements, 2 were given"),
    "none": ({"x_des": []}, "x_des has 2 elements, 0 were given"),
    "NaN": ({"Kp": float("nan")}, r"Kp\[1\] = nan is not finite"),
    "a whole number beyond all": ({"Kp": -(10**5000)}, r"Kp\[1\] = -inf is not finite"),
    "a Boolean for a number": ({"Kp": True}, r"Kp\[1\] = True: expected a number"),
    "a number for a Boolean": ({"limit_effort": 1.0}, "limit_effort = 1.0: expected true or false"),
    "a text": ({"Kn": "5"}, "Kn"),
    "a text as long as the vector": ({"Kp": "80"}, "Kp"),
    "nothing": ({"Kn": None}, "Kn"),
    "a matrix": ({"x_des": [[1, 2], [3, 4]]}, "x_des"),
}


@pytest.mark.parametrize(("settings", "culprit"), UNRESOLVED.values(), ids=UNRESOLVED)
def test_setting_that_does_not_fit_the_fmu_is_refused(fmu, settings, culprit):
    with pytest.raises(InputError, match=culprit):
        resolve(fmu, settings)


@pytest.mark.parametrize("unknown", ["tau[3]", "q1", "v[9]"])
def test_suggested_names_can_be_set(fmu, unknown):
    with pytest.raises(InputError, match=r"did you mean|there are") as refusal:
        resolve(fmu, {unknown: 1.0})
    _, _, suggested = str(refusal.value).partition("did you mean '")
    if suggested:
        resolve(fmu, {suggested.partition("'")[0]: 0.1})


# --- inputs over time ---

TABLES = {
    "one column": ("time,Kn\n0,1\n0.5,2\n", [(0.0, {"Kn": 1.0}), (0.5, {"Kn": 2.0})]),
    "time not first": ("Kn,time\n1,0.5\n", [(0.5, {"Kn": 1.0})]),
    "spaces": (" time , Kn \n 0 , 1 \n", [(0.0, {"Kn": 1.0})]),
    "a byte order mark": ("\ufefftime,Kn\n0,1\n", [(0.0, {"Kn": 1.0})]),
    "quotes": ('"time","x_des[1]"\n0,1\n', [(0.0, {"x_des[1]": 1.0})]),
    "line ends of Windows": ("time,Kn\r\n0,1\r\n", [(0.0, {"Kn": 1.0})]),
    "empty lines": ("time,Kn\n\n0,1\n\n", [(0.0, {"Kn": 1.0})]),
    "a quote that is open": ('time,Kn\n0,"1\n', [(0.0, {"Kn": 1.0})]),
    "no line end": ("time,Kn\n0,1", [(0.0, {"Kn": 1.0})]),
    "before the start": ("time,Kn\n-1,1\n", [(-1.0, {"Kn": 1.0})]),
    "two rows of one time": ("time,Kn\n1,1\n1,2\n", [(1.0, {"Kn": 1.0}), (1.0, {"Kn": 2.0})]),
}


@pytest.mark.parametrize(("text", "changes"), TABLES.values(), ids=TABLES)
def test_table_is_read(fmu, tmp_path, text, changes):
    (tmp_path / "inputs.csv").write_text(text, "utf-8", newline="")
    assert read_changes(fmu, tmp_path / "inputs.csv") == changes


BAD_TABLES = {
    "empty": ("", "is empty"),
    "no time": ("t,Kn\n0,1\n", "has no column 'time'"),
    "unsorted": ("time,Kn\n0,1\n2,1\n1,1\n", "row 4: time 1 is before"),
    "row too long": ("time,Kn\n0,1,2\n", "row 2: 3 cells, expected 2"),
    "NaN": ("time,Kn\n0,nan\n", "row 2: Kn = nan is not finite"),
    "infinite": ("time,Kn\n0,1\n1,inf\n", "row 3: Kn = inf is not finite"),
    "NaN time": ("time,Kn\nnan,1\n", "row 2: time = nan is not finite"),
    "unknown column": ("time,Kq\n0,1\n", "no variable 'Kq'; there are: .*Kp"),
    "column of another control": ("time,tau_cmd\n0,1\n", "it belongs to control 'effort'; this FMU has"),
    "column without a name": ("time,\n0,1\n", "no variable ''"),
    "no number": ("time,Kn\n0,high\n", "row 2: Kn = 'high' is not a number"),
    "an underscore": ("time,Kn\n0,1_0\n", "row 2: Kn = '1_0' is not a number"),
    "Arabic digits": ("time,Kn\n0,١\n", "row 2: Kn = '١' is not a number"),
    "empty cell": ("time,Kn\n0,\n", "row 2: Kn = '' is not a number"),
    "two columns of one name": ("time,Kn,Kn\n0,1,1\n", "two columns for 'Kn'"),
    "parameter": ("time,rtol\n0,1\n", "rtol is a parameter, which cannot change during a run"),
    "output": ("time,q[1]\n0,1\n", r"q\[1\] is not an input"),
    "no rows": ("time,Kn\n", "has no rows|is empty"),
    "cell over two lines": ('time,Kn\n0,"1\n1"\n', "row 3: 1 cells, expected 2"),
    "row below an empty line": ("time,Kn\n\n0,high\n", "row 3"),
    "long cell": ("time,Kn\n0," + "x" * 200, "Kn = 'x{50}' is not a number"),
}


@pytest.mark.parametrize(("text", "culprit"), BAD_TABLES.values(), ids=BAD_TABLES)
def test_refused_table_is_named_with_its_culprit(fmu, tmp_path, text, culprit):
    path = tmp_path / "inputs.csv"
    path.write_text(text, "utf-8")
    with pytest.raises(InputError, match=culprit) as refusal:
        read_changes(fmu, path)
    assert f"'{path}'" in str(refusal.value)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"PK\x03\x04\xc0\x00\x80"])
def test_table_that_is_not_text_is_refused(fmu, tmp_path, content):
    (tmp_path / "inputs.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"inputs\.csv' is not UTF-8 text; save it as CSV UTF-8"):
        read_changes(fmu, tmp_path / "inputs.csv")


@pytest.mark.parametrize(("name", "reason"), [("none.csv", ""), ("", "Is a directory")])
def test_table_that_is_no_file_is_refused(fmu, tmp_path, name, reason):
    with pytest.raises(InputError, match=f"'{tmp_path / name}.*{reason}"):
        read_changes(fmu, tmp_path / name)


@pytest.mark.parametrize("settings", [{"x_des": 0.2}, {"x_des[1]": 0.2}])
def test_variable_that_is_both_set_and_in_the_table_is_refused(fmu, tmp_path, settings):
    (tmp_path / "inputs.csv").write_text("time,x_des[1]\n0,0.1\n")
    with pytest.raises(InputError, match=r"x_des\[1\] is both set and in '.*inputs\.csv'"):
        twodof.experiment(fmu, settings=settings, input_file=tmp_path / "inputs.csv", stamp_start=0)


def test_a_column_of_a_vector_counts_for_each_element(fmu, tmp_path, monkeypatch):
    monkeypatch.setattr("twodof.simulation.input_values.MAX_CELLS", 9)
    path = tmp_path / "inputs.csv"
    path.write_text("time,x_des\n" + "0,0.1\n" * 4)  # 10 cells as written
    with pytest.raises(InputError, match=r"more than 9 cells$"):
        twodof.experiment(fmu, input_file=path)
    path.write_text("x_des,time\n0.1,0\n" + "0.1,0\n" * 2)
    twodof.experiment(fmu, input_file=path)
    monkeypatch.setattr("twodof.simulation.input_values.MAX_CELLS", 8)
    with pytest.raises(InputError, match="more than 8 cells; a vector's column counts for each element"):
        twodof.experiment(fmu, input_file=path)


# --- a run ---

STEP = 0.01
ROWS = [
    (0.0, {"x_des[1]": 0.21, "Kp[2]": 50.0}),
    (0.03 + 1e-12, {"x_des[1]": 0.24, "Kp[2]": 70.0}),  # on a communication point but for rounding
    (0.045, {"x_des[1]": 0.18, "Kp[2]": 60.0}),  # between two: from the next one on
    (0.061, {"x_des[1]": 9.99, "Kp[2]": 99.0}),  # two within one step: the latter
    (0.069, {"x_des[1]": 0.22, "Kp[2]": 80.0}),
    (0.5, {"x_des[1]": 0.0, "Kp[2]": 0.0}),  # after the end: never
]
SET_AT = {0: 0, 3: 1, 5: 2, 7: 4}
"""Rows that a user would set by hand, by communication point."""
N = 12


@pytest.fixture
def table(tmp_path):
    lines = [f"{t},{row['x_des[1]']},{row['Kp[2]']}" for t, row in ROWS]
    path = tmp_path / "inputs.csv"
    path.write_text("\n".join(["time,x_des[1],Kp[2]", *lines]))
    return path


def by_hand(fmu: Fmu, rows: dict[int, dict[str, float]], **options: Any) -> list[Sample]:
    """A run whose inputs are sent at communication points; those of point 0 are set before."""
    run = twodof.samples(fmu, stop_time=N * STEP, settings=rows.get(0), stamp_start=0, **options)
    found = [next(run)]
    while found[-1].k < N:
        found.append(run.send(rows.get(found[-1].k) if found[-1].k else None))
    return found


def test_run_with_a_table_is_the_run_with_its_rows_set_by_hand(fmu, table):
    run = twodof.samples(fmu, stop_time=N * STEP, input_file=table, stamp_start=0)
    seen = [(sample, dict(sample.inputs)) for sample in run]
    assert all(sample.inputs == inputs for sample, inputs in seen)  # later ones change no earlier
    from_table = [sample for sample, _ in seen]
    assert from_table == by_hand(fmu, {k: ROWS[row][1] for k, row in SET_AT.items()})
    assert len({sample.q for sample in from_table}) == N + 1


def test_start_values_hold_before_the_first_row(fmu, tmp_path):
    (tmp_path / "inputs.csv").write_text("time,x_des[1]\n0.05,0.1\n")
    run = twodof.samples(fmu, stop_time=N * STEP, input_file=tmp_path / "inputs.csv", stamp_start=0)
    assert [sample.inputs["x_des[1]"] for sample in run] == [0.2] * 6 + [0.1] * (N - 5)


def test_rows_before_the_start_hold_at_the_start(fmu, tmp_path):
    (tmp_path / "inputs.csv").write_text("time,x_des[1]\n-2,0.3\n-1,0.1\n")
    run = twodof.samples(fmu, stop_time=STEP, input_file=tmp_path / "inputs.csv", stamp_start=0)
    plain = twodof.samples(fmu, stop_time=STEP, settings={"x_des[1]": 0.1}, stamp_start=0)
    assert list(run) == list(plain)


@pytest.mark.parametrize(("end", "late"), [(0.05, 3), (0.06, 0)])
def test_rows_after_the_end_are_reported(fmu, tmp_path, caplog, end, late):
    (tmp_path / "inputs.csv").write_text("time,x_des[1]\n0.06,0.3\n0.06,0.1\n0.06,0.1\n")
    twodof.experiment(fmu, stop_time=end, input_file=tmp_path / "inputs.csv", stamp_start=0)
    twodof.experiment(fmu, stop_time=end, changes=[(0.06, {"x_des": 0.1})], stamp_start=0)
    told = f"inputs.csv': {late} of its times are after the run's end at 0.05 s"
    assert [told in line for line in caplog.messages] == [True, False] * bool(late)
    assert all("are never set" in line for line in caplog.messages)


def test_a_parameter_cannot_be_sent(fmu):
    with pytest.raises(twodof.TwoDofError, match="rtol"):
        by_hand(fmu, {2: {"rtol": 1e-4}})


def test_a_setting_holds_throughout(fmu):
    run = twodof.samples(fmu, stop_time=N * STEP, settings={"Kp": 80, "q_start": (0.4, 0.6)}, stamp_start=0)
    found = list(run)
    assert found[0].q == (0.4, 0.6)
    assert {(sample.inputs["Kp[1]"], sample.inputs["Kp[2]"]) for sample in found} == {(80.0, 80.0)}


TIMES = {
    "step 0": ({"step": 0.0}, "step 0 s must be > 0"),
    "step negative": ({"step": -0.01}, "step -0.01 s must be > 0"),
    "step NaN": ({"step": float("nan")}, "step nan s"),
    "step infinite": ({"step": float("inf")}, "step inf s"),
    "step of nothing": ({"step": 1e-320}, "step 1.*e-320"),
    "stop no multiple": ({"stop_time": 1.0, "step": 0.3}, "1 s is not a whole number of steps of 0.3"),
    "step beyond the stop": ({"stop_time": 0.1, "step": 1.0}, "not a whole number of steps"),
    "stop 0": ({"stop_time": 0.0}, "stop time 0 s must be after the start time 0 s"),
    "stop before start": ({"stop_time": 1.0, "start_time": 2.0}, "stop time 1 s must be after"),
    "stop NaN": ({"stop_time": float("nan")}, "stop time nan"),
    "stop minus infinite": ({"stop_time": float("-inf")}, "stop time -inf s"),
    "start infinite": ({"start_time": float("-inf")}, "start time -inf"),
}


@pytest.mark.parametrize(("times", "culprit"), TIMES.values(), ids=TIMES)
def test_times_that_make_no_run_are_refused(fmu, times, culprit):
    with pytest.raises(InputError, match=culprit):
        twodof.experiment(fmu, **times)


@pytest.mark.parametrize(("stop", "step", "n"), [(5.0, 0.01, 500), (0.3, 0.1, 3), (1e4, 1e-3, 10**7)])
def test_number_of_steps_is_right_though_the_step_has_no_binary_form(fmu, stop, step, n):
    run = twodof.experiment(fmu, stop_time=stop, step=step)
    assert (run.steps, run.time(n)) == (n, n * step)


# --- changes over time, given in Python ---


def test_changes_are_named_as_settings_are(fmu):
    run = twodof.experiment(fmu, changes=[(0.1, {"x_des": (0.1, 0.2)}), (0.1, {"Kp": 9})])
    assert run.changes == [(0.1, {"x_des[1]": 0.1, "x_des[2]": 0.2}), (0.1, {"Kp[1]": 9.0, "Kp[2]": 9.0})]


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ([(0.1, {"x_des": float("nan")})], r"x_des\[1\] = nan is not finite"),
        ([(0.1, {"x_dse": 1.0})], "there is no variable 'x_dse'"),
        ([(0.1, {"q": 1.0})], r"q\[1\] is of causality 'output'"),
        ([(0.1, {"rtol": 1e-3})], "rtol is not an input and cannot be changed at 0.1 s"),
        ([(0.2, {"Kp": 1.0}), (0.1, {"Kp": 2.0})], "the times of `changes` must be finite and ascend"),
        ([(float("nan"), {"Kp": 1.0})], "the times of `changes` must be finite and ascend"),
    ],
)
def test_changes_that_cannot_be_are_refused_before_the_run(fmu, changes, culprit):
    with pytest.raises(InputError, match=culprit):
        twodof.experiment(fmu, changes=changes)


def test_an_element_beyond_the_end_of_a_vector_is_named(fmu):
    with pytest.raises(InputError, match=r"no variable 'Kp\[3\]': Kp has 2 elements"):
        twodof.experiment(fmu, settings={"Kp[3]": 1.0})
