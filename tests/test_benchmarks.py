"""What the benchmark's table says beside the times: distances and numbers of right-hand sides."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pinocchio as pin
import pytest
from harness import needs
from scipy.integrate import solve_ivp

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def benchmark() -> Iterator[ModuleType]:
    """benchmarks/steps.py by its path: the folder is no package."""
    spec = importlib.util.spec_from_file_location("benchmarks_steps", BENCHMARKS / "steps.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    before = list(sys.path)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    sys.path[:] = before
    yield module
    del sys.modules[spec.name]


def test_exact_solution_begins_at_rest_and_obeys_its_equation(benchmark: ModuleType) -> None:
    h = benchmark.STEP
    e = np.array([benchmark.exact(k) - benchmark.X_DES for k in range(0, 500)])
    np.testing.assert_allclose(e[0], benchmark.position(benchmark.Q_START) - benchmark.X_DES)
    # e'' + 40 e' + 50 e = 0 from rest, as a recurrence that is exact for any step
    fast, slow = np.roots([1.0, 40.0, 50.0])
    a, b = np.exp(fast * h), np.exp(slow * h)
    np.testing.assert_allclose(e[2:], (a + b) * e[1:-1] - a * b * e[:-2], atol=1e-14)
    np.testing.assert_allclose(e[1], e[0] * (fast * b - slow * a) / (fast - slow), rtol=1e-13)


def test_listing_is_off_by_centimetres_and_needs_65_right_hand_sides(
    benchmark: ModuleType,
) -> None:
    listing = benchmark.Listing()
    assert 0.035 <= benchmark.accuracy(listing) <= 0.055
    assert 60 <= listing.evaluations() / benchmark.STEPS <= 70


def test_plant_is_exact_and_needs_61_right_hand_sides(benchmark: ModuleType) -> None:
    arm = benchmark.shipped_arm()
    assert benchmark.accuracy(benchmark.PlantAlone(arm)) <= 1e-12
    assert benchmark.right_hand_sides(arm) == 61 * benchmark.STEPS


def test_step_times_measure_every_row(benchmark: ModuleType, monkeypatch) -> None:
    monkeypatch.setattr(benchmark, "STEPS", 20)
    rows = [benchmark.Listing(), benchmark.PlantAlone(benchmark.shipped_arm())]
    times, busy = benchmark.step_times(rows, passes=1)
    assert len(times) == 2 and min(times) > 0.0 and busy > 0.0


def test_growth_is_the_largest_exponent(benchmark: ModuleType) -> None:
    assert benchmark.growth([2, 7, 16], [4.0, 49.0, 256.0]) == pytest.approx(2.0)
    assert benchmark.growth([1, 2, 4], [1.0, 2.0, 16.0]) == pytest.approx(3.0)


def test_robots_are_measured_as_they_come(benchmark: ModuleType, robots: Path) -> None:
    urdf = ET.parse(robots / "panda_description/urdf/panda.urdf")
    damping = [
        float(dynamics.get("damping"))
        for joint in urdf.iter("joint")
        if joint.get("type") == "revolute" and (dynamics := joint.find("dynamics")) is not None
    ]
    assert list(benchmark.panda().robot.damping) == damping and len(damping) == 7
    assert list(benchmark.chain(16).robot.damping) == [0.0] * 16


@pytest.fixture(scope="module")
def mujoco(
    benchmark: ModuleType, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str, int], tuple[float, list[float]]]:
    needs("cc")
    return benchmark.mujoco_runner(tmp_path_factory.mktemp("mujoco"))


def test_mujoco_has_the_same_arm(benchmark: ModuleType, mujoco: Callable) -> None:
    """Free fall from the start: MuJoCo's motion is that of Pinocchio's dynamics."""
    robot = benchmark.shipped_arm().robot
    model = robot.model.copy()
    model.gravity.linear = np.array(benchmark.STARTS["gravity"])
    data = model.createData()

    def motion(_t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[2:], pin.aba(model, data, y[:2], y[2:], np.zeros(2))])

    start = [*benchmark.Q_START, 0.0, 0.0]
    expected = solve_ivp(motion, (0.0, 0.3), start, "DOP853", rtol=1e-12, atol=1e-12).y[:2, -1]
    assert mujoco("free", 30)[1] == pytest.approx(expected, abs=1e-7)


def test_mujoco_has_the_same_controller(benchmark: ModuleType, mujoco: Callable) -> None:
    for steps in (1, 5, 50, 500):
        x = benchmark.position(mujoco("controlled", steps)[1])
        assert x == pytest.approx(benchmark.exact(steps), abs=1e-9)


def test_mujoco_is_measured_without_its_python_package() -> None:
    """That has the library ask for the time, at more than the cost of a step."""
    code = "import sys, steps; sys.exit('mujoco' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=BENCHMARKS, check=True)


def test_steps_are_timed_from_c(
    benchmark: ModuleType, mujoco: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "STEPS", 100)  # clock() has a resolution of 1 µs
    costs = [benchmark.native_cost(benchmark.shipped_arm(), tmp_path)]
    costs += [lambda kind=kind: mujoco(kind, 100)[0] for kind in ("free", "controlled")]
    rows = [benchmark.RowInC("", 2, "", cost, 61.0) for cost in costs]
    assert all(0.0 < cost < 1e-3 for cost in benchmark.times_in_c(rows, rounds=3))


def test_targets_repeat_with_their_seed(monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import targets

    def run() -> tuple[list[float], list[float], int]:
        plant = targets.shipped_plant()
        findings = targets.Findings()
        targets.run_target(plant, 1, 3, findings, verbose=False)
        return plant.q, plant.x_des, findings.wrong()

    assert run() == run()
    assert run()[2] == 0
