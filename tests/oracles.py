"""Closed forms with which tests compare, independent of the package."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

LINK = 0.15
REST = {"ur5": (0.1, -1.2, 1.4, -0.6, -1.3, 0.2), "panda": (0.1, -0.5, 0.2, -1.8, 0.1, 1.6, 0.3)}
"""Start positions away from singularities."""


def position(q: np.ndarray) -> np.ndarray:
    """End effector of the two-link arm, m; q of shape (..., 2)."""
    a, b = q[..., 0], q[..., 0] + q[..., 1]
    return LINK * np.stack([np.cos(a) + np.cos(b), np.sin(a) + np.sin(b)], axis=-1)


def jacobian(q: np.ndarray) -> np.ndarray:
    a, b = q[0], q[0] + q[1]
    return LINK * np.array([[-np.sin(a) - np.sin(b), -np.sin(b)], [np.cos(a) + np.cos(b), np.cos(b)]])


def drift(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    a, b = q[0], q[0] + q[1]
    va, vb = v[0] ** 2, (v[0] + v[1]) ** 2
    return -LINK * np.array([np.cos(a) * va + np.cos(b) * vb, np.sin(a) * va + np.sin(b) * vb])


def task_error(e0: np.ndarray, kp: float, kd: float, t: np.ndarray) -> np.ndarray:
    """e(t) of ë + kd ė + kp e = 0 with e(0) = e0, ė(0) = 0; shape (len(t), len(e0))."""
    l1, l2 = np.roots([1.0, kd, kp]).astype(complex)
    if abs(l1 - l2) < 1e-9:
        shape = (1.0 - l1 * t) * np.exp(l1 * t)
    else:
        shape = (l1 * np.exp(l2 * t) - l2 * np.exp(l1 * t)) / (l1 - l2)
    return np.real(shape)[:, None] * np.asarray(e0)


class TwoLinkArm:
    """Mass matrix and nonlinear effects of a planar two-link arm in the textbook form.

    Source: Spong, Hutchinson & Vidyasagar, "Robot Modeling and Control", 2nd ed., section 7.3.2, extended to centres of
    mass off the links' axes. Masses and inertias are those of the URDF.
    """

    def __init__(self, urdf: Path, gravity: float) -> None:
        self.gravity = gravity
        links = {link.get("name"): link.findall("inertial/*") for link in ET.parse(urdf).iter("link")}
        self.links = []
        for name in ("link1", "link2"):
            inertial = {part.tag: part.attrib for part in links[name]}
            x, y, _ = map(float, inertial["origin"]["xyz"].split())
            mass, izz = float(inertial["mass"]["value"]), float(inertial["inertia"]["izz"])
            self.links.append((mass, x, y, izz))

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        (m1, x1, y1, i1), (m2, x2, y2, i2) = self.links
        c = LINK * (x2 * np.cos(q[1]) - y2 * np.sin(q[1]))
        r1, r2 = x1**2 + y1**2, x2**2 + y2**2
        m22 = m2 * r2 + i2
        m12 = m22 + m2 * c
        m11 = m1 * r1 + i1 + m2 * LINK**2 + m22 + 2 * m2 * c
        return np.array([[m11, m12], [m12, m22]])

    def nonlinear_effects(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        (m1, x1, y1, _), (m2, x2, y2, _) = self.links
        h = m2 * LINK * (-x2 * np.sin(q[1]) - y2 * np.cos(q[1]))  # dM11/dq2 / 2
        a, b = q[0], q[0] + q[1]
        g = self.gravity
        g2 = m2 * g * (x2 * np.cos(b) - y2 * np.sin(b))
        g1 = m1 * g * (x1 * np.cos(a) - y1 * np.sin(a)) + m2 * g * LINK * np.cos(a) + g2
        coriolis = np.array([2 * h * v[0] * v[1] + h * v[1] ** 2, -h * v[0] ** 2])
        return coriolis + np.array([g1, g2])
