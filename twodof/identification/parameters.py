"""Free parameters of a fit, and their physical values as a function of coordinates.

Each coordinate is unconstrained, or has the lower bound 0, and each of its values gives a physically possible robot:

    mass     m = exp(x)
    inertia  I = tr(Σ) 1 − Σ,  Σ = L Lᵀ,  L triangular with diagonal exp(x): the second moments of mass about the
             centre are positive definite, which with m > 0 is the condition on the pseudo-inertia
    gain     exp(x)
    gravity  two tilts of its direction; its magnitude is kept
    friction, damping, armature, payload: the value itself, at least 0

Source: Wensing, Kim, Slotine, "Linear matrix inequalities for physically consistent inertial parameter
identification", IEEE RA-L 3, 2018.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, choice
from ..plant.robot import Robot, moving_links
from ..plant.urdf import INERTIA, Urdf
from .inertials import Numbers, dynamic_parameters, inertia_of, second_moments

Array = NDArray[np.float64]
OF_JOINTS = {
    "friction": ("N.m", "N"),
    "damping": ("N.m.s/rad", "N.s/m"),
    "armature": ("kg.m2", "kg"),
    "offset": ("rad", "m"),
    "gain": ("", ""),
    "bias": ("N.m", "N"),
}
"""Units of rotating and of sliding joints."""
OF_THE_ROBOT = ("payload", "payload_com", "gravity")
OF_MOTION = ("friction", "damping", "armature")
OF_THE_SETUP = ("gravity", "offset", "gain", "bias")
EXPONENTS, BOUNDED = ("mass", "gain"), ("friction", "damping", "armature", "payload")
"""Groups of values exp(x), and groups of values that are at least 0."""
SIZES = {"com": 3, "payload_com": 3, "inertia": 6, "gravity": 2}  # number of coordinates, where it is not 1
SCALES = {"mass": 1.0, "gain": 1.0, "gravity": 0.5, "com": 0.1, "payload_com": 0.1, "offset": 0.2}
"""Scales of coordinates that do not depend on the robot: deviations so large that the coordinate would be unknown."""
ROWS, COLUMNS = np.tril_indices(3)
LEAST_MOMENT = 1e-3  # fraction of m·(5 cm)²: smallest initial second moments of mass of a free inertia
LEAST_PAYLOAD = 0.1
"""Fraction of the moving mass: smallest initial payload if its position is free. From a smaller one, a first step that
reduces the load would end at a payload of 0, whose position has no effect."""
SEEN = 0.5  # the data determine a direction if its standard deviation is below this fraction of the parameters' scales


@dataclass
class Values:
    """Physical values of all parameters of a robot with n joints and k links that move and have mass."""

    friction: Numbers  # friction, damping, armature: values of the joints, n each
    damping: Numbers
    armature: Numbers
    offset: Numbers  # true minus measured position, rad or m, n
    gain: Numbers  # ratio of true to recorded effort, n
    bias: Numbers  # constant part of the effort, N·m or N, n
    mass: Numbers  # masses of links, kg, k
    com: Numbers  # centres of mass in the links' frames, m, k × 3
    second: Numbers  # second moments of mass about the centre, in the links' axes, kg·m², k × 3 × 3
    payload: Numbers  # point mass in the task frame, kg, 1
    payload_com: Numbers  # position of the payload in the task frame, m, 3
    gravity: Numbers  # m/s², root frame, 3

    def copy(self, kind: type) -> Values:
        """Return a copy with numbers of a type, float or complex."""
        return Values(*(np.array(getattr(self, field.name), kind) for field in fields(self)))


class Dynamics(NamedTuple):
    """Parameters of inverse dynamics, or their derivatives with respect to the coordinates along a last axis."""

    # ten dynamic parameters of each body about its joint's frame, in Pinocchio's order, 10·bodies; bodies are what
    # joints move, with all links that are rigidly joined
    inertial: Numbers
    friction: Numbers  # friction, damping, armature, offset, gain, bias, gravity: as in ``Values``
    damping: Numbers
    armature: Numbers
    offset: Numbers
    gain: Numbers
    bias: Numbers
    gravity: Numbers


class Free(NamedTuple):
    """Free parameters of one joint or link: group, index of joint or link, names and units of the values."""

    group: str
    number: int
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return SIZES.get(self.group, 1)

    def of(self, values: Values) -> Numbers:
        """Return a view of its values; for an inertia, of the second moments of mass."""
        whole: Numbers = getattr(values, "second" if self.group == "inertia" else self.group)
        return whole if self.group in OF_THE_ROBOT else whole[self.number, ...]


class Parameters:
    """The free parameters of a robot: their names, and the map from coordinates to values.

    Attributes:
        robot: the robot.
        links, bodies, places: names of the moving links with mass, the body of which each is a part, and its pose in
            this body.
        given, start: values of all parameters in the URDF, and the start values of the coordinates.
        free: the free parameters.
        names, units: names and units of their values.

    Args:
        patterns: names or shell patterns.
        gravity: initial gravity, m/s².

    Raises:
        InputError: a pattern matches nothing, or there is none.
    """

    def __init__(self, urdf: Urdf, robot: Robot, patterns: Sequence[str], gravity: Sequence[float]) -> None:
        self.robot, model = robot, robot.model
        n = len(robot.joints)
        self.links, self.bodies, self.places, inertias = moving_links(urdf, model)
        self.start = Values(
            friction=np.array(robot.friction),
            damping=np.array(robot.damping),
            armature=np.zeros(n),
            offset=np.zeros(n),
            gain=np.ones(n),
            bias=np.zeros(n),
            mass=np.array([inertia.mass for inertia in inertias]),
            com=np.array([inertia.lever for inertia in inertias]).reshape(-1, 3),
            second=np.array([second_moments(inertia.inertia) for inertia in inertias]).reshape(-1, 3, 3),
            payload=np.zeros(1),
            payload_com=np.zeros(3),
            gravity=np.array(gravity, float),
        )
        frame = model.frames[robot.frame_id]
        self._end = frame.parentJoint - 1, frame.placement
        known = self._known()
        names = [name for name, _ in known]
        chosen: set[str] = set()
        for pattern in patterns:
            # brackets are part of names, not of patterns
            matches = fnmatch.filter(names, pattern.replace("[", "[[]"))
            if not matches:
                group = [name for name in names if "[" in name and name.startswith(pattern.partition("[")[0] + "[")]
                joints = f"; there are: {', '.join(group)}, of joints {', '.join(robot.joints)}" if group else ""
                raise InputError(f"`free` '{pattern}' matches no parameter{joints or choice(pattern, names)}")
            chosen.update(matches)
        self.free = [free for name, free in known if name in chosen]
        if not self.free:
            raise InputError("`free` names no parameter")
        self.given = self.start.copy(float)
        self._settle()
        self.names = tuple(name for free in self.free for name in free.names)
        self.units = tuple(unit for free in self.free for unit in free.units)

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the coordinates, without the axes."""
        names = (free.group if free.group in OF_THE_ROBOT else free.names[0].partition(".")[0] for free in self.free)
        return tuple(name for free, name in zip(self.free, names) for _ in range(free.size))

    @property
    def varying(self) -> NDArray[np.int64]:
        """Indices of the inertial parameters of the bodies that the free parameters change."""
        bodies = {self.bodies[free.number] for free in self.free if free.group in ("mass", "com", "inertia")}
        if any(free.group in ("payload", "payload_com") for free in self.free):
            bodies.add(self._end[0])
        return np.array([10 * body + k for body in sorted(bodies - {-1}) for k in range(10)], np.int64)

    def with_friction(self, moving: NDArray[np.bool_]) -> Parameters:
        """Free friction, damping and armature of the joints that move, and none of their parameters that do not."""
        more = copy(self)
        known = (free for _, free in self._known() if free in self.free or free.group in OF_MOTION)
        more.free = [free for free in known if free.group not in (*OF_MOTION, "bias") or moving[free.number]]
        return more

    def with_errors(self, x: Array) -> tuple[Parameters, Array, NDArray[np.bool_]]:
        """Free all of OF_THE_SETUP in addition; return the parameters, their coordinates, and which of them are new."""
        more = copy(self)
        more.free = [free for _, free in self._known() if free in self.free or free.group in OF_THE_SETUP]
        new = np.concatenate([np.full(free.size, free not in self.free) for free in more.free])
        coordinates = np.zeros(len(new))
        coordinates[~new] = x
        return more, coordinates, new

    def _known(self) -> list[tuple[str, Free]]:
        """Return all parameters: the name that a pattern matches, and the parameters."""
        known = []
        for group, units in OF_JOINTS.items():
            for i, (joint, slides) in enumerate(zip(self.robot.joints, self.robot.prismatic)):
                name = f"{group}:{joint}" if group in ("offset", "gain", "bias") else f"{group}[{i + 1}]"
                known.append((name, Free(group, i, (name,), (units[slides],))))
        for i, link in enumerate(self.links):
            com = tuple(f"com:{link}.{axis}" for axis in "xyz")
            inertia = tuple(f"inertia:{link}.{key}" for key in INERTIA)
            known.append((f"mass:{link}", Free("mass", i, (f"mass:{link}",), ("kg",))))
            known.append((f"com:{link}", Free("com", i, com, ("m",) * 3)))
            known.append((f"inertia:{link}", Free("inertia", i, inertia, ("kg.m2",) * 6)))
        known.append(("payload", Free("payload", 0, ("payload",), ("kg",))))
        for group, unit in (("payload_com", "m"), ("gravity", "m/s2")):
            known.append((group, Free(group, 0, tuple(f"{group}[{k}]" for k in (1, 2, 3)), (unit,) * 3)))
        return known

    def _settle(self) -> None:
        """Move start values away from the boundary of possible robots, at which coordinates are infinite."""
        start, groups = self.start, [free.group for free in self.free]
        moving = float(start.mass.sum())
        if "payload_com" in groups:
            if "payload" not in groups:
                raise InputError("`free` 'payload_com' needs 'payload', which is 0")
            start.payload[:] = max(float(start.payload[0]), LEAST_PAYLOAD * moving)
        for free in self.free:
            if free.group == "inertia":
                values, vectors = np.linalg.eigh(start.second[free.number])
                least = LEAST_MOMENT * 0.05**2 * max(start.mass[free.number], 1e-3 * moving)
                start.second[free.number] = (vectors * np.maximum(values, least)) @ vectors.T

    def coordinates(self, typical: Mapping[str, Array]) -> tuple[Array, Array, Array]:
        """Return the coordinates of the start values, their lower bounds, and their scales.

        Args:
            typical: typical friction, damping and armature of each joint, n each.
        """
        x: list[float] = []
        low: list[float] = []
        for free in self.free:
            own = np.ravel(free.of(self.start)).tolist()
            if free.group in EXPONENTS:
                own = np.log(own).tolist()
            elif free.group == "inertia":
                factor = np.linalg.cholesky(free.of(self.start))
                factor[range(3), range(3)] = np.log(np.diag(factor))
                own = factor[ROWS, COLUMNS].tolist()
            elif free.group == "gravity":
                own = [0.0, 0.0]
            x += own
            low += [0.0 if free.group in BOUNDED else -inf] * free.size
        return np.array(x), np.array(low), np.concatenate([self._scale(free, typical) for free in self.free])

    def _scale(self, free: Free, typical: Mapping[str, Array]) -> Array:
        """Return the scale of each coordinate of a parameter."""
        if free.group == "inertia":
            return np.where(ROWS == COLUMNS, 1.0, np.sqrt(np.trace(free.of(self.start))))
        if free.group == "payload":
            return np.array([self.start.mass.sum()])
        own = SCALES[free.group] if free.group in SCALES else typical[free.group][free.number]
        return np.full(free.size, float(own))

    def values(self, x: Numbers) -> Values:
        """Return the physical values at coordinates, which may be complex for derivatives."""
        values, place = self.start.copy(x.dtype.type), 0
        for free in self.free:
            self._set(free, free.of(values), x[place : place + free.size])
            place += free.size
        return values

    def _set(self, free: Free, own: Numbers, part: Numbers) -> None:
        """Set the values of a parameter from its coordinates."""
        if free.group in EXPONENTS:
            own[...] = np.exp(part[0])
        elif free.group == "inertia":
            factor = np.zeros((3, 3), part.dtype)
            factor[ROWS, COLUMNS] = part
            factor[range(3), range(3)] = np.exp(np.diag(factor))
            own[:] = factor @ factor.T
        elif free.group == "gravity":
            g = self.start.gravity
            axes = np.linalg.svd(g[None])[2][1:]
            length = np.linalg.norm(g)
            own[:] = (g + length * (part @ axes)) / np.sqrt(1.0 + part @ part)
        else:
            own[...] = part if own.ndim else part[0]

    def reported(self, values: Values) -> Numbers:
        """Return the values of the named parameters."""
        return np.concatenate([_reported(free.of(values)) for free in self.free])

    def dynamics(self, values: Values) -> Dynamics:
        """Return the parameters of inverse dynamics for given values."""
        out = np.zeros(10 * (self.robot.model.njoints - 1), values.mass.dtype)
        for link in (*range(len(self.links)), None):
            body, ten = self._ten(values, link)
            if body >= 0:
                out[10 * body : 10 * body + 10] += ten
        return Dynamics(out, *(getattr(values, field) for field in Dynamics._fields[1:]))

    def _ten(self, values: Values, link: int | None) -> tuple[int, Numbers]:
        """Return the body and the ten dynamic parameters of a link, or of the payload, in the frame of its joint."""
        if link is None:
            (body, place), own = self._end, (values.payload[0], values.payload_com, np.zeros((3, 3)))
        else:
            body, place = self.bodies[link], self.places[link]
            own = values.mass[link], values.com[link], values.second[link]
        return body, dynamic_parameters(*own, place.rotation, place.translation)

    def rates(self, x: Array) -> tuple[Array, Dynamics]:
        """Return the exact derivatives of reported values and dynamics in the coordinates, by complex steps.

        A step changes the numbers of one parameter alone, and so only these are computed: a robot may have 1000 links.
        """
        step, values, column, row = 1e-30, self.values(x.astype(complex)), 0, 0
        rates = Dynamics(*(np.zeros((*each.shape, len(x))) for each in self.dynamics(self.start)))
        reported = np.zeros((sum(len(free.names) for free in self.free), len(x)))
        for free in self.free:
            own, rows, columns = free.of(values), len(free.names), slice(column, column + free.size)
            before = own.copy()
            for part, k in zip(x[columns] + 1j * step * np.eye(free.size), range(column, columns.stop)):
                self._set(free, own, part)
                reported[row : row + rows, k] = _reported(own).imag / step
                if free.group in Dynamics._fields:
                    getattr(rates, free.group)[..., k] = getattr(values, free.group).imag / step
                    continue
                body, ten = self._ten(values, None if free.group in OF_THE_ROBOT else free.number)
                if body >= 0:
                    rates.inertial[10 * body : 10 * body + 10, k] = ten.imag / step
            own[...] = before
            column, row = columns.stop, row + rows
        return reported, rates


def _reported(own: Numbers) -> Numbers:
    """Return the named values of a parameter; of second moments of mass, those of the inertia."""
    return np.array([inertia_of(own)[place] for place in INERTIA.values()]) if own.ndim == 2 else own.ravel()
