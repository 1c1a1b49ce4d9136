"""The integrator against SciPy's RK45 and against motions with known stops."""

import numpy as np
import pytest
from scipy.integrate import RK45

from twodof.plant import dormand_prince, integrator, regime
from twodof.plant.equations import Equations
from twodof.plant.stops import Stops

FREE = [(-np.inf, np.inf)]


def without_friction(limits, W=None):
    return Stops(limits, [0.0] * len(limits), lambda q: W, lambda y, a: np.zeros(len(a)), rigid=W is not None)


def advance(acceleration, q, v, h, limits, *tolerances):
    """Do a step with stops without reaction."""
    return integrator.advance(acceleration, q, v, h, without_friction(limits), *tolerances)


def smooth(acceleration):
    """Equations of motion whose J⁺ never drops a singular value."""
    return Equations(lambda q, v, rank, slip: (acceleration(q, v), 1, np.inf), lambda q: [1.0], 0.0, ())


def jumping(acceleration, ratio):
    """Equations of motion, q̈ by state and rank, whose J⁺ has rank 1 where a ratio, a function of q, is small.

    The ratio changes with joint 1 by at most 1 per rad.
    """

    def response(q, v, rank, slip):
        margin = ratio(q) - 0.01
        rank = rank or 1 + (margin > 0.0)
        return acceleration(q, v, rank), rank, margin if rank == 2 else -margin

    return Equations(response, lambda q: [1.0, ratio(q)], 0.01, (1.0,))


@pytest.fixture
def budget(monkeypatch):
    """A number of evaluations of a step that is too small."""
    monkeypatch.setattr(regime, "BUDGET", 20_000)
    return regime.BUDGET


def test_coefficients_are_those_of_scipy():
    for row, expected in zip(dormand_prince.A, [*RK45.A[1:6], RK45.B], strict=True):
        assert np.array_equal(row, expected[: len(row)]) and not any(expected[len(row) :])
    assert np.array_equal(dormand_prince.E, RK45.E)
    assert np.array_equal(dormand_prince.P, RK45.P)


@pytest.mark.parametrize("rtol, atol", [(1e-3, 1e-6), (1e-8, 1e-10)])
def test_steps_and_states_are_those_of_scipy(rtol, atol):
    """A pendulum has a stiff spring: steps are rejected and grow again."""

    def acceleration(q, v):
        return -400.0 * np.sin(q) - 0.3 * v + 50.0 * np.cos(3.0 * q)

    calls = 0

    def counted(q, v):
        nonlocal calls
        calls += 1
        return acceleration(q, v)

    h, max_step = 0.7, 0.2
    q, v = advance(smooth(counted), [1.2], [0.0], h, FREE, rtol, atol, max_step)
    scipy = RK45(
        lambda t, y: np.concatenate((y[1:], acceleration(y[:1], y[1:]))),
        0.0,
        [1.2, 0.0],
        h,
        max_step=max_step,
        rtol=rtol,
        atol=atol,
        first_step=max_step,
    )
    while scipy.status == "running":
        scipy.step()
    assert calls == scipy.nfev
    assert [*q, *v] == pytest.approx(scipy.y, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("h", [1e-3, 1e-2, 0.7])
def test_constant_acceleration_stops_at_the_instant_of_contact(h):
    """A joint hits a wall and is pressed against it: the method is exact for polynomials."""

    def acceleration(q, v):
        return [3.0]

    q, v, t = [0.0], [1.0], 0.0
    contact = (-1.0 + np.sqrt(1.0 + 2 * 3.0 * 0.05)) / 3.0  # q(t) = t + 1.5 t² = 0.05
    while t < 0.7 - 1e-9:
        q, v = advance(smooth(acceleration), q, v, h, [(-1.0, 0.05)], 1e-3, 1e-6, 1e-3)
        t += h
        if t < contact:
            assert q[0] == pytest.approx(t + 1.5 * t**2, abs=1e-13)
        else:
            assert q == [0.05]
            assert v == [0.0]


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("h", [0.25, 1.0])
def test_a_held_joint_is_released_where_its_acceleration_turns(side, h):
    """Joint 2 is a clock of constant speed; joint 1 is pressed into its limit until t = 0.3."""

    def acceleration(q, v):
        return [side * (0.3 - q[1]), 0.0]

    limits = [(-0.1, 0.1), (-9.0, 9.0)]
    q, v = [side * 0.1, 0.0], [0.0, 1.0]
    for _ in range(round(1.0 / h)):
        q, v = advance(smooth(acceleration), q, v, h, limits, 1e-3, 1e-6, 1e-2)
    # released at 0.3 with v = 0: v = −(t − 0.3)²/2, q = 0.1 − (t − 0.3)³/6
    assert v[0] == pytest.approx(-side * 0.7**2 / 2, abs=1e-10)
    assert q[0] == pytest.approx(side * (0.1 - 0.7**3 / 6), abs=1e-10)


def test_a_release_between_two_looks_at_the_effort_is_found():
    """q̈ = 1000 ((t − 0.875)² − ε²) pulls for 2ε, once within a step; the step ends where v returns to 0."""
    width, h = 0.04, 0.875 + 2 * 0.04

    def acceleration(q, v):  # joint 2 is a clock of constant speed
        return [1000.0 * ((q[1] - 0.875) ** 2 - width**2), 0.0]

    (q, _), (v, _) = advance(smooth(acceleration), [0.0, 0.0], [0.0, 1.0], h, [(-1.0, 0.0), *FREE], 1e-3, 1e-3, h)
    assert q == pytest.approx(-1000.0 * 27.0 * width**4 / 12.0, abs=1e-9)
    assert v == pytest.approx(0.0, abs=1e-9)


def test_a_joint_at_rest_at_its_limit_is_not_released_where_nothing_pulls():
    calls = 0

    def acceleration(q, v):
        nonlocal calls
        calls += 1
        return [0.0]

    moved = advance(smooth(acceleration), [1.0], [0.0], 0.01, [(0.0, 1.0)], 1e-3, 1e-6, 1e-3)
    assert moved == ([1.0], [0.0]) and calls <= 80  # of ten steps


def test_an_excursion_within_one_step_is_found():
    """A joint would move up to 1.25 mm beyond the limit and back within a step of 10 ms."""

    def acceleration(q, v):
        return [-200.0]

    top = 1.0 / (2 * 200.0)
    q, v = advance(smooth(acceleration), [0.0], [1.0], 0.01, [(-1.0, top / 2)], 1e-3, 1e-6, 0.01)
    contact = (1.0 - np.sqrt(1.0 - 2 * 200.0 * top / 2)) / 200.0
    assert v[0] == pytest.approx(-200.0 * (0.01 - contact), abs=1e-12)
    assert q[0] == pytest.approx(top / 2 - 100.0 * (0.01 - contact) ** 2, abs=1e-12)


def test_joints_stop_each_at_its_own_limit_and_leave_the_others_alone():
    """Two stop within one step; one between them turns in its range; one has no range."""
    q, v = advance(
        smooth(lambda q, v: [1.0, -2.0, 1.0, -7.0]),
        [0.0, 0.0, 0.0, 0.5],
        [1.0, 1.0, 1.0, 0.0],
        0.5,
        [(-1, 0.02), (-9, 9), (-1, 0.04), (0.5, 0.5)],
        1,
        1,
        0.5,
    )
    assert (q[0], q[2:], v[0], v[2:]) == (0.02, [0.04, 0.5], 0.0, [0.0, 0.0])
    assert (q[1], v[1]) == pytest.approx((0.5 - 0.25, 0.0), abs=1e-12)


def test_joints_that_reach_rigid_stops_within_picoseconds_stop_in_one_event():
    limits, calls = [(-1.0, 0.05 + i * 1e-13) for i in range(8)], 0

    def acceleration(q, v):
        nonlocal calls
        calls += 1
        return [0.0] * 8

    stops = without_friction(limits, np.eye(8))
    q, v = integrator.advance(smooth(acceleration), [0.0] * 8, [1.0] * 8, 0.1, stops, 1e-3, 1e-6, 0.1)
    assert q == [high for _, high in limits] and v == [0.0] * 8
    assert calls <= 20


@pytest.mark.parametrize("h", [1e-3, 1e-2, 0.1])
def test_a_change_of_rank_is_located(h):
    """q̈ is 3 up to q = 0.05, then −7: the method is exact for polynomials."""
    equations = jumping(lambda q, v, rank: [3.0 if rank == 2 else -7.0], lambda q: 0.06 - q[0])
    q, v = [0.0], [1.0]
    for _ in range(round(0.1 / h)):
        q, v = advance(equations, q, v, h, FREE, 1e-3, 1e-6, 0.1)
    contact = (-1.0 + np.sqrt(1.0 + 2 * 3.0 * 0.05)) / 3.0
    speed, rest = 1.0 + 3.0 * contact, 0.1 - contact
    assert q[0] == pytest.approx(0.05 + speed * rest - 3.5 * rest**2, abs=1e-13)
    assert v[0] == pytest.approx(speed - 7.0 * rest, abs=1e-13)


@pytest.mark.parametrize("width", [0.02, 2e-4])
def test_a_zone_of_lower_rank_is_not_missed_within_a_step(width):
    """q̈ is −100 in a zone around q = 0.05, which is crossed within a step, and 0 elsewhere."""
    equations = jumping(
        lambda q, v, rank: [0.0 if rank == 2 else -100.0], lambda q: 0.01 + abs(q[0] - 0.05) - width / 2
    )
    q, v = advance(equations, [0.0], [10.0], 0.01, FREE, 1e-3, 1e-6, 0.01)
    speed = np.sqrt(100.0 - 2 * 100.0 * width)
    inside = (10.0 - speed) / 100.0
    entered = (0.05 - width / 2) / 10.0
    assert v[0] == pytest.approx(speed, rel=1e-12)
    assert q[0] == pytest.approx(0.05 + width / 2 + speed * (0.01 - entered - inside), abs=1e-12)


@pytest.mark.parametrize("damping", [0.0, 40.0])
@pytest.mark.parametrize("strength", [1.0, 1e4])
def test_a_motion_that_both_ranks_lead_back_to_their_border_slides_along_it(strength, damping):
    calls = 0

    def acceleration(q, v, rank):
        nonlocal calls
        calls += 1
        return [(-strength if rank == 2 else strength) - damping * v[0]]

    equations = jumping(acceleration, lambda q: 0.01 + q[0])
    q, v = [1e-6], [0.0]
    for _ in range(10):
        q, v = advance(equations, q, v, 0.01, FREE, 1e-6, 1e-9, 1e-3)
    assert calls < 200_000
    # as far as it gets while the lower rank is held for half of the largest step
    assert abs(q[0]) <= 1e-6 + strength * 5e-4**2
    assert abs(v[0]) <= np.sqrt(2 * strength * 1e-6) + 2 * strength * 2.5e-4


@pytest.mark.parametrize("h", [0.01, 1e-3])
def test_a_rank_that_drops_soon_is_not_held_while_a_joint_moves_far(h):
    """q̈ = −k sgn(q) oscillates by 0.5 mrad with a period of 20 ns; after six periods the joint moves freely."""
    v0, k = 1e5, 1e13
    burst = 6.125 * 4.0 * v0 / k

    def acceleration(q, v, rank):  # joint 2 is a clock of constant speed
        return [0.0 if q[1] > burst else -k if rank == 2 else k, 0.0]

    equations = jumping(acceleration, lambda q: 0.01 + q[0])
    (q, _), (v, _) = advance(equations, [1e-30, 0.0], [v0, 1.0], h, FREE * 2, 1e-6, 1e-12, h)
    left = 0.5 * v0 / k
    assert v == pytest.approx(v0 - k * left, rel=1e-4)
    assert q == pytest.approx(v0 * left - 0.5 * k * left**2 + v * (h - burst), rel=1e-6)


def test_a_joint_that_bounces_on_a_clamp_within_nanoseconds_is_not_held_there():
    """q̈ = −k (sin ωt − 0.5) for 6.35 periods of 0.1 µs; in each, the joint leaves its limit and returns."""
    k, period, h = 1e12, 1e-7, 1e-3
    omega, begun, burst = 2.0 * np.pi / period, 0.02 * period, 6.35 * period

    def acceleration(q, v):  # joint 2 oscillates, joint 3 is a clock of constant speed
        return [-k * (q[1] - 0.5), -(omega**2) * q[1], 0.0] if q[2] < burst else [0.0] * 3

    limits = [(-20.0, 0.0), *FREE * 2]
    start = [0.0, np.sin(omega * begun), begun], [0.0, omega * np.cos(omega * begun), 1.0]
    q, v = advance(smooth(acceleration), *start, h - begun, limits, 1e-6, 1e-12, h)
    left, end = np.pi / 6 / omega, 0.35 * period  # of the last period
    flown = end - left
    speed = -k * ((np.cos(omega * left) - np.cos(omega * end)) / omega - 0.5 * flown)
    reached = np.cos(omega * left) * flown / omega - (np.sin(omega * end) - 0.5) / omega**2 - 0.25 * flown**2
    assert v[0] == pytest.approx(speed, rel=1e-3)
    assert q[0] == pytest.approx(-k * reached + v[0] * (h - burst), rel=1e-6)


def test_a_jump_that_no_rank_explains_is_refused(budget):
    """Both sides have the same rank, so a step that fails the error test is not accepted."""

    def acceleration(q, v):
        return [-1e4 if q[0] + 0.01 * v[0] > 0.0 else 1e4]

    with pytest.raises(regime.StepError) as refused:
        advance(smooth(acceleration), [1e-3], [0.0], 0.02, FREE, 1e-6, 1e-9, 1e-3)
    assert refused.value.joint == 0


@pytest.mark.parametrize("rate", [1e2, 1e4, 1e6])
def test_a_stiff_motion_is_that_of_its_closed_form(rate):
    """v̇ = −rate·(v − cos t) needs steps much shorter than the largest."""
    clock = []

    def acceleration(q, v):  # joint 2 is a clock of constant speed
        clock.append(q[1])
        return [-rate * (v[0] - np.cos(q[1])), 0.0]

    start = rate**2 / (1 + rate**2)  # on the slow solution
    _, v = advance(smooth(acceleration), [0.0, 0.0], [start, 1.0], 0.02, FREE * 2, 1e-6, 1e-9, 1e-3)
    exact = (rate**2 * np.cos(0.02) + rate * np.sin(0.02)) / (1 + rate**2)
    assert v[0] == pytest.approx(exact, abs=1e-6)
    assert np.diff(clock).max() <= 1e-3 + 1e-15


def test_a_motion_beyond_the_budget_is_refused_with_its_rate(budget):
    calls = 0

    def acceleration(q, v):
        nonlocal calls
        calls += 1
        return [-v[0], -1e10 * v[1]]

    with pytest.raises(regime.StepError, match="joint 1 changes at a rate of 1e") as refused:
        advance(smooth(acceleration), [0.0] * 2, [0.0, 1.0], 0.01, FREE * 2, 1e-3, 1e-6, 1e-3)
    assert (refused.value.joint, refused.value.too_fine) == (1, False)
    assert refused.value.rate == pytest.approx(1e10, rel=1e-6)
    assert budget < calls <= budget + 20


def test_a_joint_that_answers_to_its_position_is_named_by_the_root_of_it(budget):
    with pytest.raises(regime.StepError) as refused:
        advance(
            smooth(lambda q, v: [-1e18 * q[0], -1e8 * v[1]]), [1.0, 0.0], [0.0, 1.0], 0.01, FREE * 2, 1e-3, 1e-6, 1e-3
        )
    assert refused.value.joint == 0 and refused.value.rate == pytest.approx(1e9, rel=1e-6)


def test_a_value_that_is_not_finite_is_an_error():
    with pytest.raises(regime.StepError) as refused:
        advance(smooth(lambda q, v: [float("nan")]), [0.0], [0.0], 0.01, FREE, 1e-3, 1e-6, 1e-3)
    assert not refused.value.finite


def test_an_impact_that_another_undoes_leaves_its_joint_free():
    """Two joints hit their limits; the first one's impact alone throws the second back."""
    W = np.array([[1.0, 0.9], [0.9, 1.0]])
    y = [0.0, 0.0, -1.0, -0.5]
    without_friction([(0.0, 1.0)] * 2, W).impact(y, [False, False])
    assert y == pytest.approx([0.0, 0.0, 0.0, 0.4], abs=1e-15)  # -0.5 + 0.9 · 1
