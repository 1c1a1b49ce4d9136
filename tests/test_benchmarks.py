"""What the benchmark's table says beside the times: distances and numbers of right-hand sides."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pinocchio as pin
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def benchmark() -> Iterator[ModuleType]:
    """benchmarks/run.py by its path: the folder is no package."""
    spec = importlib.util.spec_from_file_location("benchmarks_run", BENCHMARKS / "run.py")
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


def test_arms_have_the_joints_that_the_table_says(benchmark: ModuleType) -> None:
    for arm, joints in ((benchmark.panda(), 7), (benchmark.chain(16), 16)):
        assert len(arm.robot.joints) == joints and not any(arm.robot.damping)


def test_mujoco_has_the_same_arm(benchmark: ModuleType) -> None:
    """Free fall from the start: MuJoCo's motion is that of Pinocchio's dynamics."""
    model, robot = benchmark.mujoco_arm(), benchmark.shipped_arm().robot
    data, reference = mujoco.MjData(model), robot.model.copy()
    reference.gravity.linear = np.array(benchmark.STARTS["gravity"])
    data.qpos[:], data.qvel[:] = benchmark.Q_START, (1.0, -2.0)
    mujoco.mj_forward(model, data)
    expected = pin.aba(reference, reference.createData(), data.qpos, data.qvel, np.zeros(2))
    np.testing.assert_allclose(data.qacc, expected, rtol=1e-9)


def test_steps_are_timed_from_c(benchmark: ModuleType, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(benchmark, "STEPS", 100)  # clock() has a resolution of 1 µs
    native = benchmark.native_cost(benchmark.shipped_arm(), tmp_path)
    rows = [benchmark.RowInC("", 2, cost, 61.0) for cost in (native, benchmark.mujoco_cost())]
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
