"""Inertias of links as in a URDF, as second moments of mass, and as dynamic parameters of bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ..plant.urdf import Urdf

Array = NDArray[np.float64]
INERTIA = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
"""Attributes of <inertia>, and their indices in the matrix."""


def inertia_of(second: NDArray[Any]) -> NDArray[Any]:
    """Return the inertia of second moments of mass Σ: tr(Σ) 1 − Σ."""
    return np.asarray(np.trace(second) * np.eye(3) - second)


def second_moments(inertia: Array) -> Array:
    """Return the second moments of mass Σ of an inertia: tr(I)/2 1 − I."""
    return np.asarray(0.5 * np.trace(inertia) * np.eye(3) - inertia)


def dynamic_parameters(mass: Any, com: Any, second: Any, R: Array, p: Array) -> NDArray[Any]:
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
        copy.inertias[body + 1] = pin.Inertia.FromDynamicParameters(ten)
    return copy


def moving_links(urdf: Urdf, model: pin.Model) -> tuple[list[str], list[int], list[pin.SE3], list[pin.Inertia]]:
    """Return the moving links with mass: names, bodies, poses in these, and inertias in the links' frames."""
    names, bodies, places, inertias = [], [], [], []
    for element in urdf.tree.findall("link"):
        name = str(element.get("name"))
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        inertial = element.find("inertial")
        if not frame.parentJoint or inertial is None:
            continue
        mass = inertial.find("mass")
        tensor = inertial.find("inertia")
        if mass is None or tensor is None or not float(mass.get("value", 0.0)):
            continue
        about = np.empty((3, 3))
        for key, (row, column) in INERTIA.items():
            about[row, column] = about[column, row] = float(tensor.get(key, 0.0))
        place = inertial_place(inertial)
        names.append(name)
        bodies.append(frame.parentJoint - 1)
        places.append(frame.placement)
        inertias.append(place.act(pin.Inertia(float(mass.get("value", 0.0)), np.zeros(3), about)))
    return names, bodies, places, inertias


def inertial_place(inertial: Any) -> pin.SE3:
    """Return the pose of an <inertial> element's frame in its link's frame."""
    origin = inertial.find("origin")
    xyz, rpy = ("0 0 0" if origin is None else origin.get(key, "0 0 0") for key in ("xyz", "rpy"))
    x, r = (np.array([float(word) for word in text.split()]) for text in (xyz, rpy))
    return pin.SE3(pin.rpy.rpyToMatrix(*r), x)
