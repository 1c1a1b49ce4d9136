"""Random programs of calls: each state of an FMU depends on its history alone.

A program sets, steps, saves, restores, serialises, frees, resets and reads, and makes refused calls. Its history is the
list of settings and steps since the last initialisation; restoring returns to an earlier history, and resetting empties
it. After every operation, the FMU's values are bit-identical to those of a new instance that does only the history. The
flavours agree on histories away from singularities. All FMUs run in a separate process; if one crashes, its program
fails.
"""

import re
from collections import Counter
from functools import partial
from itertools import chain
from math import inf, nan
from typing import Any, NamedTuple

import fmpy
import numpy as np
import pinocchio as pin
import pytest
from fmpy.fmi2 import fmi2FMUstate
from harness import Driver, Worker
from hypothesis import Phase, given, note, settings
from hypothesis import strategies as st
from oracles import REST

from twodof import FmuOptions, build_fmu
from twodof.files import data_file
from twodof.plant.robot import Robot, load_robot

OK, DISCARD, ERROR = 0, 2, 3
ESCAPED = "gave a value that is not finite"
OUTPUTS = ("q", "v", "x", "xd", "quat", "omega", "tau", "q_meas", "v_meas")
INPUTS = (
    "x_des",
    "xd_des",
    "xdd_des",
    "quat_des",
    "omega_des",
    "alpha_des",
    "q_des",
    "v_des",
    "a_des",
    "tau_cmd",
    "Kp",
    "Kd",
    "Kp_rot",
    "Kd_rot",
    "Kn",
    "tau_ext",
    "f_ext",
)
BOOLEANS = ("v_from_q", "limit_effort", "rigid_stops", "payload_known")
PARAMETERS = (
    "q_start",
    "v_start",
    "q_min",
    "q_max",
    "gravity",
    "payload",
    "payload_com",
    "rcond",
    "rtol",
    "atol",
    "max_step",
    "control_period",
    "control_delay",
    "q_resolution",
    "q_noise",
    "v_noise",
    *BOOLEANS,
)
"""Groups of all controls; an FMU has those of its own."""
TARGETS = {"task": "x_des", "pose": "x_des", "joint": "q_des", "effort": "tau_cmd"}


class Program(list):
    """Operations, each a tuple of a name and arguments, shown one per line."""

    def __repr__(self):
        return "".join(["[\n", *(f"    {operation},\n" for operation in self), "]"])


# --- carrying out a program ---


class Master:
    """Executes operations, which are its methods; stores the time and the saved states."""

    def __init__(self, fmu, folder):
        self.fmu = fmu
        self.driver = Driver(fmu, folder)
        self.time, self.saved = 0.0, {}

    def answer(self, operation):
        """The statuses of the operation's calls, the FMU's error messages, and the read values."""
        self.statuses: list[int] = []
        self.driver.log.clear()
        name, *arguments = operation
        values = getattr(self, name)(*arguments)
        return self.statuses, self.complaints(), values

    def complaints(self):
        return [text for status, text in self.driver.log if status >= DISCARD]

    def call(self, name, *arguments, **named):
        value = self.driver.call(name, *arguments, **named)
        self.statuses.append(self.driver.status)
        return value

    def enter(self, start):
        self.call("setupExperiment", startTime=start)
        if not self.complaints():
            self.call("enterInitializationMode")
            self.time = start

    def exit(self):
        self.call("exitInitializationMode")

    def set(self, name, value):
        self.driver.set(**{name: value})
        self.statuses.append(self.driver.status)

    def read(self, *groups):
        groups = groups or OUTPUTS + INPUTS + PARAMETERS
        references = {group: vrs for group in groups if (vrs := self.driver.references(group))}
        truths = {group: references.pop(group) for group in BOOLEANS if group in references}
        values = self.call("getReal", [*chain.from_iterable(references.values())])
        booleans = self.call("getBoolean", [*chain.from_iterable(truths.values())])
        if self.complaints():
            return None
        rest = chain(values, booleans)
        return {group: [next(rest) for _ in vrs] for group, vrs in (references | truths).items()}

    def step(self, h, late=0.0):
        """Do a step; repeat it once if it is discarded."""
        point = self.time + late
        self.call("doStep", point, h)
        if self.statuses == [DISCARD]:
            self.call("doStep", point, h)
        if self.statuses[-1] == OK:
            self.time = point + h

    def terminate(self):
        self.call("terminate")

    def reset(self):
        self.call("reset")

    def fail_to_start(self, name, value):
        """Do an initialisation that is refused for a parameter, between two resets."""
        self.reset()
        self.set(name, value)
        self.enter(0.0)
        self.exit()
        self.reset()

    def save(self, slot):
        """Save into a slot, over its state if it has one."""
        state, _ = self.saved.get(slot, (fmi2FMUstate(), 0.0))
        self.call("fmi2GetFMUstate", self.driver.slave.component, state)
        self.saved[slot] = state, self.time

    def restore(self, slot):
        state, self.time = self.saved[slot]
        self.call("setFMUstate", state)

    def free(self, slot):
        state, _ = self.saved.pop(slot)
        self.call("freeFMUstate", state)

    def serialise(self, slot):
        """Replace a saved state by its deserialised bytes."""
        state, time = self.saved[slot]
        data = self.call("serializeFMUstate", state)
        self.call("freeFMUstate", state)
        self.saved[slot] = self.call("deSerializeFMUstate", data), time

    def damage(self, slot):
        """Restore a state without its last bytes."""
        state, _ = self.saved[slot]
        data = self.call("serializeFMUstate", state)
        state = self.call("deSerializeFMUstate", data[:-9])
        if state is not None:
            self.call("setFMUstate", state)
            self.call("freeFMUstate", state)

    def wreck(self, slot):
        """Set inputs with which no step succeeds, try a step, and restore."""
        for name, huge in (("Kp", 1e308), ("x_des", 1e300), ("q_des", 1e300), ("tau_cmd", 1e308)):
            if vrs := self.driver.references(name):
                self.set(name, (huge,) * len(vrs))
        self.call("doStep", self.time, 0.01)
        self.read()
        self.restore(slot)

    def move(self):
        """Continue in a new instance, which receives the state and all saved ones as bytes."""
        self.save("present")
        old, self.driver = self.driver, Driver(self.fmu, self.driver.folder)
        for slot, (state, time) in self.saved.items():
            data = old.call("serializeFMUstate", state)
            old.call("freeFMUstate", state)
            self.saved[slot] = self.call("deSerializeFMUstate", data), time
        old.slave.freeInstance()
        self.restore("present")
        self.free("present")


def carry_out(fmu, folder, program):
    """The answers of a new instance to the operations of a program."""
    master = Master(fmu, folder)
    answers = [master.answer(operation) for operation in program]
    for slot in list(master.saved):
        master.free(slot)
    master.driver.slave.freeInstance()
    return answers


# --- what is to come of it ---


class Expected(NamedTuple):
    """Expected result of an operation."""

    history: tuple  # operations, this one among them where it counts
    refused: bool
    discards: bool  # a call before was refused: the Python flavour discards the next step


def expectations(program):
    history: tuple[tuple, ...] = ()
    discards, saved = False, {}
    for operation in program:
        refused, discards_now = not is_legal(operation, history), discards
        match operation:
            case ("set" | "enter" | "exit" | "step" | "terminate", *_):
                history = history if refused else (*history, operation)
                discards = (discards or refused) and operation[0] != "step"
            case ("damage", _):
                discards = True
            case ("reset",) | ("fail_to_start", *_):
                history, discards = (), False
            case ("save", slot):
                saved[slot] = history, discards
            case ("restore" | "wreck", slot):
                history, discards = saved[slot]
        yield Expected(history, refused, discards_now)


def is_legal(operation, history):
    """Return whether it is legal by the state machine of FMI 2.0.4, section 4.2.4, and the ranges of values."""
    done = {name for name, *_ in history}
    phase = next((name for name in ("terminate", "exit", "enter") if name in done), "")
    match operation:
        case ("set", name, value):
            group = name.partition("[")[0]
            phases = {"", "enter", "exit"} if group in INPUTS else {"", "enter"}
            return group not in OUTPUTS and phase in phases and bool(np.isfinite(value).all())
        case ("enter", start):
            return phase == "" and abs(start) < inf
        case ("exit",):
            return phase == "enter"
        case ("step", h, *late):
            return phase == "exit" and 0.0 < h < inf and abs(sum(late)) <= 1e-9
        case ("terminate",):
            return phase == "exit"
        case ("read", *_):
            return phase != ""
        case ("damage", _) | ("fail_to_start", *_):
            return False
    return True


def is_right(flavour, operation, expected, answer):
    """Return True if statuses and log are as expected.

    The native flavour refuses by fmi2Error. The Python one logs, and discards the next step, which succeeds at the
    second attempt.
    """
    statuses, complaints, _ = answer
    complained, refused = bool(complaints), expected.refused
    if operation[0] == "wreck":
        return statuses[-1] == OK  # of restoring; what was before may fail or not
    if flavour == "native":
        return complained == refused and max(statuses) == (ERROR if refused else OK)
    if operation[0] != "step":
        return complained == refused and max(statuses) == OK
    if refused or expected.discards:
        return complained and statuses == [DISCARD, DISCARD if refused else OK]
    return not complained and statuses == [OK]


class EscapeError(Exception):
    """A joint is at a limit and the arm near a singularity: the speeds of the others grow without bound.

    q̈ is quadratic in q̇ there, and rounding decides whether the arm passes.
    """


def run(fresh, flavour, program):
    """Return the values read after the operations of a program: (index, history, values by group).

    ``fresh`` gives the answers of a new instance to a program.

    Raises:
        EscapeError: the speeds of a step grow without bound.
    """
    readings = []
    answers = fresh(program)
    for i, (operation, expected) in enumerate(zip(program, expectations(program))):
        if operation[0] == "step" and any(ESCAPED in text for text in answers[i][1]):
            raise EscapeError
        assert is_right(flavour, operation, expected, answers[i]), (
            f"{flavour} flavour, operation {i}, {operation}: {answers[i][0]}, {expected}"
        )
        if operation[0] == "read" and not expected.refused:
            readings.append((i, expected.history, answers[i][2]))
    return readings


def states(fresh, flavour, program):
    """Return the states at the ends of the histories of a program, each run alone.

    They are values by group by history, None before initialisation mode.
    """
    readings = run(fresh, flavour, program)
    alone: dict[tuple, Any] = {}
    histories = dict.fromkeys(expected.history for expected in expectations(program))
    for history in sorted(histories, key=len, reverse=True):
        if history not in alone:  # it is not the beginning of a longer one
            line = [part for operation in history for part in (operation, ("read",))]
            alone |= dict.fromkeys(history[:i] for i in range(len(history) + 1))
            alone |= {past: values for _, past, values in run(fresh, flavour, line)}
    for i, history, values in readings:
        for group, value in values.items():
            assert repr(value) == repr(alone[history][group]), (
                f"{flavour} flavour, operation {i}: {group} is not that of {Program(history)}"
            )
    return alone


def far(theirs, ours, group):
    """Largest difference of a group's values, relative to values above 1."""
    scale = np.maximum(1.0, np.abs(ours[group]))
    return (np.abs(np.subtract(theirs[group], ours[group])) / scale).max()


def compared(arm, python, native, again):
    """The histories that were compared, and agree; the others pass near a singularity.

    They agree to 1e-9, or to the effect of a change in the last digit of the start. ``again`` gives the native
    flavour's answers to a program.
    """
    found = {()}
    for history in sorted(python, key=len):
        ours, theirs, before = python[history], native[history], history[:-1]
        if ours is None:
            found.add(history)
        elif before in found and arm.keeps_away(history, python[before], ours):
            found.add(history)
            for group in ours.keys() & set(OUTPUTS):
                difference = far(theirs, ours, group)
                sensitivity = 0.0
                if difference > 1e-9:
                    i = history.index(("exit",))
                    moved = ("set", "q_start", tuple(np.nextafter(ours["q_start"], np.inf)))
                    moved = again([*history[:i], moved, *history[i:], ("read",)])[-1][2]
                    sensitivity = far(moved, theirs, group)
                assert difference <= max(1e-9, sensitivity), (
                    f"the flavours' {group} differ by {difference:g} after {Program(history)}"
                )
    return found


# --- the robots ---


class Arm(NamedTuple):
    """A robot, its FMUs and the region of its programs."""

    robot: Robot
    control: str
    fmus: dict  # flavour: (file, folder where it is unzipped)
    rest: tuple  # joint positions
    x: tuple  # where the end effector then is
    quat: tuple

    def keeps_away(self, history, before, after):
        """Return True if the last operation keeps away from the singularities of J⁺.

        At its end, σ_min/σ_max of J is at least 2.5 rcond, and also at any angle within a step at the speeds of its
        ends, because it changes by at most about 1 per radian.
        """
        if "rcond" not in after:
            return True
        robot, frame = self.robot, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        q, data = np.array(after["q"]), robot.model.createData()
        J = pin.computeFrameJacobian(robot.model, data, q, robot.frame_id, frame)
        rows = ["xyz".index(axis) for axis in robot.axes] + [3, 4, 5] * (self.control == "pose")
        sigma = np.linalg.svd(J[rows], compute_uv=False)
        name, *arguments = history[-1]
        angle = arguments[0] * max(map(abs, before["v"] + after["v"])) if name == "step" else 0.0
        return sigma[-1] / sigma[0] - angle >= 2.5 * after["rcond"][0]


ARMS = {
    "twodof task": (50, 2000),
    "panda task": (5, 300),
    "panda pose": (5, 300),
    "twodof joint": (10, 500),
    "twodof effort": (10, 500),
}
"""A robot and a control, and how many programs are run, without --full and with it."""


@pytest.fixture(scope="module", params=ARMS)
def arm(request, tmp_path_factory):
    robot, control = request.param.split()
    folder = tmp_path_factory.mktemp(robot)
    if robot == "twodof":
        urdf, frame, axes = data_file("urdf", "2dof.urdf").read_text(), "EndEffector", "xy"
        rest: tuple[float, ...] = (0.2, 2.0)
        options: dict[str, Any] = {}
    else:
        frame, axes, rest = "panda_hand_tcp", "xyz", REST["panda"]
        # a tool off the last joint's axis: else rounding alone says whether it leaves a limit
        urdf = request.getfixturevalue("panda").replace('"0 0 0.1034"', '"0.05 0 0.1034"')
        assert '"0.05 0 0.1034"' in urdf
        path = folder / "panda.urdf"
        path.write_text(re.sub(r"<mesh [^>]*>", "<sphere radius='0.01'/>", urdf))
        options = {"urdf": path, "frame": frame, "name": "Panda"}
    fmus = {}
    for flavour in ("python", "native"):
        chosen = FmuOptions(**options, control=control, q_start=rest, native=flavour == "native")
        fmu = build_fmu(folder / f"{flavour}.fmu", chosen)
        fmus[flavour] = str(fmu), fmpy.extract(fmu, str(folder / flavour))
    robot = load_robot(urdf, frame, axes)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, np.array(rest))
    pose = data.oMf[robot.frame_id]
    x = tuple(float(pose.translation["xyz".index(axis)]) for axis in axes)
    quat = tuple(pin.Quaternion(pose.rotation).coeffs().tolist())
    return Arm(robot, control, fmus, rest, x, quat)


# --- random programs ---


def number(low, high, digits=3):
    whole = st.integers(round(low * 10**digits), round(high * 10**digits))
    return whole.map(lambda i: i / 10**digits)


def near(centre, distance):
    return st.tuples(*(number(c - distance, c + distance) for c in centre))


def one(name, *arguments):
    """A phrase, a list of operations, with one operation, given strategies for its arguments."""
    return st.tuples(st.just(name), *arguments).map(lambda operation: [operation])


def phrase(*parts):
    return st.tuples(*parts).map(lambda phrases: list(chain.from_iterable(phrases)))


def some(part, least, most):
    phrases = st.lists(part, min_size=least, max_size=most)
    return phrases.map(lambda phrases: list(chain.from_iterable(phrases)))


def choice(*phrases):
    """One of these strategies; within a phrase, ``one_of`` would merge nested alternatives."""
    return phrase(st.one_of(*phrases))


def setting(values):
    """Set one of these inputs, given strategies for the values."""
    return choice(*(one("set", st.just(name), value) for name, value in values.items()))


@st.composite
def read_along(draw, phrases):
    """A phrase with one way of reading, or none, after each of its operations."""
    reading = draw(st.sampled_from([[("read",)], [("read",)], [("read", "tau")], []]))
    return [part for operation in draw(phrases) for part in (operation, *reading)]


def inputs_of_law(arm):
    """Strategies for the inputs of an arm's control law, by name."""
    n, m = len(arm.rest), len(arm.x)

    def gains(size, of=""):
        proportional = st.sampled_from([50.0, 400.0, 8000.0])
        return {f"Kp{of}": proportional.map(lambda gain: (gain,) * size), f"Kd{of}": near((30.0,) * size, 25.0)}

    if arm.control == "effort":
        return {"tau_cmd": near((0.0,) * n, 0.3), "tau_cmd[1]": number(-0.3, 0.3)}
    if arm.control == "joint":
        return {
            "q_des": near(arm.rest, 0.3),
            "q_des[1]": number(arm.rest[0] - 0.3, arm.rest[0] + 0.3),
            "v_des": near((0.0,) * n, 1.0),
            "a_des": near((0.0,) * n, 10.0),
            **gains(n),
        }
    position = {
        "x_des": near(arm.x, 0.07),
        "x_des[1]": number(arm.x[0] - 0.07, arm.x[0] + 0.07),
        "xd_des": near((0.0,) * m, 0.3),
        "xdd_des": near((0.0,) * m, 3.0),
        "Kn": number(0.0, 20.0),
        **gains(m),
    }
    if arm.control == "task":
        return position
    return {
        **position,
        "quat_des": near(arm.quat, 0.2),
        "quat_des[1]": number(arm.quat[0] - 0.2, arm.quat[0] + 0.2),
        "omega_des": near((0.0,) * 3, 0.5),
        "alpha_des": near((0.0,) * 3, 3.0),
        **gains(3, "_rot"),
    }


def programs(arm):
    """Programs that begin with an initialisation and end by reading all."""
    n, target = len(arm.rest), TARGETS[arm.control]
    size = len(arm.x) if target == "x_des" else n
    inputs = setting({**inputs_of_law(arm), "tau_ext": near((0.0,) * n, 0.1), "f_ext": near((0.0,) * 3, 0.5)})
    parameters = setting(
        {
            "q_start": near(arm.rest, 0.3),
            "v_start": near((0.0,) * n, 1.0),
            "gravity": near((0.0, -9.81, 0.0), 5.0),
            "payload": number(0.0, 1.0),
            "payload_com": near((0.0,) * 3, 0.1),
            **({"payload_known": st.booleans()} if arm.control != "effort" else {}),
            **({"rcond": st.sampled_from([0.005, 0.02])} if target == "x_des" else {}),
            "rtol": st.sampled_from([1e-6, 1e-2]),
            "atol": st.sampled_from([1e-9, 1e-3]),
            "max_step": st.sampled_from([5e-4, 5e-3, 0.1]),
            "damping": st.sampled_from([(0.3,) * n]),
            "integrator": st.integers(0, 2),
        }
    )
    limits = setting(
        {
            "q_min": near([q - 0.1 for q in arm.rest], 0.09),
            "q_max": near([q + 0.1 for q in arm.rest], 0.09),
            "limit_effort": st.just(True),
            "rigid_stops": st.booleans(),
        }
    )
    sampled = phrase(
        one("set", st.just("control_period"), st.sampled_from([0.002, 0.003])),
        some(
            setting(
                {
                    "control_delay": st.sampled_from([0.0005, 0.003, 0.02]),
                    "q_resolution": near((0.0007,) * n, 0.0006),
                    "q_noise": near((0.001,) * n, 0.001),
                    "seed": st.integers(0, 2**31 - 1),
                }
            ),
            0,
            3,
        ),
        choice(setting({"v_from_q": st.just(True)}), setting({"v_noise": near((0.01,) * n, 0.01)}), st.just([])),
    )
    value = choice(inputs, parameters, limits)
    slot = st.sampled_from("abc")
    save, restore, reset = one("save", slot), one("restore", slot), one("reset")
    h = st.one_of(number(0.0001, 0.01, digits=4), number(0.001, 0.05))
    step = choice(one("step", h), one("step", h, st.just(1e-10)))
    go = phrase(some(inputs, 0, 2), some(step, 1, 3))
    begin = phrase(
        some(sampled, 0, 1),
        some(limits, 0, 2),
        some(value, 0, 3),
        some(save, 0, 1),
        one("enter", st.sampled_from([0.0, 2.5, -1.0])),
        some(value, 0, 2),
        some(save, 0, 1),
        one("exit"),
    )
    restart = choice(
        phrase(reset, begin),
        phrase(one("terminate"), reset, begin),
        phrase(one("fail_to_start", st.just("rtol"), st.just(0.0)), begin),
    )
    refused = choice(
        one("set", st.just(target), st.sampled_from([(0.1,) * (size - 1) + (nan,), (inf,) * size])),
        one("set", st.just("x"), st.just((0.1,) * len(arm.x))),
        parameters,  # in step mode
        one("step", st.sampled_from([0.0, -0.01, nan, inf])),
        one("step", h, st.sampled_from([1e-3, -0.5, nan])),
        one("enter", st.sampled_from([0.0, nan])),
        one("exit"),
    )

    def with_a_state(slot):
        """Save, and do with that state what there is to do."""
        save, restore, serialise, damage, wreck, free = (
            one(name, st.just(slot)) for name in ("save", "restore", "serialise", "damage", "wreck", "free")
        )
        return choice(
            phrase(save, go, some(serialise, 0, 1), restore),
            phrase(refused, save, some(serialise, 0, 1), go, restore, go),
            phrase(save, refused, restore, go),
            phrase(save, restart, some(go, 0, 1), restore),
            phrase(save, reset, some(value, 0, 2), restore),
            phrase(save, go, damage, go),
            phrase(save, go, wreck),
            phrase(save, go, restore, go, restore, free),
        )

    part = choice(
        st.just([]),  # what the others shrink to
        go,
        go,
        restore,
        restart,
        phrase(refused, some(save, 0, 1), go),
        one("move"),
        *4 * [slot.flatmap(with_a_state)],
    )
    parts = some(read_along(part), 10, 20)
    whole = phrase(read_along(phrase(begin, go)), parts, one("read"))
    return whole.map(without_empty_slots)


def without_empty_slots(program):
    """Remove operations on saved states that do not exist."""
    kept, filled = Program(), set()
    for operation in program:
        match operation:
            case ("save", slot):
                filled.add(slot)
            case ("restore" | "serialise" | "damage" | "wreck" | "free", slot):
                if slot not in filled:
                    continue
                if operation[0] == "free":
                    filled.remove(slot)
        kept.append(operation)
    return kept


# --- the test, and what its programs are to contain ---

CONTAINED = (
    "parameter after a reset",
    "set tau_ext",
    "set limit_effort",
    "set control_period",
    "set control_delay",
    "set v_from_q",
    "set v_noise",
    "two states alive",
    "save at a limit",
    "save before a discard",
    "restore after set",
    "restore after step",
    "restore after reset",
    "restore after serialise",
    "move",
    "wreck",
    "terminate",
    "refused set",
    "refused step",
    "refused damage",
    "refused fail_to_start",
)
"""Calls that one program in fifty contains at least; most are in every second to fourth."""


def features(arm, program, values):
    """Return the features of a program, given the values of its histories."""
    since: dict[int, set[str]] = {}  # since each state was saved: what happened to it
    found: set[str] = set()
    history: tuple[tuple, ...] = ()
    for operation, expected in zip(program, expectations(program)):
        name, before, history = operation[0], history, expected.history
        found.add(f"refused {name}" if expected.refused else name)
        match operation:
            case ("set", group, _) if not expected.refused:
                found.add(f"set {group}")
                if group in PARAMETERS and "reset" in found:
                    found.add("parameter after a reset")
            case ("reset",) | ("serialise", _):
                for slot in operation[1:] or since:
                    since[slot].add(name)
            case ("save", slot):
                since[slot] = set()
                found |= {"two states alive"} if len(since) > 1 else set()
                found |= {"save before a discard"} if expected.discards else set()
                if "step" in {name for name, *_ in history} and at_a_limit(values[history]):
                    found.add("save at a limit")
            case ("free", slot):
                del since[slot]
            case ("restore", slot):
                later = before[len(history) :] if before[: len(history)] == history else ()
                found |= {f"restore after {name}" for name in since[slot]}
                found |= {f"restore after {name}" for name, *_ in later}
    limited = [read["tau"] for read in values.values() if read and read["limit_effort"] == [True]]
    if any(np.any(np.abs(tau) == arm.robot.effort) for tau in limited):
        found.add("effort at its limit")
    return found


def at_a_limit(values):
    joints = zip(values["q"], values["v"], values["q_min"], values["q_max"])
    return any(v == 0.0 and q in (low, high) for q, v, low, high in joints)


@pytest.fixture(scope="module")
def worker():
    worker = Worker()
    yield worker
    worker.end()


@pytest.mark.long
def test_every_state_is_that_of_its_history_alone(arm, worker, request):
    full = request.config.getoption("full", default=False)
    few, many = ARMS[request.node.callspec.params["arm"]]
    seen: Counter[str] = Counter()

    @settings(
        max_examples=many if full else few,
        derandomize=not full,
        database=None,
        deadline=None,
        phases=[Phase.generate, Phase.shrink],
    )
    @given(programs(arm))
    def holds(program):
        note(program)
        try:
            python, native = (
                states(partial(worker, carry_out, *fmu), flavour, program) for flavour, fmu in arm.fmus.items()
            )
        except EscapeError:
            seen.update(["programs", "escapes"])
            return
        found = features(arm, program, python)
        again = partial(worker, carry_out, *arm.fmus["native"])
        if compared(arm, python, native, again) == python.keys():
            found.add("all histories compared")
        seen.update(found | {"programs"})

    holds()
    print(*seen.most_common(), sep="\n")  # pytest -rP shows it
    own = [f"set {group}" for group in inputs_of_law(arm)]
    rare = [what for what in (*CONTAINED, *own) if seen[what] < seen["programs"] // 50]
    assert not rare, seen
    assert seen["escapes"] <= seen["programs"] / 100
    assert seen["all histories compared"] > 0.5 * seen["programs"], seen
