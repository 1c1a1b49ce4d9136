"""Inertias of links as in a URDF, as second moments of mass, and as dynamic parameters of bodies."""

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ..plant.urdf import INERTIA

Array = NDArray[np.float64]
Numbers = NDArray[Any]  # real numbers, or complex ones for derivatives


def inertia_of(second: Numbers) -> Numbers:
    """Return the inertia of second moments of mass Σ: tr(Σ) 1 − Σ."""
    return np.asarray(np.trace(second) * np.eye(3) - second)


def second_moments(inertia: Array) -> Array:
    """Return the second moments of mass Σ of an inertia: tr(I)/2 1 − I."""
    return np.asarray(0.5 * np.trace(inertia) * np.eye(3) - inertia)


def dynamic_parameters(mass: Numbers, com: Numbers, second: Numbers, R: Array, p: Array) -> Numbers:
    """Return m, m c and the inertia about the origin of a body that is placed in another frame."""
    c = R @ com + p
    about_origin = inertia_of(R @ second @ R.T + mass * np.outer(c, c))
    xx, xy, xz, yy, yz, zz = (about_origin[place] for place in INERTIA.values())
    return np.array([mass, *(mass * c), xx, xy, yy, xz, yz, zz])


def model_with(model: pin.Model, inertial: Array, gravity: Array) -> pin.Model:
    """Return a copy of a model with the dynamic parameters of its bodies, and the gravity, m/s²."""
    copy = model.copy()
    copy.gravity.linear = gravity
    for body, ten in enumerate(inertial.reshape(-1, 10)):
        copy.inertias[body + 1] = pin.Inertia.FromDynamicParameters(ten) if ten.any() else pin.Inertia.Zero()
    return copy
