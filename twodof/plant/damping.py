"""The exact solution of the damped motion M v̇ = −D v, with M as at one position.

With V M Vᵀ = 1 and V D Vᵀ = diag(s), the velocity c in each mode, one row of V, decays on its own:

    ċ = −s c        c = V M v        v = Vᵀ c

An acceleration a at first, in the modes, and no change of v̇ but that of the damping, give

    v(t) = v + Vᵀ t φ₁(s t) a        φ₁(z) = (1 − exp(−z))/z
    q(t) = q + t v + Vᵀ t² φ₂(s t) a        φ₂(z) = (1 − φ₁(z))/z
"""

from typing import NamedTuple

import numpy as np

from .dormand_prince import Array

SERIES = 1e-3
"""Below it, the series of φ₂ is more precise than the difference."""
UNSEEN = 10.0
"""A mode decays before the stages of an integration step if the cube of rate times step exceeds it."""


class Modes(NamedTuple):
    """Modes of the damped motion, one a row: rates s, n values, 1/s; V and V M, n × n."""

    rate: Array
    V: Array
    VM: Array

    def decay(self, v: Array, a: Array, t: float) -> tuple[Array, Array]:
        """Return the change of (q, v) after t, and its rate there.

        Args:
            v: velocity at first.
            a: acceleration at first, in the modes.
            t: time, s.
        """
        n, z = len(v), self.rate * t
        first, second = _phi(z)
        change = np.concatenate([t * v + (t * t * second * a) @ self.V, (t * first * a) @ self.V])
        return change, np.concatenate([v + change[n:], ((1.0 - z * first) * a) @ self.V])

    def excursions(self, v: Array, a: Array, t: float) -> Array:
        """Return bounds on the distances that the joints move within t, n values.

        Each mode decays, and is accelerated by the efforts of other causes.

        Args:
            v, a: velocities and accelerations of the joints at first.
            t: time, s.
        """
        first, second = _phi(self.rate * t)
        speed = self.VM @ v
        most = t * first * np.abs(speed) + t * t * second * np.abs(self.VM @ a + self.rate * speed)
        distances: Array = most @ np.abs(self.V)
        return distances

    def seen(self, step: float) -> Array:
        """Return the shares of the modes' decays that the stages of an integration step see."""
        return UNSEEN / (UNSEEN + (self.rate * step) ** 3)


def _phi(z: Array) -> tuple[Array, Array]:
    """Return φ₁ and φ₂."""
    first = np.divide(-np.expm1(-z), z, out=np.ones(len(z)), where=z > 0.0)
    series = 0.5 - z * (1.0 / 6 - z * (1.0 / 24 - z / 120))
    return first, np.divide(1.0 - first, z, out=series, where=z > SERIES)


def find_modes(mobility: Array, damping: Array) -> Modes:
    """Return the modes of M⁻¹, n × n, and the damping D, n values, N·m·s/rad or N·s/m."""
    B = np.linalg.cholesky(mobility)  # B Bᵀ = M⁻¹, so the columns of B are orthonormal by M
    _, sigma, Vt = np.linalg.svd(np.sqrt(damping)[:, np.newaxis] * B)
    return Modes(sigma**2, Vt @ B.T, np.linalg.solve(B.T, Vt.T).T)
