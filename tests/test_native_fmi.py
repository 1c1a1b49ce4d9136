"""The native FMU's library through FMPy: the standard's state machine, saved states, instances."""

from __future__ import annotations

import ctypes
import re
import struct
import subprocess

import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave
from harness import Recorded
from native_models import GUID, HERE, executable, library, model
from tools import needs

OK, WARNING, DISCARD, ERROR = range(4)


class FMU2Arm(Recorded, FMU2Slave):
    def __init__(self, name="twodof", guid=GUID, logging=False, start=True):
        self.of = model(name)
        super().__init__(
            guid=guid,
            modelIdentifier="Arm",
            unzipDirectory=str(library(name).parent),
            libraryPath=str(library(name)),
            instanceName=name,
        )
        self.instantiate(callbacks=self.functions(), loggingOn=logging)
        self.time = 0.0
        if start:
            self.start()

    def start(self, **values):
        for name, value in values.items():
            self.set(name, value)
        self.setupExperiment(startTime=0.0)
        self.enterInitializationMode()
        self.exitInitializationMode()
        self.time = 0.0

    def set(self, name, value):
        first = self.of.reference(name)
        values = np.atleast_1d(value).tolist()
        self.setReal(list(range(first, first + len(values))), values)

    def get(self, name):
        table = self.of.table
        return self.getReal([i for i, v in enumerate(table, 1) if name in (v.name, v.group)])

    def step(self, h=0.01):
        self.doStep(self.time, h)
        self.time += h

    def outputs(self):
        return [self.get(group) for group in ("q", "v", "x", "tau")]

    def run(self, steps):
        """Return a run with changing targets, as numbers to compare bit for bit."""
        rows = []
        for k in range(steps):
            if k % 40 == 0:
                self.set("x_des", [0.25 - 0.002 * k, 0.05 + 0.001 * k])
            self.step()
            rows.append(self.outputs())
        return rows


Arm = FMU2Arm


def test_outputs_follow_parameters_in_initialization_mode():
    arm = Arm(start=False)
    arm.setupExperiment(startTime=0.0)
    arm.enterInitializationMode()
    assert arm.get("q") == [0.5, 0.35]
    arm.set("q_start", [0.1, 0.2])
    assert arm.get("q") == [0.1, 0.2]
    assert arm.get("x") == pytest.approx(
        [0.15 * (np.cos(0.1) + np.cos(0.3)), 0.15 * (np.sin(0.1) + np.sin(0.3))], abs=1e-12
    )
    still = arm.get("tau")
    arm.set("gravity", [0.0, 0.0, 0.0])
    assert arm.get("tau") != still


def test_limit_effort_is_boolean():
    arm = Arm(start=False)
    vr = arm.of.reference("limit_effort")
    arm.setBoolean([vr], [True])
    arm.start(x_des=[1e4, 0.0])
    assert arm.getBoolean([vr]) == [True]
    assert np.abs(arm.get("tau")).max() == 10.0
    arm.refused("limit_effort is of type Boolean", "getReal", [vr])
    arm.refused("rcond is of type Real", "getBoolean", [arm.of.reference("rcond")])


# --- the state machine ---

LEGAL = {
    "instantiated": {"setupExperiment", "enterInitializationMode", "reset", "set input", "set parameter"},
    "initialization": {"exitInitializationMode", "reset", "get", "set input", "set parameter"},
    "step": {"doStep", "terminate", "reset", "get", "set input", "getStatus"},
    "failed": {"terminate", "reset", "get", "getStatus"},
    "terminated": {"reset", "get", "getStatus"},
}
CALLS = {
    "setupExperiment": ("setupExperiment", None, 0.0),
    "enterInitializationMode": ("enterInitializationMode",),
    "exitInitializationMode": ("exitInitializationMode",),
    "doStep": ("doStep", 0.0, 0.01),
    "terminate": ("terminate",),
    "reset": ("reset",),
    "get": ("getReal", [1]),
    "set input": ("setReal", [1], [0.1]),
    "set parameter": ("set", "rtol", 0.02),
    "getStatus": ("getRealStatus", 2),
}


def arm_in(phase):
    arm = Arm(start=False)
    if phase == "instantiated":
        return arm
    if phase == "initialization":
        arm.setupExperiment(startTime=0.0)
        arm.enterInitializationMode()
        return arm
    arm.start()
    if phase == "failed":
        arm.set("Kp", [1e308, 1e308])
        arm.set("x_des", [1e300, 1.0])
        assert arm.status("doStep", 0.0, 0.01) == DISCARD
    if phase == "terminated":
        arm.terminate()
    return arm


@pytest.mark.parametrize("phase", LEGAL)
def test_every_call_in_every_phase(phase):
    for call, arguments in CALLS.items():
        arm = arm_in(phase)
        if call in LEGAL[phase]:
            assert arm.status(*arguments) == OK, call
        else:
            arm.refused("is not allowed in the state", *arguments)


def test_calls_that_are_not_supported_or_of_model_exchange_are_refused():
    arm, null = Arm(), ctypes.c_void_p()
    refusals = dict.fromkeys(
        ("SetRealInputDerivatives", "GetRealOutputDerivatives"), "is not supported by this FMU"
    ) | dict.fromkeys(
        (
            "EnterEventMode",
            "NewDiscreteStates",
            "EnterContinuousTimeMode",
            "CompletedIntegratorStep",
            "SetContinuousStates",
            "GetDerivatives",
            "GetEventIndicators",
            "GetContinuousStates",
            "GetNominalsOfContinuousStates",
        ),
        "is a call of Model Exchange, and the instance is one of co-simulation",
    )
    for function, text in refusals.items():
        arm.messages.clear()
        assert arm.dll[f"fmi2{function}"](ctypes.c_void_p(arm.component), *[null] * 6) == ERROR
        assert arm.messages == [(ERROR, f"fmi2{function} {text}")]


# --- refusals ---


def test_values_that_are_not_finite():
    arm = Arm()
    vr = arm.of.reference("Kp[2]")
    for value, text in ((np.nan, "nan"), (np.inf, "inf"), (-np.inf, "-inf")):
        # nothing of a refused call is done, its first value neither
        arm.refused(rf"^Kp\[2\] = {text} is not finite$", "setReal", [1, vr], [0.3, value])


def test_refusals_name_the_culprit():
    arm = Arm()
    vr = arm.of.reference
    beyond = len(arm.of.table) + 1
    arm.refused(f"no variable with value reference {beyond}", "getReal", [1, beyond])
    arm.refused("no variable with value reference 0$", "getReal", [0])
    arm.refused("no variable with value reference 4294967295", "setReal", [2**32 - 1], [0.0])
    arm.refused(r"q\[1\] is computed and cannot be set", "setReal", [vr("q[1]")], [0.0])
    arm.refused(r"parameter \(max_step\) is not allowed", "setReal", [vr("max_step")], [0.1])
    arm.refused(r"x_des\[1\] is of type Real", "getInteger", [1])
    arm.refused(r"x_des\[1\] is of type Real", "setString", [1], ["a"])
    arm.refused("communication point 0.1 s is not the time of the FMU, 0 s", "doStep", 0.1, 0.01)
    arm.refused("communication point nan s", "doStep", np.nan, 0.01)
    arm.refused("communication point inf s", "doStep", np.inf, 0.01)
    for h in (0.0, -0.01, np.nan, np.inf):
        arm.refused("the step .* must be finite and > 0", "doStep", 0.0, h)
    assert arm.status("doStep", 0.9e-9, 0.01) == OK


def test_values_out_of_their_range_are_refused_where_they_are_set():
    arm = arm_in("initialization")
    for name, value, message in (
        ("rtol", 0.0, "rtol = 0 must be > 0"),
        ("atol", -1.0, "atol = -1 must be > 0"),
        ("max_step", 0.0, "max_step = 0 must be > 0"),
        ("rcond", 1.0, r"rcond = 1 must be in \[0, 1\)"),
        ("payload", -0.1, "payload = -0.1 must be >= 0"),
        ("Kp[2]", -1.0, r"Kp\[2\] = -1 must be >= 0"),
    ):
        arm.refused(message, "setReal", [1, arm.of.reference(name)], [0.3, value])


def test_limits_are_checked_when_initialization_ends():
    arm = arm_in("initialization")
    message = r"q_min\[2\] = 4 > q_max\[2\] = 3.14159 \(joint 'joint2'\)"
    arm.set("q_min[2]", 4.0)
    arm.refused(message, "exitInitializationMode")
    arm.refused(message, "getReal", [arm.of.reference("q[1]")])
    arm.set("q_min[2]", -4.0)
    arm.exitInitializationMode()


def test_start_and_stop_times():
    arm = Arm(start=False)
    arm.refused("start time is not finite", "setupExperiment", None, np.nan)
    arm.refused("stop time 1 < start time 2", "setupExperiment", None, 2.0, 1.0)
    arm.setupExperiment(startTime=1.0, stopTime=1.02)
    arm.enterInitializationMode()
    arm.exitInitializationMode()
    arm.doStep(1.0, 0.01)
    arm.refused("ends after the stop time, 1.02 s", "doStep", 1.01, 0.02)
    arm.doStep(1.01, 0.01)


def test_tolerance_is_ignored_with_a_message():
    arm = Arm(start=False, logging=True)
    arm.setupExperiment(tolerance=1e-9, startTime=0.0)
    assert [status for status, _ in arm.messages] == [OK]
    assert "tolerance 1e-09 of the experiment is ignored" in arm.messages[0][1]
    quiet = Arm(start=False)
    quiet.setupExperiment(tolerance=1e-9, startTime=0.0)
    assert not quiet.messages


def test_start_outside_the_limits_is_clamped_with_a_warning():
    arm = Arm(start=False)
    arm.start(q_start=[4.0, 0.35], v_start=[1.0, 0.0])
    text = "q_start[1] = 4 of joint 'joint1' is outside its limits [-3.14159, 3.14159] and was clamped to 3.14159"
    assert arm.messages == [(WARNING, text)]
    assert arm.get("q") == [np.pi, 0.35] and arm.get("v") == [0.0, 0.0]


def test_wrong_guid_and_names():
    with pytest.raises(Exception, match="instantiate"):
        Arm(guid="another")
    arm = Arm()
    assert arm.fmi2GetVersion() == b"2.0" and arm.fmi2GetTypesPlatform() == b"default"
    arm.refused("there is no category 'x'", "setDebugLogging", True, ["x"])


def test_a_failed_step_is_discarded_and_changes_nothing():
    arm = Arm()
    arm.step()
    before = arm.get("q")
    saved = arm.getFMUState()
    arm.set("Kp", [1e308, 1e308])
    arm.set("x_des", [1e300, 1.0])
    arm.messages.clear()
    assert arm.status("doStep", 0.01, 0.01) == DISCARD
    assert arm.messages == [
        (
            DISCARD,
            "fmi2DoStep at 0.01 s: the equations of motion gave a value that is not finite:"
            " inputs, payload or speeds are too large, or joint 'joint1', which changes at a rate of inf 1/s,"
            " needs armature or a lock",
        )
    ]
    assert arm.get("q") == before and arm.getRealStatus(2) == 0.01
    arm.setFMUState(saved)
    arm.doStep(0.01, 0.01)
    assert arm.get("q") == two_steps()


def two_steps():
    arm = Arm()
    arm.step()
    arm.step()
    return arm.get("q")


# --- states that are not to be trusted, instances; test_states.py has the rest ---


def test_foreign_and_damaged_states_are_refused():
    arm, other = Arm(), Arm("ur5")
    state = other.getFMUState()
    foreign = other.serializeFMUState(state)
    own = bytearray(arm.serializeFMUState(arm.getFMUState()))
    own[100] ^= 1
    for blob in (foreign, bytes(own), b"", b"nonsense"):
        arm.refused("not one of this FMU", "deSerializeFMUstate", blob)
    arm.refused("null pointer", "setFMUState", ctypes.c_void_p())


def forged(arm, field, value):
    """The bytes of an instance's state with another value in a field, and a valid checksum."""
    blob = arm.snapshot()
    n = len(arm.of.table)
    head = len(GUID) + 1 + 8 - (len(GUID) + 1) % 8
    joints = len(arm.of.robot.joints)
    layout = struct.Struct(f"={head}s{n + 4 + 5 * joints}d2i{3 + 12 * joints}d2i{3 * joints}d{3 * joints + 4}id6iQ")
    fields = list(layout.unpack(blob))
    names = ["time", "stop_time", "step_start"]
    names += [f"step_{kind}[{i + 1}]" for kind in ("q", "v", "a") for i in range(joints)]
    names += [f"reached_{state}[{i + 1}]" for state in "qv" for i in range(joints)]
    names += ["reached_at", "passed_by", "step_begun", "first_sample", "last_sample", "samples"]
    names += [f"sample[{i + 1}]" for i in range(joints)]
    names += [f"pending{k}[{i + 1}]" for k in range(11) for i in range(joints)]
    names += ["waiting", "clock"] + [f"before_{kind}[{i + 1}]" for kind in ("tau", "q", "v") for i in range(joints)]
    names += [f"{what}[{i + 1}]" for what in ("held", "watched", "slip") for i in range(joints)]
    names += ["any_held", "any_watched", "any_slip", "rank", "acting", "phase", "initialised"]
    names += ["has_x", "has_tau", "has_stops", "has_rates"]
    place = n + 1 + names.index(field) if field in names else 1 + arm.of.index(field)
    fields[place] = value
    fields[-1] = fnv(layout.pack(*fields)[:-8])
    return layout.pack(*fields)


def fnv(content):
    """FNV-1a, 64 bits; RFC 9923."""
    digest = 0xCBF29CE484222325
    for byte in content:
        digest = (digest ^ byte) * 0x100000001B3 % 2**64
    return digest


UNSOUND = "fmi2DeSerializeFMUstate: invalid FMU state"
FORGERIES = {
    "held[1]": ((4, -1), UNSOUND),
    "slip[1]": ((2, -2), UNSOUND),
    "watched[2]": ((1, 7), UNSOUND),  # of a joint that is not held
    "acting": ((np.nan, np.inf, -1.0), UNSOUND),
    "phase": ((-1, 4, 5, 7, 77, 2**31 - 1, -(2**31)), UNSOUND),
    "time": ((np.nan, np.inf, -np.inf), UNSOUND),
    "stop_time": ((np.nan, -np.inf), UNSOUND),
    "step_start": ((np.nan, np.inf), UNSOUND),
    "step_v[2]": ((np.nan, np.inf), UNSOUND),
    "reached_q[1]": ((np.nan, -np.inf), UNSOUND),
    "reached_at": ((np.nan, np.inf), UNSOUND),
    "passed_by": ((-1, 3), UNSOUND),
    "step_begun": ((-1, 2), UNSOUND),
    "first_sample": ((np.nan, np.inf), UNSOUND),
    "samples": ((np.nan, -1.0, 0.5, 1e16), UNSOUND),
    "sample[2]": ((np.nan, np.inf), UNSOUND),
    "pending10[1]": ((np.nan, np.inf), UNSOUND),
    "waiting": ((1, -1, 11, 2**31 - 1), UNSOUND),  # where no controller is sampled
    "clock": ((1, 2, -1, 3), UNSOUND),  # of an FMU without one
    "before_v[2]": ((np.nan, np.inf), UNSOUND),
    "x_des[1]": ((np.nan, np.inf), UNSOUND),
    "seed": ((0.5, np.nan), UNSOUND),
    "integrator": ((0.5, np.nan), UNSOUND),
    "control_delay": ((0.01,), "control_delay = 0.01 needs a control_period > 0"),
    "Kn": ((-np.inf,), UNSOUND),
    "q[1]": ((np.nan, np.inf, 3.2, -3.2), UNSOUND),
    "v[2]": ((np.nan, np.inf), UNSOUND),
    "gravity[3]": ((np.nan,), UNSOUND),
    "max_step": ((0.0, -1.0), "max_step = .* must be > 0"),
    "rtol": ((0.0,), "rtol = 0 must be > 0"),
    "rcond": ((1.0,), r"rcond = 1 must be in \[0, 1\)"),
    "q_min[1]": ((1.0,), UNSOUND),
    "Kp[1]": ((-1.0,), r"Kp\[1\] = -1 must be >= 0"),
    "limit_effort": ((0.5, 2.0, np.nan), UNSOUND),
}


@pytest.mark.parametrize("field", FORGERIES)
def test_a_state_with_a_right_checksum_and_a_wrong_field_is_refused(field):
    arm = Arm()
    arm.step()
    assert forged(arm, "time", 0.01) == arm.snapshot()
    values, message = FORGERIES[field]
    for value in values:
        arm.refused(message, "deSerializeFMUstate", forged(arm, field, value))


@pytest.mark.parametrize(
    "field", ["initialised", "has_x", "has_tau", "has_stops", "has_rates", "any_held", "x[1]", "tau[1]", "der(v[1])"]
)
def test_values_computed_on_demand_are_not_taken_from_the_bytes_of_a_state(field):
    arm, other = Arm(), Arm(start=False)
    arm.step()
    arm.outputs()
    for value in (0, 1, -7):
        other.setFMUState(other.deSerializeFMUstate(forged(arm, field, value)))
        assert other.outputs() == arm.outputs()


def test_a_state_from_before_the_run_keeps_pending_errors():
    arm = Arm(start=False)
    arm.set("q_min[1]", 4.0)
    saved = arm.deSerializeFMUstate(arm.snapshot())
    arm.reset()
    arm.setFMUState(saved)
    arm.setupExperiment(startTime=0.0)
    arm.enterInitializationMode()
    arm.refused(r"q_min\[1\] = 4 > q_max", "exitInitializationMode")


def test_interleaved_instances_equal_one_alone():
    alone = Arm().run(60)
    arms, other = [Arm() for _ in range(8)], Arm("ur5")
    for k in range(60):
        other.step()
        for arm in arms:
            if k % 40 == 0:
                arm.set("x_des", [0.25 - 0.002 * k, 0.05 + 0.001 * k])
            arm.step()
            assert arm.outputs() == alone[k]


# --- the library ---


def test_library_exports_the_standard_needs_libc_alone_and_is_small():
    path = library("twodof")
    symbols = subprocess.check_output([needs("nm"), "-D", "--defined-only", path], text=True).split()[2::3]
    header = "\n".join(
        content.decode() for file, content in model("twodof").sources().items() if file == "fmi2Functions.h"
    )
    assert sorted(symbols) == sorted(
        [*re.findall(r"FMI2_Export \w+TYPE +(\w+);", header), "twodof_evaluations", "twodof_span"]
    )
    needed = subprocess.check_output(["readelf", "-d", path], text=True)
    assert set(re.findall(r"NEEDED.*\[(.*)\]", needed)) <= {"libc.so.6", "libm.so.6"}
    versions = re.findall(r"GLIBC_2\.(\d+)", subprocess.check_output([needs("nm"), "-D", path], text=True))
    assert max(map(int, versions)) <= 17
    assert path.stat().st_size <= 200_000


def test_no_memory_is_allocated_and_no_global_is_written():
    """Exceptions are instantiation and saved states. The linker's writable data is allowed."""
    wanted = {"instance.c": 1, "saved_state.c": 1}  # calls of the allocator
    for file, content in model("twodof").sources().items():
        if file.endswith(".c"):
            text = content.decode()
            assert len(re.findall(r"alloc\(", text)) == wanted.get(file, 0), file
            assert not re.search(r"^static (?!const|inline)[^()]*[;=]", text, re.M), file


@pytest.mark.long
def test_random_calls_under_sanitizers(length):
    """Calls are legal and illegal, with NaN, infinities and more."""
    count = length(100_000, 6_000)
    program = executable(
        model("twodof"),
        HERE / "fuzz.c",
        HERE / "fuzz2.h",
        flags=("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
    )
    done = subprocess.run([program, str(count), "0"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{count} sequences")


@pytest.mark.long
def test_instances_in_threads_share_nothing(length):
    """Several threads make random calls on their instances under ThreadSanitizer."""
    count = length(25_000, 500)
    flags = ("-g", "-O1", "-pthread", "-fsanitize=thread")
    program = executable(model("twodof"), HERE / "fuzz.c", HERE / "fuzz2.h", flags=flags)
    done = subprocess.run([program, str(count), "2", "4"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(f"{count} sequences") == 4


def test_run_under_valgrind():
    program = executable(model("twodof"), HERE.parents[1] / "benchmarks" / "native_step.c")
    command = [needs("valgrind"), "-q", "--error-exitcode=9", "--leak-check=full", str(program)]
    done = subprocess.run([*command, "0.01", "5", "2"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
