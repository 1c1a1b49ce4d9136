"""HTML page of an arm, whose motion comes from an engine, from samples of a run, or from a server.

The page is self-contained and uses no network. Its Content-Security-Policy allows only its own script. Text from the
URDF is stored as JSON and shown as text.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import logging
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..bag.provenance import provenance_of
from ..bag.storage import profile
from ..bounds import MAX_HEAD, MAX_SOURCES, MIB
from ..errors import BuildError, PageError
from ..export.compiler import compile_web_module, compiles_for_the_web, standard_headers
from ..files import JsonObject, data_file, head_of, read_member, refusing, write_file
from ..fmu import Fmu, opened, resource_reader
from ..geometry.kinematics import Kinematics, Placement, quaternions
from ..geometry.shapes import Shape, link_shapes, sphere
from ..plant.urdf import UNBOUNDED, Joint, RobotError, read_urdf
from ..plots.scripts import packed, script
from ..ros.messages import Messages, definition
from ..simulation.cause import KINDS
from ..simulation.experiments import Experiment, experiment
from ..simulation.input_values import Setting

SCENE = logging.getLogger("twodof.ros.scene")
RECORDED = ("q", "v", "x", "quat", "tau", "x_des", "quat_des", "q_des")
"""Groups of variables in a sample, in their order."""
LIMITS = ("low", "high", "effort", "velocity")  # of a joint
GRAIN = 65535  # resolution of vertices, as parts of a mesh's size
POLICY = "default-src 'none'; script-src 'sha256-{script}'{more}; style-src 'unsafe-inline'; img-src data:"
PAGES = ("", ".html")  # suffixes of pages
CONTAINER = b'<div class="arm" id="arm"'  # mark that identifies a page with an arm


def names_page(path: Path) -> bool:
    """Return whether a path may name a page: a name with a suffix of a page, or without a suffix."""
    return path.suffix.lower() in PAGES and (bool(path.suffix) or not path.name.startswith("."))


class Arm(NamedTuple):
    """Contents of a robot's page."""

    # facts of the FMU by name: name, robot, joints, frame, axes and control as in ``Fmu``; step, s; variables, with
    # each element of a vector: name, index, causality, type, unit, start and description; and remarks, which are
    # warnings
    facts: JsonObject
    urdf: str  # text of resources/robot.urdf
    shapes: Sequence[Shape]  # shapes of the links

    @property
    def title(self) -> str:
        """Title of the page of an FMU."""
        return str(self.facts["robot"] or self.facts["name"])


def page(
    fmu: Fmu | str | Path,
    output: str | Path,
    *,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
) -> Path:
    """Write an FMU as a page with the robot in 3D and its running plant; return its path.

    The FMU's C sources are compiled to WebAssembly, so that the page computes the same numbers.

    Args:
        fmu: a native FMU of this package.
        output: the HTML file, which is written completely or not at all.
        step: communication step, s; None: the FMU's own.
        settings: start values of inputs and parameters, as for ``experiment``.

    Raises:
        FmuError, InputError: the file is not an FMU, or a setting is invalid.
        PageError: the FMU is not a native one of this package, or the page has another suffix or cannot be written.
        BuildError: there is no compiler.
    """
    path = Path(output)
    if not names_page(path):
        raise PageError(f"'{path}': the name of a page ends in .html")
    content = page_of(experiment(fmu, stop_time=inf, step=step, settings=settings))
    with refusing(PageError, f"write '{path}'"):
        write_file(path, content)
    return path


def page_of(run: Experiment) -> bytes:
    """Return the HTML of a run's FMU; errors as in ``page``."""
    fmu, sources = run.fmu, _sources(run.fmu)
    if not fmu.control or not sources:
        raise PageError(f"'{fmu.path}' is not a native FMU of twodof; build one with `native`")
    arm = arm_of(run)
    files = {**standard_headers(), **sources, "page.c": _asset("page.c").encode()}
    try:
        module = compile_web_module(files, ["page.c"])  # a page needs no derivatives
    except BuildError as error:
        from ..export.flavours import engine_sources  # Pinocchio takes long to import

        own = engine_sources(fmu.control, fmu.version).items()
        if sources.items() >= own or not compiles_for_the_web():
            raise
        reason = "its C sources are not those of this version of twodof, and do not compile for a page"
        raise PageError(f"'{fmu.path}': {reason}; build it again") from error
    provenance = provenance_of(run, "")
    provenance["versions"] = {"twodof": provenance["versions"]["twodof"]}  # a page uses only this package
    engine, allowed = {"engine": packed(module)}, " 'wasm-unsafe-eval'"
    return arm_page(arm.title, arm, engine, allowed, provenance=provenance, **_topics(run))


def _topics(run: Experiment) -> dict[str, object]:
    """Return topics and message definitions of a bag with the run's scene and efforts.

    The scene does not warn of meshes that cannot be read: the arm of the page has done so.
    """
    SCENE.addFilter(_reject)
    try:
        messages = Messages(run, scene=True, effort=bool(run.fmu.vector("tau")))
    finally:
        SCENE.removeFilter(_reject)
    topics = [
        {"name": name, "type": kind, "qos": profile(qos), **template}
        for name, template in messages.templates().items()
        for kind, qos in [messages.topics[name]]
    ]
    return {"topics": topics, "definitions": {kind: definition(kind) for kind, _ in messages.topics.values()}}


def _reject(_: logging.LogRecord) -> bool:
    return False


def is_page(path: Path) -> bool:
    """Return whether a file is a page with an arm."""
    return CONTAINER in head_of(path, MAX_HEAD)


def arm_of(run: Experiment) -> Arm:
    """Return the page contents of a run's FMU."""
    fmu = run.fmu
    urdf = fmu.urdf or ""
    try:
        robot = read_urdf(urdf)
        shapes, _ = link_shapes(robot, resource_reader(fmu))
        if fmu.frame and fmu.frame not in robot.links:
            raise RobotError(f"it has no link '{fmu.frame}'")
    except RobotError as error:
        raise PageError(f"'{fmu.path}': its robot cannot be shown: {error}") from error
    variables = [
        {
            "name": name,
            "index": index,
            "causality": variable.causality,
            "type": variable.type,
            "unit": variable.unit or "",
            "start": run.start_values.get(name),
            "description": variable.description,
        }
        for index, (name, variable) in enumerate(fmu.variables.items())
        if variable.causality != "local"
    ]
    known = {key: getattr(fmu, key) for key in ("name", "robot", "joints", "frame", "axes", "control")}
    return Arm({**known, "variables": variables, "step": run.step, "remarks": []}, urdf, shapes)


def _sources(fmu: Fmu) -> dict[str, bytes]:
    """Return the C files of sources/ and their headers, by file name."""
    names = [
        name for name in fmu.members if name.count("/") == 1 and name[:8] == "sources/" and name[-2:] in (".c", ".h")
    ]
    with opened(fmu) as archive:
        if sum(archive.getinfo(name).file_size for name in names) > MAX_SOURCES:
            raise PageError(f"'{fmu.path}': its C sources have more than {MAX_SOURCES // MIB} MiB together")
        return {Path(name).name: read_member(archive, name, MAX_SOURCES) for name in names}


def arm_page(title: str, arm: Arm, source: Mapping[str, str], allowed: str = "", **facts: object) -> bytes:
    """Return the HTML of an arm.

    Args:
        source: packed source of motion: "engine", or "samples", N × (time in s, groups in ``RECORDED``); empty: the
            server of the page, at /socket.
        allowed: further permissions of the page, in the syntax of a Content-Security-Policy.
        facts: further facts for the script.
    """
    known, meshes = _facts(arm)
    data = json.dumps({**known, **facts}, sort_keys=True).replace("<", "\\u003c")
    code = script("fmu_src", "page", "main.js")
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    policy = POLICY.format(script=digest, more=allowed)
    parts = {"facts": data, "meshes": packed(meshes), **source}.items()
    blocks = "\n".join(f'<script type="application/json" id="arm-{name}">{text}</script>' for name, text in parts)
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)} - twodof</title>\n"
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f'<link rel="icon" href="data:,">\n<style>\n{_asset("arm.css")}</style>\n</head>\n'
        f"<body>\n{_asset('arm.html')}{blocks}\n<script>{code}</script>\n</body>\n</html>\n"
    )
    return page.encode("utf-8", "replace")  # file names need not be UTF-8


def _asset(name: str) -> str:
    return data_file("fmu_src", "page", name).read_text("utf-8")


def _facts(arm: Arm) -> tuple[dict[str, object], bytes]:
    """Return the page's facts about its FMU, and the content of its meshes."""
    urdf = read_urdf(arm.urdf)
    ball = Shape("", Placement(np.zeros(3), np.eye(3)), (0, 0, 0), *sphere(1.0))
    packed = [_mesh(shape) for shape in [ball, *arm.shapes]]
    kinematics = Kinematics(urdf, arm.facts["joints"])
    links, number = _links(kinematics)
    facts = {
        **arm.facts,
        "joints": [_joint(name, urdf.joints.get(name)) for name in arm.facts["joints"]],
        "recorded": RECORDED,
        "causes": [*KINDS],
        "links": links,
        "moving": [number[joint.child] for joint in urdf.joints.values() if kinematics.moves(joint)],
        "frameLink": number[arm.facts["frame"]],
        "shapes": [{"link": number[s.link], "placement": _matrix(s.transform), "colour": s.colour} for s in arm.shapes],
        "meshes": [facts for facts, _ in packed],
    }
    return facts, b"".join(content for _, content in packed)


def _joint(name: str, joint: Joint | None) -> dict[str, object]:
    """Return an independent joint's facts; null for an unknown or missing limit."""
    if joint is None:
        return {"name": name, "prismatic": False, "damping": 0.0, **dict.fromkeys(LIMITS)}
    limits = {limit: getattr(joint, limit) for limit in LIMITS}
    finite = {key: value if abs(value) < UNBOUNDED else None for key, value in limits.items()}
    return {"name": name, "prismatic": joint.prismatic, "damping": joint.damping, **finite}


def _links(kinematics: Kinematics) -> tuple[list[dict[str, object]], dict[str, int]]:
    """Return the tree of links, parents first, with the joint above each, and link numbers by name."""
    urdf = kinematics.urdf
    number = {urdf.root: 0}
    links: list[dict[str, object]] = [{"parent": -1}]
    for joint in sorted(urdf.joints.values(), key=lambda joint: len(urdf.chain(joint.child))):
        number[joint.child] = len(links)
        column, ratio, offset = kinematics.column(joint)
        links.append(
            {
                "parent": number[joint.parent],
                "placement": _matrix(Placement(np.array(joint.xyz), kinematics.origins[joint.name])),
                "quat": quaternions(kinematics.origins[joint.name]).tolist(),
                "axis": joint.axis,
                "prismatic": joint.prismatic,
                "column": -1 if column is None else column,
                "ratio": ratio,
                "offset": offset,
                **kinematics.body(joint.child)._asdict(),
            }
        )
    return links, number


def _matrix(transform: Placement) -> list[float]:
    """Return a 4 × 4 matrix in column order, as WebGL requires."""
    matrix = np.eye(4)
    matrix[:3, :3] = transform.rotation
    matrix[:3, 3] = transform.translation
    values: list[float] = matrix.T.reshape(-1).tolist()
    return values


def _mesh(shape: Shape) -> tuple[dict[str, object], bytes]:
    """Return a mesh with unique 16-bit vertices relative to its size, and 32-bit triangle indices."""
    low = shape.vertices.min(axis=0)
    size = max(float(np.ptp(shape.vertices, axis=0).max()), 1e-9)
    grains = np.round((shape.vertices - low) / size * GRAIN).astype("<u2")
    vertices, index = np.unique(grains, axis=0, return_inverse=True)
    triangles = index.reshape(-1)[shape.triangles]
    whole = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    content = vertices.astype("<u2").tobytes()
    content += bytes(-len(content) % 4) + whole.astype("<u4").tobytes()
    facts = {"low": low.tolist(), "size": size, "vertices": len(vertices), "triangles": len(whole)}
    return facts, content
