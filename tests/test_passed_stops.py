"""Model Exchange detects stops that joints reach and leave within one step of the importer's solver.

Solvers are FMPy's CVode, and a Runge-Kutta method of order 4 with located events.
"""

from __future__ import annotations

import ctypes
import math
import re
import shutil
import tempfile

import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model
from harness import Recorded
from tools import needs

from twodof import FmuOptions, build_fmu

WARNING = 1
TIGHT = {"rtol": 1e-12, "atol": 1e-12}
TOUCH = {"q_start[1]": -1.2, "q_start[2]": -2.9, "v_start[2]": -6.452166419, "tau_cmd[2]": 0.06}
"""Joint 2 of the bare arm touches -pi: 2e-7 rad deep without the stop, for 0.15 ms."""
WHEN = 0.07856  # s
FREE = {f"q_{end}[{i}]": x for i in (1, 2) for end, x in (("min", -10.0), ("max", 10.0))}
STATES = [f"{s}[{i}]" for s in "qv" for i in (1, 2)]


@pytest.fixture(scope="session")
def fmus(tmp_path_factory):
    """FMUs by version of FMI and control, each built on demand."""
    folder, built = tmp_path_factory.mktemp("passed"), {}

    def build(fmi=2, control="effort"):
        if (fmi, control) not in built:
            options = FmuOptions(native=True, fmi=fmi, control=control, arrays=fmi == 2, meshes=False)
            built[fmi, control] = build_fmu(folder / f"{control}{fmi}.fmu", options)
        return built[fmi, control]

    return build


def simulated(fmu, kind, starts, stop_time, interval=0.05, **named):
    result = fmpy.simulate_fmu(
        str(fmu),
        fmi_type=kind,
        stop_time=stop_time,
        start_values={**TIGHT, **starts},
        output=STATES,
        output_interval=interval,
        record_events=False,
        **named,
    )
    return np.array([result[name] for name in STATES]).T


class Importer(Recorded):
    """A solver with steps of a length, each of some parts, on an instance of either version."""

    three = False

    def open(self, fmu, starts=()):
        self.description = description = fmpy.read_model_description(str(fmu))
        self.n = description.numberOfContinuousStates
        self.nz = description.numberOfEventIndicators
        self.folder = tempfile.mkdtemp()
        super().__init__(
            guid=description.guid,
            modelIdentifier="TwoDof",
            instanceName="arm",
            unzipDirectory=fmpy.extract(str(fmu), self.folder),
        )
        self.messages, self.asked, self.events = [], [], []
        if self.three:
            self.instantiate(loggingOn=True, logMessage=lambda _, status, kind, text: self.keep(status, text))
        else:
            self.instantiate(callbacks=self.functions(), loggingOn=True)
            self.setupExperiment(startTime=0.0)
        references = {v.name: v.valueReference for v in description.modelVariables}
        setter = self.setFloat64 if self.three else self.setReal
        for name, value in {**TIGHT, **dict(starts)}.items():
            if isinstance(value, bool):
                self.setBoolean([references[name]], [value])
            else:
                setter([references[name]], [value])
        self.enterInitializationMode()
        self.exitInitializationMode()
        self.update()
        return self

    def close(self):
        self.terminate()
        self.freeInstance()
        shutil.rmtree(self.folder)

    def update(self):
        changed = (self.updateDiscreteStates if self.three else self.newDiscreteStates)()[3]
        self.enterContinuousTimeMode()
        return changed

    def vector(self, function, size):
        values = (ctypes.c_double * size)()
        function(values, size)
        return np.array(values)

    @property
    def y(self):
        return self.vector(self.getContinuousStates, self.n)

    @property
    def indicators(self):
        return self.vector(self.getEventIndicators, self.nz)

    def put(self, t, y):
        self.setTime(t)
        self.setContinuousStates((ctypes.c_double * self.n)(*y), self.n)

    def rates(self, t, y):
        self.put(t, y)
        rates = self.getContinuousStateDerivatives if self.three else self.getDerivatives
        return self.vector(rates, self.n)

    def advanced(self, t, y, h, parts):
        """Return the state at t + h, and set it in the instance."""
        step = h / parts
        for k in range(parts):
            at = t + k * step
            a = self.rates(at, y)
            b = self.rates(at + step / 2, y + step / 2 * a)
            c = self.rates(at + step / 2, y + step / 2 * b)
            y = y + step / 6 * (a + 2 * b + 2 * c + self.rates(at + step, y + step * c))
        self.put(t + h, y)
        return y

    def located(self, t, y, h, parts, before):
        """Return the longest step that ends just after the first event."""
        low = 0.0
        while h - low > 2e-15:
            middle = (low + h) / 2
            if not low < middle < h:
                break
            self.advanced(t, y, middle, parts)
            if np.array_equal(self.indicators > 0.0, before):
                low = middle
            else:
                h = middle
        return h

    def run(self, stop_time, h, interval=0.05, parts=1, obeys=True, tells=True):
        """Return states at each interval; the instance learns of completed steps, and is obeyed, or not."""
        t, y, rows = 0.0, self.y, [self.y]
        before = self.indicators > 0.0
        while len(rows) <= round(stop_time / interval):
            end = len(rows) * interval
            step = min(h, end - t)
            last = step == end - t
            new = self.advanced(t, y, step, parts)
            event = not np.array_equal(self.indicators > 0.0, before)
            if event:
                located = self.located(t, y, step, parts, before)
                last, step = last and located == step, located
                new = self.advanced(t, y, step, parts)
            t, y = end if last else t + step, new
            self.setTime(t)
            if tells and self.completedIntegratorStep()[0]:
                self.asked.append(t)
                event = event or obeys
            if event:
                self.events.append(t)
                self.enterEventMode()
                self.update()
                y = self.y
            before = self.indicators > 0.0
            if last:
                rows.append(y)
        return np.array(rows)


class FMU2Importer(Importer, FMU2Model):
    pass


class FMU3Importer(Importer, FMU3Model):
    three = True


@pytest.fixture
def importer(fmus):
    """Open importers, which are closed at the end."""
    opened = []

    def build(starts=(), fmi=2, control="effort"):
        kind = FMU2Importer if fmi == 2 else FMU3Importer
        opened.append(kind.__new__(kind).open(fmus(fmi, control), starts))
        return opened[-1]

    yield build
    for instance in opened:
        instance.close()


def test_the_contact_is_as_short_as_documented(importer):
    """Without stops, by differences of an importer's own solver."""
    rows = importer({**TOUCH, **FREE}).run(0.08, 1e-5, 1e-5)
    below = np.flatnonzero(rows[:, 1] < -math.pi)
    assert 1.8e-7 < -math.pi - rows[:, 1].min() < 2.2e-7
    assert abs(below[0] * 1e-5 - WHEN) < 2e-5 and 13 <= len(below) <= 16
    assert 5e-3 < -rows[below[0], 3] < 6e-3


@pytest.mark.parametrize("fmi", [2, 3])
def test_cvode_sees_a_short_stop(fmus, fmi):
    assert fmpy.read_model_description(str(fmus(fmi))).modelExchange.needsCompletedIntegratorStep
    ours = simulated(fmus(fmi), "CoSimulation", TOUCH, 0.3)
    theirs = simulated(fmus(fmi), "ModelExchange", TOUCH, 0.3, relative_tolerance=1e-12)
    assert np.abs(ours - theirs)[:, :2].max() <= 1e-7  # 2.5e-3 without the stop


@pytest.mark.parametrize("h", [5e-4, 5e-3, 0.02])
@pytest.mark.parametrize("fmi", [2, 3])
def test_runge_kutta_sees_a_short_stop(fmus, importer, fmi, h):
    ours = simulated(fmus(fmi), "CoSimulation", TOUCH, 0.3)
    solver = importer(TOUCH, fmi)
    theirs = solver.run(0.3, h, parts=math.ceil(h / 2.5e-4))
    assert len(solver.asked) == 1 and 0.0 <= solver.asked[0] - WHEN <= h
    assert np.abs(ours - theirs)[:, :2].max() <= 1e-7
    assert not solver.messages


@pytest.mark.parametrize("h", [1e-3, 1e-2])
def test_pathsim_sees_a_short_stop(fmus, h, tmp_path, monkeypatch):
    """1e-2 s is PathSim's default step; inputs without a connection would be 0."""
    needs("pathsim")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # PathSim does not remove the unpacked FMU
    from pathsim import Connection, Simulation
    from pathsim.blocks import Constant
    from pathsim.solvers import RKDP87
    from pathsim_fmi import ModelExchangeFMU

    ours = simulated(fmus(), "CoSimulation", TOUCH, 0.3)
    arm = ModelExchangeFMU(str(fmus()), start_values={**TIGHT, **TOUCH})
    torque = Constant(TOUCH["tau_cmd[2]"])
    simulation = Simulation([arm, torque], [Connection(torque, arm["tau_cmd[2]"])], dt=h, Solver=RKDP87, log=False)
    simulation.run(0.3 - 0.5 * h, adaptive=False)
    assert simulation.time == pytest.approx(0.3, abs=1e-9)
    assert np.abs(arm.engine.get()[:2] - ours[-1, :2]).max() <= 1e-7  # 2.5e-3 without the stop


def test_a_short_stop_of_a_closed_form(importer):
    """q = q_des (1 - cos wt) turns at 2 q_des; a stop 1e-6 before that ends the motion.

    The motion continues from rest.
    """
    depth, omega = 1e-6, 5.0
    starts = {
        "q_start[1]": 0.0,
        "q_start[2]": 0.0,
        "q_des[1]": 1.0,
        "q_des[2]": 0.0,
        "q_max[1]": 2.0 - depth,
        "Kp[1]": omega**2,
        "Kd[1]": 0.0,
        "Kd[2]": 0.0,
        "rigid_stops": False,
    }
    solver = importer(starts, control="joint")
    rows = solver.run(1.0, 0.01, parts=20)
    stop = math.acos(depth - 1.0) / omega
    t = np.arange(len(rows)) * 0.05
    exact = 1.0 + np.where(t < stop, -np.cos(omega * t), (1 - depth) * np.cos(omega * (t - stop)))
    assert len(solver.asked) == 1 and 0.0 <= solver.asked[0] - stop <= 0.01
    assert np.abs(rows[:, 0] - exact).max() <= 1e-7  # 7e-4 without the stop


def test_a_solver_that_enters_no_event_mode_is_warned(importer):
    for fmi in (2, 3):
        solver = importer(TOUCH, fmi)
        solver.run(0.3, 5e-4, obeys=False)
        ((status, text),) = solver.messages
        (when,) = re.findall(r"'joint2' was at a limit at (\S+) s", text)
        assert status == WARNING and abs(float(when) - WHEN) < 2e-5
        assert text.startswith(f"fmi{fmi}CompletedIntegratorStep") and "EnterEventMode" in text


def test_a_step_that_the_engine_cannot_integrate_is_warned_of(importer):
    solver = importer({**TOUCH, "max_step": 1e-10})
    solver.run(0.1, 5e-4)
    ((status, text),) = solver.messages
    assert status == WARNING and "joint 'joint2' reversed at a limit in the solver's step to " in text
    assert not solver.asked


def test_a_motion_that_passes_no_stop_is_the_same_as_without_the_call(importer):
    """Results are bit-identical, with located stops."""
    starts = {"q_min[1]": -0.5, "q_max[1]": 1.5, "q_min[2]": -1.0, "q_max[2]": 1.0, "v_start[1]": 2.0}
    told, silent = importer(starts), importer(starts)
    rows = told.run(1.0, 2e-3)
    assert np.array_equal(rows, silent.run(1.0, 2e-3, tells=False))
    assert len(told.events) >= 2 and not told.asked


def turning_point(solver, joint):
    """The time and the position at which a joint first turns without stops."""
    t, h, y = 0.0, 1e-3, solver.y
    new = solver.advanced(t, y, h, 4)
    while y[2 + joint] * new[2 + joint] > 0.0:
        t, y, new = t + h, new, solver.advanced(t + h, new, h, 4)
    low, high = 0.0, h
    for _ in range(40):
        middle = (low + high) / 2
        new = solver.advanced(t, y, middle, 4)
        low, high = (middle, high) if new[2 + joint] * y[2 + joint] > 0.0 else (low, middle)
    return t + high, new[joint]


def short_stop(solver, joint, depth):
    """The start value of a limit that a joint passes by a given depth before it turns."""
    upwards = solver.y[2 + joint] > 0.0
    turn, q = turning_point(solver, joint)
    if upwards:
        return turn, {f"q_max[{joint + 1}]": q - depth}
    return turn, {f"q_min[{joint + 1}]": q + depth}


def test_after_a_passed_stop_all_is_as_at_a_start_there(importer):
    """Resting joints and rates follow from the state, as at any event."""
    starts = {
        "q_start[1]": 0.0,
        "q_start[2]": 0.0,
        "q_des[1]": 1.0,
        "q_des[2]": 1.0,
        "q_max[1]": 2.0 - 1e-6,
        "q_max[2]": 0.0,
        "Kp[1]": 25.0,
        "Kp[2]": 25.0,
        "Kd[1]": 0.0,
        "Kd[2]": 0.0,
        "rigid_stops": False,
    }
    solver = importer(starts, control="joint")
    rows = solver.run(0.63, 0.01, 0.63)
    assert solver.asked == [0.63] and rows[-1, 1] == 0.0 and rows[-1, 3] == 0.0
    reached = {f"{s}_start[{i + 1}]": rows[-1, 2 * k + i] for k, s in enumerate("qv") for i in (0, 1)}
    fresh = importer({**starts, **reached}, control="joint")
    assert np.array_equal(fresh.rates(0.0, rows[-1]), solver.rates(0.63, rows[-1]))
    assert np.array_equal(fresh.indicators, solver.indicators)


def test_the_rank_after_a_passed_stop_is_that_of_the_state_there(importer, fmus):
    """J+ has rank 1 during the whole motion."""
    starts = {"rcond": 0.9, "Kp[1]": 100.0, "Kp[2]": 100.0, "Kd[1]": 0.0, "Kd[2]": 0.0}
    turn, limit = short_stop(importer({**starts, "v_start[2]": 1.0}, control="task"), 1, 1e-6)
    starts |= {"v_start[2]": 1.0, **limit}
    solver = importer(starts, control="task")
    theirs = solver.run(0.3, 0.02, parts=40)
    ours = simulated(fmus(2, "task"), "CoSimulation", starts, 0.3)
    assert solver.indicators[6] < 0.0 and len(solver.asked) == 1
    assert 0.0 <= solver.asked[0] - turn <= 0.02
    assert np.abs(ours - theirs)[:, :2].max() <= 1e-7


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_saved_state_knows_the_solvers_step(importer, fmi):
    """It is saved within the step, and between its end and the event."""
    states = []
    for moment in ("never", "within", "asked"):
        solver = importer(TOUCH, fmi)
        rows = solver.run(0.075, 5e-3, 0.075, 20)
        y = solver.advanced(0.075, rows[-1], 5e-3, 20)
        solver.put(0.08, y)
        if moment == "within":
            solver = moved(solver, importer(TOUCH, fmi))
        assert solver.completedIntegratorStep()[0]
        if moment == "asked":
            solver = moved(solver, importer(TOUCH, fmi))
        solver.enterEventMode()
        assert solver.update()
        states.append(solver.y)
        assert solver.y[3] != y[3]
    assert np.array_equal(states[0], states[1]) and np.array_equal(states[0], states[2])


def moved(solver, other):
    """Another instance in the serialised state of one."""
    state = solver.getFMUState()
    copy = other.deserializeFMUState(bytes(solver.serializeFMUState(state)))
    solver.freeFMUState(state)
    other.setFMUState(copy)
    other.freeFMUState(copy)
    return other


def test_an_event_at_another_state_takes_no_passed_stop(importer):
    """The importer continues, or sets the states itself, instead of entering event mode."""
    solver = importer(TOUCH)
    rows = solver.run(0.075, 5e-3, 0.075, 20)
    y = solver.advanced(0.075, rows[-1], 5e-3, 20)
    solver.put(0.08, y)
    assert solver.completedIntegratorStep()[0]
    other = y + np.array([0.01, 0.01, 0.0, 0.0])
    solver.put(0.08, other)
    solver.enterEventMode()
    assert not solver.update() and np.array_equal(solver.y, other)


@pytest.mark.parametrize("seed", range(8))
def test_every_short_stop_of_random_falls_is_seen_at_steps_of_20_ms(importer, fmus, seed):
    random = np.random.default_rng(seed)
    starts = {
        "v_start[1]": random.uniform(-6, 6),
        "v_start[2]": random.uniform(-10, 10),
        "q_start[1]": random.uniform(-1, 1),
        "q_start[2]": random.uniform(-1, 1),
    }
    free, joint = {**FREE, **starts}, seed % 2
    turn, limit = short_stop(importer(free), joint, 10 ** random.uniform(-6, -4))
    solver = importer({**free, **limit})
    end = 0.02 * math.ceil(turn / 0.02 + 2)
    theirs = solver.run(end, 0.02, 0.02, parts=40)
    ours = simulated(fmus(), "CoSimulation", {**free, **limit}, end, 0.02)
    assert solver.asked or abs(solver.events[0] - turn) <= 0.02
    assert np.abs(ours - theirs)[:, :2].max() <= 1e-7
