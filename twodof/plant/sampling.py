"""Sampled control: sampling times, measured values, and the delay of efforts.

    t_k    = start + k T                              an exact integer k, T = control_period
    q_meas = ρ round(q/ρ) + noise                     at t_k; ρ = q_resolution, ties to even
    v_meas = v + noise, or (q_meas(t_k) − q_meas(t_(k−1)))/T, 0 at the first sample
    τ_k    = law(q_meas, v_meas, inputs at t_k)       acts from t_k + D until t_(k+1) + D, D = control_delay

No effort acts before the first. With T = 0 the law is continuous, and each communication point is a sample of the
sensors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

from .control_law import ControlledPlant
from .integrator import Budget, advance
from .noise import normal_pair

MOST_PERIODS = 10  # longest delay, in periods
TIME_TOLERANCE = 1e-9  # tolerance for equal times, relative to max(1 s, |t|)
PART_OF_PERIOD = 1e-3  # tolerance for equal times, relative to the period
WHOLE = 2.0**53  # doubles of this size or larger are integers


@dataclass
class Sampling:
    """Discrete state of a sampled controller of n joints."""

    start: float  # t_0, s
    time: float
    k: int
    count: int  # number of efforts that were commanded and do not act yet
    q_meas: list[float]  # q_meas, v_meas: the latest sample, n values each, rad or m, rad/s or m/s
    v_meas: list[float]
    effort: list[float]  # the effort that acts now, n values, N·m or N
    # efforts that do not act yet, the oldest first; MOST_PERIODS + 1 lists, of which ``count`` are used
    pending: list[list[float]]

    @classmethod
    def begin(cls, n: int, start: float) -> Sampling:
        """Return the state of n joints before the first sample, at time ``start``, s."""
        still = [0.0] * n
        pending = [list(still) for _ in range(MOST_PERIODS + 1)]
        return cls(start, start, 0, 0, list(still), list(still), list(still), pending)

    def settled(self, plant: ControlledPlant, time: float) -> Sampling:
        """Return the state after all events that are due at a time, s, with the plant's state and inputs.

        Raises:
            FloatingPointError: an effort is not finite.
        """
        after = replace(self, pending=list(self.pending))
        if plant.control_period:
            after._sample(plant, time)
        else:
            after._measure(plant, time)
        return after

    def is_sound(self, plant: ControlledPlant) -> bool:
        """Return whether the state is valid at the plant's time, if all its numbers are finite."""
        if not 0 <= self.count <= min(self.k, MOST_PERIODS) or self.k >= WHOLE:
            return False
        period = plant.control_period
        return abs(self._instant(plant, self.k) - plant.time) <= 2.0 * period if period else not self.count

    def next_event(self, plant: ControlledPlant) -> float:
        """Return the time of the next sample or of the next change of effort, s; infinite without samples."""
        if not plant.control_period:
            return inf
        return min(self._instant(plant, self.k), self._due(plant))

    def _instant(self, plant: ControlledPlant, k: int) -> float:
        return float(self.start + k * plant.control_period)

    def _due(self, plant: ControlledPlant) -> float:
        """Return the time from which the oldest pending effort acts, s."""
        first = self.k - self.count
        return self._instant(plant, first) + float(plant.control_delay) if self.count else inf

    def _sample(self, plant: ControlledPlant, time: float) -> None:
        by = time + slack(plant, time)
        if self._instant(plant, self.k) <= by:
            self._measure(plant, time)
            effort = plant.commanded_effort(self.q_meas, self.v_meas)
            if not all(abs(tau) < inf for tau in effort):
                raise FloatingPointError(
                    "the control law gave an effort that is not finite: inputs, payload or speeds are too large"
                )
            self.pending[self.count] = effort
            self.count += 1
        while self.count > MOST_PERIODS or self._due(plant) <= by:
            self.effort, *self.pending = self.pending
            self.pending.append([0.0] * len(self.effort))
            self.count -= 1

    def _measure(self, plant: ControlledPlant, time: float) -> None:
        """Take a sample of the sensors."""
        before, elapsed = self.q_meas, plant.control_period or time - self.time
        q_meas, v_meas = list(plant.q), list(plant.v)
        for i, (rho, q_noise, v_noise) in enumerate(zip(plant.q_resolution, plant.q_noise, plant.v_noise)):
            q_meas[i] = rounded(q_meas[i], rho)
            if q_noise or v_noise:
                of_q, of_v = normal_pair(plant.seed, self.k, i)
                q_meas[i] += q_noise * of_q
                v_meas[i] += v_noise * of_v
            if plant.v_from_q:
                v_meas[i] = (q_meas[i] - before[i]) / elapsed if self.k else 0.0
        self.q_meas, self.v_meas, self.time, self.k = q_meas, v_meas, time, self.k + 1


def advance_sampled(plant: ControlledPlant, h: float) -> None:
    """Advance a plant's q, v and samples by h seconds, from one sample or change of effort to the next.

    Raises:
        FloatingPointError: an effort or rate is not finite.
        StepError: the motion is too fast.
    """
    t, end, stops, budget = plant.time, plant.time + h, plant.stops(), Budget()
    length, last = h, False
    while not last:
        plant.sampling = plant.sampling.settled(plant, t)
        next_event = plant.sampling.next_event(plant)
        last = not next_event < end - slack(plant, end)
        if not last or t != plant.time:
            length = (end if last else next_event) - t
        settings = plant.rtol, plant.atol, plant.max_step, plant.integrator
        plant.q, plant.v = advance(
            plant.equations_of_motion(), plant.q, plant.v, length, stops, *settings, budget=budget
        )
        t = next_event


def rounded(q: float, resolution: float) -> float:
    """Return a number rounded to multiples of a resolution, ties to even; 0: the number itself."""
    steps = q / resolution if resolution else inf
    return resolution * round(steps) if abs(steps) < WHOLE else q


def slack(plant: ControlledPlant, time: float) -> float:
    """Return the tolerance for equal times, s; 0 without samples."""
    return min(TIME_TOLERANCE * max(1.0, abs(time)), PART_OF_PERIOD * float(plant.control_period))


def sampling_refusal(plant: ControlledPlant, of_points: bool) -> str:
    """Return why the parameters of sampling are invalid, or "" if they are valid.

    Args:
        of_points: whether sensors without a control_period are sampled at communication points.
    """
    period, delay = plant.control_period, plant.control_delay
    if delay and not period:
        return f"control_delay = {delay:g} needs a control_period > 0; set that, or leave it out"
    if delay > MOST_PERIODS * period * (1.0 + 1e-12):  # 0.11 is more than ten times 0.011 in binary numbers
        return (
            f"control_delay = {delay:.12g} must be at most {MOST_PERIODS} times control_period = {period:.12g};"
            " reduce it, or increase control_period"
        )
    sensors = {"q_resolution": plant.q_resolution, "q_noise": plant.q_noise, "v_noise": plant.v_noise}
    given = [f"{group}[{i + 1}] = {x:g}" for group, values in sensors.items() for i, x in enumerate(values) if x]
    if plant.v_from_q and given and given[-1].startswith("v_noise"):
        return f"{given[-1]} has no effect with v_from_q = true; leave one of them out"
    given += ["v_from_q = true"] if plant.v_from_q else []
    if given and not period and not of_points:
        return f"{given[0]} needs a control_period > 0; set that, or leave it out"
    return ""
