"""The public interface of the package: names, types, one-line reprs, and missing extras."""

import importlib
import inspect
import pickle
import pkgutil
import pydoc
import re
import subprocess
import sys
from dataclasses import replace
from html import escape
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas
import pytest
from harness import forged, python

import twodof
from twodof.version import versions

PROGRAM = """
import twodof

fmu = twodof.load_fmu("TwoDof.fmu")
run: twodof.Experiment = twodof.experiment(fmu, stop_time=1.0)
summary = twodof.simulate(run, twodof.Bag("my_bag"))
error: float | None = summary.error
bag = twodof.read_bag("my_bag")
count: int = bag.q.shape[0]
reveal_type(bag.x)
reveal_type(summary.last.target)
twodof.simulate(run, stop_tim=2)
bag.positions
"""

WITHOUT = """
import sys
for name in {names!r}:
    sys.modules[name] = None
from pathlib import Path
import twodof
from twodof.cli.main import main
from twodof.version import versions
"""

RUN = """
fmu, = sys.argv[1:]
for line in (
    f"run {fmu} -o bag --scene --stop-time 0.1", "info bag", f"info {fmu}", "plot bag -o p.svg",
    "view bag --export v.html", f"sweep {fmu} --grid Kp=20:80:2 --stop-time 0.1 -o s",
    "plot s -o s.svg", "info s",
):
    assert main(line.split()) == 0, line
assert not [name for name in sys.modules if name.startswith("pinocchio.")]
"""


@pytest.mark.needs("cyclonedds")
def test_names_are_the_public_ones_and_no_module_takes_their_place():
    for module in pkgutil.walk_packages(twodof.__path__, "twodof."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    names = vars(twodof)["__all__"]
    assert dir(twodof) == sorted(names)
    for name in names:
        value = getattr(twodof, name)
        assert isinstance(value, str) if name == "__version__" else callable(value)
        assert name == "__version__" or value.__name__ == name


def test_a_users_program_is_checked_by_its_types(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    cache = f"--cache-dir={Path(__file__).parents[1] / '.mypy_cache'}"
    command = [sys.executable, "-m", "mypy", "--strict", cache, "program.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    lines = [line.split(": ", 1)[1] for line in done.stdout.splitlines()[:-1]]
    assert [line[:50] for line in lines if line.startswith("error")] == [
        'error: Unexpected keyword argument "stop_tim" for ',
        'error: "Recording" has no attribute "positions"  [',
    ]
    assert any("ndarray" in line for line in lines)
    assert any("tuple[float, ...] | None" in line for line in lines)


@pytest.mark.needs("cyclonedds")
@pytest.mark.parametrize("name", [name for name in dir(twodof) if name[0] != "_"])
def test_a_misspelt_keyword_names_the_nearest_one(name):
    """Each public function and class that users call does so, for each of its keywords."""
    public = getattr(twodof, name)
    if inspect.isclass(public) and not inspect.isfunction(vars(public).get("__init__")):
        assert issubclass(public, (Exception, tuple, twodof.Sink))  # not made by users
        return
    parameters = inspect.signature(public).parameters.values()
    for key in [p.name for p in parameters if p.kind is not p.VAR_POSITIONAL and len(p.name) > 1]:
        typo = key[: len(key) // 2] + "x" + key[len(key) // 2 :]
        with pytest.raises(TypeError, match=rf"^{name}\(\) has no argument '{typo}'; did you mean '{key}'\? It takes "):
            public(**{typo: None})


@pytest.mark.needs("cyclonedds")
@pytest.mark.parametrize(
    ("call", "remedy"),
    [
        (lambda: twodof.samples("a.fmu", stp=1), "did you mean 'step' or 'stop'?"),  # type: ignore[call-arg]
        (lambda: twodof.experiment("a.fmu", stop=1), "did you mean 'stop_time'?"),  # type: ignore[call-arg]
        (lambda: twodof.build_fmu(frame="tool0"), "did you mean options=FmuOptions(frame=…)?"),  # type: ignore[call-arg]
        (lambda: twodof.publish("a", namspace="b"), "did you mean publisher=Publisher(namespace=…)?"),  # type: ignore[call-arg]
        (lambda: twodof.view("bag", export="a.html"), "'export'. It takes bag, fmu, frame, host, mesh_dir, "),  # type: ignore[call-arg]
    ],
)
def test_an_unknown_keyword_names_where_it_belongs(call, remedy):
    with pytest.raises(TypeError, match=re.escape(remedy)):
        call()


def test_a_public_function_is_pickled_by_its_public_name():
    """Workers of a user's program receive it so."""
    assert pickle.loads(pickle.dumps(twodof.run)) is twodof.run and b"twodof" in pickle.dumps(twodof.run)


@pytest.mark.needs("cyclonedds")
def test_public_signatures_name_every_keyword():
    """An editor and ``help`` show names, types and defaults."""
    for name in dir(twodof):
        public = getattr(twodof, name)
        if name in ("TwoDofError", "__version__"):  # of no signature of its own
            continue
        own = vars(public).items() if inspect.isclass(public) else ()
        methods = [method for key, method in own if inspect.isfunction(method) and not key.startswith("_")]
        for callable_ in (public, *methods):
            signature = str(inspect.signature(callable_))
            assert not re.search(r"\bAny\b|lambda|\*\*| at 0x", signature), f"{name}: {signature}"
    assert inspect.signature(twodof.run) == inspect.signature(twodof.simulate)
    assert {"stop_time", "settings", "steer"} <= inspect.signature(twodof.run).parameters.keys()


def test_help_begins_with_every_name_of_the_package():
    page = pydoc.plain(pydoc.render_doc(twodof)).partition("PACKAGE CONTENTS")[0]
    assert "twodof.run(fmu" in page
    listed = {*re.findall(r"\w+", page.partition("Build an FMU")[2])}
    assert {*dir(twodof)} - {"__version__"} <= listed


@pytest.mark.parametrize("kind", ["fmu", "recording", "summary", "linear model", "sweep"])
def test_a_notebook_shows_a_table_and_a_picture(kind, native_path, tmp_path):
    """The HTML is well-formed, has no script, and shows third-party names as text."""
    hostile = "<script>alert(1)</script>&\"'"
    fmu = twodof.load_fmu(native_path)
    fmu = replace(fmu, robot=hostile)
    summary = twodof.run(fmu, twodof.Bag(tmp_path / "bag"), stop_time=0.5)
    shown = {
        "fmu": lambda: (fmu, ["joint1, joint2", escape(hostile)]),
        "recording": lambda: (
            replace(twodof.read_bag(tmp_path / "bag"), joints=(hostile, "b")),
            ["51 × sensor_msgs/msg/JointState", escape(hostile)],
        ),
        "summary": lambda: (summary, ["after 50 steps", f"{summary.error:.3g} m"]),
        "linear model": lambda: (twodof.linearise(fmu)._replace(remarks=(hostile,)), ["-1.292", escape(hostile)]),
        "sweep": lambda: (twodof.sweep(fmu, grid={"Kp": [20.0, 80.0]}, stop_time=0.1), ["Sweep of 2 runs", "Kp"]),
    }[kind]()
    html = shown[0]._repr_html_()
    ElementTree.fromstring(re.sub(r"<style.*?</style>", "", f"<p>{html}</p>", flags=re.S))
    assert "<script" not in html and all(text in html for text in shown[1])
    assert "<table" in html and re.search(r"<(polyline|circle) ", html)


def test_the_picture_of_a_long_recording_keeps_its_extremes(native_path, tmp_path):
    twodof.run(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.1)
    bag = twodof.read_bag(tmp_path / "bag")
    q = np.zeros((100_000, 2))
    q[54_321] = 7.25, -3.5
    stamps = np.arange(len(q)) * 10**6
    html = replace(bag, q=q, stamps=stamps)._repr_html_()
    assert "-3.5 to 7.25" in html and len(html) < 30_000


def test_an_unknown_control_is_an_error_of_the_called_function():
    with pytest.raises(twodof.TwoDofError, match=r"^`control` 'jont' is .*; did you mean 'joint'"):
        twodof.FmuOptions(control="jont")


def test_reprs_are_one_line(native_path, tmp_path):
    run = twodof.experiment(native_path, stop_time=0.05)
    twodof.simulate(run, twodof.Bag(tmp_path / "bag"))
    bag = twodof.read_bag(tmp_path / "bag")
    assert repr(run.fmu) == f"<Fmu '{native_path}': TwoDof, joints joint1, joint2>"
    last = twodof.Sample(500, 5.0, (-0.5, 1.25), (0.0, -1e-5), (0.2, 0.05), (0.5, 0.25), {}, 0.0, 0)
    assert repr(last) == "<Sample 500 at 5 s: q=(-0.5, 1.25), v=(0, -1e-05), x=(0.2, 0.05), tau=(0.5, 0.25)>"
    long = (-1.2345e-05,) * 30
    assert len(repr(last._replace(k=10**6, t=10000.25, q=long, v=long, x=long[:3], tau=long))) <= 170
    assert repr(run) == f"<Experiment: {native_path.name} from 0 s to 0.05 s in steps of 0.01 s>"
    assert repr(bag) == f"<Recording '{tmp_path / 'bag'}': 6 samples in 0.05 s of joint1, joint2>"


def test_recording_has_the_values_of_the_samples(native_path, tmp_path):
    samples = []
    run = twodof.experiment(native_path, stop_time=0.5)
    steps = twodof.samples(run)
    with twodof.Bag(tmp_path / "bag", effort=True).begin(run) as sink:
        for sample in steps:
            samples.append(sample)
            sink.write(sample)
            if sample.k == 20:
                samples.append(steps.send({"x_des": (0.1, 0.2)}))
                sink.write(samples[-1])
    bag = twodof.read_bag(tmp_path / "bag")
    np.testing.assert_allclose(bag.x, [s.x for s in samples], atol=1e-14)
    np.testing.assert_array_equal(bag.target, [s.target for s in samples])
    np.testing.assert_array_equal(bag.tau, [s.tau for s in samples])
    table = bag.to_pandas()
    assert isinstance(table, pandas.DataFrame) and table.index.name == "t"
    assert [*table.columns] == [f"{group}[{i}]" for group in ("q", "v", "tau", "x", "x_des") for i in (1, 2)]
    np.testing.assert_array_equal(table[["q[1]", "q[2]"]], bag.q)
    np.testing.assert_allclose(table.index, [s.t for s in samples], atol=1e-12)


def program(names: list[str], code: str, folder: Path, *arguments: object) -> str:
    """Run code without some modules; return its output."""
    done = python("-c", WITHOUT.format(names=names) + code, *arguments, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_nothing_but_building_needs_pinocchio(native_path, tmp_path):
    """The child processes of a sweep cannot import it either."""
    for name in ("pinocchio", "coal", "pythonfmu"):
        (tmp_path / "absent").mkdir(exist_ok=True)
        (tmp_path / f"absent/{name}.py").write_text("raise ImportError('not here')")
    program(["pinocchio", "coal", "pythonfmu"], RUN, tmp_path, native_path)
    code = "print(main(['build', '-o', 'x.fmu']))"
    assert program(["pinocchio"], code, tmp_path) == "1\n"


def test_a_run_that_reaches_its_target_imports_no_scipy(native_path, tmp_path):
    """It would take as long as all the rest of a short run."""
    code = "fmu, = sys.argv[1:]\nassert main(['run', fmu]) == 0\nprint('scipy' in sys.modules)"
    assert program([], code, tmp_path, native_path).splitlines()[-1] == "False"


ABSENT = {
    "twodof.view('bag')": "view",
    "twodof.live('x.fmu')": "view",
    "twodof.plot('bag')": "view",
    "twodof.sweep('x.fmu', grid={'Kp': [1.0]})": "sweep",
    "twodof.publish('x.fmu')": "ros",
    "twodof.Publisher()": "ros",
}
CALLS = """
for call in sys.argv[1:]:
    name = call.partition("(")[0]
    assert isinstance(eval(name), type) == name.split(".")[1][0].isupper()
    try:
        eval(call)
    except twodof.TwoDofError as error:
        print(error)
"""


def test_a_name_that_needs_an_extra_names_it_when_it_is_used(tmp_path):
    names = ["websockets", "matplotlib", "pyarrow", "cyclonedds"]
    errors = program(names, CALLS, tmp_path, *ABSENT).splitlines()
    for error, extra in zip(errors, ABSENT.values(), strict=True):
        assert f"extra '{extra}'" in error


def test_times_are_those_of_the_fmus_default_experiment(native_path, tmp_path):
    default = 'stopTime="5.0"(.*)stepSize="0.01"'
    other = forged(native_path, tmp_path, default, r'stopTime="0.3"\1stepSize="0.02"')
    run = twodof.experiment(other)
    assert (run.steps, run.step) == (15, 0.02)
    run = twodof.experiment(native_path)
    assert (run.steps, run.step) == (500, 0.01)


def test_columns_of_a_csv_are_named_as_settings_are(native_path, tmp_path):
    (tmp_path / "in.csv").write_text("time,Kp,x_des[1]\n0,50,0.2\n0.05,80,0.1\n")
    run = twodof.experiment(native_path, stop_time=0.1, input_file=tmp_path / "in.csv")
    assert run.changes[0] == (0.05, {"Kp[1]": 80.0, "Kp[2]": 80.0, "x_des[1]": 0.1})
    (tmp_path / "in.csv").write_text("time,Kp,Kp[2]\n0,50,60\n")
    with pytest.raises(twodof.TwoDofError, match=r"two columns for 'Kp\[2\]'"):
        twodof.experiment(native_path, input_file=tmp_path / "in.csv")


def test_versions_are_those_of_the_installed_packages():
    """A run without Pinocchio also records versions."""
    assert versions("numpy", "no-such-package") == {"twodof": twodof.__version__, "numpy": np.__version__}
