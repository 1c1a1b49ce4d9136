"""A controller that the importer samples with an input clock (FMI 3.0, sections 2.2.8 and 2.3.4), by FMPy's calls.

The truth is the continuous controller: a sampled one gives its efforts at the ticks and holds them in between.
"""

from __future__ import annotations

import ctypes
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi3 import FMU3Model, FMU3Slave
from fmpy.validation import validate_fmu
from harness import Recorded, unzipped
from tools import needs

import twodof
from twodof.errors import BuildError
from twodof.export.compiler import UNITS

PERIOD, STEP, STEPS = 0.005, 0.001, 40
PER_TICK = round(PERIOD / STEP)


class Host(Recorded):
    """An instance, with the values of its vectors by name."""

    def open(self, fmu: Path, **settings: float) -> Any:
        description = fmpy.read_model_description(str(fmu))
        self.vr = {v.name: v.valueReference for v in description.modelVariables}
        super().__init__(
            guid=description.guid,
            modelIdentifier=description.modelName,
            instanceName="law",
            unzipDirectory=unzipped(fmu),
        )
        self.messages = []
        self.begin(lambda _, status, category, text: self.keep(status, text))
        for name, value in settings.items():
            self.setFloat64([self.vr[name]], [value])
        self.enterInitializationMode(startTime=0.0)
        return self

    def begin(self, log: Any) -> None:
        self.instantiate(logMessage=log, loggingOn=True)

    def put(self, q: np.ndarray, v: np.ndarray) -> None:
        self.setFloat64([self.vr["q"], self.vr["v"]], [*q, *v])

    def tau(self) -> list[float]:
        return list(self.getFloat64([self.vr["tau_cmd"]], 2))

    def tick(self) -> list[float]:
        """Tick the clock in event mode, and return the efforts."""
        clock = [self.vr["control_clock"]]
        self.setClock(clock, [True])
        assert self.getClock(clock) == [True]
        tau = self.tau()
        assert self.updateDiscreteStates()[0] is False
        assert self.getClock(clock) == [False] and self.tau() == tau
        return tau


class FMU3Alone(Host, FMU3Slave):
    """Co-simulation without event mode."""

    def at(self, n: int) -> list[float]:
        tau = self.tau()
        self.doStep(n * STEP, STEP)
        return tau


class FMU3Events(Host, FMU3Slave):
    """Co-simulation with event mode."""

    def begin(self, log: Any) -> None:
        self.instantiate(logMessage=log, loggingOn=True, eventModeUsed=True)

    def at(self, n: int) -> list[float]:
        if n % PER_TICK == 0:
            if n > 0:
                self.enterEventMode()
            self.tick()
            self.enterStepMode()
        tau = self.tau()
        self.doStep(n * STEP, STEP)
        return tau


class FMU3Exchange(Host, FMU3Model):
    def begin(self, log: Any) -> None:
        FMU3Model.instantiate(self, logMessage=log, loggingOn=True)

    def at(self, n: int) -> list[float]:
        if n > 0:
            self.setTime(n * STEP)
            self.enterEventMode()
        if n % PER_TICK == 0:
            self.tick()
        else:
            self.updateDiscreteStates()
        self.enterContinuousTimeMode()
        return self.tau()


KINDS = [FMU3Alone, FMU3Events, FMU3Exchange]


@pytest.fixture(scope="module")
def laws(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The shipped arm's controller, with a clock and continuous."""
    folder = tmp_path_factory.mktemp("clocked")
    of: dict[str, dict[str, Any]] = {
        "clocked": {"clocked": True, "settings": {"control_period": PERIOD}},
        "continuous": {},
    }
    return {
        name: twodof.build_fmu(
            folder / f"{name}.fmu", twodof.FmuOptions(native=True, fmi=3, part="controller", name=name, **more)
        )
        for name, more in of.items()
    }


@pytest.fixture
def events(laws: dict[str, Path]) -> Any:
    """An instance with event mode, at the start."""
    host = FMU3Events.__new__(FMU3Events).open(laws["clocked"])
    host.exitInitializationMode()
    return host


def motion() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    draw = np.random.default_rng(5)
    for _ in range(STEPS):
        yield draw.uniform(-1, 1, 2), draw.uniform(-2, 2, 2)


@pytest.mark.parametrize("delay", [0.0, 0.0075])
@pytest.mark.parametrize("kind", KINDS)
def test_efforts_are_those_of_the_law_at_the_ticks(laws: dict[str, Path], kind: Any, delay: float) -> None:
    continuous = FMU3Alone.__new__(FMU3Alone).open(laws["continuous"])
    host = kind.__new__(kind).open(laws["clocked"], control_delay=delay)
    at_ticks, late = [], round(delay / STEP * 2) / 2
    for n, (q, v) in enumerate(motion()):
        for each in (continuous, host):
            each.put(q, v)
        if n == 0:
            continuous.exitInitializationMode()
            host.exitInitializationMode()
        law = continuous.at(n)
        if n % PER_TICK == 0:
            at_ticks.append(law)
        acting = [tau for k, tau in enumerate(at_ticks) if k * PER_TICK + late <= n]
        assert host.at(n) == (acting[-1] if acting else [0.0, 0.0]), n
    assert len({*map(tuple, at_ticks)}) == STEPS // PER_TICK


def test_the_description_has_the_clock(laws: dict[str, Path]) -> None:
    assert validate_fmu(str(laws["clocked"])) == []
    description = fmpy.read_model_description(str(laws["clocked"]))
    (clock,) = [v for v in description.modelVariables if v.type == "Clock"]
    assert (clock.name, clock.causality, clock.intervalVariability) == ("control_clock", "input", "fixed")
    (element,) = ET.parse(Path(unzipped(laws["clocked"]), "modelDescription.xml")).iter(
        "Clock"
    )  # FMPy does not read the interval
    assert float(element.attrib["intervalDecimal"]) == PERIOD
    assert description.coSimulation.hasEventMode


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_the_sources_compile_without_a_warning(laws: dict[str, Path], compiler: str) -> None:
    command = [needs(compiler), "-std=c99", "-fsyntax-only", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    for name in UNITS:
        source = str(Path(unzipped(laws["clocked"]), "sources", name))
        headers = f"-I{Path(fmpy.__file__).parent / 'c-code'}"
        done = subprocess.run([*command, headers, source], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_the_importer_sets_the_interval(laws: dict[str, Path]) -> None:
    host = FMU3Events.__new__(FMU3Events).open(laws["clocked"])
    clock, period = (ctypes.c_uint32 * 1)(host.vr["control_clock"]), (ctypes.c_double * 1)(0.02)
    host.refused("must be >= 0", "setIntervalDecimal", clock, (ctypes.c_double * 1)(-1.0))
    host.setIntervalDecimal(clock, period)
    told, shift, qualifier = (ctypes.c_double * 1)(), (ctypes.c_double * 1)(1.0), (ctypes.c_int * 1)()
    host.getIntervalDecimal(clock, told, qualifier)
    host.fmi3GetShiftDecimal(host.component, clock, 1, shift)
    assert (told[0], qualifier[0], shift[0]) == (0.02, 2, 0.0)  # 2: fmi3IntervalChanged
    host.exitInitializationMode()
    host.tick()
    host.enterStepMode()
    host.refused("passes the tick of the clock at 0.02 s", "doStep", 0.0, 0.025)
    host.doStep(0.0, 0.02)
    host.enterEventMode()
    host.tick()
    host.refused("not allowed in the state 'event mode'", "setIntervalDecimal", clock, period)


def test_a_clock_without_an_interval_is_refused(laws: dict[str, Path]) -> None:
    host = FMU3Events.__new__(FMU3Events).open(laws["clocked"], control_period=0.0)
    host.refused("control_period = 0, but a clock samples", "exitInitializationMode")


def test_ticks_that_are_left_out_or_early_are_refused(events: Any, laws: dict[str, Path]) -> None:
    clock = [events.vr["control_clock"]]
    events.refused("ticks next at 0 s, and the time is 0 s", "enterStepMode")
    events.tick()
    assert events.updateDiscreteStates()[4] is False  # the FMU has no time event of its own
    events.refused("ticks next at 0.005 s, and the time is 0 s", "setClock", clock, [True])
    events.refused("reference 1 is not of the clock", "setClock", [1], [True])
    events.refused("null pointer", "fmi3SetClock", events.component, None, 1, None)
    events.enterStepMode()
    events.refused("'step mode'", "setClock", clock, [True])
    events.doStep(0.0, 0.005)
    events.enterEventMode()
    events.refused("fmi3EnterStepMode: control_clock ticks next at 0.005 s", "enterStepMode")
    alone = FMU3Alone.__new__(FMU3Alone).open(laws["clocked"])
    alone.exitInitializationMode()
    alone.refused("a call of event mode", "enterEventMode")
    exchange = FMU3Exchange.__new__(FMU3Exchange).open(laws["clocked"])
    exchange.exitInitializationMode()
    exchange.refused("fmi3EnterContinuousTimeMode: control_clock ticks", "enterContinuousTimeMode")
    with pytest.raises(Exception, match="fmi3EnterStepMode failed"):
        fmpy.simulate_fmu(unzipped(laws["clocked"]), stop_time=0.1, use_event_mode=True)


def test_a_clock_that_is_taken_back_leaves_the_effort(events: Any) -> None:
    clock, (q, v) = [events.vr["control_clock"]], next(motion())
    events.put(q, v)
    first = events.tick()
    events.enterStepMode()
    events.doStep(0.0, PERIOD)
    events.enterEventMode()
    events.put(v, q)
    events.setClock(clock, [True])
    second = events.tau()
    saved = events.getFMUState()
    events.setClock(clock, [False])
    assert events.tau() == first != second
    events.setFMUState(saved)
    assert events.getClock(clock) == [True] and events.tau() == second


def test_states_of_instances_with_and_without_a_clock_are_apart(events: Any, laws: dict[str, Path]) -> None:
    alone = FMU3Alone.__new__(FMU3Alone).open(laws["clocked"])
    alone.exitInitializationMode()
    events.tick()
    events.enterStepMode()
    alone.refused("other kind of instance", "setFMUState", events.getFMUState())
    events.refused("other kind of instance", "setFMUState", alone.getFMUState())


@pytest.mark.parametrize(
    "given, message",
    [
        ({"fmi": 3}, "`clocked` needs `part` controller and `fmi` 3"),
        ({"part": "controller"}, "`clocked` needs `part` controller and `fmi` 3"),
        ({"part": "controller", "fmi": 3}, "the clock needs the controller's period; set control_period"),
    ],
)
def test_an_fmu_that_cannot_have_a_clock_is_not_built(tmp_path: Path, given: dict[str, Any], message: str) -> None:
    with pytest.raises(BuildError, match=message):
        twodof.build_fmu(tmp_path / "a.fmu", twodof.FmuOptions(native=True, clocked=True, **given))
    assert not list(tmp_path.iterdir())
