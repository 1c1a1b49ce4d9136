"""The Python flavour through FMPy; each test loads it in its own process."""

import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import time
import zipfile
from contextlib import nullcontext
from ctypes import c_double, c_size_t, c_void_p
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from harness import Driver, changed_plant, in_child_process, unzipped
from oracles import position, task_error

from twodof import FmuOptions, TwoDofError, build_fmu, simulate
from twodof.export.composition import DEFAULT_ARM
from twodof.files import data_file
from twodof.plant.plant import Plant
from twodof.plant.robot import load_robot
from twodof.plant.variables import variable_table

OK, DISCARD, ERROR = 0, 2, 3
DO_STEP_STATUS = 0


@pytest.fixture(scope="module")
def ur5_fmu(robots, tmp_path_factory):
    urdf = robots / "ur_description/urdf/ur5_robot.urdf"
    options = FmuOptions(urdf=urdf, frame="ee_link", name="UR5", q_start=(0.1, -1.2, 1.4, 0, -1, 0))
    return build_fmu(tmp_path_factory.mktemp("ur5") / "UR5.fmu", options)


# --- the equations, through the FMU ---


@in_child_process
def test_outputs_are_right_after_initialisation_and_follow_the_plant_bit_for_bit(fmu_path):
    driver = Driver(fmu_path).initialise()
    robot = load_robot(data_file("urdf", "2dof.urdf").read_text(), "EndEffector", "xy")
    plant = Plant(robot, variable_table(robot, DEFAULT_ARM))
    plant.initialise()
    assert driver.outputs() == [*plant.q, *plant.v, *plant.x, *plant.tau]
    assert driver.get("x") == pytest.approx(position(np.array([0.5, 0.35])), abs=1e-15)
    for row in driver.run(50):
        plant.step(0.01)
        assert row == [*plant.q, *plant.v, *plant.x, *plant.tau]


@in_child_process
def test_steps_of_different_sizes_meet(fmu_path):
    driver = Driver(fmu_path).initialise()
    t = 0.0
    for h in (0.01, 0.003, 0.027, 0.1, 0.0001, 0.8599):
        assert driver.step(t, h) == OK
        t += h
    other = Driver(fmu_path).initialise()
    other.run(100)
    assert driver.get("q", "v") == pytest.approx(other.get("q", "v"), abs=1e-11)


# --- one process, several FMUs ---


@in_child_process
def test_different_fmus_run_one_after_the_other_and_interleaved(fmu_path, ur5_fmu):
    alone = []
    for fmu in (fmu_path, ur5_fmu):
        driver = Driver(fmu).initialise()
        alone.append(driver.run(20))
        driver.free()
    drivers = [Driver(fmu).initialise() for fmu in (fmu_path, ur5_fmu, fmu_path)]
    rows: list[list[float]] = [[], [], []]
    for k in range(20):
        for driver, seen in zip(drivers, rows):
            seen += driver.run(1, start=k)
    assert rows == [alone[0], alone[1], alone[0]]


@in_child_process
def test_an_fmu_runs_the_code_inside_its_own_zip(fmu_path, tmp_path):
    """A patched checkout and another FMU with other code are in the same process."""
    sys.modules["twodof.plant.plant"].Plant.step = None
    other = changed_plant(fmu_path, tmp_path, "Plant.x = property(lambda self: [42.0, 42.0])\n")
    driver, changed = Driver(fmu_path).initialise(), Driver(other).initialise()
    driver.run(2)
    assert driver.get("x") == pytest.approx(position(np.array(driver.get("q"))), abs=1e-15)
    assert changed.get("x") == [42.0, 42.0]


@in_child_process
def test_the_unzip_folder_and_the_working_directory_may_be_removed(fmu_path, tmp_path):
    (tmp_path / "gone").mkdir()
    os.chdir(tmp_path / "gone")
    first = Driver(fmu_path).initialise()
    shutil.rmtree(first.folder)
    shutil.rmtree(tmp_path / "gone")
    expected = first.run(10)
    first.slave.freeInstance()
    os.chdir(tmp_path)
    assert Driver(fmu_path).initialise().run(10) == expected


@in_child_process
def test_an_instance_runs_after_another_was_interrupted_while_it_loaded(fmu_path):
    """Ctrl-C in a notebook's first cell affects no later one."""

    class Interrupt:
        def find_spec(self, name, *_):
            if name.endswith(".plant.robot"):
                sys.meta_path.remove(self)
                raise KeyboardInterrupt

    sys.meta_path.insert(0, Interrupt())
    for raises in (pytest.raises((TwoDofError, KeyboardInterrupt)), nullcontext()):
        with raises:  # each from a folder of its own
            simulate(fmu_path, stop_time=0.02)
    assert not any(isinstance(finder, Interrupt) for finder in sys.meta_path)


@in_child_process
def test_importing_the_slave_is_cheap_and_free_of_effects(fmu_path, tmp_path):
    with zipfile.ZipFile(fmu_path) as archive:
        archive.extractall(tmp_path)
    resources = tmp_path / "resources"
    module = (resources / "slavemodule.txt").read_text().strip()
    for name in [name for name in sys.modules if name.split(".")[0] in ("pinocchio", "numpy")]:
        del sys.modules[name]
    sys.path.insert(0, str(resources))
    before = sorted(path.name for path in resources.iterdir())
    namespace = vars(importlib.import_module(module))
    exec(compile((resources / f"{module}.py").read_text(), module, "exec"), namespace, {})
    assert "pinocchio" not in sys.modules
    assert "numpy" not in sys.modules
    assert sorted(path.name for path in resources.iterdir() if path.suffix != "") == [
        name for name in before if "." in name
    ]


# --- states that are not to be trusted; test_states.py has the rest ---


FOREIGN = (
    b"not a state",
    b"[1, 2]",
    b"{}",
    b'{"identity": "x"}',
    b"",
    b"\xff\xfe",
    b"null",
    b"NaN",
    b"[" * 60_000,
    b'{"a":' * 10_000,
    b"1" * 60_000,
    b"[" + b"1," * 10**7 + b"1]",
)


@in_child_process
def test_a_foreign_state_is_refused(fmu_path):
    driver = Driver(fmu_path).initialise()
    driver.run(3)
    before = driver.outputs()
    for data in FOREIGN:
        refused(driver, data, "the state is not one of this FMU")
    assert driver.outputs() == before
    assert driver.step(0.03) == OK


NAN, INF = float("nan"), float("inf")
UNSOUND = "invalid FMU state"
FORGERIES = {
    "phase": (("flying", "", 2, None, ["step mode"]), UNSOUND),
    "time": ((NAN, INF, -INF, "0.03", 3, True, None, [0.03], 10**400), UNSOUND),
    "refused": ((None, 0, [], "\ud800", "half \udc00"), UNSOUND),
    "plant": ((None, [], {}, {"q": [0.1, 0.2]}, "step"), UNSOUND),
    "more": ((1.0,), UNSOUND),
    "plant.q": (([], [0.1], [0.1] * 3, [NAN, 0.1], [0.1, 3.2], [0.1, "0.1"], 0.1), UNSOUND),
    "plant.v": (([INF, 0.0], [None, 0.0], [[0.0], 0.0], [False, 0.0]), UNSOUND),
    "plant.x_des": (([NAN, 0.1], [0.1, 10**400]), UNSOUND),
    "plant.Kn": ((NAN, -INF, [10.0], None), UNSOUND),
    "plant.limit_effort": ((0, 1, 2.0, "true", None), UNSOUND),
    "plant.q_min": (([0.9, 0.9],), UNSOUND),
    "plant.step": ((1.0,), UNSOUND),
    "plant._data": ((None,), UNSOUND),
    "plant.max_step": ((0.0, -1.0), "max_step = .* must be > 0"),
    "plant.rtol": ((0.0,), "rtol = 0 must be > 0"),
    "plant.rcond": ((1.0,), r"rcond = 1 must be in \[0, 1\)"),
}


@in_child_process
def test_a_state_with_a_wrong_field_is_refused_and_leaves_all_as_it_was(fmu_path):
    driver = Driver(fmu_path).initialise()
    driver.run(3)
    before = driver.outputs()
    own = driver.call("serializeFMUstate", driver.call("getFMUstate"))
    for field, (values, message) in FORGERIES.items():
        for value in values:
            state = json.loads(own)
            holder = state["plant"] if "." in field else state
            holder[field.rpartition(".")[2]] = value
            refused(driver, json.dumps(state).encode(), message)
    for missing in ("phase", "plant"):
        state = json.loads(own)
        del state[missing]
        refused(driver, json.dumps(state).encode(), UNSOUND)
    assert driver.outputs() == before
    assert driver.call("serializeFMUstate", driver.call("getFMUstate")) == own


def refused(driver, data, message):
    driver.log.clear()
    driver.call("setFMUstate", driver.call("deSerializeFMUstate", data))
    ((status, text),) = driver.log
    assert status == ERROR
    assert re.fullmatch(f"fmi2SetFMUstate: {message}", text), data[:200]
    assert driver.step(0.03) == DISCARD


@in_child_process
def test_a_state_from_before_the_run_keeps_pending_errors(fmu_path):
    driver = Driver(fmu_path)
    driver.set(rtol=-1.0)
    data = driver.call("serializeFMUstate", driver.call("getFMUstate"))
    driver.call("reset")
    driver.call("setFMUstate", driver.call("deSerializeFMUstate", data))
    assert driver.log == []
    driver.initialise()
    assert driver.log == [(ERROR, "rtol = -1 must be > 0")]


# --- refusals ---


REFUSALS = {
    "x_des[1] = nan is not finite": lambda driver: driver.set(x_des=(NAN, 0.1)),
    "Kn = inf is not finite": lambda driver: driver.set(Kn=INF),
    "fmi2SetReal: q[1] is computed and cannot be set": (
        lambda driver: driver.call("setReal", driver.references("q")[:1], [0.1])
    ),
    "fmi2Set of a parameter (rtol) is not allowed in the state 'step mode'": (lambda driver: driver.set(rtol=1e-6)),
    "fmi2SetReal: there is no variable with value reference 999": (lambda driver: driver.call("setReal", [999], [0.1])),
    "fmi2SetReal: there is no variable with value reference -1": (
        lambda driver: driver.call("setReal", [2**32 - 1], [0.1])
    ),
    "fmi2SetReal: limit_effort is of type Boolean": (
        lambda driver: driver.call("setReal", driver.references("limit_effort"), [1.0])
    ),
    "fmi2SetInteger: Kn is of type Real": (lambda driver: driver.call("setInteger", driver.references("Kn"), [1])),
    "fmi2GetReal: there is no variable with value reference 999": (lambda driver: driver.call("getReal", [999])),
    "fmi2EnterInitializationMode is not allowed in the state 'step mode'": (
        lambda driver: driver.call("enterInitializationMode")
    ),
}


@in_child_process
def test_a_refused_value_is_logged_keeps_the_state_and_discards_the_next_step(fmu_path):
    expected = Driver(fmu_path).initialise().run(20)
    driver = Driver(fmu_path).initialise()
    for k, (message, refuse) in enumerate(REFUSALS.items()):
        before = driver.outputs()
        read = refuse(driver)
        assert not message.startswith("fmi2Get") or np.isnan(read).all()
        assert (ERROR, message) in driver.log, message
        assert driver.step(k * 0.01) == DISCARD, message
        assert (DISCARD, f"step discarded: {message}") in driver.log
        assert driver.outputs() == before
        assert driver.run(1, start=k) == expected[k : k + 1]


@in_child_process
def test_a_wrong_step_is_discarded(fmu_path):
    driver = Driver(fmu_path).initialise()
    driver.run(3)
    before = driver.outputs()
    elsewhere = "is not the time of the FMU, 0.03 s"
    for t, h, message in (
        (0.05, 0.01, f"fmi2DoStep: the communication point 0.05 s {elsewhere}"),
        (0.03 + 1e-8, 0.01, elsewhere),
        (NAN, 0.01, elsewhere),
        (INF, 0.01, elsewhere),
        (0.03, 0.0, "fmi2DoStep: the step 0.0 s must be finite and > 0"),
        *((0.03, h, "must be finite and > 0") for h in (-0.01, NAN, INF)),
    ):
        assert driver.step(t, h) == DISCARD
        assert message in driver.log[-1][1]
        assert driver.outputs() == before
    assert driver.step(0.03 + 1e-10) == OK  # rounding of the master's time is no mistake


@in_child_process
def test_bad_parameters_are_refused_at_the_end_of_initialisation(fmu_path):
    driver = Driver(fmu_path)
    for settings, message in (
        ({"q_min": (4.0, 0.0)}, "q_min[1] = 4 > q_max[1] = 3.14159 (joint 'joint1')"),
        ({"rtol": 0.0}, "rtol = 0 must be > 0"),
        ({"max_step": -1.0}, "max_step = -1 must be > 0"),
        ({"rcond": 2.0}, "rcond = 2 must be in [0, 1)"),
    ):
        driver.initialise(**settings)
        assert (ERROR, message) in driver.log
        assert driver.step(0.0) == DISCARD
        assert driver.step(0.0) == DISCARD
        driver.call("reset")
    assert driver.initialise().step(0.0) == OK


@in_child_process
def test_a_gain_below_zero_is_refused_and_the_old_one_kept(fmu_path):
    driver = Driver(fmu_path).initialise()
    driver.set(Kp=(80.0, -1.0))
    assert driver.log == [(ERROR, "Kp[2] = -1 must be >= 0")]
    assert driver.get("Kp") == [50.0, 50.0]
    assert [driver.step(0.0), driver.step(0.0)] == [DISCARD, OK]


@in_child_process
def test_calls_before_their_time_are_refused(fmu_path):
    driver = Driver(fmu_path)
    assert driver.step(0.0) == DISCARD
    assert driver.log[-1][1] == "fmi2DoStep is not allowed in the state 'instantiated'"
    assert np.isnan(driver.get("q")).all()
    assert driver.log[-1][1] == "fmi2GetReal is not allowed in the state 'instantiated'"
    driver.call("exitInitializationMode")
    assert driver.log[-1][1] == "fmi2ExitInitializationMode is not allowed in the state 'instantiated'"
    driver.call("reset")
    driver.initialise()
    driver.call("terminate")
    assert driver.step(0.0) == DISCARD
    assert driver.log[-1][1] == "fmi2DoStep is not allowed in the state 'terminated'"
    assert driver.get("q") == [0.5, 0.35]  # reading stays allowed


@in_child_process
def test_start_outside_the_limits_warns_and_a_tolerance_is_ignored_with_a_line(fmu_path):
    driver = Driver(fmu_path)
    driver.call("setupExperiment", startTime=0.0, tolerance=1e-9)
    driver.set(q_start=(4.0, 0.35))
    driver.call("enterInitializationMode")
    driver.call("exitInitializationMode")
    assert driver.get("q") == [np.pi, 0.35]
    (warning,) = [message for status, message in driver.log if status == 1]
    assert "q_start[1] = 4 of joint 'joint1' is outside its limits" in warning
    assert any("tolerance of the experiment is ignored" in message for _, message in driver.log)


@in_child_process
def test_refusals_and_resets_in_any_number_do_not_end_the_process(fmu_path):
    """Three exceptions and a reset would end a process with pythonfmu; so none is raised."""
    driver = Driver(fmu_path).initialise()
    for _ in range(5):
        for refuse in REFUSALS.values():
            refuse(driver)
        assert driver.step(0.0) == DISCARD
        driver.call("reset")
        driver.initialise()
    assert driver.step(0.0) == OK


@in_child_process
def test_sigint_during_a_step_is_a_discard_and_not_fatal(fmu_path):
    driver = Driver(fmu_path).initialise(max_step=1e-6)  # a step of seconds
    threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    begin = time.process_time()
    assert driver.step(0.0, 0.1) == DISCARD
    assert time.process_time() - begin < 5.0
    assert "interrupted" in driver.log[-1][1]
    assert driver.get("q") == [0.5, 0.35]
    assert driver.step(0.0, 1e-4) == OK


@in_child_process
def test_log_messages_are_no_printf_formats(tmp_path):
    urdf = tmp_path / "percent.urdf"
    text = data_file("urdf", "2dof.urdf").read_text().replace('"joint1"', '"100%s%n"')
    urdf.write_text(re.sub(r"<mesh [^>]*>", "<sphere radius='0.01'/>", text))
    fmu = build_fmu(tmp_path / "P.fmu", FmuOptions(urdf=urdf, axes="xy", name="P"))
    driver = Driver(fmu).initialise(q_start=(4.0, 0.0))
    assert "joint '100%s%n' is outside its limits" in driver.log[-1][1]


# --- the limits of this flavour ---


def refuse_a_call(fmu):
    driver = Driver(fmu).initialise()
    driver.set(Kn=float("nan"))
    refused = driver.status
    return refused == ERROR, (refused, driver.step(0.0)) == (OK, DISCARD)


def discard_a_step_without_ending_the_run(fmu):
    try:
        rows = fmpy.simulate_fmu(unzipped(fmu), start_values={"Kp[1]": 1e308, "x_des[1]": 1e300})
    except FMICallException as error:
        return error.status == DISCARD, False
    return False, rows["time"].tolist() == [0.0, 0.0]


def check_the_guid(fmu):
    try:
        return False, Driver(fmu, guid="another").initialise().step(0.0) == OK
    except Exception as error:  # FMPy's own
        return "instantiate" in str(error), False


def refuse_a_null_pointer(fmu):
    driver, one = Driver(fmu).initialise(), c_size_t(1)
    dll, component = driver.slave.dll, c_void_p(driver.slave.component)
    calls = [
        lambda: dll.fmi2GetReal(component, None, one, None),
        lambda: dll.fmi2SetReal(component, None, one, None),
        lambda: dll.fmi2DoStep(None, c_double(0.0), c_double(0.01), 0),
    ]
    ends = []
    for call in calls:
        if (child := os.fork()) == 0:
            os._exit(call())
        ends.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    return ends == [ERROR] * 3, ends == [-signal.SIGSEGV] * 3


def keep_to_the_stop_time(fmu):
    driver = Driver(fmu)
    driver.call("setupExperiment", startTime=0.0, stopTime=0.01)
    driver.call("enterInitializationMode")
    driver.call("exitInitializationMode")
    steps = driver.step(0.0), driver.step(0.01)
    return steps == (OK, ERROR), steps == (OK, OK)


def answer_getstatus(fmu):
    driver = Driver(fmu).initialise()
    driver.call("getStatus", DO_STEP_STATUS)
    return driver.status == OK, driver.status == ERROR


CANNOT = (
    refuse_a_call,
    discard_a_step_without_ending_the_run,
    check_the_guid,
    refuse_a_null_pointer,
    keep_to_the_stop_time,
    answer_getstatus,
)


@in_child_process
def test_the_limits_of_this_flavour_are_as_documented(fmu_path, native_path):
    """Each returns whether the feature works, and whether the documented effect occurs instead."""
    for row in CANNOT:
        assert row(native_path) == (True, False), row
        assert row(fmu_path) == (False, True), row


def test_the_limits_of_this_flavour_are_listed_row_by_row(fmu_path, native_path):
    rows = []
    for fmu in (fmu_path, native_path):
        with zipfile.ZipFile(fmu) as archive:
            page = archive.read("documentation/index.html").decode()
        section = page.partition("<h2>Limits of the Python FMU</h2>")[2].partition("<h2>")[0]
        rows.append(re.findall("<tr><td>(.*?)</td>", section, re.DOTALL))
    python, native = rows
    assert native == []
    assert [re.sub(r"\W", "_", row.replace("fmi2", "")).lower() for row in python] == [row.__name__ for row in CANNOT]


# --- packages ---


@in_child_process
def test_a_missing_package_is_named_with_the_remedy(fmu_path):
    patch, messages = pytest.MonkeyPatch(), []
    patch.setitem(sys.modules, "pinocchio", None)  # as if it were not installed
    patch.setattr(Driver, "_log", lambda *arguments: messages.append(arguments[-1].decode()))
    with pytest.raises(Exception, match="Failed to instantiate"):
        Driver(fmu_path)
    (message,) = messages
    assert "has no package 'pinocchio'" in message
    assert "resources/requirements.txt" in message
    assert "externalDependencies.txt" in message
    assert "link_environment" in message


HOST_WITHOUT_PINOCCHIO = """
import sys
from harness import Driver
try:
    import pinocchio
except ModuleNotFoundError:
    sys.exit(Driver(sys.argv[1]).initialise().step(0.0))
sys.exit("this host was not to have pinocchio")
"""


@pytest.mark.parametrize("linked", [True, False])
def test_a_linked_environment_is_found_without_any_variable(linked, tmp_path):
    fmu = build_fmu(tmp_path / "L.fmu", FmuOptions(link_environment=linked, name="L"))
    packages = tmp_path / "packages"  # all of this environment but Pinocchio
    packages.mkdir()
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if not entry.name.startswith("cmeel"):
            (packages / entry.name).symlink_to(entry)
    host = subprocess.run(
        [sys.executable, "-S", "-c", HOST_WITHOUT_PINOCCHIO, fmu],
        env={"PYTHONPATH": f"{packages}:{Path(__file__).parent}", "TWODOF_TESTS": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert host.returncode == (0 if linked else 1), host.stderr
    assert ("Failed to instantiate" in host.stderr) == (not linked)


def test_requirements_name_the_imports_of_the_plant(fmu_path):
    with zipfile.ZipFile(fmu_path) as archive:
        requirements = archive.read("resources/requirements.txt").decode().split()
        config = json.loads(archive.read("resources/plant.json"))
    assert [re.split("[<>=]", line)[0] for line in requirements] == ["numpy", "pin"]
    assert config["site_packages"] == []
    imported = set()
    for path in Path(data_file("plant")).glob("*.py"):
        imported |= set(re.findall(r"^(?:import|from) ([a-z]\w*)", path.read_text(), re.M))
    third_party = imported - set(sys.stdlib_module_names)
    assert third_party == {"numpy", "pinocchio"}


@in_child_process
def test_a_robot_with_one_joint_runs(tmp_path):
    urdf = tmp_path / "one.urdf"
    urdf.write_text(
        '<robot name="one"><link name="base"/><link name="arm"><inertial><origin xyz="0.1 0 0"/>'
        '<mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
        '</inertial></link><link name="tip"/>'
        '<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>'
        '<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="0" velocity="1"/></joint>'
        '<joint name="end" type="fixed"><parent link="arm"/><child link="tip"/>'
        '<origin xyz="0.3 0 0"/></joint></robot>'
    )
    options = FmuOptions(urdf=urdf, frame="tip", axes="y", name="One")
    arm = Driver(build_fmu(tmp_path / "One.fmu", options)).initialise(x_des=(0.1,))
    rows = np.array(arm.run(200))
    t = 0.01 * np.arange(1, 201)
    expected = 0.1 - task_error(np.array([0.1]), 50.0, 40.0, t)[:, 0]
    np.testing.assert_allclose(0.3 * np.sin(rows[:, 0]), expected, rtol=0.0, atol=1e-9)
