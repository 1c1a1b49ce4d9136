"""The closed form of the task-space motion against exact arithmetic, SciPy and the oracles."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import oracles
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from twodof.export.closed_form import Held, responses, task_error

GAINS = {
    "overdamped, the default": (50.0, 40.0),
    "stiff": (50.0, 4000.0),
    "critical": (400.0, 40.0),
    "underdamped": (400.0, 4.0),
    "just over": (400.0 * (1 - 1e-9), 40.0),
    "just under": (400.0 * (1 + 1e-9), 40.0),
    "one rounding over": (float(np.nextafter(400.0, 0.0)), 40.0),
    "one rounding under": (float(np.nextafter(400.0, 500.0)), 40.0),
    "no gains": (0.0, 0.0),
    "no spring": (0.0, 40.0),
    "no damper": (50.0, 0.0),
    "hardly a spring": (1e-9, 40.0),
    "hardly anything": (1e-12, 1e-6),
    "hardly anything, critical": (1e-12, 2e-6),
    "pushed away": (-3.0, 2.0),
    "growing": (3.0, -2.0),
    "growing, critical": (1.0, -2.0),
}


def exact(times: list[float], Kp: float, Kd: float) -> Iterator[tuple[float, ...]]:
    """φ, ψ, γ and ψ' by the power series of γ, in rational numbers.

    γ = Σ cₖ tᵏ solves γ'' + Kd γ' + Kp γ = 1 from rest: c₂ = 1/2 and
    cₖ k (k − 1) = −Kd (k − 1) cₖ₋₁ − Kp cₖ₋₂.
    """
    spring, damper = Fraction(Kp), Fraction(Kd)
    series = [Fraction(0), Fraction(0), Fraction(1, 2)]
    for k in range(3, 150):
        force = damper * (k - 1) * series[-1] + spring * series[-2]
        series.append(-force / (k * (k - 1)))
    for time in map(Fraction, times):
        assert abs(series[-1]) * time**147 < Fraction(1, 10**20) * abs(series[2])
        gamma, psi, psi_rate = Fraction(0), Fraction(0), Fraction(0)
        for k, c in reversed([*enumerate(series)]):
            gamma = gamma * time + c
            psi, psi_rate = psi * time + k * c, psi_rate * time + k * (k - 1) * c
        yield tuple(map(float, (1 - spring * gamma, psi / time, gamma, psi_rate / time**2)))


@pytest.mark.parametrize("gains", GAINS.values(), ids=list(GAINS))
def test_responses_are_exact_to_rounding(gains: tuple[float, float]) -> None:
    """This includes critical damping, gains of 0, and the transition to the series."""
    Kp, Kd = gains
    stages = np.array([1e-6, 0.1, 0.49, 0.51, 3.0, 15.0], np.float32)
    times = np.float64(stages / np.float32(max(abs(Kd), abs(Kp) ** 0.5) or 1.0))  # short fractions
    exactly = exact(times.tolist(), Kp, Kd)
    for t, expected, *found in zip(times, exactly, *responses(times, Kp, Kd), strict=True):
        size = max(1.0, abs(expected[0]))  # of what rounding is measured by; φ crosses zero
        phi, psi, gamma, psi_rate = map(float, found)
        assert phi == pytest.approx(expected[0], rel=1e-14, abs=1e-15 * size)
        assert psi == pytest.approx(expected[1], rel=1e-14, abs=2e-15 * size * t)
        assert gamma == pytest.approx(expected[2], rel=3e-14)
        assert psi_rate == pytest.approx(expected[3], rel=1e-14, abs=2e-15 * size)


@pytest.mark.parametrize("gains", GAINS.values(), ids=list(GAINS))
def test_responses_are_the_matrix_exponential(gains: tuple[float, float]) -> None:
    """The system is ẋ = v, v̇ = −Kp x − Kd v + a, ȧ = 0, over ten seconds."""
    Kp, Kd = gains
    t = np.linspace(0.0, 10.0, 21)
    phi, psi, gamma, psi_rate = responses(t, Kp, Kd)
    system = np.array([[0.0, 1.0, 0.0], [-Kp, -Kd, 1.0], [0.0, 0.0, 0.0]])
    found = np.array([[phi, psi, gamma], [-Kp * psi, psi_rate, psi]]).transpose(2, 0, 1)
    expected = expm(system * t[:, None, None])[:, :2]
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


def test_small_errors_keep_their_digits() -> None:
    """A plot in decades shows them: after 20 s the default run's error is 1e-12 of its start."""
    t = np.array([20.0])
    phi = float(responses(t, 50.0, 40.0).phi[0])
    root = -20.0 + np.sqrt(350.0)
    other = -20.0 - np.sqrt(350.0)
    expected = other / (other - root) * np.exp(root * 20.0)
    assert phi == pytest.approx(expected, rel=1e-12)
    assert expected < 1e-10


@pytest.mark.parametrize("Kp", [1e-9, 1e-3, 1.0])
def test_a_soft_spring_is_accurate_over_long_times(Kp: float) -> None:
    """Its root is Kp/Kd to first order, a difference of almost equal numbers."""
    Kd = 4e4
    t = np.array([Kd / Kp])
    phi = float(responses(t, Kp, Kd).phi[0])
    assert phi == pytest.approx(np.exp(-1.0), rel=3.0 * Kp / Kd**2 + 1e-14)


def held(x_des, xd_des=(0.0, 0.0), xdd_des=(0.0, 0.0), Kp=(50.0, 50.0), Kd=(40.0, 40.0)) -> Held:
    return Held(x_des, xd_des, xdd_des, Kp, Kd)


@pytest.mark.parametrize("step", [0.01, 1])
def test_held_inputs_from_rest_give_the_textbook_solution(step: float) -> None:
    steps = 500
    error = task_error((0.23, 0.18), (0.0, 0.0), [(0, held((0.2, 0.05)))], step, np.arange(steps + 1))
    expected = oracles.task_error(np.array([0.03, 0.13]), 50.0, 40.0, step * np.arange(steps + 1))
    np.testing.assert_allclose(error, expected, rtol=0.0, atol=1e-15)


SCHEDULE = [
    (0, held((0.2, 0.05), xd_des=(0.3, -0.1))),
    (70, held((0.1, 0.2), Kp=(400.0, 20.0), Kd=(4.0, 40.0))),
    (71, held((0.1, 0.2), xdd_des=(-1.0, 2.0), Kp=(0.0, 20.0), Kd=(4.0, 0.0))),
    (150, held((0.0, 0.0), xd_des=(0.1, 0.0), Kp=(0.0, 30.0), Kd=(0.0, 11.0))),
    (220, held((0.1, -0.1), xdd_des=(0.0, 1.0), Kp=(100.0, 0.0), Kd=(20.0, 3.0))),
]


def test_inputs_that_change_give_the_results_of_an_integrator() -> None:
    """Targets, velocities, accelerations and gains change during the motion; some are zero."""
    step, steps = 0.01, 300
    x, v = np.array([0.23, 0.18]), np.array([0.4, -0.2])
    error = task_error(tuple(x), tuple(v), SCHEDULE, step, np.arange(steps + 1))
    assert error.shape == (steps + 1, 2)
    np.testing.assert_array_equal(error[0], x - SCHEDULE[0][1].x_des)
    ends = [k for k, _ in SCHEDULE[1:]] + [steps]
    for (k, inputs), end in zip(SCHEDULE, ends, strict=True):
        x_des, xd_des, xdd_des, Kp, Kd = map(np.array, inputs)

        def motion(_t, y, x_des=x_des, xd_des=xd_des, xdd_des=xdd_des, Kp=Kp, Kd=Kd):
            return np.r_[y[2:], xdd_des + Kd * (xd_des - y[2:]) + Kp * (x_des - y[:2])]

        t = step * np.arange(end - k + 1)
        solution = solve_ivp(motion, (0.0, t[-1]), np.r_[x, v], method="DOP853", t_eval=t, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(error[k + 1 : end + 1], solution.y[:2, 1:].T - x_des, rtol=0.0, atol=1e-12)
        x, v = solution.y[:2, -1], solution.y[2:, -1]


def test_at_a_change_the_error_is_still_that_from_the_target_before() -> None:
    schedule = [(0, held((0.2, 0.05))), (3, held((5.0, 5.0)))]
    error = task_error((0.23, 0.18), (0.0, 0.0), schedule, 0.01, np.arange(7))
    before = task_error((0.23, 0.18), (0.0, 0.0), schedule[:1], 0.01, np.arange(7))
    np.testing.assert_array_equal(error[:4], before[:4])
    assert (error[4:] < -4.0).all()


def test_a_subset_of_samples_has_the_same_errors() -> None:
    """The bag is recovered or downsampled; some intervals between changes have no sample."""
    steps = np.array([0, 1, 2, 69, 70, 72, 150, 151, 299])
    some, every = (task_error((0.23, 0.18), (0.4, -0.2), SCHEDULE, 0.01, k) for k in (steps, np.arange(300)))
    np.testing.assert_allclose(some, every[steps], rtol=0.0, atol=1e-15)


def test_a_run_without_steps() -> None:
    error = task_error((0.23, 0.18), (0.0, 0.0), [(0, held((0.2, 0.05)))], 0.01, np.zeros(1, int))
    np.testing.assert_allclose(error, [[0.03, 0.13]], rtol=1e-15)


@pytest.mark.filterwarnings("error")
def test_gains_that_make_it_explode_warn_of_nothing() -> None:
    wild = held((0.2, 0.05), Kp=(-1e4, 50.0), Kd=(-1e4, 1e8))
    error = task_error((0.23, 0.18), (0.0, 0.0), [(0, wild)], 0.1, np.arange(1001))
    assert not np.isfinite(error[-1, 0])
    assert error[-1, 1] == pytest.approx(0.13, rel=1e-3)
