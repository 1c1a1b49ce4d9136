"""Parts of an error that are due to forces and to the motion, from the equations of the controlled robot.

    M q̈_cmd + h_known − s = τ,    q̈_cmd = J⁺ (a − J̇ v + Kn J v) − Kn v,    a = Kp e + Kd (ẋ_des − J v) + ẍ_des
    id(q̈) = τ + tau_ext + Jᵀ f_ext − D v + r

id is the inverse dynamics of the robot with its payload, and id_known that of the controller's model. s is the effort
that a saturated motor lacks, and r are the reactions of friction and of stops. Elimination of τ gives e as a sum of one
term for each force and one for the motion:

    e = Kp⁻¹ ((J q̈ + J̇ v + Kd J v) − Kd ẋ_des − ẍ_des + (I − J J⁺) (a − J̇ v)
              + J M⁻¹ (id(q̈) − id_known(q̈) − tau_ext − Jᵀ f_ext + D v − r + s))

Friction first balances the loads at its joint. Under joint control J is the identity and J̇ is 0. The part of a term c
in the error is c·e / e·e; all parts add up to 1.
Source: Siciliano, Sciavicco, Villani & Oriolo, "Robotics", 2009, sections 8.5.2 and 8.6.2.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ..geometry.dynamics import Dynamics, rotation_error
from ..plant.variables import EXACT
from .controller_causes import PERIODS, payloads
from .judge import AT_LIMIT, Judge
from .setup import Array

CLOSED = 0.1  # part of the error that may remain without a cause
HOLDING = 1.001  # reaction of friction at rest relative to its bound, beyond rounding
LOOKED_AT = 9  # samples of the last quarter
PARAMETERS = ("gravity", "armature", "payload", "payload_com")  # of plant and controller
LAWS = {
    "x": ("Kp", "Kd", "xd_des", "xdd_des"),
    "quat": ("Kp_rot", "Kd_rot", "omega_des", "alpha_des"),
    "q": ("Kp", "Kd", "v_des", "a_des"),
}
Key = tuple[str, str]
"""A kind of cause, or "motion", and the joint or the input concerned, or ""."""


class Parts(NamedTuple):
    """Parts of the errors of the missed outputs late in a run.

    Attributes:
        of: part of each cause, averaged over the outputs; empty if the equations of the robot are unknown, or if more
            than CLOSED remains without a cause.
        static: magnitude of the error that would remain without the motion, by output, m or rad.
    """

    of: Mapping[Key, float]
    static: Mapping[str, float]


UNKNOWN = Parts({}, {})


def parts_of_error(judge: Judge, missed: Sequence[str]) -> Parts:
    """Return the part that each cause has in the errors of the missed outputs late in the run."""
    setup, gravity = judge.setup, judge.given("gravity")
    lawful = not judge.held.get("limit_effort") and not any(map(setup.starts.get, PERIODS))  # the effort is the law's
    efforts = len(judge.end("tau")) == len(setup.joints) or lawful
    others = any(judge.held.get(name, value) != value for name, value in setup.links.items())  # not the URDF's inertias
    if not missed or setup.robot is None or not efforts or len(gravity) != 3 or others:
        return UNKNOWN
    known = setup.frame in setup.robot.links and {*setup.joints} <= setup.robot.joints.keys()
    n = len(setup.joints)
    sizes = {"x": len(setup.rows), "quat": 3, "q": n}
    expected = {group: sizes[name] for name in judge.aims for group in LAWS[name]}
    expected |= {"tau_ext": n, "f_ext": 3, "damping": n, "friction": n, "armature": n, "payload_com": 3}
    if not known or any(len(judge.given(group)) != size for group, size in expected.items()):
        return UNKNOWN  # another FMU gives some of the values
    models = _models(judge)
    owner = [name for name in judge.aims for _ in judge.given(LAWS[name][0])]
    rows = {name: np.array([of == name for of in owner]) for name in missed}
    static = dict[str, float]()
    wholes, parts = dict.fromkeys(missed, 0.0), {name: defaultdict[Key, float](float) for name in missed}
    balances = [_Balance(judge, models, *sample) for sample in _late(judge)]
    try:
        every = [[*balance.terms()] for balance in balances]
    except np.linalg.LinAlgError:  # rounding makes a mass matrix singular, as under a gravity of 1e30 m/s²
        return UNKNOWN
    for balance, terms in zip(balances, every):
        for name, own in rows.items():
            wholes[name] += float(balance.e[own] @ balance.e[own])
            for key, term in terms:
                parts[name][key] += float(term[own] @ balance.e[own])
            still = [term[own] for (kind, _), term in terms if kind != "motion"]
            static[name] = float(np.linalg.norm(sum(still))) if not static.get(name) else static[name]
    if not all(wholes.values()):
        return UNKNOWN
    mean = defaultdict[Key, float](float)
    for name, own_parts in parts.items():
        for key, part in own_parts.items():
            mean[key] += part / wholes[name] / len(missed)
    return Parts(mean, static) if abs(1.0 - sum(mean.values())) <= CLOSED else UNKNOWN


def _models(judge: Judge) -> dict[str, Dynamics]:
    """Return the plant's model under "", and models with one more of the controller's parameters each."""
    own = judge.setup.controller
    payload, believed = payloads(judge)
    values: dict[str, Any] = {name: judge.given(name) for name in ("gravity", "payload_com", "armature")}
    values["payload"] = payload
    known = {name: judge.given(own + name) if own else values[name] for name in values}
    known["payload"] = believed
    models, made, urdf = {}, dict[str, Dynamics](), judge.setup.robot
    assert urdf is not None
    for changed in ("", *PARAMETERS):
        if changed:
            values[changed] = known[changed]
        key = str(values)
        made[key] = made.get(key) or Dynamics(
            urdf, judge.setup.joints, judge.setup.frame, values["gravity"], values["payload"], values["payload_com"],
            values["armature"],
        )  # fmt: skip
        models[changed] = made[key]
    return models


def _late(judge: Judge) -> Iterator[tuple[Array, Array, Array]]:
    """Yield q, v and τ at samples of the last quarter of the run, but after the last change of a target.

    For a moving target, they are samples of the second half.
    """
    q, v, tau = (judge.history(name) for name in ("q", "v", "tau"))
    begin = 0.5 * judge.duration if judge.moving else max(judge.changed, 0.75 * judge.duration)
    since = int(np.searchsorted(judge.history(), begin))
    yield judge.end("q"), judge.end("v"), judge.end("tau")
    for k in np.linspace(min(since + 1, len(q)), len(q), LOOKED_AT - 1, endpoint=False).astype(int):
        if k < len(q):
            yield q[k], v[k], tau[k]


class _Balance:
    """The balance of forces at one sample.

    Attributes:
        e: errors of all outputs with a target, m and rad.
    """

    def __init__(self, judge: Judge, models: Mapping[str, Dynamics], q: Array, v: Array, tau: Array) -> None:
        self._judge, self._models, self._known = judge, models, models[PARAMETERS[-1]]
        self._q, self._v, self._tau = q, v, tau
        known = self._known
        x, rotation, rows, drift = known.observe(q, v)
        axes, errors, gains = [], [], []
        for name in judge.aims:
            axes += {"x": judge.setup.rows, "quat": [3, 4, 5]}.get(name, [])
            wanted = judge.wanted(name)
            errors.append(
                rotation_error(wanted, rotation)
                if name == "quat"
                else wanted - (q if name == "q" else x[judge.setup.rows])
            )
            gains.append([judge.given(group) for group in LAWS[name]])
        self.e = np.concatenate(errors)
        self._Kp, self._Kd, self._xd, self._xdd = (np.concatenate(column) for column in zip(*gains))
        self._force = rows[:3]
        self._J = rows[axes] if axes else np.eye(len(q))
        self._drift = drift[axes] if axes else np.zeros(len(q))

    def terms(self) -> Iterator[tuple[Key, Array]]:
        """Yield the terms of e, m and rad, with their causes."""
        judge, J, v, Kp, Kd = self._judge, self._J, self._v, self._Kp, self._Kd
        inverse = np.divide(1.0, Kp, out=np.zeros(len(Kp)), where=Kp > 0.0)
        rate, Kn = J @ v, float(judge.held.get("Kn", 0.0))
        wanted = Kp * self.e + Kd * (self._xd - rate) + self._xdd - self._drift
        pseudo = np.linalg.pinv(J, float(judge.setup.starts.get("rcond", 0.0)))
        command = self._known.inverse_dynamics(self._q, v, pseudo @ (wanted + Kn * rate) - Kn * v)
        tau = self._tau if self._tau.size else command  # bags may have no efforts
        a, reaction = self._motion(tau)
        yield ("motion", ""), inverse * (J @ a + self._drift + Kd * rate)
        yield from self._feedforward(inverse)
        yield ("singularity", ""), inverse * (wanted - J @ (pseudo @ wanted))
        to_error = inverse[:, None] * (J @ np.linalg.inv(self._known.mass_matrix(self._q)))
        efforts = [*self._netted(a, reaction), *self._shortages(command, tau)]
        free = Kp == 0.0
        if not free.any():
            yield from ((key, to_error @ effort) for key, effort in efforts)
            return
        # without a gain, the initial error stays, and forces share the rest of the error by their accelerations
        first = np.concatenate([w if len(w := judge.aims[n].way) else self.e[self._own(n)] for n in judge.aims])
        to_rate = J @ np.linalg.inv(self._known.mass_matrix(self._q))
        rates = np.array([to_rate @ effort for _, effort in efforts])
        whole, least = rates.sum(axis=0), 0.01 * np.abs(rates).sum(axis=0)  # forces in balance move nothing
        share = np.divide(self.e - first, whole, out=np.zeros(len(Kp)), where=free & (np.abs(whole) > least))
        yield ("gain", ""), np.where(free & (share != 0.0), first, np.where(free, self.e, 0.0))
        for key, effort in efforts:
            yield key, to_error @ effort + share * (to_rate @ effort)

    def _own(self, name: str) -> slice:
        """Return the rows of an output."""
        sizes = [len(self._judge.given(LAWS[each][0])) for each in self._judge.aims]
        first = sum(sizes[: [*self._judge.aims].index(name)])
        return slice(first, first + len(self._judge.given(LAWS[name][0])))

    def _feedforward(self, inverse: Array) -> Iterator[tuple[Key, Array]]:
        for name in self._judge.aims:
            _, _, velocity, acceleration = LAWS[name]
            own = np.zeros(len(self.e))
            own[self._own(name)] = 1.0
            yield ("feedforward", velocity), -inverse * own * self._Kd * self._xd
            yield ("feedforward", acceleration), -inverse * own * self._xdd

    def _external(self) -> dict[str, Array]:
        given = self._judge.given
        forces = {"tau_ext": given("tau_ext"), "f_ext": self._force.T @ given("f_ext")}
        return {**forces, "damping": -given("damping") * self._v}

    def _motion(self, tau: Array) -> tuple[Array, Array]:
        """Return accelerations, rad/s² or m/s², and reactions of stops and friction, N·m or N.

        A joint at a stop, and one at rest with friction, does not accelerate, unless that needs a stop that pulls or
        more than the friction.
        """
        setup, real, v = self._judge.setup, self._models[""], self._v
        friction = self._judge.given("friction")
        low, high = (np.abs(self._q - bound) <= AT_LIMIT for bound in (setup.low, setup.high))
        M = real.mass_matrix(self._q)
        effort = tau + sum(self._external().values()) - real.inverse_dynamics(self._q, v, np.zeros(len(v)))
        effort -= friction * np.sign(v)
        held = (v == 0.0) & (low | high | (friction > 0.0))
        for _ in setup.joints:
            a, free = np.zeros(len(v)), np.flatnonzero(~held)
            a[free] = np.linalg.solve(M[np.ix_(free, free)], effort[free])
            reaction = M @ a - effort
            pulls = held & ((reaction < -HOLDING * friction) & ~high | (reaction > HOLDING * friction) & ~low)
            if not pulls.any():
                break
            held &= ~pulls
        return a, np.where(held, reaction, -friction * np.sign(v))

    def _loads(self, a: Array) -> Iterator[tuple[Key, Array]]:
        """Yield efforts that the controller does not know, N·m or N."""
        needed = {model: model.inverse_dynamics(self._q, self._v, a) for model in {*self._models.values()}}
        for before, name in pairwise(self._models):
            yield ("load", name), needed[self._models[before]] - needed[self._models[name]]
        for name, effort in self._external().items():
            yield ("load", name), -effort

    def _netted(self, a: Array, reaction: Array) -> list[tuple[Key, Array]]:
        """Return loads and reactions; the friction of a joint balances the loads at it before the controller."""
        loads, reactions = [*self._loads(a)], [*self._reactions(reaction)]
        whole = np.sum([effort for _, effort in loads], axis=0)
        own = np.sum([effort for (kind, _), effort in reactions if kind == "friction"] or [np.zeros(len(a))], axis=0)
        held = np.where(whole * own < 0.0, np.minimum(np.abs(whole), np.abs(own)), 0.0)
        left = [1.0 - np.divide(held, np.abs(x), out=np.zeros(len(a)), where=x != 0.0) for x in (whole, own)]
        loads = [(key, effort * left[0]) for key, effort in loads]
        return loads + [(key, effort * (left[1] if key[0] == "friction" else 1.0)) for key, effort in reactions]

    def _reactions(self, reaction: Array) -> Iterator[tuple[Key, Array]]:
        setup = self._judge.setup
        at_low, at_high = (np.abs(self._q - bound) <= AT_LIMIT for bound in (setup.low, setup.high))
        stops = at_low & (reaction > 0.0) | at_high & (reaction < 0.0)
        for joint, stop, own in zip(setup.joints, stops, -np.diag(reaction)):
            yield ("limit" if stop else "friction", joint), own

    def _shortages(self, command: Array, tau: Array) -> Iterator[tuple[Key, Array]]:
        """Yield the differences between the efforts of the law and those that are applied, N·m or N."""
        setup = self._judge.setup
        saturated = np.abs(tau) >= np.array(setup.limits.effort) * (1.0 - EXACT)
        saturated &= bool(self._judge.held.get("limit_effort"))
        sampled = any(setup.starts.get(name) for name in PERIODS)
        short = np.diag(command - tau)
        for i, joint in enumerate(setup.joints):
            if saturated[i] or sampled:
                yield ("saturation", joint) if saturated[i] else ("sampling", ""), short[i]
