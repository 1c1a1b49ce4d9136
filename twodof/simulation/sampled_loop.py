"""Stability of a sampled controller of a joint or a direction of the task, in closed form."""

from math import sqrt

import numpy as np

COARSE, MOST, FINE = 0.9, 66, 12  # ratio of bandwidths in a search, their number, and bisections after it


def spectral_radius(Kp: float, Kd: float, period: float, delay: float, *, differences: bool = False) -> float:
    """Return the spectral radius of q̈ = −Kp q − Kd q̇ between periods of a sampled controller with a delay.

    The loop is stable if it is less than 1; friction, limits and errors of the model are not counted. The state is q, q̇
    and q of the sample before, then the commands on their way, the latest first. For Kp = 0 it is the radius of q̇: the
    change of q since the sample before replaces q. A command holds for a period
    (zero-order hold with delay: Åström, Wittenmark, "Computer-Controlled Systems", 1997, section 2.3).

    Args:
        Kp, Kd: gains, 1/s², 1/s.
        period, delay: of the controller, s.
        differences: whether velocities are differences of positions.
    """
    whole = round(delay // period + (period - delay % period < 1e-9))
    part = delay - whole * period
    step = np.zeros((4 + whole, 4 + whole))
    command = np.zeros(4 + whole)
    has_position = float(Kp != 0.0)
    command[:3] = (-Kp - Kd / period, 0.0, has_position * Kd / period) if differences else (-Kp, -Kd, 0.0)
    oldest, next_one = np.eye(4 + whole)[3 + whole], command if whole == 0 else np.eye(4 + whole)[2 + whole]
    rest = period - part
    step[0] = (
        [has_position, period, *[0.0] * (2 + whole)] + oldest * (part * rest + part**2 / 2) + next_one * rest**2 / 2
    )
    step[1] = [0.0, 1.0, *[0.0] * (2 + whole)] + oldest * part + next_one * rest
    step[2, 0], step[3] = 1.0, command
    step[4:, 3:-1] = np.eye(whole)
    return float(np.abs(np.linalg.eigvals(step)).max())


def stable_gains(
    Kp: float, Kd: float, period: float, delay: float, *, differences: bool = False
) -> tuple[float, float]:
    """Return the largest stable gains Kp and Kd below those given, which are unstable, at the same damping ratio.

    Return zeros if gains with a thousandth of the bandwidth √Kp give none. Arguments: as above.
    """

    def stable(scale: float) -> bool:
        return spectral_radius(scale**2 * Kp, scale * Kd, period, delay, differences=differences) < 1.0

    low = next((scale for scale in COARSE ** np.arange(1.0, MOST) if stable(scale)), 0.0)
    high = low / COARSE
    for _ in range(FINE if low else 0):
        middle = sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low**2 * Kp, low * Kd


def quickest_gains(
    Kp: float, Kd: float, period: float, delay: float, *, differences: bool = False
) -> tuple[float, float]:
    """Return the gains Kp and Kd of the same damping ratio, below those given, whose errors decay the quickest.

    The ratio of the bandwidths is exact to a hundredth. Arguments: as above.
    """

    def radius(scale: float) -> float:
        return spectral_radius(scale**2 * Kp, scale * Kd, period, delay, differences=differences)

    best = min(COARSE ** np.arange(1.0, MOST), key=radius)
    scale = min(best * np.linspace(COARSE, 1.0 / COARSE, 2 * FINE), key=radius)
    return scale**2 * Kp, scale * Kd
