"""The bare plant under a controller that is an FMU of its own, in libcosim."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import fmpy
import numpy as np
import pytest
from harness import in_child_process

import twodof
from twodof import FmuOptions

GOAL, KP, KD = (0.9, -0.6), 400.0, 40.0
CONTROLLER = '''
import numpy as np
import pinocchio as pin
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

URDF = {urdf!r}


class Controller(Fmi2Slave):
    """Torques by inverse dynamics, from what is measured at the beginning of a step."""

    def __init__(self, **arguments):
        super().__init__(**arguments)
        self.model = pin.buildModelFromXML(URDF)
        self.model.gravity.linear = np.array([0.0, -9.81, 0.0])
        self.data = self.model.createData()
        for name in ("q1", "q2", "v1", "v2"):
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.input, start=0.0))
        for name in ("tau1", "tau2"):
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.output))

    def exit_initialization_mode(self):
        self.do_step(0.0, 0.0)

    def do_step(self, current_time, step_size):
        q, v = np.array([self.q1, self.q2]), np.array([self.v1, self.v2])
        a = {kp} * (np.array({goal}) - q) - {kd} * v
        self.tau1, self.tau2 = map(float, pin.rnea(self.model, self.data, q, v, a))
        return True
'''


def references(fmu: Path) -> dict[str, int]:
    return {v.name: v.valueReference for v in fmpy.read_model_description(str(fmu)).modelVariables}


def in_libcosim(plant: Path, controller: Path, step: float, seconds: float) -> np.ndarray:
    """q at multiples of 10 ms."""
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    log_output_level(CosimLogLevel.WARNING)
    execution = CosimExecution.from_step_size(round(step * 1e9))
    arm = execution.add_local_slave(CosimLocalSlave(str(plant), "arm"))
    law = execution.add_local_slave(CosimLocalSlave(str(controller), "law"))
    theirs, ours = references(controller), references(plant)
    for i in (1, 2):
        execution.connect_real_variables(law, theirs[f"tau{i}"], arm, ours[f"tau_cmd[{i}]"])
        execution.connect_real_variables(arm, ours[f"q[{i}]"], law, theirs[f"q{i}"])
        execution.connect_real_variables(arm, ours[f"v[{i}]"], law, theirs[f"v{i}"])
    for name, value in (("rtol", 1e-10), ("atol", 1e-12)):
        execution.real_initial_value(arm, ours[name], value)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    rows = []
    for _ in range(round(seconds / 0.01)):
        execution.step(round(0.01 / step))
        rows.append(observer.last_real_values(arm, [ours["q[1]"], ours["q[2]"]]))
    return np.array(rows)


@in_child_process
def test_a_second_fmu_holds_the_arm_in_libcosim(tmp_path: Path) -> None:
    """It stands at the target; halving the step halves the distance from the loop inside."""
    bare = FmuOptions(control="effort", native=True)
    plant = twodof.build_fmu(tmp_path / "Bare.fmu", bare)
    inside = twodof.build_fmu(tmp_path / "in.fmu", FmuOptions(control="joint", native=True))
    script = tmp_path / "controller.py"
    urdf = twodof.load_fmu(plant).urdf
    script.write_text(CONTROLLER.format(urdf=urdf, kp=KP, kd=KD, goal=GOAL))
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", str(script), "-d", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    settings = {"q_des": GOAL, "Kp": KP, "Kd": KD, "rtol": 1e-10, "atol": 1e-12}
    samples = twodof.samples(inside, stop_time=1.0, settings=settings)
    expected = np.array([sample.q for sample in samples])[1:]
    distances = []
    for step in (0.002, 0.001):
        found = in_libcosim(plant, tmp_path / "Controller.fmu", step, 1.0)
        distances.append(np.abs(found - expected).max())
        np.testing.assert_allclose(found[-1], GOAL, atol=1e-4)
        np.testing.assert_allclose(found[-1], found[-10], atol=1e-5)
    assert distances[1] / distances[0] == pytest.approx(0.5, abs=0.02)
    assert distances[0] < 0.05
