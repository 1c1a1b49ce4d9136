"""Contents of an FMU's archive and their digest, from a URDF and options."""

import hashlib
import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from ..errors import BuildError, InputError, choice
from ..files import data_file
from ..plant.plant import ParameterError, Plant
from ..plant.robot import Robot, load_robot
from ..plant.urdf import read_urdf
from ..plant.variables import CONTROLS, Starts, Value, Variable, controller_table, free_table, variable_table
from .bodies import FreeLink
from .compiler import PLATFORMS, TARGETS, host_platform
from .documentation import documentation
from .flavours import Files, Flavour, native_flavour, python_flavour
from .fmu_options import FmuOptions
from .free_links import free_links
from .icon import icon
from .mesh_files import collect_meshes
from .model_description import model_description
from .native import engine_variables
from .references import references
from .start_values import resolve
from .typed_values import Type
from .urdf_source import end_effector, lock_joints, read_text, without_meshes

logger = logging.getLogger(__name__)

DEFAULT_ARM = {"q_start": (0.5, 0.35), "x_des": (0.2, 0.05), "gravity": (0.0, -9.81, 0.0)}
"""Start values of the shipped arm; no other code depends on its two joints."""
PLACEHOLDERS: Starts = {"x_des": (0.0,) * 3, "quat_des": (0.0, 0.0, 0.0, 1.0)}
"""Provisional start values of targets, for the table with which the real ones are computed."""
POSE = ("q_start", "v_start", "q_min", "q_max", "gravity")
"""Start values that have their own option, or on which the pose at the start depends."""
ICONS = {2: "model.png", 3: "terminalsAndIcons/icon.png"}  # icon files by version of FMI


def compose(options: FmuOptions) -> tuple[Flavour, Files, Callable[[], Files]]:
    """Return the flavour, the files that the GUID covers, and a function that compiles the others."""
    if not options.name.isidentifier() or not options.name.isascii():
        raise BuildError(f"name '{options.name}' must be an identifier: letters, digits and _")
    path = data_file("urdf", "2dof.urdf") if options.urdf is None else Path(options.urdf)
    mesh_dir = None if options.mesh_dir is None else Path(options.mesh_dir)
    if mesh_dir is not None and not mesh_dir.is_dir():
        raise BuildError(f"the mesh folder '{options.mesh_dir}' does not exist")
    mesh_dir = data_file("meshes") if options.urdf is None else mesh_dir
    text = read_text(path, mesh_dir)
    text = lock_joints(text, options.lock) if options.lock else text
    options = replace(options, frame=end_effector(read_urdf(text), options.frame))
    if not options.meshes or options.part == "controller":
        text = without_meshes(text)
    robot = _robot(options, text)
    patterns = [name for name in options.free if ":" in name]
    links, values = free_links(read_urdf(text), robot, patterns) if patterns else ([], [])
    table, starts = _model(options, robot, values)
    if options.part == "controller":
        table = controller_table(table)
        if options.clocked and not next(v.start for v in table if v.group == "control_period"):
            raise BuildError("the clock needs the controller's period; set control_period, to 0.005 s for example")
    urdf, meshes = collect_meshes(text, path.parent, mesh_dir)
    flavour = _flavour(options, robot, table, links, urdf, starts)
    resources = {"robot.urdf": urdf.encode(), **meshes}
    files = {f"resources/{name}": content for name, content in resources.items()}
    files.update(flavour.files)
    variables = engine_variables(robot, table, options.control, flavour.fmi)
    shown = [variable for variable in table if variable.shown]

    digest = hashlib.sha256(model_description(options, robot, variables, flavour, ""))
    for name in sorted(files):
        digest.update(name.encode() + b"\0" + files[name])
    guid = digest.hexdigest()
    files["modelDescription.xml"] = model_description(options, robot, variables, flavour, guid)
    files[ICONS[flavour.fmi]] = icon(read_urdf(urdf), robot, starts["q_start"])

    def finish() -> Files:
        """Return the files that the GUID does not cover: binaries, documentation and references."""
        described = documentation(options, robot, shown, flavour, guid, urdf)
        extra = references(robot, table, options.control) if options.reference else {}
        return {**flavour.signed(guid), **described, **extra}

    return flavour, files, finish


def fmi_version(options: FmuOptions) -> int:
    """Return a native FMU's version of FMI; by default 2, or 3 if FMI 2.0 has no name for this machine."""
    return options.fmi or (2 if options.platforms or host_platform() else 3)


def _flavour(
    options: FmuOptions, robot: Robot, table: list[Variable], links: list[FreeLink], urdf: str, starts: Starts
) -> Flavour:
    if not options.native:
        if options.platforms or options.fmi not in (None, 2) or not options.arrays:
            raise BuildError(
                "the platforms, the version of FMI and its arrays can be chosen for native FMUs only, `native=True`"
            )
        return python_flavour(options, robot, urdf, starts)
    if options.link_environment:
        raise BuildError("a native FMU needs no Python environment; leave out `link_environment=True`")
    fmi = fmi_version(options)
    if fmi not in PLATFORMS:
        raise BuildError(f"`fmi` {fmi} must be 2 or 3")
    platforms = options.platforms or (host_platform(fmi),)
    if platforms == ("",):
        other = ", or `fmi` 3, which has one" if host_platform(3) else ""
        raise BuildError(f"FMI {fmi}.0 has no name for this machine; choose one with `platforms`{other}")
    for platform in platforms:
        if platform not in PLATFORMS[fmi]:
            other = f"; `fmi` {5 - fmi} has it" if platform in TARGETS else choice(platform, PLATFORMS[fmi])
            raise BuildError(f"FMI {fmi}.0 has no platform '{platform}'{other}")
    if fmi == 2 and not options.arrays:
        raise BuildError("FMI 2.0 has no arrays to leave out; `arrays=False` needs `fmi=3`")
    return native_flavour(options, robot, table, fmi, platforms, links)


def _robot(options: FmuOptions, urdf: str) -> Robot:
    """Return the robot of a URDF, and log its warnings."""
    shipped = options.urdf is None
    axes = ("xy" if shipped else "xyz") if options.axes is None else options.axes
    assert options.frame is not None
    robot = load_robot(urdf, options.frame, axes)
    for warning in robot.warnings:
        logger.warning("%s: %s", options.urdf, warning)
    if options.control == "pose" and sum(robot.moves_frame()) < len(axes) + 3:
        logger.warning(
            "only %d joints move '%s': it cannot reach every position in every orientation",
            sum(robot.moves_frame()),
            robot.frame,
        )
    if shipped and axes != "xy":
        raise BuildError("the shipped arm moves in the x-y plane: its axes are xy")
    return robot


def _model(options: FmuOptions, robot: Robot, links: Sequence[Variable]) -> tuple[list[Variable], dict[str, Any]]:
    """Return the variables of a robot and of links, and the start values that differ from the table's."""
    shipped = options.urdf is None
    rest = tuple(
        0.0 if low <= 0.0 <= high else 0.5 * (low + high) for low, high in zip(robot.q_min, robot.q_max, strict=True)
    )
    starts: dict[str, Any] = dict(DEFAULT_ARM) if shipped else {"q_start": rest}
    if shipped and options.lock:  # the shipped arm's target may then be out of reach
        q = dict(zip(("joint1", "joint2"), DEFAULT_ARM["q_start"]))
        starts = {"gravity": DEFAULT_ARM["gravity"], "q_start": tuple(map(q.__getitem__, robot.joints))}
    settings = _settings(options, dict(zip(robot.joints, starts["q_start"])))
    try:
        placeholders = variable_table(robot, {**PLACEHOLDERS, **starts}, options.control)
        values = resolve(_Variables({v.name: v for v in (*placeholders, *links)}, options.control), settings)
        _set(robot, starts, options.control, values, POSE)
        at_rest = {**PLACEHOLDERS, **{group: starts[group] for group in POSE if group in starts}}
        plant = Plant(robot, variable_table(robot, at_rest, "pose"), "pose")
        for warning in plant.initialise():
            logger.warning("%s", warning)
        if "q_des" in CONTROLS[options.control].inputs:
            starts["q_des"] = tuple(plant.q)
        if "x_des" not in CONTROLS[options.control].inputs:
            starts.pop("x_des", None)
        else:
            starts.setdefault("x_des", tuple(plant.x))
            if options.control == "pose":
                starts["quat_des"] = tuple(plant.quat)
        _set(robot, starts, options.control, values, {name.partition("[")[0] for name in values})
        table = variable_table(robot, starts, options.control, options.outputs)
        links = [replace(variable, start=values.get(variable.name, variable.start)) for variable in links]
        if refusal := next(filter(None, (v.refusal(v.start) for v in (*table, *links) if v.start is not None)), ""):
            raise ParameterError(refusal)
        if options.reference and (changed := next((v.name for v in links if v.start != v.known), "")):
            raise ParameterError(f"references are computed with the URDF's links; leave out `reference` or {changed}")
        Plant(robot, table, options.control).initialise()
    except (InputError, ParameterError) as error:
        raise BuildError(str(error)) from error
    return free_table(table, options.free, links) if options.free else table, starts


class _Variables(NamedTuple):
    """The variables of an FMU that has not been built."""

    variables: Mapping[str, Variable]
    control: str
    aliases: Mapping[str, str] = MappingProxyType({})

    def type_of(self, name: str) -> Type:
        """Return the type of a variable, without its range, which ``Variable.refusal`` has in words."""
        return Type(self.variables[name].type)

    def source_of(self, _name: str) -> str:
        """Return "", because a build has no connections."""
        return ""


def _settings(options: FmuOptions, rest: Mapping[str, float]) -> dict[str, object]:
    """Return the given start values, completed by the start positions ``rest`` of the other joints."""
    settings = dict(options.settings)
    for key, given in (("gravity", options.gravity), ("q_start", options.q_start)):
        if given is None:
            continue
        if key in {name.partition("[")[0] for name in settings}:
            raise BuildError(f"{key} is given twice, by `{key}` and as a start value")
        if isinstance(given, Mapping):
            for name in given.keys() - {*rest}:
                raise BuildError(f"{key}: there is no joint '{name}'{choice(name, rest)}")
            given = tuple({**rest, **given}.values())
        if key == "q_start" and len(given) != len(rest):
            raise BuildError(f"q_start has {len(given)} values, the robot has {len(rest)} joints: {', '.join(rest)}")
        settings[key] = given
    return settings


def _set(
    robot: Robot, starts: dict[str, Any], control: str, values: Mapping[str, Value], groups: Collection[str]
) -> None:
    """Set elements by name in the start values of their groups."""
    table = variable_table(robot, {**PLACEHOLDERS, **starts}, control)
    for group in {variable.group for variable in table if variable.name in values} & {*groups}:
        elements = [values.get(v.name, v.start) for v in table if v.group == group]
        starts[group] = elements[0] if group in values else tuple(elements)
