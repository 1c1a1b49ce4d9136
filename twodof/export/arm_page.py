"""An arm in a page: its robot, and what moves it: its engine, samples of a run, or a server.

All is in the page itself: it asks no network for anything, and its Content-Security-Policy allows
its own script alone. Text from the URDF is in it as JSON, and shown as text.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..files import data_file, packed
from ..geometry.kinematics import Array, Kinematics, Placement
from ..geometry.shapes import Shape, sphere
from ..plant.urdf import UNBOUNDED, Joint, Urdf, read_urdf
from ..version import versions
from .compiler import compile_web_module

SCRIPTS = (
    "engine.js", "samples.js", "session.js", "replay.js", "remote.js", "matrices.js", "robot.js",
    "camera.js", "scene.js", "handle.js", "curves.js", "recording.js", "controls.js", "main.js",
)  # fmt: skip
"""In the order in which they are read."""
FUNCTIONS = (
    "engine_instantiate", "engine_message", "engine_forget", "engine_allocate", "engine_reset",
    "engine_initialise", "engine_set_reals", "engine_set_boolean", "engine_get_reals",
    "engine_step",
)  # fmt: skip
"""Of page.c, which the page calls."""
RECORDED = ("q", "v", "x", "quat", "tau", "x_des", "quat_des", "q_des")
"""Groups of variables that a sample holds, in its order."""
GRAIN = 65535  # of a mesh's size: how exactly its vertices are known
POLICY = (
    "default-src 'none'; script-src 'sha256-{script}'{more};"
    " style-src 'unsafe-inline'; img-src data:"
)
CONTAINER = b'<div class="arm" id="arm"'
"""By which a page with an arm is known."""


@dataclass(frozen=True)
class Arm:
    """What a page of a robot is made of.

    Attributes:
        name, guid, file: of the FMU.
        robot: name of the robot; frame, root, axes, control, joints as in ``Fmu``.
        variables: one for each of the FMU's, elements of vectors by themselves: name, value
            reference, causality, unit, start and description.
        step: communication step, s.
        urdf: text of resources/robot.urdf.
        shapes: of its links.
        sources: contents of sources/.
        remarks: what is not as it should be.
    """

    name: str
    guid: str
    file: str
    robot: str
    joints: Sequence[str]
    frame: str
    root: str
    axes: str
    control: str
    variables: Sequence[Mapping[str, Any]]
    step: float
    urdf: str
    shapes: Sequence[Shape]
    sources: Mapping[str, bytes] = field(default_factory=dict)
    remarks: Sequence[str] = ()


class LivePart(NamedTuple):
    """An arm as it stands in a page: what belongs into its head, and into its body."""

    head: str
    body: str


def live_part(arm: Arm) -> LivePart:
    """The arm, with its engine.

    Raises:
        BuildError: the engine cannot be compiled.
    """
    around = data_file("fmu_src", "page", "page.c").read_bytes()
    units = ("fmu.c", "page.c")  # a page asks for no derivatives
    module = compile_web_module({**arm.sources, "page.c": around}, units, FUNCTIONS)
    provenance = {
        "fmu": {"name": arm.name, "guid": arm.guid, "file": arm.file},
        **{key: getattr(arm, key) for key in ("robot", "frame", "root", "axes", "step")},
        "joints": list(arm.joints),
        "versions": versions(),
        "urdf": arm.urdf,
    }
    source = {"engine": packed(module)}
    return _part(arm, source, " 'wasm-unsafe-eval'", provenance=provenance)


def replayed_part(arm: Arm, samples: Array) -> LivePart:
    """The arm, with samples: N × (time in s, groups in ``RECORDED``)."""
    return _part(arm, {"samples": packed(samples.astype("<f8").tobytes())})


def served_part(arm: Arm) -> LivePart:
    """The arm, moved by the server of the page, at /socket."""
    return _part(arm, {}, "; connect-src 'self'")


def _part(arm: Arm, source: Mapping[str, str], more: str = "", **others: Any) -> LivePart:
    facts, meshes = _facts(arm)
    data = json.dumps({**facts, **others}, sort_keys=True).replace("<", "\\u003c")
    script = "".join(_asset(name) for name in SCRIPTS)
    script = f'(() => {{ "use strict";\n{script}}})();\n'
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = POLICY.format(script=digest, more=more)
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<link rel="icon" href="data:,">\n'
        f"<style>\n{_asset('arm.css')}</style>\n"
    )
    parts = {"facts": data, "meshes": packed(meshes), **source}.items()
    blocks = "\n".join(
        f'<script type="application/json" id="arm-{name}">{text}</script>' for name, text in parts
    )
    return LivePart(head, f"{_asset('arm.html')}{blocks}\n<script>{script}</script>\n")


def arm_page(title: str, part: LivePart) -> bytes:
    """An arm as a page of its own."""
    head, body = part
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)} - twodof</title>\n{head}</head>\n"
        f'<body class="whole">\n{body}</body>\n</html>\n'
    )
    return page.encode("utf-8", "replace")  # names of files need not be text


def _asset(name: str) -> str:
    return data_file("fmu_src", "page", name).read_text("utf-8")


def _facts(arm: Arm) -> tuple[dict[str, Any], bytes]:
    """What the page knows of its FMU, and the content of its meshes."""
    urdf = read_urdf(arm.urdf)
    ball = Shape("", Placement(np.zeros(3), np.eye(3)), (0, 0, 0), *sphere(1.0))
    packed = [_mesh(shape) for shape in [ball, *arm.shapes]]
    links, number = _links(urdf, arm.joints)
    facts = {
        **{key: getattr(arm, key) for key in ("name", "robot", "frame", "axes", "control", "step")},
        "joints": [_joint(name, urdf.joints.get(name)) for name in arm.joints],
        "recorded": RECORDED,
        "remarks": list(arm.remarks),
        "variables": list(arm.variables),
        "links": links,
        "frameLink": number[arm.frame],
        "shapes": [
            {"link": number[s.link], "place": _matrix(s.place), "colour": s.colour}
            for s in arm.shapes
        ],
        "meshes": [facts for facts, _ in packed],
    }
    return facts, b"".join(content for _, content in packed)


def _joint(name: str, joint: Joint | None) -> dict[str, Any]:
    """Of a joint that moves on its own; null where it has no limit, or none is known."""
    if joint is None:
        return {"name": name, "prismatic": False, "low": None, "high": None, "effort": None}
    limits = {"low": joint.low, "high": joint.high, "effort": joint.effort}
    finite = {key: value if abs(value) < UNBOUNDED else None for key, value in limits.items()}
    return {"name": name, "prismatic": joint.prismatic, **finite}


def _links(urdf: Urdf, joints: Sequence[str]) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """The tree of links, parents first, with the joint above each; the number of each link."""
    kinematics = Kinematics(urdf, joints)
    number = {urdf.root: 0}
    links: list[dict[str, Any]] = [{"parent": -1}]
    for joint in sorted(urdf.joints.values(), key=lambda joint: len(urdf.chain(joint.child))):
        number[joint.child] = len(links)
        column, ratio, offset = kinematics.column(joint)
        turn = Rotation.from_euler("xyz", joint.rpy).as_matrix()
        links.append(
            {
                "parent": number[joint.parent],
                "place": _matrix(Placement(np.array(joint.xyz), turn)),
                "axis": joint.axis,
                "prismatic": joint.prismatic,
                "column": -1 if column is None else column,
                "ratio": ratio,
                "offset": offset,
            }
        )
    return links, number


def _matrix(place: Placement) -> list[float]:
    """4 × 4, by columns, as WebGL has it."""
    matrix = np.eye(4)
    matrix[:3, :3] = place.rotation
    matrix[:3, 3] = place.translation
    values: list[float] = matrix.T.reshape(-1).tolist()
    return values


def _mesh(shape: Shape) -> tuple[dict[str, Any], bytes]:
    """Its vertices as whole parts of its size, each once, and its triangles: 16 and 32 bits."""
    low = shape.vertices.min(axis=0)
    size = max(float(np.ptp(shape.vertices, axis=0).max()), 1e-9)
    grains = np.round((shape.vertices - low) / size * GRAIN).astype("<u2")
    vertices, place = np.unique(grains, axis=0, return_inverse=True)
    triangles = place.reshape(-1)[shape.triangles]
    whole = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    content = vertices.astype("<u2").tobytes()
    content += bytes(-len(content) % 4) + whole.astype("<u4").tobytes()
    facts = {
        "low": low.tolist(), "size": size, "vertices": len(vertices), "triangles": len(whole),
    }  # fmt: skip
    return facts, content
