"""Make the meshes of the default robot, a planar arm of two links, and its mass properties.

    python meshes/make_meshes.py [FOLDER]

writes link1.stl, link2.stl (visual) and link1_collision.stl, link2_collision.stl (convex) to
FOLDER, by default this one, and prints the <inertial> of each link for urdf/2dof.urdf.

Frames: each link in its joint's frame, z the joint axis, x to the next joint or the tool tip,
150 mm away. Link 1 lies below the plane z = 0 and link 2 above it, so they pass each other at
any angle; the tip of the pen that link 2 carries is the end effector, (150, 0, 0).
Units: millimetres in this script; metres and kilograms in the files and in what is printed.
"""

import sys
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

DENSITY = 2700.0  # kg/m3, aluminium
LENGTH = 150.0

Outline = list[complex]  # corners x + iy, counter-clockwise seen from +z
Shape = Callable[[float], Outline]  # an outline pulled in by so much
Chain = Sequence[tuple[Outline, float]]  # outlines of as many corners each, and their heights


def arc(centre: complex, r: float, angles: np.ndarray) -> Outline:
    """Return points of a circle, to the nanometre: a sine's last digits depend on the machine."""
    return np.round(centre + r * np.exp(1j * angles), 6).tolist()


def circle(centre: complex, r: float, n: int = 32) -> Shape:
    """Return a circle of n corners."""
    return lambda d: arc(centre, r - d, 2 * np.pi / n * np.arange(n))


def slot(x0: float, r0: float, x1: float, r1: float, n: int = 18) -> Shape:
    """Return two arcs of n corners and their common tangents."""
    end = np.pi / 2 - np.arcsin((r0 - r1) / (x1 - x0))
    front, back = np.linspace(-end, end, n), np.linspace(end, 2 * np.pi - end, n)
    return lambda d: arc(x1, r1 - d, front) + arc(x0, r0 - d, back)


def wall(shape: Shape, base: float, top: float, radius: float) -> Chain:
    """Return a wall with a rounded edge at the top."""
    turn = radius * (1 - np.exp(1j * np.pi / 6 * np.arange(4)))
    return [(shape(0), base), *((shape(t.real), top - radius - t.imag) for t in turn)]


def triangulate(outer: Outline, holes: Iterable[Outline]) -> list[list[complex]]:
    """Join the holes to the outline where they are closest, then cut off ears, small ones first."""

    def area(a: complex, b: complex, c: complex) -> float:  # doubled; negative if clockwise
        return ((b - a).conjugate() * (c - a)).imag

    def distance(a: complex, b: complex) -> float:  # rounded for ties to be ties on any machine
        return round(abs(a - b), 6)

    ring, holes, ears = list(outer), [hole[::-1] for hole in holes], []
    while holes:
        pairs = [(i, j, h) for h in holes for i in range(len(ring)) for j in range(len(h))]
        i, j, hole = min(pairs, key=lambda p: distance(ring[p[0]], p[2][p[1]]))
        ring[i:i] = [ring[i], *hole[j:], *hole[: j + 1]]
        holes.remove(hole)
    while len(ring) > 2:
        corners = [[ring[i - 2], ring[i - 1], ring[i]] for i in range(len(ring))]
        for i in sorted(range(len(ring)), key=lambda i: distance(corners[i][0], corners[i][2])):
            a, b, c = corners[i]
            others = [p for p in ring if p not in corners[i]]
            if area(a, b, c) > 0.01 and not any(  # no sliver, and no other corner inside
                min(area(a, b, p), area(b, c, p), area(c, a, p)) > -1e-6 for p in others
            ):
                break
        else:
            raise ValueError("the outlines of a face cross or touch")
        ears.append(corners[i])
        del ring[i - 1]
    return ears


class Body:
    """A closed surface. Heights count from z = middle: up on side 1, down on side -1."""

    def __init__(self, middle: float) -> None:
        self.middle = middle
        self.triangles: list[list[tuple[float, float, float]]] = []

    def skin(self, side: int, chain: Chain) -> Outline:
        """Join each outline to the next, from the body outwards; the first, a hole in a face."""
        for (low, h0), (high, h1) in pairwise(chain):
            for a, b, c, d in zip(low, low[1:] + low[:1], high[1:] + high[:1], high):
                self._add(side, (a, b, c), (h0, h0, h1))
                self._add(side, (a, c, d), (h0, h1, h1))
        return chain[0][0]

    def boss(self, side: int, chain: Chain, holes: Iterable[Outline] = ()) -> Outline:
        """Return the skin closed by a face with these holes: a raised or sunk boss."""
        for triangle in triangulate(chain[-1][0], holes):
            self._add(side, triangle, [chain[-1][1]] * 3)
        return self.skin(side, chain)

    def hub(self, side: int, x: float, r: float, base: float, top: float) -> Outline:
        """Return a joint's boss: hexagon sockets around a shaft in its bearing."""
        screws = arc(x, 0.77 * r, np.pi / 3 * (np.arange(6) + 0.5))
        sockets = [circle(screw, 0.13 * r, 6)(0) for screw in screws]
        shaft = self.boss(side, wall(circle(x, 0.36 * r), top - 1.5, top + 0.5, 0.8))
        bearing = circle(x, 0.55 * r)(0)
        holes = [self.boss(side, [(bearing, top), (bearing, top - 1.5)], [shaft])]
        holes += [self.boss(side, [(socket, top), (socket, top - 2)]) for socket in sockets]
        return self.boss(side, wall(circle(x, r), base, top, 1.5), holes)

    def facets(self) -> np.ndarray:
        """Return triangles in metres as an STL file holds them."""
        return (np.array(self.triangles) / 1000 + 0.0).astype("<f4")  # + 0.0: no minus zeros

    def _add(self, side: int, corners: Iterable[complex], heights: Iterable[float]) -> None:
        triangle = [(p.real, p.imag, self.middle + side * h) for p, h in zip(corners, heights)]
        if len(set(triangle)) == 3:  # a chain may end in a point
            self.triangles.append(triangle[::side])


def link1() -> Body:
    """Return a plate with a hub, a seat for link 2 and a pocket with lightening bores on both faces."""
    body, pocket = Body(-14), slot(42, 16, 114, 12.5)
    bores = [circle(x, r, 24)(0) for x, r in ((42, 11), (67, 9.6), (90, 8.4), (111.5, 7.4))]
    for side in (1, -1):
        holes = [body.skin(side, [(bore, 3.5), (bore, 0)]) for bore in bores]
        holes = [body.boss(side, [(pocket(0), 8), (pocket(1), 3.5)], holes)]
        holes.append(body.hub(side, 0, 22, 8, 13))
        holes.append(body.boss(side, wall(circle(LENGTH, 16), 8, 13, 1)))
        body.boss(side, wall(slot(0, 26, LENGTH, 20), 0, 8, 3), holes)
    return body


def link2() -> Body:
    """Return a plate with two slots, standing on the elbow with a column and holding a pen."""
    body, barrel = Body(20), circle(LENGTH, 5)
    slots = slot(36, 9, 70, 7.6, 14), slot(92, 6.8, 124, 5.4, 14)
    for side in (1, -1):
        holes = [body.skin(side, [(s(0), 6), (s(1), 5), (s(1), 0)]) for s in slots]
        if side > 0:
            pen = body.boss(side, wall(barrel, 9, 22, 2))
            holes.append(body.hub(side, 0, 16.5, 6, 11))
        else:
            tip = [(barrel(0), 9), (barrel(0), 11), (barrel(4), 19), (barrel(5), 20)]
            pen = body.skin(side, tip)
            holes.append(body.boss(side, wall(circle(0, 15), 6, 19, 1)))
        holes.append(body.boss(side, wall(circle(LENGTH, 8.5), 6, 9, 1), [pen]))
        body.boss(side, wall(slot(0, 20, LENGTH, 12), 0, 6, 2.5), holes)
    return body


def hull(r0: float, r1: float, middle: float, half: float, height: float, slope: float) -> Body:
    """Return a convex body around a link: a plate that narrows by slope towards its hubs and pen."""
    wider = 1 / np.cos(np.radians(12))  # for long chords to stay outside the arcs of r0 and r1
    body, edge = Body(middle), slot(0, r0 * wider, LENGTH, r1 * wider, 10)
    for side in (1, -1):
        body.boss(side, [(edge(0), 0), (edge(0), half), (edge(slope), height)])
    return body


def inertial(facets: np.ndarray) -> str:
    """Return the URDF <inertial>, exact: a sum over the tetrahedra of each facet and a common corner.

    With edges a, b, c from that corner, s = a + b + c and the signed volume V = det(a, b, c) / 6,
    the integrals of 1, r and r r^T are V, V s / 4 and V (s s^T + a a^T + b b^T + c c^T) / 20.
    """
    facets = facets.astype(float)
    masses = DENSITY * np.linalg.det(facets) / 6
    com = masses @ facets.sum(axis=1) / 4 / masses.sum()
    edges = facets - com
    vectors = np.concatenate([edges, edges.sum(axis=1, keepdims=True)], axis=1)
    parts = DENSITY * np.linalg.det(edges) / 120
    second = np.einsum("t,tki,tkj->ij", parts, vectors, vectors)
    moments = np.trace(second) * np.eye(3) - second
    named = zip(["xx", "xy", "xz", "yy", "yz", "zz"], moments[np.triu_indices(3)].tolist())
    inertia = " ".join(f'i{axes}="{moment!r}"' for axes, moment in named)
    return f"""    <inertial>
      <origin xyz="{" ".join(map(repr, com.tolist()))}" rpy="0 0 0"/>
      <mass value="{float(masses.sum())!r}"/>
      <inertia {inertia}/>
    </inertial>"""


def write_stl(path: Path, facets: np.ndarray) -> None:
    """Write a binary STL: a header of 80 bytes, the count, and 50 bytes a triangle."""
    a, b, c = facets.astype(float).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.sqrt((normals**2).sum(axis=1, keepdims=True))
    records = np.zeros(len(facets), [("normal and corners", "<f4", (4, 3)), ("unused", "<u2")])
    records["normal and corners"] = np.concatenate([normals[:, None] + 0.0, facets], axis=1)
    count = len(facets).to_bytes(4, "little")
    path.write_bytes(b"Binary STL, metres".ljust(80) + count + records.tobytes())


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    write_stl(folder / "link1_collision.stl", hull(26, 20, -14, 8, 13.5, 2).facets())
    write_stl(folder / "link2_collision.stl", hull(20, 12, 21, 7, 21, 3).facets())
    for name, link in (("link1", link1()), ("link2", link2())):
        write_stl(folder / f"{name}.stl", link.facets())
        print(f"{name}: {len(link.triangles)} triangles, density {DENSITY:g} kg/m3")
        print(inertial(link.facets()))
