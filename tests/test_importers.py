"""FMUs in third-party importers other than FMPy."""

from __future__ import annotations

import ctypes
import functools
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import fmpy
import numpy as np
import pytest
from harness import Driver, in_child_process
from native_models import model
from tools import needs

import twodof
from twodof import FmuOptions

COMMANDS = {
    "task": {"x_des[1]": 0.1, "x_des[2]": 0.2},
    "pose": {"x_des[1]": 0.1, "x_des[2]": 0.2, "quat_des[3]": 0.5, "quat_des[4]": 0.8},
    "joint": {"q_des[1]": 0.9, "q_des[2]": -0.6},
    "effort": {"tau_cmd[1]": 0.05, "tau_cmd[2]": -0.02},
}
Q = ("q[1]", "q[2]")
TIGHT = {"rtol": 1e-10, "atol": 1e-12}
END = 0.4  # s, before the bare arm has fallen onto a stop


Build = Callable[[str, int], tuple[str, list[float]]]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """An FMU without arrays, and the final state of FMPy's co-simulation, which its law in Python confirms."""

    @functools.cache
    def build(control: str, fmi: int) -> tuple[str, list[float]]:
        options = FmuOptions(control=control, native=True, fmi=fmi, arrays=fmi == 2)
        fmu = twodof.build_fmu(tmp_path_factory.mktemp("built") / "Arm.fmu", options)
        result = fmpy.simulate_fmu(
            str(fmu),
            stop_time=END,
            step_size=0.01,
            output_interval=0.01,
            output=Q,
            start_values={**COMMANDS[control], **TIGHT},
            fmi_type="CoSimulation",
        )
        end = [float(result[name][-1]) for name in Q]
        assert np.abs(np.subtract(end, (0.5, 0.35))).max() > 0.1  # it has moved
        plant = model("twodof", control).plant()
        plant.rtol, plant.atol = TIGHT["rtol"], TIGHT["atol"]
        for name, value in COMMANDS[control].items():
            getattr(plant, name[:-3])[int(name[-2]) - 1] = value
        for _ in range(round(END / 0.01)):
            plant.step(0.01)
        np.testing.assert_allclose(end, plant.q, rtol=0.0, atol=1e-9)
        return str(fmu), end

    return build


@pytest.mark.parametrize("control", COMMANDS)
def test_libcosim(control: str, built: Build) -> None:
    needs("libcosimpy")
    needs("libatomic")
    in_libcosim(control, *built(control, 2))


@in_child_process
def in_libcosim(control: str, fmu: str, expected: list[float]) -> None:
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    known, execution = references(fmu), CosimExecution.from_step_size(10_000_000)
    arm = execution.add_local_slave(CosimLocalSlave(fmu, "arm"))
    for name, value in {**COMMANDS[control], **TIGHT}.items():
        execution.real_initial_value(arm, known[name], value)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    execution.step(40)
    values = observer.last_real_values(arm, [known[name] for name in Q])
    np.testing.assert_allclose(values, expected, rtol=0.0, atol=1e-12)


def references(fmu: str | Path) -> dict[str, int]:
    return {v.name: v.valueReference for v in fmpy.read_model_description(str(fmu)).modelVariables}


@pytest.mark.parametrize("control, fmi", [*((control, 2) for control in COMMANDS), ("pose", 3)])
def test_casadi(control: str, fmi: int, built: Build, tmp_path: Path) -> None:
    in_casadi(control, *built(control, fmi), tmp_path)


@in_child_process
def in_casadi(control: str, fmu: str, expected: list[float], folder: Path) -> None:
    """Run Model Exchange by a classical Runge–Kutta method."""
    import casadi

    dae = casadi.DaeBuilder("arm", str(fmpy.extract(fmu, str(folder / "unzipped"))))
    f = dae.create("f", ["x", "u"], ["ode"])
    start = {name: float(np.squeeze(dae.start(name))) for name in (*dae.x(), *dae.u())}
    u = np.array([COMMANDS[control].get(name, start[name]) for name in dae.u()])
    x, h = np.array([start[name] for name in dae.x()]), END / 800

    def rate(state: np.ndarray) -> np.ndarray:
        return np.array(f(state, u)).ravel()

    for _ in range(800):
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        k4 = rate(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    end = dict(zip(dae.x(), x))
    np.testing.assert_allclose([end[name] for name in Q], expected, rtol=0.0, atol=1e-8)


SMALLEST_ARE_0 = """
#include <xmmintrin.h>
__attribute__((constructor)) static void begin(void) { _mm_setcsr(_mm_getcsr() | 0x8040); }
"""
"""A library does this that was linked with -ffast-math by a gcc before 13."""


@pytest.mark.parametrize("flavour", ["native", "python"])
def test_a_tolerance_of_0_is_refused_where_the_smallest_numbers_are_0(
    flavour: str, native_path: Path, fmu_path: Path, tmp_path: Path
) -> None:
    fmu = native_path if flavour == "native" else fmu_path
    where_the_smallest_are_0(str(fmu), tmp_path, needs("gcc"))


@in_child_process
def where_the_smallest_are_0(fmu: str, folder: Path, gcc: str) -> None:
    (folder / "csr.c").write_text(SMALLEST_ARE_0)
    command = [gcc, "-shared", "-fPIC", "csr.c", "-o", "csr.so"]
    subprocess.run(command, check=True, cwd=folder)
    ctypes.CDLL(str(folder / "csr.so"))
    assert np.float64(5e-324) * np.float64(1.0) == 0.0
    for name in ("rtol", "atol", "max_step"):
        driver = Driver(fmu)
        driver.set(**{name: 0.0})
        driver.call("setupExperiment")
        driver.call("enterInitializationMode")
        driver.call("exitInitializationMode")
        assert any(f"{name} = 0 must be > 0" in text for _, text in driver.log), name


# --- a controller that is an FMU of its own ---

GOAL, KP, KD = (0.9, -0.6), 400.0, 40.0
CONTROLLER = '''
import numpy as np
import pinocchio as pin
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Controller(Fmi2Slave):
    """Torques by inverse dynamics, from what is measured at the beginning of a step."""

    def __init__(self, **arguments):
        super().__init__(**arguments)
        self.model = pin.buildModelFromXML({urdf!r})
        self.model.gravity.linear = np.array([0.0, -9.81, 0.0])
        self.data = self.model.createData()
        for name in ("q1", "q2", "v1", "v2", "tau1", "tau2"):
            setattr(self, name, 0.0)
            kind, start = (Fmi2Causality.output, {{}}) if "tau" in name else (
                Fmi2Causality.input, {{"start": 0.0}}
            )
            self.register_variable(Real(name, causality=kind, **start))

    def exit_initialization_mode(self):
        self.do_step(0.0, 0.0)

    def do_step(self, current_time, step_size):
        q, v = np.array([self.q1, self.q2]), np.array([self.v1, self.v2])
        a = {kp} * (np.array({goal}) - q) - {kd} * v
        self.tau1, self.tau2 = map(float, pin.rnea(self.model, self.data, q, v, a))
        return True
'''


def test_a_second_fmu_holds_the_arm_in_libcosim(built: Build, tmp_path: Path) -> None:
    """It ends as near the target as the internal loop, along a path that differs by the step of 1 ms."""
    needs("libcosimpy")
    needs("libatomic")
    plant, _ = built("effort", 2)
    options = FmuOptions(control="joint", native=True)
    inside = twodof.build_fmu(tmp_path / "in.fmu", options)
    script = tmp_path / "controller.py"
    script.write_text(CONTROLLER.format(urdf=twodof.load_fmu(plant).urdf, kp=KP, kd=KD, goal=GOAL))
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", str(script), "-d", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    settings = {"q_des": GOAL, "Kp": KP, "Kd": KD, **TIGHT}
    samples = twodof.samples(inside, stop_time=1.0, settings=settings)
    couple(plant, str(tmp_path / "Controller.fmu"), np.array([sample.q for sample in samples])[1:])


@in_child_process
def couple(plant: str, controller: str, expected: np.ndarray) -> None:
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = CosimExecution.from_step_size(1_000_000)
    arm = execution.add_local_slave(CosimLocalSlave(plant, "arm"))
    law = execution.add_local_slave(CosimLocalSlave(controller, "law"))
    ours, theirs = references(plant), references(controller)
    for i in (1, 2):
        execution.connect_real_variables(law, theirs[f"tau{i}"], arm, ours[f"tau_cmd[{i}]"])
        execution.connect_real_variables(arm, ours[f"q[{i}]"], law, theirs[f"q{i}"])
        execution.connect_real_variables(arm, ours[f"v[{i}]"], law, theirs[f"v{i}"])
    for name, value in TIGHT.items():
        execution.real_initial_value(arm, ours[name], value)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    rows = []
    for _ in expected:
        execution.step(10)
        rows.append(observer.last_real_values(arm, [ours[name] for name in Q]))
    assert np.abs(np.array(rows) - expected).max() < 0.025
    np.testing.assert_allclose(rows[-1], GOAL, atol=1e-4)
    np.testing.assert_allclose(rows[-1], rows[-10], atol=1e-5)
