"""Joints whose holding effort is at its bound up to rounding, while others slip, in both flavours.

The joints are prismatic and in a line, so that accelerations are rational numbers, and each motion is a parabola.
"""

from __future__ import annotations

import functools
import itertools
import random
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest
from native_models import Engine, from_urdf

START, H = Fraction(1, 8), 0.01


def chain(n: int) -> str:
    """The URDF of n links of 1 kg in a line."""
    links = "".join(
        f'<link name="l{i}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        f'</inertial></link><joint name="j{i}" type="prismatic"><parent link="l{i - 1}"/><child link="l{i}"/>'
        '<axis xyz="1 0 0"/><limit lower="-10" upper="10" effort="0" velocity="0"/></joint>'
        for i in range(1, n + 1)
    )
    return f'<robot name="chain"><link name="l0"/>{links}</robot>'


@functools.cache
def line(n: int) -> Engine:
    return Engine(from_urdf(chain(n), f"l{n}", "x", "effort"))


@dataclass
class Case:
    """A chain that moves from START.

    Attributes:
        v, friction, armature: of the joints.
        stopped: joints at their lower limits.
        tau: efforts.
    """

    v: list[Fraction]
    friction: list[Fraction]
    armature: list[Fraction]
    stopped: list[bool]
    tau: list[Fraction]

    @property
    def n(self) -> int:
        return len(self.v)

    def mass_matrix(self) -> list[list[Fraction]]:
        n = self.n
        return [[Fraction(n - max(i, j)) + self.armature[i] * (i == j) for j in range(n)] for i in range(n)]

    def motion(self, mode: tuple[int, ...]) -> tuple[list[Fraction], list[Fraction]]:
        """q̈ in a mode, which has the direction of slip or of motion of each joint, and 0 at rest; and λ at rest."""
        M, moves = self.mass_matrix(), [i for i, direction in enumerate(mode) if direction]
        known = [tau - F * direction for tau, F, direction in zip(self.tau, self.friction, mode)]
        a = [Fraction(0)] * self.n
        for i, x in zip(moves, solution([[M[i][j] for j in moves] for i in moves], [known[i] for i in moves])):
            a[i] = x
        return a, [sum(map(Fraction.__mul__, row, a), -effort) for row, effort in zip(M, known)]

    def acceleration(self) -> list[Fraction]:
        """q̈ in the only mode that meets the conditions of friction and stops; modes that tie have the same q̈."""
        choices = [(sign(v),) if v else (0, 1, -1) for v in self.v]
        for mode in itertools.product(*choices):
            a, effort = self.motion(mode)
            if all(self._is_met(i, mode[i], a[i], effort[i]) for i, v in enumerate(self.v) if not v):
                return a
        raise AssertionError

    def _is_met(self, i: int, direction: int, a: Fraction, effort: Fraction) -> bool:
        if direction:
            return direction * a >= 0 and not (self.stopped[i] and direction < 0)
        return -self.friction[i] <= effort and (self.stopped[i] or effort <= self.friction[i])

    def expected(self, h: float) -> list[float]:
        """q and v after h, with no further event."""
        a, t = self.acceleration(), Fraction(h)
        q = [START + v * t + rate * t * t / 2 for v, rate in zip(self.v, a)]
        return [*map(float, q), *(float(v + rate * t) for v, rate in zip(self.v, a))]

    def found(self, h: float, *, python: bool) -> list[float]:
        """The same by a flavour."""
        of = line(self.n)
        plant = of.model.plant()
        plant.gravity, plant.rigid_stops, plant.q_start = [0.0] * 3, True, [float(START)] * self.n
        plant.q_min = [float(START) if stopped else -10.0 for stopped in self.stopped]
        plant.v_start, plant.friction, plant.armature, plant.tau_cmd = (
            [float(x) for x in values] for values in (self.v, self.friction, self.armature, self.tau)
        )
        plant.initialise()
        if python:
            plant.step(h)
            return [*plant.q, *plant.v]
        values = of.values(plant)
        assert of.call("advance", values, h) == 1, of.failure()
        return [*of.group(values, "q"), *of.group(values, "v")]


def sign(x: Fraction) -> int:
    return (x > 0) - (x < 0)


def solution(A: list[list[Fraction]], b: list[Fraction]) -> list[Fraction]:
    """x of A x = b, for a positive definite A."""
    rows = [[*row, x] for row, x in zip(A, b)]
    for k, pivot in enumerate(rows):
        pivot[:] = [x / pivot[k] for x in pivot]
        for other in rows:
            if other is not pivot:
                other[:] = [x - other[k] * y for x, y in zip(other, pivot)]
    return [row[-1] for row in rows]


def fractions(*values: float | str) -> list[Fraction]:
    return list(map(Fraction, values))


def random_case(seed: int) -> Case:
    """A chain whose joints with v = 0 need efforts at a bound of friction or a stop, or in the middle."""
    rng = random.Random(seed)
    n = rng.choice([2, 3, 4, 5])
    v = fractions(*(rng.choice([-1, 0.5, 1, 0, 0]) for _ in range(n)))
    v[rng.randrange(n)] = Fraction(1)
    case = Case(
        v=v,
        friction=fractions(*(rng.choice([0, 0, 1, 2, 0.5]) for _ in range(n))),
        armature=fractions(*(rng.choice([0, 0, 1]) for _ in range(n))),
        stopped=[not speed and rng.random() < 0.7 for speed in v],
        tau=fractions(*(rng.choice([-3, -2, -1, 0, 1, 2, 3]) for _ in range(n))),
    )
    _, effort = case.motion(tuple(map(sign, v)))
    for i in range(n):
        if not v[i]:
            case.tau[i] += effort[i] - rng.choice([-1, -1, 0, 1]) * case.friction[i]
    return case


THREE = Case(
    fractions(0.5, 0.5, 0), fractions(2, 1, 0), fractions(0, 1, 0), [False, False, True], fractions(-2, 1, "-4/5")
)
FOUR = Case(
    fractions(0, 0.5, 0, 0),
    fractions(1, 1, 0, 0),
    fractions(0, 0, 0, 0),
    [False, False, True, True],
    fractions(3, 2, "2/3", "1/3"),
)


@pytest.mark.parametrize("python", [False, True])
@pytest.mark.parametrize("h", [H, 1e-6])
@pytest.mark.parametrize("case", [THREE, FOUR])
def test_a_joint_rests_at_its_stop_without_load(case, h, python):
    np.testing.assert_allclose(case.found(h, python=python), case.expected(h), rtol=0, atol=1e-14)
    assert case.acceleration()[-1] == 0


@pytest.mark.parametrize(("python", "count"), [(False, 300), (True, 60)])
def test_efforts_at_their_bounds_are_right(python, count):
    for seed in range(count):
        case = random_case(seed)
        found = case.found(H, python=python)
        np.testing.assert_allclose(found, case.expected(H), rtol=0, atol=1e-12, err_msg=f"seed {seed}")
