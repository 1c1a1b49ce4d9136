"""What the benchmark's table says beside the times: distances and numbers of right-hand sides."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
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
    counted = benchmark.CountedPlant()
    assert benchmark.accuracy(counted) <= 1e-12
    assert counted.evaluations() == 61 * benchmark.STEPS
    assert benchmark.accuracy(benchmark.PlantAlone()) <= 1e-12


def test_step_times_measure_every_row(benchmark: ModuleType, monkeypatch) -> None:
    monkeypatch.setattr(benchmark, "STEPS", 20)
    rows = [benchmark.Listing(), benchmark.PlantAlone()]
    times, busy = benchmark.step_times(rows, passes=1)
    assert len(times) == 2 and min(times) > 0.0 and busy > 0.0


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
