"""Common mistakes of users: each message names the culprit and a remedy that works."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

import twodof
from twodof.cli.main import main
from twodof.cli.printing import plain
from twodof.export.start_values import no_variable
from twodof.plant.variables import Variable

RUN = "run arm.fmu -o out --stop-time 0.02"
MISTAKES: dict[str, str] = {
    # options and verbs
    f"{RUN} --stoptime 3": "no option '--stoptime'; did you mean '--stop-time'",
    f"{RUN} --stop_time 3": "'--stop_time'; did you mean '--stop-time'",
    f"{RUN} --stop 3": "'--stop'; did you mean '--stop-time'",
    f"{RUN} --duration 3": "'--duration'; did you mean '--stop-time'",
    f"{RUN} --dt=0.001": "'--dt'; did you mean '--step'",
    f"{RUN} -s Kp=3": "'-s'; did you mean '--set'",
    f"{RUN} --output b": "'--output'; did you mean '-o'",
    f"{RUN} --force": "'--force'; did you mean '--overwrite'",
    f"{RUN} --step-size 0.01": "no option '--step-size'; did you mean '--step'",
    f"{RUN} --start-time 1": "no option '--start-time'; did you mean '--stamp-start'",
    f"{RUN} --tolerance 1e-6": "did you mean '--set rtol=1e-6'",
    f"{RUN} --solver cvode": "no option '--solver'; 'twodof run --help' lists them",
    f"{RUN} --start-values Kp=3": "did you mean '--set'",
    "build --me": "no option '--me'; 'twodof build --help' lists them",
    f"{RUN} --Set Kp=3": "'--Set'; did you mean '--set'",
    f"{RUN} --xyzzy": "no option '--xyzzy'; 'twodof run --help' lists",
    f"{RUN} --set Kp=80 Kd=20": "'Kd=20' belongs to no option: .*--set Kd=20",
    f"{RUN} --set Kp 80": "'80' belongs to no option: .*--set Kp=80$",
    f"{RUN} --set x_des 0.2,0.1": "as in --set Kp=0.2,0.1$",
    f"{RUN} --scene meshes": "'meshes' is one argument too many; did you mean '--meshes'",
    f"{RUN} other.fmu": "'other.fmu' is one argument too many; .*; 'twodof run --help'",
    f"{RUN} --step 10ms": "'10ms' is not a number; leave units out",
    f"{RUN} --set Kp=1_0": "--set Kp=1_0: '1_0' is not a number; write numbers as 0.2,0.1",
    f"{RUN} --stop-time ٣": "'٣' is not a number; leave units out",
    f"{RUN} --stamp-start 1_000": "'1_000' is not a number; leave units out",
    "sweep --grid Kp=1_0:20:3": "--grid Kp=1_0:20:3: expected NAME=LOW:HIGH:COUNT",
    "sweep --random 1_0": "'1_0' is not a whole number",
    f"{RUN} --storage db3": "'db3' .*'sqlite3'",
    "simulate arm.fmu": "no verb 'simulate'; did you mean 'run'",
    "bild": "no verb 'bild'; did you mean 'build'",
    "linearize arm.fmu": "'linearize'; did you mean 'linearise'",
    "show bag": "'show'; did you mean 'info'",
    "": "there is no verb; begin with 'twodof build', or see 'twodof --help'",
    "build --robot": "argument --robot: expected one argument: NAME, .*--list-robots",
    "build --robot UR5": "no robot 'UR5'; did you mean 'ur5_robot'",
    "export bag": "an export needs the name of its file, as in -o bag.csv",
    "build --frame": "expected one argument: LINK, controlled link",
    "xyzzy": "no verb 'xyzzy'; there are: build, run, ",
    "help simulate": "'simulate'; did you mean 'run'",
    "--versoin": "no option '--versoin'; did you mean '--version'",
    "-v": "no option '-v'",
    "split arm.fmu": "no verb 'split'; did you mean 'build'",
    "validate arm.fmu": "'validate'; did you mean 'check'",
    f"{RUN} --cost settling": "no option '--cost'; did you mean '--fail-if'",
    f"{RUN} --fail-if overshoot>5%": "'overshoot>5%' is not a comparison, as 'error > 1e-3'; leave units out",
    f"{RUN} --fail-if error>1mm": "'error>1mm' is not a comparison, as 'error > 1e-3'; leave units out",
    f"{RUN} --robot panda": "'arm.fmu' is an FMU, which has no components; leave out --robot 'panda'",
    "run --robot panda": "names a component of a system; .* build a robot with 'twodof build --robot panda'",
    "build robot.urdf --fmi 3.0": "'3.0' is not a whole number",
    "build --split -o arms.fmu": "'arms.fmu': the name of a system of FMUs ends in .ssp",
    f"{RUN} --native=yes": "error: --native takes no value; leave out 'yes'",
    "export bag x.csv": "an export needs the name of its file, as in -o x.csv",
    "sweep arm.fmu -o s": "there is nothing to vary; give values of an input with --grid",
    "info bag --cost settling": "--cost ranks the runs of a sweep, and 'bag' is not a sweep; leave it out",
    "fit bag robot.urdf --free payload": "the URDF comes first: twodof fit robot.urdf bag",
    # paths
    "run bag": "'bag' is not an FMU: it is a bag; use 'twodof view bag'",
    "run bag/bag.mcap": "'bag/bag.mcap' is not an FMU: it is a bag; use 'twodof view bag/bag.mcap'",
    "run gains": "'gains' is not an FMU: it is a sweep; use 'twodof plot gains'",
    "run folder": "'folder' is not an FMU: it is a folder without a bag",
    "run arn.fmu": "no FMU 'arn.fmu'; did you mean 'arm.fmu'",
    "run arm-native.fmu": "no FMU 'arm-native.fmu'; did you mean 'arm.fmu'",
    "run x.fmu": "no FMU 'x.fmu'; make one with 'twodof build'",
    "run missing/arm.fmu": "no FMU 'missing/arm.fmu': there is no folder 'missing'",
    "run notes.txt": "'notes.txt' is not an FMU",
    "plot notes.txt": "'notes.txt' is not a bag; make one with 'twodof run'",
    "build https://example.org/r.urdf": "'https:/example.org/r.urdf' is a web address, .*; download the URDF first",
    f"{RUN} --input arm.fmu": "'arm.fmu' is not a CSV: it is an FMU",
    "live bag": "'bag' is not an FMU: it is a bag",
    "page bag": "'bag' is not an FMU: it is a bag",
    "layouts bag": "'bag' is not an FMU: it is a bag",
    "linearise bag": "'bag' is not an FMU: it is a bag",
    "sweep bag --grid Kp=1:2:3 -o s": "'bag' is not an FMU: it is a bag",
    "build bag": "'bag' is not a URDF: it is a bag",
    "build arm.fmu": "'arm.fmu' is not a URDF: it is an FMU; use 'twodof run arm.fmu'",
    "build robt.urdf": "no URDF 'robt.urdf'; did you mean 'robot.urdf'",
    "plot arm.fmu": "'arm.fmu' is not a bag: it is an FMU; use 'twodof run arm.fmu'",
    "plot nowhere": "no bag 'nowhere'; make one with 'twodof run'",
    "plot bga": "no bag 'bga'; did you mean 'bag'",
    "view gains": "'gains' is not a bag: it is a sweep; use 'twodof plot gains'",
    "recover gains": "'gains' is not a bag: it is a sweep",
    "recover nowhere": "no bag 'nowhere'",
    "info gain": "no 'gain'; did you mean 'gains'",
    "info bagg": "no 'bagg'; did you mean 'bag'",
    "info robot.urdf": "'robot.urdf' is not an FMU: .*; use 'twodof build robot.urdf'",
    "info table.csv": "'table.csv' is not an FMU: it is a CSV file, for --input of a run",
    "info notes.txt": "'notes.txt' is neither an FMU nor the folder of a bag or a sweep",
    f"{RUN} --input gains": "'gains' is not a bag: it is a sweep",
    f"{RUN} --input tabel.csv": "no CSV 'tabel.csv'; did you mean 'table.csv'",
    # tables
    f"{RUN} --input semicolons.csv": "no column 'time'; it has semicolons between its cells: write commas",
    f"{RUN} --input tabs.csv": "no column 'time'; it has tabs between",
    f"{RUN} --input capital.csv": "no column 'time'; rename the column 'Time'",
    f"{RUN} --input headless.csv": "no column 'time'; its first line is '0,50'",
    f"{RUN} --input lonely.csv": "'lonely.csv' has no column except 'time'; add one for each input",
    f"{RUN} --input wide.csv": "'wide.csv' is not UTF-8 text; save it as CSV UTF-8",
    f"{RUN} --input start.csv": "'start.csv': q_start is a parameter, which cannot change during a run",
    f"{RUN} --fail-if error>1e-3,saturated>0.1": "is not a comparison, .*; give each condition separately",
    "run arm.fmu out": "'out' is one argument too many; .* needs -o, as in -o out",
    "run arm.fmu -o out --stop-time 1e9": "with a duration of 1e.09 s are not within 1970 to 2038",
    f"{RUN} --input lower.csv": "no variable 'kp'; did you mean 'Kp'",
    # settings
    f"{RUN} --set x_des_1=0.2": r"'x_des_1'; did you mean 'x_des\[1\]'",
    f"{RUN} --set x_des_y=0.2": r"'x_des_y'; did you mean 'x_des\[2\]'",
    f"{RUN} --input exported.csv": r"'x_des.x \[m\]'; did you mean 'x_des\[1\]'",
    f"{RUN} --set x_des2=0.2": r"'x_des2'; did you mean 'x_des\[2\]'",
    f"{RUN} --set x_des[0]=0.2": "x_des has 2 elements",
    f"{RUN} --set zeta=0.7": "'zeta'; did you mean 'Kd'",
    f"{RUN} --set tau_max=5": "'tau_max'; did you mean 'limit_effort'",
    f"{RUN} --set Ki=10": "'Ki'; there are: ",
    f"{RUN} --input united.csv": r"'Kp \[1/s2\]'; did you mean 'Kp'",
    f"{RUN} --set x_des=0.2;0.1": "'0.2;0.1' is not a number; write numbers as 0.2,0.1",
    f"{RUN} --set x_des=[0.2,0.1]": "is not a number; write numbers as",
    f"{RUN} --set limit_effort=yes": "'yes' is not a number; .* true or false",
    f"{RUN} --set q=1,1": r"q\[1\] is of causality 'output' .*; set q_start\[1\]",
    f"{RUN} --set q_des=1,1": "'q_des': it belongs to control 'joint'",
    f"{RUN} --set x_des=1e30": r"a setting may be too large: x_des\[1\] = 1e\+30 m",
    f"{RUN} --step 0.015": "not a whole number of steps of 0.015 s; take steps of 0.02 s, or end at 0.015 s",
    "run arm.fmu -o out --stop-time 5 --step 0.03": "steps of 0.0299401198 s, or end at 5.01 s",
    # robots
    "build robot.urdf --frame end_effector": "no frame 'end_effector' .*; did you mean 'EndEffector'",
    "build robot.urdf --frame tool0": "no frame 'tool0' .*; there are: world, link1",
    "build robot.urdf --frame joint2": "frame 'joint2' is a joint .*; did you mean its link 'link2'",
    "build robot.urdf --lock joint1 --lock joint2": "no joint moves a link; .*, not locked",
    "build robot.urdf --lock Joint1": "no joint 'Joint1' to lock; did you mean 'joint1'",
    "build robot.urdf --lock joint1=90deg": "'90deg' is not a number",
    "build robot.urdf --q-start 1": "q_start has 1 values, the robot has 2 joints",
    "build robot.urdf --control torque": "'torque' .*'effort'",
    "build robot.urdf --native --platform linux --no-meshes": "no platform 'linux'; did you mean 'linux64'",
    "build robot.xml": "<mujoco>, expected <robot>",
    "plot bag --joints Joint1 -o x.png": "no joint 'Joint1'; did you mean 'joint1'",
    "plot bag --frame endeffector -o x.png": "did you mean 'EndEffector'",
    "plot nowhere -o x.jpg": "'x.jpg': the name of a plot ends in .png",
    "build robot.urdf --gravity 0,-9.81,0": "--gravity: expected 3 numbers with spaces between them",
    "page arm.fmu -o .html": "'.html': the name of a page ends in .html",
    "info nothing": "there is no FMU, bag or sweep 'nothing'",
    "page arm.fmu -o page.htm": "'page.htm': the name of a page ends in .html",
    "page arm.fmu -o arm.fmu": "'arm.fmu' would replace the input 'arm.fmu'; give another output",
    "layouts arm.fmu -o notes.txt": "cannot make the folder 'notes.txt': File exists",
    # sweeps
    "sweep arm.fmu --grid Kp=50:100 -o s": "expected NAME=LOW:HIGH:COUNT, as in --grid Kp=20:200:10",
    "sweep arm.fmu --range Kp=50 -o s": "expected NAME=LOW:HIGH, as in --range Kp=20:200$",
}


@pytest.fixture(scope="module")
def things(native_path, tmp_path_factory):
    """A user's working folder after an hour."""
    folder = tmp_path_factory.mktemp("hour")
    shutil.copy(native_path, folder / "arm.fmu")
    shutil.copy(Path(__file__).parents[1] / "urdf/2dof.urdf", folder / "robot.urdf")
    twodof.simulate(native_path, twodof.Bag(folder / "bag", scene=True), stop_time=0.05)
    twodof.sweep(native_path, grid={"Kp": [50.0, 60.0]}, stop_time=0.05, output=folder / "gains")
    (folder / "folder").mkdir()
    for name, text in {
        "notes.txt": "hello",
        "robot.xml": "<mujoco/>",
        "table.csv": "time,Kp\n0,50\n",
        "semicolons.csv": "time;Kp\n0,0;50,5\n",
        "tabs.csv": "time\tKp\n0\t50\n",
        "capital.csv": "Time,Kp\n0,50\n",
        "headless.csv": "0,50\n1,60\n",
        "lower.csv": "time,kp\n0,50\n",
        "lonely.csv": "time\n0\n1\n",
        "start.csv": "time,q_start\n0,1\n",
        "united.csv": "time,Kp [1/s2]\n0,50\n",
        "exported.csv": "time,x_des.x [m]\n0,0.2\n",
    }.items():
        (folder / name).write_text(text)
    (folder / "wide.csv").write_text("time,Kp\n0,50\n", encoding="utf-16")
    return folder


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_gets_its_remedy(line, things, monkeypatch, capsys):
    monkeypatch.chdir(things)
    before = sorted(things.iterdir())
    try:
        status = main(line.split())
    except SystemExit as end:
        status = int(str(end.code))
    error = [text for text in capsys.readouterr().err.splitlines() if "error: " in text]
    assert status in (1, 2)
    assert len(error) == 1 and re.search(MISTAKES[line], error[0])
    shutil.rmtree("out", ignore_errors=True)  # the bag of a run that failed on the way
    assert sorted(things.iterdir()) == before


CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "a path as a sink": (lambda: twodof.run("arm.fmu", "bag2"), r"such as twodof.Bag\('my_bag'\), not 'bag2'"),  # type: ignore[arg-type]
    "a class as a sink": (lambda: twodof.run("arm.fmu", twodof.Bag), "a sink is an instance of Sink"),  # type: ignore[arg-type]
    "a text as a time": (
        lambda: twodof.run("arm.fmu", stop_time="5"),  # type: ignore[arg-type]
        "`stop_time` is '5', not a number of seconds",
    ),
    "a list of settings": (
        lambda: twodof.run("arm.fmu", settings=[("Kp", 80)]),  # type: ignore[arg-type]
        r"values by name, as \{'Kp': 80\}, not \[\('Kp', 80\)\]",
    ),
    "one value as a grid": (
        lambda: twodof.sweep("arm.fmu", grid={"Kp": 50}),  # type: ignore[dict-item]
        r"grid of Kp is 50; give its values, as \[20, 50, 80\]",
    ),
    "three values as a range": (
        lambda: twodof.sweep("arm.fmu", ranges={"Kp": (1, 2, 3)}, random=2),
        r"range of Kp is \(1, 2, 3\); give low and high",
    ),
    "one number as gravity": (
        lambda: twodof.FmuOptions(gravity=-9.81),  # type: ignore[arg-type]
        "`gravity` is the number -9.81; give all its elements",
    ),
    "one number as a start": (
        lambda: twodof.FmuOptions(q_start=0.5),  # type: ignore[arg-type]
        "`q_start` is the number 0.5; give all",
    ),
    "a list of locks": (
        lambda: twodof.FmuOptions(lock=["joint1"]),  # type: ignore[arg-type]
        r"`lock` is \['joint1'\]; give positions by joint, as \{'joint1': 0.0\}",
    ),
    "an input as a keyword": (
        lambda: twodof.run("arm.fmu", x_des=(0.2, 0.1)),  # type: ignore[call-arg]
        r"no argument 'x_des'; inputs and parameters are settings=\{'x_des': …\}",
    ),
    "values by joint": (
        lambda: twodof.run("arm.fmu", settings={"x_des": {"x": 0.2}}),
        r"x_des is \{'x': 0.2\}; give its 2 values in a list",
    ),
    "a joint as a setting": (
        lambda: twodof.run("arm.fmu", settings={"joint2": 0.3}),
        "no variable 'joint2': it is a joint, number 2 of the elements",
    ),
    "changes by time": (
        lambda: twodof.run("arm.fmu", changes={0.5: {"Kp": 80}}),  # type: ignore[arg-type]
        r"`changes` is \{0.5: .* give times with their inputs, as \[\(0.5, \{'Kp': 80\}\)\]",
    ),
    "a text as a grid": (
        lambda: twodof.sweep("arm.fmu", grid={"Kp": "50"}),  # type: ignore[dict-item]
        "grid of Kp is '50'; give its values, as",
    ),
    "a grid of the command line": (
        lambda: twodof.sweep("arm.fmu", grid={"Kp": "20:60:3"}),  # type: ignore[dict-item]
        "grid of Kp is '20:60:3'; give its values, as",
    ),
    "a URDF as options": (
        lambda: twodof.build_fmu("new.fmu", "robot.urdf"),  # type: ignore[arg-type]
        r"options are 'robot.urdf'; give twodof.FmuOptions\(urdf=…\)",
    ),
    "options as a path": (
        lambda: twodof.build_fmu(twodof.FmuOptions()),  # type: ignore[arg-type]
        r"FmuOptions\(.* is not a path; give the path of the FMU",
    ),
    "a figure of a number": (lambda: twodof.plot(3), "3 is not a path; give the path of the bag"),  # type: ignore[arg-type]
    "a name of another library": (lambda: twodof.load_bag, "no attribute 'load_bag'; did you mean 'read_bag'"),  # type: ignore[attr-defined]
}


@pytest.mark.parametrize("mistake", CALLS)
def test_a_mistake_in_python_gets_its_remedy(mistake, things, monkeypatch):
    monkeypatch.chdir(things)
    call, words = CALLS[mistake]
    with pytest.raises((twodof.TwoDofError, TypeError, AttributeError), match=words):
        call()


@pytest.mark.parametrize(
    "name, meant",
    [("controler.Kp", "Kp"), ("controller.Kpp", "Kp"), ("controller.control_perod", "controller.control_period")],
)
def test_a_name_of_a_system_that_is_mistyped_suggests_the_nearest(name: str, meant: str) -> None:
    names = ("Kp", "Kd", "controller.seed", "controller.control_period", "plant.payload")
    variables = {each: Variable(each, None, "input", "", 0.0, "") for each in names}
    system = SimpleNamespace(variables=variables, control="", joints=())
    assert no_variable(system, name, "input").endswith(f"did you mean '{meant}'?")


def test_a_tab_in_a_name_is_printed_as_an_escape() -> None:
    assert plain("joint\t1\n") == "joint\\t1\\n"
