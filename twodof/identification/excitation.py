"""Design of an experiment: a motion within a robot's limits from which a fit is most precise.

Each joint follows a Fourier series, and begins and ends at rest in the middle of its range, without acceleration:

    v(t) = Σ a_k cos(kωt) + b_k sin(kωt),  ω = 2π/T,  Σ a_k = 0,  Σ k b_k = 0

The coefficients minimise the determinant of the covariance of the parameters (a D-optimal design).

Source: Swevers, Ganseman, Tükel, De Schutter, Van Brussel, "Optimal robot excitation and identification",
IEEE Transactions on Robotics and Automation 13(5), 1997.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import differential_evolution

from ..bag.trajectory_bag import write_trajectory
from ..errors import InputError
from ..files import refusing, write_file
from ..plant.robot import Robot
from ..plant.urdf import UNBOUNDED
from ..signatures import with_keywords_of
from .curves import efforts
from .estimate import DELAY_SCALE, FIRST_NOISE, PRIOR, typical
from .fit_result import check_folder
from .fitting import ModelOptions, read_model
from .parameters import Parameters
from .recording_checks import GRAVITY
from .regression import Rows, information_root, position_derivatives, regressors
from .stretches import Array, Stretch

if TYPE_CHECKING:
    from typing_extensions import Unpack

LOG = logging.getLogger(__name__)
SHORTEST, LONGEST = 5.0, 120.0  # s
HARMONICS, HIGHEST = 6, 1.0  # number of harmonics of a joint, and the highest frequency, Hz
MARGIN = 0.9  # part of the limits that the motion uses, because efforts are those of the URDF's masses
REACH, SPEED = np.pi, 2.0
"""Range to both sides, rad or m, and speed, rad/s or m/s, of joints that have no limits in the URDF."""
COARSE, FINE = 0.1, 0.002  # time between samples of the design and of the result, s
POINTS = 5  # samples from one point of a trajectory to the next, between which it is quintic
CANDIDATES, GENERATIONS, BOUND = 30, 60, 6.0
"""Number of random motions from which the search begins, its steps, and the bound of its coefficients."""
MOST_WORK = 4e9  # work of a search, some minutes: samples × joints × p (p + 20) of each evaluation, for p parameters
HALVINGS = 8  # bisections of the size of a motion to the effort limits


class Excitation(NamedTuple):
    """A motion to record for a fit.

    Attributes:
        joints: names of the robot's n joints.
        t: time, s, N.
        q, v, a: positions, rad or m, and their derivatives, N × n.
        factor: median width of intervals with random motions, relative to this motion; geometric mean over directions.
    """

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array
    a: Array
    factor: float

    def save(self, path: str | Path) -> Path:
        """Write the motion, and return its path: as inputs for joint control if it ends in .csv, else as a bag.

        The bag has one JointTrajectory on the topic of ROS 2's joint_trajectory_controller.

        Raises:
            InputError: the file or folder cannot be written, or the folder exists.
        """
        path = Path(path)
        with refusing(InputError, f"write '{path}'"):
            if path.suffix == ".csv":
                heads = [f"{group}[{i + 1}]" for group in ("q_des", "v_des", "a_des") for i in range(len(self.joints))]
                rows = np.column_stack([self.t, self.q, self.v, self.a]).round(9).tolist()
                lines = [",".join(["time", *heads]), *(",".join(map(repr, row)) for row in rows)]
                write_file(path, ("\n".join(lines) + "\n").encode())
            else:
                few = slice(None, None, POINTS)
                write_trajectory(
                    check_folder(path), self.joints, *(each[few] for each in (self.t, self.q, self.v, self.a))
                )
        return path


class _Design:
    """Motions of a robot within its limits, and the covariance of a fit to them.

    Attributes:
        shape: shape of the coefficients a and b: n × 2 × harmonics.
        relative: size of coefficients that give all harmonics the same amplitude of the position.
    """

    def __init__(self, robot: Robot, speed: Sequence[float], parameters: Parameters, seconds: float) -> None:
        self._robot, self._parameters, self._seconds = robot, parameters, seconds
        self._values = parameters.dynamics(parameters.given)
        self._harmonics = np.unique(np.geomspace(1.0, seconds * HIGHEST, HARMONICS).round())
        self.shape, self.relative = (len(robot.joints), 2, len(self._harmonics)), self._harmonics / self._harmonics[-1]
        low, high = np.array(robot.q_min), np.array(robot.q_max)
        limited = (low > -UNBOUNDED) & (high < UNBOUNDED)
        self._middle = np.where(limited, 0.5 * (low + high), 0.0)
        self._reach = MARGIN * np.where(limited, 0.5 * high - 0.5 * low, REACH)
        self._speed = MARGIN * np.where(np.isfinite(speed), speed, SPEED)
        self._effort = MARGIN * np.array(robot.effort)
        for joint, reach in zip(robot.joints, self._reach):
            if not reach > 0.0:
                raise InputError(
                    f"joint '{joint}', with the joints that mimic it, has a range of 0 in the URDF: correct the limits,"
                    " or `lock` it"
                )
        still = self._sampled(np.zeros(self.shape), COARSE)
        for joint, effort, most in zip(robot.joints, np.abs(still.tau[0]), self._effort):
            if effort >= most:
                raise InputError(
                    f"the effort limit of joint '{joint}' does not hold the robot in the middle of its range:"
                    f" {effort:.3g} of {most:.3g} N·m; correct the limit or the masses in the URDF"
                )

    def refer(self, stretch: Stretch) -> None:
        """Take scales of the parameters and noise of the efforts from a motion."""
        scales = self._parameters.coordinates(typical([stretch]))
        self._z, self._scales = np.append(scales[0], 0.0), np.append(scales[2], DELAY_SCALE)
        self._noise = FIRST_NOISE * np.sqrt(np.mean(stretch.tau**2, axis=0))

    def motion(self, coefficients: Array, step: float) -> Stretch:
        """Return the motion, scaled to the largest one whose samples are within the limits, in samples of a step, s."""
        shape = coefficients.reshape(self.shape).copy()
        _, q, v, _ = self._moved(shape, min(step, COARSE / 4.0))
        off = np.abs(q - self._middle).max(axis=0) / self._reach
        shape /= np.maximum(off, np.abs(v).max(axis=0) / self._speed)[:, None, None]
        low, high = 0.0, 2.0
        for _ in range(HALVINGS):
            part = 0.5 * (low + high)
            if (np.abs(self._sampled(part * shape, step).tau) <= self._effort).all():
                low = part
            else:
                high = part
            if low == 1.0:
                break
        return self._sampled(low * shape, step)

    def _sampled(self, shape: Array, step: float) -> Stretch:
        t, q, v, a = self._moved(shape, step)
        moving, band = np.ones(q.shape, bool), np.full(len(shape), 0.5 / step)
        stretch = Stretch(0, t, q, q, v, a, np.zeros_like(q), moving, band)
        return stretch._replace(tau=efforts(self._robot, self._values, stretch))

    def _moved(self, shape: Array, step: float) -> tuple[Array, Array, Array, Array]:
        """Return times, positions and their derivatives."""
        k, t = self._harmonics, np.asarray(step * np.arange(round(self._seconds / step) + 1), np.float64)
        w = 2.0 * np.pi * k / self._seconds
        a = shape[:, 0] - shape[:, 0].mean(axis=1, keepdims=True)
        b = shape[:, 1] - np.outer(shape[:, 1] @ k, k / (k @ k))
        cos, sin = np.cos(np.outer(t, w)), np.sin(np.outer(t, w))
        q = self._middle + (sin / w) @ a.T + ((1.0 - cos) / w) @ b.T
        return t, q, cos @ a.T + sin @ b.T, (cos * w) @ b.T - (sin * w) @ a.T

    def _covariance(self, stretch: Stretch) -> Array:
        """Return the covariance of the coordinates, in their scales."""
        varying = self._parameters.varying
        Y, G = regressors(self._robot, stretch, self._values, varying)
        offsets = any(free.group == "offset" for free in self._parameters.free)
        turning = position_derivatives(self._robot, self._values, stretch, offsets)
        rate, none = np.gradient(stretch.tau, stretch.step, axis=0), np.zeros(len(Y), np.int64)
        signals = np.stack([np.sign(stretch.v), stretch.v, stretch.a, np.ones_like(rate), stretch.tau, rate])
        about = self._values.offset, 0.0
        rows = []
        for i, (sign, v, a, one, tau, tau_rate) in enumerate(signals.transpose(2, 0, 1)):
            gravity = G[:, :, i].swapaxes(0, 1)
            own = sign, v, a, one, tau, tau_rate, turning[:, i], rate, none, tau  # `rate`: it has no unmodelled errors
            rows.append(Rows(i, varying, Y[:, i], gravity, *own, about))
        sd = [np.full(len(Y), noise) for noise in self._noise]
        J = information_root(self._parameters, rows, sd, self._z) * self._scales
        return np.asarray(np.linalg.inv(J.T @ J + PRIOR**-2 * np.eye(len(self._z)))[:-1, :-1])

    def cost(self, coefficients: Array) -> float:
        """Return the mean logarithm of the standard deviations in all directions."""
        covariance = self._covariance(self.motion(coefficients, COARSE))
        return float(0.5 * np.linalg.slogdet(covariance)[1] / len(covariance))


def _generations(seconds: float, joints: int, parameters: int) -> int:
    """Return the number of steps of a search of limited work; the candidates are evaluated twice before."""
    work = seconds / COARSE * joints * parameters * (parameters + 20)
    generations = min(GENERATIONS, int(MOST_WORK / work) // CANDIDATES - 2)
    if generations < 1:
        raise InputError(
            f"a motion of {seconds:g} s for {parameters} parameters of {joints} joints takes too long to design;"
            " `free` fewer parameters, or `lock` joints"
        )
    if generations < GENERATIONS:
        LOG.warning(
            f"the search for the motion ends after {generations} of {GENERATIONS} steps, because {parameters}"
            f" parameters of {joints} joints take long; with fewer parameters the motion may be better"
        )
    return generations


@with_keywords_of(read_model)
def excite(
    urdf: str | Path,
    seconds: float,
    free: str | Sequence[str],
    *,
    output: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[ModelOptions],
) -> Excitation:
    """Design a motion within the limits of the URDF whose recording gives the most precise fit.

    Collisions are not considered. The design is the same on each call. For many joints and parameters the search ends
    early, with a warning.

    Args:
        urdf, free, frame, lock, gravity, progress: as for ``fit``; ``gravity`` None: (0, 0, −9.81).
        seconds: duration, s.
        output: .csv file, or new folder of a bag, as for ``save``; None: nothing is written.

    Raises:
        InputError: the duration is out of range, a pattern matches no parameter, there are too many parameters, an
            effort limit does not hold the robot, or the output cannot be written.
        BuildError: the URDF cannot be read.
    """
    if not SHORTEST <= seconds <= LONGEST:
        raise InputError(f"a motion of {seconds:g} s is not possible: between {SHORTEST:g} and {LONGEST:g} s")
    if output is not None and Path(output).suffix != ".csv":
        check_folder(output)
    model = read_model(urdf, free, **options)
    gravity = options.get("gravity")
    parameters, robot = model.parameters(GRAVITY if gravity is None else tuple(gravity)), model.robot
    generations = _generations(seconds, len(robot.joints), len(parameters.free))
    known = model.locked.joints.values()
    own = [[j.velocity / abs(j.ratio) for j in known if j.ratio and j.leader == name] for name in robot.joints]
    design = _Design(robot, [min(each) for each in own], parameters, seconds)
    rng = np.random.default_rng(0)
    candidates = (rng.normal(size=(CANDIDATES, *design.shape)) * design.relative).reshape(CANDIDATES, -1)
    design.refer(design.motion(candidates[0], COARSE))
    costs = np.array([design.cost(each) for each in candidates])
    steps = count(1)

    def finished(intermediate_result: object) -> None:
        if progress:
            progress(next(steps), generations)

    best = differential_evolution(
        design.cost, [(-BOUND, BOUND)] * candidates.shape[1], init=candidates, maxiter=generations, tol=0.0,
        mutation=(0.3, 0.7), recombination=0.5, polish=False, rng=rng, callback=finished,
    )  # fmt: skip
    motion, factor = design.motion(best.x, FINE), float(np.exp(np.median(costs) - best.fun))
    result = Excitation(robot.joints, motion.t, motion.q, motion.v, motion.a, factor)
    if output is not None:
        result.save(output)
    return result
