"""FMUs in importers of others, beside FMPy."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import fmpy
import numpy as np
import pytest
from harness import in_child_process
from native_models import model

import twodof
from twodof import FmuOptions

COMMANDS = {
    "pose": {"x_des[1]": 0.1, "x_des[2]": 0.2, "quat_des[3]": 0.5, "quat_des[4]": 0.8},
    "effort": {"tau_cmd[1]": 0.05, "tau_cmd[2]": -0.02},
}
"""By control: that with all of the engine's files and that with the fewest."""
Q = ("q[1]", "q[2]")
TIGHT = {"rtol": 1e-10, "atol": 1e-12}
END = 0.4  # s, before the bare arm has fallen onto a stop


Build = Callable[[str, int], tuple[str, list[float]]]


@pytest.fixture(scope="module")
def built(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str, int], tuple[str, list[float]]]:
    """An FMU, without arrays, and where FMPy's co-simulation ends, which is where its law leads in
    Python."""

    @functools.cache
    def build(control: str, fmi: int) -> tuple[str, list[float]]:
        options = FmuOptions(
            control=control, native=True, fmi=fmi, arrays=fmi == 2, live_documentation=False
        )
        fmu = twodof.build_fmu(tmp_path_factory.mktemp("built") / "Arm.fmu", options)
        result = fmpy.simulate_fmu(
            str(fmu), stop_time=END, step_size=0.01, output_interval=0.01, output=Q,
            start_values={**COMMANDS[control], **TIGHT}, fmi_type="CoSimulation",
        )  # fmt: skip
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
    in_libcosim(control, *built(control, 2))


@in_child_process
def in_libcosim(control: str, fmu: str, expected: list[float]) -> None:
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    known = {v.name: v.valueReference for v in fmpy.read_model_description(fmu).modelVariables}
    execution = CosimExecution.from_step_size(10_000_000)
    arm = execution.add_local_slave(CosimLocalSlave(fmu, "arm"))
    for name, value in {**COMMANDS[control], **TIGHT}.items():
        execution.real_initial_value(arm, known[name], value)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    execution.step(40)
    values = observer.last_real_values(arm, [known[name] for name in Q])
    np.testing.assert_allclose(values, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("control, fmi", [("pose", 2), ("pose", 3), ("effort", 2)])
def test_casadi(control: str, fmi: int, built: Build, tmp_path: Path) -> None:
    in_casadi(control, *built(control, fmi), tmp_path)


@in_child_process
def in_casadi(control: str, fmu: str, expected: list[float], folder: Path) -> None:
    """Model Exchange by the classical Runge–Kutta method written here."""
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
