"""Model Exchange of the native FMU: in FMPy by CVode and by Euler, and call by call."""

from __future__ import annotations

import ctypes
import re
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import replace
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Model
from fmpy.validation import validate_fmu
from harness import Driver, Recorded, unzipped
from native_models import robots_folder

from twodof import FmuOptions, build_fmu

UR5_START = (0.3, -1.2, 1.4, -1.0, -1.5, 0.4)
ERROR = 3
TIGHT = {"rtol": 1e-10, "atol": 1e-10}
NARROW = {"q_min[1]": -0.5, "q_max[1]": 1.5, "q_min[2]": -1.0, "q_max[2]": 1.0}


class Fmus(dict):
    """The default arm under each control, and other robots, each built on demand."""

    def __init__(self, folder):
        self._folder = folder

    def __missing__(self, name):
        ur5 = robots_folder() / "ur_description/urdf/ur5_robot.urdf"
        bare = FmuOptions(native=True, control="effort", meshes=False)
        options = {
            "ur5": replace(bare, urdf=ur5, frame="tool0"),
            "ur5 pose": replace(bare, control="pose", urdf=ur5, frame="tool0", q_start=UR5_START),
        }
        chosen = options[name] if name in options else FmuOptions(native=True, control=name)
        self[name] = build_fmu(self._folder / f"{name}.fmu", chosen)
        return self[name]


@pytest.fixture(scope="session")
def fmus(tmp_path_factory):
    return Fmus(tmp_path_factory.mktemp("exchange"))


def states(fmu):
    names = [v.name for v in fmpy.read_model_description(str(fmu)).modelVariables]
    return [name for name in names if name[:2] in ("q[", "v[")]


def run(fmu, kind, starts, stop_time=2.0, interval=0.01, **named):
    """States at each interval, one column per state."""
    result = fmpy.simulate_fmu(
        str(fmu),
        fmi_type=kind,
        stop_time=stop_time,
        start_values={**TIGHT, **starts},
        output=states(fmu),
        output_interval=interval,
        record_events=False,
        **named,
    )
    return np.array([result[name] for name in states(fmu)]).T


class FMU2Exchange(Recorded, FMU2Model):
    def __init__(self, fmu, **starts):
        self.description = fmpy.read_model_description(str(fmu))
        self.vr = {v.name: v.valueReference for v in self.description.modelVariables}
        self.n = self.description.numberOfContinuousStates
        identifier = self.description.modelExchange.modelIdentifier
        super().__init__(
            guid=self.description.guid, modelIdentifier=identifier, instanceName="model", unzipDirectory=unzipped(fmu)
        )
        self.instantiate(callbacks=self.functions())
        self.set(**starts)
        self.setupExperiment(startTime=0.0)
        self.enterInitializationMode()
        self.exitInitializationMode()

    def set(self, **values):
        for group, value in values.items():
            names = [n for n in self.vr if n == group or n.startswith(f"{group}[")]
            setter = self.setBoolean if isinstance(value, bool) else self.setReal
            setter([self.vr[n] for n in names], np.atleast_1d(value).tolist())

    def get(self, group):
        names = [n for n in self.vr if n.startswith(f"{group}[")]
        return self.getReal([self.vr[n] for n in names])

    @property
    def y(self):
        x = (ctypes.c_double * self.n)()
        self.getContinuousStates(x, self.n)
        return list(x)

    @y.setter
    def y(self, values):
        self.setContinuousStates((ctypes.c_double * self.n)(*values), self.n)

    def rates(self):
        dx = (ctypes.c_double * self.n)()
        self.getDerivatives(dx, self.n)
        return list(dx)

    def indicators(self):
        count = self.description.numberOfEventIndicators
        z = (ctypes.c_double * count)()
        self.getEventIndicators(z, count)
        return list(z)

    def event(self):
        """Do an event, requested or not; return whether the state changed."""
        self.enterEventMode()
        return self.go()

    def go(self):
        changed = self.newDiscreteStates()[3]
        self.enterContinuousTimeMode()
        return changed


Model = FMU2Exchange


@pytest.mark.parametrize("name", ["task", "pose", "effort", "ur5"])
def test_the_description_is_valid(fmus, name):
    assert validate_fmu(str(fmus[name])) == []
    description = fmpy.read_model_description(str(fmus[name]))
    with zipfile.ZipFile(fmus[name]) as archive:
        xml = ET.fromstring(archive.read("modelDescription.xml"))
    reinit = [v.get("name") for v in xml.iter("ScalarVariable") if v[0].get("reinit") == "true"]
    assert reinit == states(fmus[name])
    n = description.numberOfContinuousStates // 2
    ratios = {"task": 1, "pose": 4}.get(name, 0)  # of the singular values of 2 or 5 rows
    assert description.numberOfEventIndicators == 3 * n + ratios
    variables = {v.name: v for v in description.modelVariables}
    for i in range(n):
        for state in ("q", "v"):
            variable = variables[f"{state}[{i + 1}]"]
            assert variable.initial == "approx"
            assert variable.start == variables[f"{state}_start[{i + 1}]"].start
            assert variables[f"der({state}[{i + 1}])"].derivative is variable


RUBBING = {
    "q_des": (-1, 1),
    "v_start": (1, 3),
    "Kp": (10, 90),
    "Kd": (0, 3),
    "friction": (0.02, 0.2),
    "damping": (0, 0.02),
}
RUNS = {
    ("effort", "swings into its stops"): {**NARROW, "v_start[1]": 2.0},
    ("effort", "clamped"): {**NARROW, "v_start[1]": 2.0, "rigid_stops": False},
    ("joint", "stops"): {**NARROW, "q_max[1]": 0.6, "q_des[1]": 0.7, "q_des[2]": 0.9},
    ("joint", "saturated"): {"limit_effort": True, "q_des[1]": 1.0, "Kp[1]": 4e3, "payload": 1.0},
    ("task", "stops"): {
        "q_min[1]": -0.2,
        "q_max[1]": 0.8,
        "q_min[2]": 0.8,
        "q_max[2]": 1.9,
        "q_start[1]": 0.3,
        "q_start[2]": 1.3,
        "Kp[1]": 400.0,
        "Kp[2]": 400.0,
        "x_des[1]": 0.14,
        "x_des[2]": -0.03,
    },
    ("task", "forces"): {"tau_ext[1]": 0.2, "f_ext[2]": -0.5, "limit_effort": True},
    ("pose", "stops"): {"q_max[1]": 0.7, "x_des[1]": 0.1, "x_des[2]": 0.2, "quat_des[3]": 0.5, "quat_des[4]": 0.8},
    ("effort", "sticks, and swings into its stops"): {
        **NARROW,
        "v_start[1]": 2.0,
        "friction[1]": 0.05,
        "friction[2]": 0.02,
        "armature[2]": 0.01,
    },
    ("joint", "sticks and slips"): {"q_des[1]": 1.2, "Kd[1]": 0.0, "friction[1]": 0.3, "friction[2]": 0.1},
    ("task", "slips"): {"x_des[1]": 0.14, "Kd[1]": 5.0, "friction[1]": 0.05, "friction[2]": 0.02, "damping[1]": 0.01},
    ("ur5", "falls into its stops"): {
        **{f"q_min[{i}]": -0.3 for i in (2, 3, 4)},
        **{f"q_max[{i}]": 0.4 for i in (2, 3, 4)},
    },
    ("ur5 pose", "turns"): {"omega_des[3]": 0.3, "quat_des[1]": 0.1, "payload": 1.0},
}


@pytest.mark.parametrize("name, what", RUNS, ids=map(" ".join, RUNS))
def test_cvode_gives_the_trajectories_of_co_simulation(fmus, name, what):
    stop_time = 2.0 if "stop" in what and name != "ur5" else 1.0
    ours = run(fmus[name], "CoSimulation", RUNS[name, what], stop_time)
    theirs = run(fmus[name], "ModelExchange", RUNS[name, what], stop_time, relative_tolerance=1e-10)
    n = ours.shape[1] // 2
    assert ours.shape == theirs.shape
    assert np.abs(ours - theirs)[:, :n].max() <= 1e-7
    if "stop" in what:
        limits = [RUNS[name, what].get(f"q_{side}[{i + 1}]", np.nan) for i in range(n) for side in ("min", "max")]
        assert np.isin(ours[:, :n], limits).any()


def test_euler_converges_at_first_order_to_the_same_stops_included(fmus):
    starts = RUNS["task", "stops"]
    exact = run(fmus["task"], "CoSimulation", starts)
    error = []
    for step in (1e-3, 5e-4, 2.5e-4):
        rough = run(fmus["task"], "ModelExchange", starts, 2.0, step, solver="Euler", step_size=step)
        error.append(np.abs(rough[:: round(0.01 / step)] - exact)[:, :2].max())
    assert error[0] < 5e-3
    assert 1.7 < error[0] / error[1] < 2.4 and 1.7 < error[1] / error[2] < 2.4


def test_a_joint_that_rests_at_its_stop_for_ten_seconds_has_one_event(fmus, monkeypatch):
    events = []
    enter = FMU2Model.enterEventMode

    def entered(model):
        events.append(1)
        return enter(model)

    monkeypatch.setattr(FMU2Model, "enterEventMode", entered)
    run(fmus["effort"], "ModelExchange", {"q_min[1]": 0.0, "q_min[2]": 0.0}, 10.0, relative_tolerance=1e-10)
    assert 2 <= len(events) <= 6  # two joints, and a bounce or two until both rest
    events.clear()
    starts = {"q_min[1]": 0.5, "q_min[2]": 0.35}  # both at rest from the start
    run(fmus["effort"], "ModelExchange", starts, 10.0)
    assert not events


# --- events: early, late, at zero and for nothing ---


@pytest.fixture
def falling(fmus):
    """The bare arm without gravity, whose first joint moves to a limit at 1 rad/s."""
    model = Model(
        fmus["effort"],
        gravity=[0.0, 0.0, 0.0],
        q_start=[0.5, 0.0],
        v_start=[0.0, 0.0],
        q_max=[1.0, 2.0],
        rigid_stops=False,
    )
    model.go()
    return model


def test_an_early_event_changes_nothing_and_the_indicator_goes_on(falling):
    falling.y = [1.0 - 1e-9, 0.0, 1.0, 0.0]
    z = falling.indicators()
    assert not falling.event()
    assert falling.indicators() == z and z[0] > 0.0
    falling.y = [1.0 + 1e-9, 0.0, 1.0, 0.0]
    assert falling.indicators()[0] < 0.0


@pytest.mark.parametrize("past", [0.0, 1e-13, 1e-9, 0.01])
def test_an_event_at_the_limit_or_late_puts_the_joint_onto_it(falling, past):
    falling.y = [1.0 + past, 0.0, 1.0, 0.3]
    assert falling.event()
    assert falling.y == [1.0, 0.0, 0.0, 0.3]
    assert not falling.event()  # for nothing


def test_a_late_event_of_a_joint_that_is_on_its_way_back_keeps_its_velocity(falling):
    falling.y = [1.01, 0.0, -1.0, 0.0]
    assert falling.event()
    assert falling.y == [1.0, 0.0, -1.0, 0.0]


def test_an_impact_beyond_all_numbers_is_refused_and_changes_nothing(fmus):
    model = Model(fmus["effort"], q_start=[0.5, 0.1], q_max=[1.0, 2.0])
    model.go()
    model.y = [1.1, 0.1, 1e308, 1e308]
    model.enterEventMode()
    model.refused(r"fmi2NewDiscreteStates: v\[2\] would not be finite", "newDiscreteStates")
    assert model.y == [1.1, 0.1, 1e308, 1e308]


@pytest.mark.parametrize("rigid", [False, True])
def test_a_held_joint_is_released_where_it_is_pulled_off_and_no_sooner(fmus, rigid):
    model = Model(
        fmus["effort"],
        gravity=[0.0, 0.0, 0.0],
        q_start=[1.0, 0.0],
        q_max=[1.0, 2.0],
        tau_cmd=[0.5, 0.0],
        rigid_stops=rigid,
    )
    model.go()
    assert model.rates()[2] == 0.0 and model.indicators()[0] > 0.0
    model.set(tau_cmd=[1e-12, 0.0])
    assert model.indicators()[0] > 0.0 and not model.event() and model.rates()[2] == 0.0
    model.set(tau_cmd=[-0.5, 0.0])
    assert model.indicators()[0] < 0.0 and model.rates()[2] == 0.0  # until its event
    assert not model.event()  # of the state; what is held is another
    assert model.rates()[2] < 0.0 < model.indicators()[0]


def test_a_solvers_rounding_does_not_release_a_held_joint(fmus):
    model = Model(fmus["effort"], gravity=[0.0, 0.0, 0.0], q_start=[1.0, 0.0], q_max=[1.0, 2.0], tau_cmd=[0.5, 0.0])
    model.go()
    model.y = [1.0 - 1e-12, 0.0, -1e-17, 0.0]
    assert model.indicators()[0] > 0.0 and model.rates()[2] == 0.0
    assert model.event() and model.y == [1.0, 0.0, 0.0, 0.0] and model.rates()[2] == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_sticking_and_slipping_have_few_events(fmus, events, seed):
    """There are at most three for each change, some of which the steps of 1 ms of co-simulation show."""
    rng = np.random.default_rng(seed)
    starts = {f"{group}[{i}]": rng.uniform(low, high) for i in (1, 2) for group, (low, high) in RUBBING.items()}
    ours = run(fmus["joint"], "CoSimulation", starts, 2.0, 1e-3)
    theirs = run(fmus["joint"], "ModelExchange", starts, 2.0, 1e-3, relative_tolerance=1e-10)
    assert np.abs(ours - theirs).max() <= 1e-6
    signs = np.sign(ours[:, 2:])
    changes = np.count_nonzero(np.diff(signs, axis=0)) + 2  # and those within a step, of which there are few
    assert 1 <= len(events) <= 3 * changes


@pytest.fixture
def events(monkeypatch):
    """A list with one element per event of a model that FMPy simulates; more than 1,000 fail."""
    entered, enter = [], FMU2Model.enterEventMode

    def counted(model):
        entered.append(model)
        assert len(entered) <= 1000
        return enter(model)

    monkeypatch.setattr(FMU2Model, "enterEventMode", counted)
    return entered


def test_two_joints_that_drive_each_other_off_come_to_rest(fmus, events):
    """They act like the feet of a rocking block.

    If each impact released the other joint, events would never end.
    """
    starts = {
        "q_min[1]": 0.0,
        "q_max[2]": 0.5,
        "q_start[1]": 0.0,
        "q_start[2]": -0.457,
        "tau_cmd[1]": -1.451,
        "tau_cmd[2]": 1.308,
        "gravity[2]": 0.0,
    }
    theirs = run(fmus["effort"], "ModelExchange", starts, 2.0, relative_tolerance=1e-10)
    assert events and theirs[-1].tolist() == [0.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize("torques", [(0.0236, 0.9009), (0.8861, 0.0227), (0.2502, 0.7944)])
def test_a_joint_that_is_thrown_off_its_stop_has_no_event_by_a_solvers_error(fmus, events, torques):
    """CVode's own tolerance is much larger than the tolerated depth behind a limit."""
    starts = {
        f"{group}[{i}]": value for i in (1, 2) for group, value in (("q_start", 0.0), ("q_min", -0.3), ("q_max", 0.3))
    }
    starts |= {"tau_cmd[1]": torques[0], "tau_cmd[2]": torques[1]}
    for tolerance, near in ((1e-5, 1e-2), (1e-10, 1e-7)):
        events.clear()
        theirs = run(fmus["effort"], "ModelExchange", starts, 1.0, relative_tolerance=tolerance)
        assert 0 < len(events) <= 50
        ours = run(fmus["effort"], "CoSimulation", {**starts, "rtol": 1e-10, "atol": 1e-12}, 1.0)
        assert np.abs(theirs - ours)[:, :2].max() <= near


def test_events_are_at_the_times_of_the_closed_form(fmus, monkeypatch):
    """q = q_des (1 − cos ωt) under joint control without Kd reaches 1 where cos ωt = 1 − 1/q_des."""
    time, events = [0.0], []
    enter, set_time = FMU2Model.enterEventMode, FMU2Model.setTime

    def timed(model, t):
        time.append(t)
        return set_time(model, t)

    def entered(model):
        events.append(time[-1])
        return enter(model)

    monkeypatch.setattr(FMU2Model, "setTime", timed)
    monkeypatch.setattr(FMU2Model, "enterEventMode", entered)
    for side in (1.0, -1.0):  # both ends of both joints
        starts = {
            "q_start[1]": 0.0,
            "q_start[2]": 0.0,
            "q_des[1]": 2.0 * side,
            "q_des[2]": -2.0 * side,
            "Kp[1]": 25.0,
            "Kp[2]": 49.0,
            "Kd[1]": 0.0,
            "Kd[2]": 0.0,
            **{f"q_{end}[{i}]": x for i in (1, 2) for end, x in (("min", -1.0), ("max", 1.0))},
            "rigid_stops": False,
        }
        events.clear()
        last = run(fmus["joint"], "ModelExchange", starts, 0.5, relative_tolerance=1e-10)[-1]
        assert last.tolist() == [side, -side, 0.0, 0.0]
        assert np.abs(np.array(events) - [np.pi / 3 / 7, np.pi / 3 / 5]).max() <= 1e-8


def test_the_jump_of_the_pseudo_inverse_is_an_event(fmus):
    """Near the start, only the stretched arm has the ratio rcond of singular values."""
    model = Model(fmus["task"], rcond=0.05)
    model.go()
    signs = []
    for angle in np.linspace(0.3, 0.01, 50):
        model.y = [0.3, angle, 0.0, 0.0]
        c, s = np.cos(0.3), np.sin(0.3)
        c2, s2 = np.cos(0.3 + angle), np.sin(0.3 + angle)
        sigma = np.linalg.svd(0.15 * np.array([[-s - s2, -s2], [c + c2, c2]]))[1]
        assert model.indicators()[6] == pytest.approx(sigma[1] / sigma[0] - 0.05, abs=1e-12)
        signs.append(model.indicators()[6] > 0.0)
    assert signs[0] and not signs[-1] and np.count_nonzero(np.diff(signs)) == 1


# --- calls ---


def test_states_by_real_variables_and_derivatives_by_real_variables(fmus):
    """CasADi uses them, also in event mode."""
    model, other = Model(fmus["task"]), Model(fmus["task"])
    other.go()
    y = [0.3, 0.9, -0.4, 0.2]
    model.set(q=y[:2], v=y[2:])
    other.y = y
    assert [*model.get("q"), *model.get("v")] == y == model.y
    rates = model.getReal([model.vr[f"der({s}[{i}])"] for s in "qv" for i in (1, 2)])
    assert rates == other.rates() and rates[:2] == y[2:]


def test_a_state_that_is_set_by_hand_determines_the_resting_joints_again(fmus):
    model = Model(fmus["effort"], q_start=[0.5, 0.0], q_min=[0.5, -1.0])
    assert model.getReal([model.vr["der(v[1])"]]) == [0.0]  # it rests
    model.set(q=[0.6, 0.0])
    assert model.getReal([model.vr["der(v[1])"]])[0] < -1.0


def test_a_guess_of_the_state_before_the_run_is_its_start(fmus):
    model = Model(fmus["task"], q=[0.5, 0.9])
    assert not model.messages
    assert model.get("q") == [0.5, 0.9] and model.y[:2] == [0.5, 0.9]


def test_sensors_need_a_period_as_there_are_no_communication_points(fmus):
    Model(fmus["effort"], control_period=0.01, q_noise=(0.1, 0.0))
    with pytest.raises(fmpy.fmi1.FMICallException, match="fmi2ExitInitializationMode"):
        Model(fmus["effort"], q_noise=(0.1, 0.0))


def test_a_time_event_is_announced_until_it_is_past(fmus):
    """Samples are at 0, 0.01, …, efforts act 4 ms later; the acting effort changes only at events."""
    model = Model(fmus["joint"], control_period=0.01, control_delay=0.004, q_des=(0.6, 0.5))

    def next_event():
        *_, defined, time = model.newDiscreteStates()
        assert defined
        model.enterContinuousTimeMode()
        return time

    assert next_event() == 0.004
    for time, following in ((0.004, 0.01), (0.01, 0.014), (0.012, 0.014), (0.014, 0.02)):
        before = model.get("tau")
        model.setTime(time)
        model.y = [0.5 + time, 0.35, 0.1, 0.0]
        assert model.get("tau") == before
        model.enterEventMode()
        assert next_event() == pytest.approx(following, abs=1e-15)
        assert (model.get("tau") != before) == (time in (0.004, 0.014))


def test_calls_out_of_order_or_with_invalid_values_are_refused_and_change_nothing(fmus):
    model = Model(fmus["task"])
    four = (ctypes.c_double * 4)(0.1, 0.2, np.nan, 0.0)
    model.enterEventMode()  # the table of FMI 2.0.4 allows it in event mode too, that of 3.0.2 does not
    model.refused("is not allowed in the state 'event mode'", "setContinuousStates", four, 4)
    step = (model.component, ctypes.c_double(0.0), ctypes.c_double(0.01), 0)
    assert model.dll["fmi2DoStep"](ctypes.c_void_p(step[0]), *step[1:]) == ERROR
    assert "fmi2DoStep is a call of co-simulation" in model.messages.pop()[1]
    model.refused("wrong number of values, expected 4", "getDerivatives", four, 3)
    model.refused(r"der\(q\[1\]\) is computed and cannot be set", "setReal", [model.vr["der(q[1])"]], [0])
    model.go()
    model.refused("is not allowed in the state 'continuous-time mode'", "newDiscreteStates")
    model.refused(r"v\[1\] is not finite", "setContinuousStates", four, 4)
    model.refused("the time is not finite", "setTime", np.nan)
    model.refused(r"fmi2Set of a parameter \(rcond\)", "setReal", [model.vr["rcond"]], [0.1])


def test_a_state_is_restored_bit_for_bit_and_is_of_its_kind(fmus):
    model = Model(fmus["effort"], q_start=[1.0, 0.0], q_max=[1.0, 2.0], tau_cmd=[5.0, 0.0])
    model.go()
    model.y = [1.0, 0.2, 0.0, 0.3]
    saved, rates, indicators = model.getFMUState(), model.rates(), model.indicators()
    blob = model.serializeFMUState(saved)
    model.y = [0.2, 0.2, 1.0, 0.0]
    model.event()
    assert model.rates() != rates
    for state in (saved, model.deSerializeFMUstate(blob)):
        model.setFMUState(state)
        assert (model.rates(), model.indicators()) == (rates, indicators)
        model.event()


def test_directional_derivatives_are_those_of_the_rates_in_both_kinds(fmus):
    model = Model(fmus["effort"], v_start=[0.4, -0.3])
    arm = Driver(fmus["effort"]).initialise(v_start=(0.4, -0.3))
    model.go()
    y, vr = model.y, model.vr
    unknown = [vr[f"der({s}[{i}])"] for s in "qv" for i in (1, 2)]
    for k, name in enumerate(states(fmus["effort"])):
        ends = []
        for h in (1e-5, -1e-5):
            model.y = [value + h * (i == k) for i, value in enumerate(y)]
            ends.append(np.array(model.rates()))
        model.y = y
        expected = (ends[0] - ends[1]) / 2e-5
        for instance in (model, arm.slave):
            found = instance.getDirectionalDerivative(unknown, [vr[name]], [1.0])
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)
    arm.free()


def move(model, y):
    model.y = y
    return model


CHANGES = {
    "states": lambda model: move(model, [0.4, 0.2, 0.6, 0.5]),
    "a state alone": lambda model: model.set(v=[-0.8, 0.3]),
    "efforts": lambda model: model.set(tau_ext=[0.3, -0.2]),
    "a force": lambda model: model.set(f_ext=[2.0, -1.0, 0.5]),
    "a joint that sticks": lambda model: move(model, [0.4, 0.2, 0.0, 0.5]).event(),
    "a joint at its stop": lambda model: move(model, [0.4, 2.0, 0.3, 0.0]).event(),
    "a state restored": lambda model: model.setFMUState(model.saved),
    "the time of a sample": lambda model: (model.setTime(0.1), model.enterEventMode()),
    "a step": lambda model: model.doStep(0.0, 0.05),
    "a parameter": lambda model: (model.reset(), model.set(payload=0.4), model.enterInitializationMode()),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_anything_gives_another_jacobian(fmus, change):
    """Its columns equal those of an instance that computes one direction at each point."""
    starts: dict[str, Any] = {
        "friction": [0.3, 0.0],
        "q_max": [3.0, 2.0],
        "v_start": [0.5, -0.4],
        "tau_ext": [0.1, 0.2],
    }
    if change == "the time of a sample":
        starts["control_period"] = 0.1
    if change == "a step":
        first, second = (Driver(fmus["joint"]).initialise(**starts).slave for _ in range(2))
    else:
        first, second = (Model(fmus["joint"], **starts) for _ in range(2))
        first.go()
    vr = Model(fmus["joint"]).vr
    unknown = [vr[name] for name in vr if name.startswith("der(")]
    known = [vr[name] for name in vr if re.match(r"[qv]\[|tau_ext|f_ext", name)]

    def jacobian():
        twice = [[first.getDirectionalDerivative(unknown, [k], [1.0]) for k in known] for _ in range(2)]
        state, alone = first.getFMUState(), []
        for k in known:
            second.setFMUState(state)
            alone.append(second.getDirectionalDerivative(unknown, [k], [1.0]))
        for columns in twice:
            np.testing.assert_allclose(columns, alone, rtol=1e-10, atol=1e-10 * np.abs(alone).max())
        return np.array(alone)

    if change == "the time of a sample":
        first.set(q_des=[0.9, -0.5])
    if change == "a state restored":
        first.saved = first.getFMUState()
        first.y = [0.1, 0.9, 1.0, -1.0]
    before = jacobian()
    CHANGES[change](first)
    assert np.abs(jacobian() - before).max() > 1e-3


def test_after_a_point_with_several_directions_the_first_one_is_a_column_of_the_jacobian(fmus):
    """A column of the Jacobian is bit-identical each time; a complex step rounds otherwise."""
    model = Model(fmus["joint"], v_start=[0.5, -0.4], tau_ext=[0.1, 0.2])
    model.go()
    unknown = [model.vr[f"der(v[{i}])"] for i in (1, 2)]

    def column(known):
        return model.getDirectionalDerivative(unknown, [model.vr[known]], [1.0])

    for k in range(6):
        model.y = [0.1 * k, 0.2, 0.5, -0.3 * k]
        first = column("q[2]")
        column("q[1]")
        assert k == 0 or first == column("q[2]")
    for k in range(2):  # after a point with one direction, the first one is a complex step
        model.y = [0.3, 0.2 + 0.1 * k, 0.7, 0.1]
        first = column("q[2]")
    column("q[1]")
    assert first != column("q[2]")


def test_a_derivative_of_a_variable_without_one_is_refused(fmus):
    model = Model(fmus["task"])
    call, vr = "getDirectionalDerivative", model.vr
    refused = [
        ("x_des[1] is not computed", ["x_des[1]"], ["q[1]"], [1.0]),
        ("rcond is neither a state nor an input", ["x[1]"], ["rcond"], [1.0]),
        ("tau[1] is neither a state nor an input", ["x[1]"], ["tau[1]"], [1.0]),
        ("the change of q[2] is not finite", ["x[1]"], ["q[2]"], [np.nan]),
        ("limit_effort is of type Boolean", ["x[1]"], ["limit_effort"], [1.0]),
    ]
    for message, unknown, known, seed in refused:
        model.refused(re.escape(message), call, [vr[n] for n in unknown], [vr[n] for n in known], seed)
