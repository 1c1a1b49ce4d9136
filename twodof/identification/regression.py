"""Inverse dynamics along measured motion as a regression whose rows have independent noise.

    τ_rec(t − delay) = (Y(q, v, q̈) π + F sgn v + D v + armature q̈ + bias)/gain + noise

π are the ten inertial parameters of each body. For each joint and each stretch in which it moves, rows are coefficients
in an orthonormal basis of smooth functions within the band. White noise stays white in this basis, and position noise,
which the second derivative amplifies, is left out. The variance of rows depends on joint and frequency, and is
estimated from the residuals.

Sources: Janot, Vandanjon, Gautier, "A generic instrumental variable approach for industrial robot identification",
IEEE TCST 22, 2014, for the regression; Whittle, "Estimation and information in stationary time series", 1953, for the
likelihood by frequency.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from ..plant.robot import Robot
from .inertials import model_with
from .parameters import Dynamics, Parameters
from .stretches import EDGE, Array, Stretch, means

LEAST_SAMPLES, LONGEST = 12, 400
"""Smallest and largest number of samples of a stretch in which a joint moves; a longer one is divided."""
MOST_RESTING = 40  # means of samples of a stretch in which a joint may rest
EDGES = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Edges of the frequency bins, in each of which noise has one variance, as fractions of the band."""
UNMODELLED = ("drag", "load", "spring", "payload", "filter")
"""Errors that are no parameters, or may not be free: damping by the square of the speed, friction in proportion to the
load, a spring about the mean position, a payload, and a low-pass filter, whose size is half the square of its time
constant, s². The last two are of all joints."""


class Rows(NamedTuple):
    """Rows of one joint."""

    joint: int  # index of the joint
    # indices of the m inertial parameters that vary, of 10·bodies; the others have the URDF's values
    varying: NDArray[np.int64]
    Y: Array  # regressor of the varying inertial parameters without gravity, and the effort of the others, K × (m + 1)
    G: Array  # the same per m/s² of gravity along x, y and z of the root, 3 × K × (m + 1)
    sign: Array  # sign, v, a, one: regressors of friction, damping, armature and bias, K each
    v: Array
    a: Array
    one: Array
    tau: Array  # tau, tau_rate: recorded effort and its derivative, K
    tau_rate: Array
    offsets: Array  # derivative of the inverse dynamics with respect to positions, K × n
    unmodelled: Array  # efforts of each of UNMODELLED of size 1, K × 5
    bin: NDArray[np.int64]  # index of each row's frequency bin, K
    power: Array  # mean square of the recorded effort where each row weighs it, K
    about: tuple[Array, float]  # offsets, n, and delay of the efforts, s, at which the rows were linearised


def regressors(robot: Robot, stretch: Stretch, values: Dynamics, varying: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return Y, N × n × (m + 1), without gravity, and G, N × 3 × n × (m + 1), of gravity along each axis.

    The last column is the effort of the inertial parameters that do not vary.

    Args:
        values: true minus measured positions, and inertial parameters.
        varying: indices of the m inertial parameters that vary.
    """
    model = robot.model.copy()
    data, n = model.createData(), len(robot.joints)
    C = np.eye(n) if robot.coupling is None else robot.coupling
    q, v, a = (stretch.q + values.offset) @ C.T + robot.offset, stretch.v @ C.T, stretch.a @ C.T
    model.gravity.linear = np.zeros(3)
    count = 10 * (model.njoints - 1)
    columns = np.zeros((count, len(varying) + 1))
    columns[varying, range(len(varying))] = 1.0
    columns[:, -1] = values.inertial
    columns[varying, -1] = 0.0
    Y, G = np.empty((len(q), n, len(columns.T))), np.empty((len(q), 3, n, len(columns.T)))
    still = np.zeros(model.nv)
    regressor = pin.computeJointTorqueRegressor
    for k in range(len(q)):  # one joint: Pinocchio has a vector
        Y[k] = C.T @ regressor(model, data, q[k], v[k], a[k]).reshape(-1, count) @ columns
    for axis in range(3):
        model.gravity.linear = np.eye(3)[axis]
        for k in range(len(q)):
            G[k, axis] = C.T @ regressor(model, data, q[k], still, still).reshape(-1, count) @ columns
    return Y, G


def rows_of(
    parameters: Parameters, values: Dynamics, stretches: Sequence[Stretch], delay: float, with_offsets: bool
) -> list[Rows]:
    """Return the rows of each joint that has some, linearised at values of the parameters and a delay of efforts, s."""
    found: list[list[Rows]] = [[] for _ in parameters.robot.joints]
    for stretch in stretches:
        rows_in = projector(parameters, values, stretch, delay, with_offsets)
        for i, rows in enumerate(found):
            for begin, end in _runs(stretch.moving[:, i]):
                # by fading, functions of short stretches would reach beyond the band, into the filter's edge
                frequency = np.arange(end - begin) / (2.0 * (end - begin) * stretch.step)
                keep = max(0, int(np.searchsorted(frequency, stretch.band[i])) - 1)
                if end - begin >= LEAST_SAMPLES and keep:
                    bins = np.searchsorted(EDGES, frequency[:keep] / stretch.band[i], side="right") - 1
                    rows.append(rows_in(i, slice(begin, end), smooth_basis(end - begin, keep), bins))
    return [_joined(rows) for rows in found if rows]


def resting_rows(
    parameters: Parameters, values: Dynamics, stretches: Sequence[Stretch], delay: float
) -> Iterator[tuple[Rows, float, float]]:
    """Yield, for each stretch in which a joint may rest, its row, the variance of its effort, and its middle, s.

    The row is a weighted mean, scaled so that it has the noise of one sample. Its weights fade to 0 at both ends, and
    samples are averaged first: otherwise the noise of positions would be large in the accelerations.
    """
    for stretch in stretches:
        edge = int(np.ceil(EDGE / stretch.step))
        for i in range(len(parameters.robot.joints)):
            for begin, end in _runs(~stretch.moving[:, i]):
                if end - begin > 3 * edge:
                    whole = stretch.part(slice(begin + edge, end - edge))
                    many = -(-len(whole.t) // MOST_RESTING)
                    cut: dict[str, Any] = {name: means(getattr(whole, name), many) for name in ("t", *"qva", "tau")}
                    part = whole._replace(**cut)
                    weights = np.sin(np.pi * (np.arange(len(part.t)) + 0.5) / len(part.t)) ** 2
                    weights *= np.sqrt(many / np.sum(weights**2))
                    rows_in = projector(parameters, values, part, delay, True)
                    row = rows_in(i, slice(None), weights[None], np.zeros(1, np.int64))
                    yield row, float(np.var(whole.tau[:, i])), part.t[len(part.t) // 2]


def projector(
    parameters: Parameters, values: Dynamics, stretch: Stretch, delay: float, with_offsets: bool
) -> Callable[[int, slice, Array, NDArray[np.int64]], Rows]:
    """Return a function that makes rows of a joint from a part of a stretch, in a basis with bins of frequency."""
    robot, varying = parameters.robot, parameters.varying
    Y, G = regressors(robot, stretch, values, varying)
    turning = position_derivatives(robot, values, stretch, with_offsets)
    late = _delayed(stretch, delay)
    rate = np.gradient(late, stretch.step, axis=0)
    joint = np.sign(stretch.v), stretch.v, stretch.a, np.ones_like(rate), late, rate
    load = (Y + np.einsum("g,kgij->kij", values.gravity, G)) @ np.append(values.inertial[varying], 1.0)
    carried = payload_efforts(parameters, values, stretch, with_offsets)
    signals = np.dstack([*joint, *unmodelled(stretch, values, load, carried)])
    size, n = Y.shape[2], len(robot.joints)

    def rows_in(i: int, at: slice, basis: Array, bins: NDArray[np.int64]) -> Rows:
        gravity = (G[at, axis, i] for axis in range(3))
        columns = np.column_stack([Y[at, i], *gravity, turning[at, i], signals[at, i]])
        parts = np.split(basis @ columns, [size, 4 * size, 4 * size + n], axis=1)
        G_rows = parts[1].reshape(len(basis), 3, size).transpose(1, 0, 2)
        sign, v, a, one, tau, tau_rate, *others = parts[3].T
        power = basis**2 @ stretch.tau[at, i] ** 2
        own = sign, v, a, one, tau, tau_rate, parts[2], np.column_stack(others), bins, power
        return Rows(i, varying, parts[0], G_rows, *own, (values.offset, delay))

    return rows_in


def _joined(rows: list[Rows]) -> Rows:
    """Return the rows of all stretches of a joint as one."""
    names = ("Y", "G", "sign", "v", "a", "one", "tau", "tau_rate", "offsets", "unmodelled", "bin", "power")
    parts: dict[str, Any] = {
        name: np.concatenate([getattr(r, name) for r in rows], axis=int(name == "G")) for name in names
    }
    return rows[0]._replace(**parts)


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the begin and the end of each run of True values; long runs are divided."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False])).tolist()
    runs = []
    for begin, end in zip(edges[::2], edges[1::2]):
        cuts = np.linspace(begin, end, -(-(end - begin) // LONGEST) + 1).astype(int).tolist()
        runs += [*pairwise(cuts)]
    return runs


@cache
def smooth_basis(size: int, count: int) -> Array:
    """Return orthonormal rows, count × size: cosines of increasing frequency that fade to 0 at both ends.

    White noise stays white in this basis. The functions begin and end smoothly, so that fast noise does not leak into
    slow rows.
    """
    at = (np.arange(size) + 0.5) / size
    waves = np.cos(np.pi * at[:, None] * np.arange(count)) * np.sin(np.pi * at[:, None]) ** 2
    return np.asarray(np.linalg.qr(waves)[0].T)


def _delayed(stretch: Stretch, delay: float) -> Array:
    """Return the efforts that act at the samples, N × n."""
    if not delay:
        return stretch.tau
    return np.asarray(make_interp_spline(stretch.t, stretch.tau, 3)(np.clip(stretch.t - delay, *stretch.t[[0, -1]])))


def position_derivatives(robot: Robot, values: Dynamics, stretch: Stretch, wanted: bool) -> Array:
    """Return the derivative of the inverse dynamics with respect to positions, N × n × n; 0 if it is not needed."""
    n = len(robot.joints)
    out = np.zeros((len(stretch.t), n, n))
    if not wanted:
        return out
    model = model_with(robot.model, values.inertial, values.gravity)
    data = model.createData()
    C = np.eye(n) if robot.coupling is None else robot.coupling
    q, v, a = (stretch.q + values.offset) @ C.T + robot.offset, stretch.v @ C.T, stretch.a @ C.T
    for k in range(len(q)):
        pin.computeRNEADerivatives(model, data, q[k], v[k], a[k])
        out[k] = C.T @ data.dtau_dq @ C
    return out


def payload_efforts(parameters: Parameters, values: Dynamics, stretch: Stretch, wanted: bool) -> Array:
    """Return the efforts of a payload of 1 kg, N × n; 0 if they are not needed."""
    robot, alone = parameters.robot, parameters.start.copy(float)
    for field in ("mass", "com", "second", "payload_com"):
        getattr(alone, field)[...] = 0.0
    alone.payload[:] = 1.0
    model = model_with(robot.model, parameters.dynamics(alone).inertial, values.gravity)
    data, C = model.createData(), np.eye(len(robot.joints)) if robot.coupling is None else robot.coupling
    out = np.zeros_like(stretch.q)
    q, v, a = (stretch.q + values.offset) @ C.T + robot.offset, stretch.v @ C.T, stretch.a @ C.T
    for k in range(len(q) if wanted else 0):
        out[k] = C.T @ pin.rnea(model, data, q[k], v[k], a[k])
    return out


def unmodelled(stretch: Stretch, values: Dynamics, load: Array, carried: Array) -> list[Array]:
    """Return the efforts, N × n, of each of UNMODELLED of size 1, by those of the links and of a payload of 1 kg.

    A filter of a time constant T changes a smooth effort by a delay and, in the second order, by T²/2 times its second
    derivative. Friction is not smooth.
    """
    v, smooth = stretch.v, load + values.damping * stretch.v + values.armature * stretch.a
    bent = np.gradient(np.gradient(smooth, stretch.step, axis=0), stretch.step, axis=0)
    spring = stretch.q - stretch.q.mean(axis=0)
    return [each / values.gain for each in (v * np.abs(v), np.sign(v) * np.abs(load), spring, carried, bent)]


def residual(rows: Rows, values: Dynamics, delay: float) -> Array:
    """Return the residuals of one joint's rows, N·m or N."""
    return np.asarray(
        rows.tau - (delay - rows.about[1]) * rows.tau_rate - modelled(rows, values) / values.gain[rows.joint]
    )


def modelled(rows: Rows, values: Dynamics) -> Array:
    """Return the effort that the model gives, N·m or N."""
    i = rows.joint
    links = (rows.Y + np.tensordot(values.gravity, rows.G, 1)) @ _inertial(rows, values)
    joint = values.friction[i] * rows.sign + values.damping[i] * rows.v + values.armature[i] * rows.a
    return np.asarray(links + joint + values.bias[i] * rows.one + rows.offsets @ (values.offset - rows.about[0]))


def _inertial(rows: Rows, values: Dynamics) -> Array:
    """Return what the columns of Y and G are multiplied with, m + 1."""
    return np.append(values.inertial[rows.varying], 1.0)


def jacobian(rows: Rows, values: Dynamics, rates: Dynamics) -> Array:
    """Return the derivative of ``residual`` with respect to each coordinate and, last, the delay.

    Args:
        rates: derivatives of the values with respect to the coordinates, which are the last axis.
    """
    i, gain = rows.joint, values.gain[rows.joint]
    columns = (rows.Y + np.tensordot(values.gravity, rows.G, 1))[:, :-1] @ rates.inertial[rows.varying]
    columns += np.einsum("kij,j->ik", rows.G, _inertial(rows, values)) @ rates.gravity + rows.offsets @ rates.offset
    for group, column in (("friction", rows.sign), ("damping", rows.v), ("armature", rows.a), ("bias", rows.one)):
        columns += np.outer(column, getattr(rates, group)[i])
    columns -= np.outer(modelled(rows, values) / gain, rates.gain[i])
    return np.column_stack([-columns / gain, -rows.tau_rate])


def information_root(parameters: Parameters, rows: Sequence[Rows], sd: Sequence[Array], z: Array) -> Array:
    """Return the Jacobian of the whitened residuals with respect to the coordinates and, last, the delay."""
    dynamics = parameters.dynamics(parameters.values(z[:-1]))
    rates = parameters.rates(z[:-1])[1]
    return np.vstack([jacobian(each, dynamics, rates) / s[:, None] for each, s in zip(rows, sd)])


def stretched(rows: Rows, values: Dynamics) -> Array:
    """Return the derivative of ``residual`` with respect to the part by which speeds are too low, by a wrong clock."""
    i = rows.joint
    twice = rows.Y @ _inertial(rows, values) + values.armature[i] * rows.a
    return np.asarray(-(2.0 * twice + values.damping[i] * rows.v) / values.gain[i])
