"""Read and check the description of an FMU, without running it."""

import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from xml.etree import ElementTree as ET

import fmpy
from fmpy.model_description import ModelDescription, ValidationError

from ..bounds import MAX_RESOURCE
from ..errors import ZIP_ERRORS, FmuError, path_of
from ..export.compiler import host_platform
from ..export.icon import side_view
from ..export.start_values import groups_of, vector
from ..export.typed_values import Type
from ..files import read_member, shown
from ..notebook import card, picture
from .archives import checksums, open_archive, read_archive
from .scalar import Scalar, scalars
from .validation import SCALED, problems_of_names, problems_of_times, read_description

RECORDED = ("q", "v", "x", "xd", "tau", "q_des", "x_des", "quat_des")
"""Vectors of a robot that bags, verdicts and plots contain in SI units."""
SI = "a robot needs SI units, as rad, m and N.m"


@dataclass(frozen=True, repr=False)
class Fmu:
    """An FMI 2.0 or 3.0 co-simulation FMU with outputs q[i] and v[i].

    Attributes:
        path: the file.
        description: FMPy's model description.
        variables: by name, in the order of the description.
        members: checksums of the file's members, by name.
        platforms: FMI names of the platforms of its binaries, e.g. "linux64".
        robot: name of the robot; "" if unknown.
        joints: joint names, one for each q[i]; "joint1", … if unknown.
        frame, root, axes: the task frame, the frame in which its position is expressed, and the task
            axes; "" if unknown.
        control: name of the control law, e.g. "task"; "" if unknown.
        described: size of its description, bytes.
        inside: name of the FMU's file in the system at ``path``; "" if ``path`` is the FMU.
        aliases: in a system, further names of variables and vectors, and the names that they stand for.
        unjudged: in a system, reasons for which targets of the robot's controllers are not judged, a line each.
    """

    path: Path
    description: ModelDescription
    variables: dict[str, Scalar]
    members: Mapping[str, int]
    platforms: tuple[str, ...]
    robot: str
    joints: tuple[str, ...]
    frame: str
    root: str
    axes: str
    control: str
    described: int = 0
    inside: str = ""
    aliases: Mapping[str, str] = field(default_factory=dict)
    unjudged: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<Fmu '{self.path}': {self.name}, joints {', '.join(self.joints)}>"

    def _repr_html_(self) -> str:
        facts = {"FMI": str(self.version), "platforms": ", ".join(self.platforms), "joints": ", ".join(self.joints)}
        facts |= {key: getattr(self, key) or "not known" for key in ("robot", "control", "frame", "axes")}
        facts |= {f"{kind}s": ", ".join(self.groups(kind)) for kind in ("input", "output", "parameter")}
        return card(f"FMU {self.name}, {shown(self.path)}", facts, _pose(self))

    @property
    def name(self) -> str:
        """The model's name."""
        return str(self.description.modelName)

    @property
    def version(self) -> int:
        """Version of FMI: 2 or 3."""
        return int(str(self.description.fmiVersion).partition(".")[0])

    @property
    def platform(self) -> str:
        """Platform of this machine in the FMU's version of FMI; "" if FMI has no name for it."""
        return host_platform() if self.version == 2 else str(fmpy.platform_tuple)

    @property
    def guid(self) -> str:
        """GUID of the FMU; in FMUs of this package, a digest of all relevant inputs."""
        return str(self.description.guid)

    @property
    def is_native(self) -> bool:
        """True for a native FMU of this package; to run, it needs no file but its library."""
        own = str(self.description.generationTool).startswith("twodof ")
        return own and not self.description.coSimulation.needsExecutionTool

    @property
    def library(self) -> str:
        """File name of its binary on this platform."""
        identifier = self.description.coSimulation.modelIdentifier
        return f"{identifier}{fmpy.sharedLibraryExtension}"

    @property
    def urdf(self) -> str | None:
        """Text of resources/robot.urdf; None without it."""
        content = resource_reader(self)("robot.urdf")
        try:
            return None if content is None else content.decode("utf-8")
        except UnicodeDecodeError as error:
            raise FmuError(f"'{self.path}': resources/robot.urdf is not UTF-8 text") from error

    @property
    def start_values(self) -> dict[str, float | bool]:
        """Return start values of inputs and parameters, by the model description."""
        settable = (v for v in self.variables.values() if v.causality in ("input", "parameter"))
        return {v.name: v.start_value for v in settable if v.start_value is not None}

    @property
    def real_outputs(self) -> tuple[str, ...]:
        """Names of the outputs that are real numbers."""
        return tuple(v.name for v in self.variables.values() if (v.causality, v.type) == ("output", "Real"))

    def remarks(self, asked: Iterable[str] = ()) -> list[str]:
        """Return warnings about settings, one line each; only a system has any."""
        return []

    def vector(self, group: str) -> list[str]:
        """Return the names of a vector's elements in order, or of the scalar; empty if there is none."""
        return vector(self.variables, self.aliases.get(group, group))

    def type_of(self, name: str) -> Type:
        """Return the type of a variable."""
        return self.variables[name].value_type

    def source_of(self, _name: str) -> str:
        """Return the output that is connected to a variable of a system; "" without a connection."""
        return ""

    def groups(self, causality: str) -> dict[str, list[str]]:
        """Return vectors and scalars of one causality by group name."""
        return groups_of(self.variables, causality)


def _pose(fmu: Fmu) -> str:
    """Return a picture of the robot at its start, seen along the axis of its smallest extent; "" without a URDF."""
    from ..geometry.kinematics import chains_at  # SciPy takes half a second to import

    q = [float(fmu.start_values.get(name, 0.0)) for name in fmu.vector("q_start")]
    if not (chains := chains_at(fmu.urdf or "", fmu.joints[: len(q)], q)):
        return ""
    lines, axes = side_view(chains)
    return picture((line.T for line in lines), *(f"{axis} in m" for axis in axes), equal=True)


def load_any_fmu(path: str | Path, inside: str = "") -> Fmu:
    """Read the description of any co-simulation FMU, of a robot or not; ``joints`` may be empty.

    Raises:
        FmuError: the file is missing, is not a zip archive, is unsafe to unzip, or is not a co-simulation FMU of FMI
            2.0 or 3.0.
    """
    path = path_of(path, "FMU")
    where = path / inside
    xml, members = read_archive(path, inside)
    try:
        root = ET.fromstring(xml)
        description = read_description(root, xml)
    except Exception as error:  # FMPy raises bare exceptions of several libraries
        raise FmuError(f"'{where}': modelDescription.xml is not valid: {error!s:.300}") from error
    if not re.match(r"[23]\.0", description.fmiVersion) or description.coSimulation is None:
        kind = "co-simulation" if description.coSimulation is not None else "model exchange"
        raise FmuError(f"'{where}' is FMI {description.fmiVersion} {kind}; FMI 2.0 or 3.0 co-simulation is needed")
    simulation = root.find("CoSimulation[@providesDirectionalDerivatives]")
    if simulation is not None:  # FMPy expects the name of FMI 2.0
        derivatives = simulation.get("providesDirectionalDerivatives") in ("true", "1")
        description.coSimulation.providesDirectionalDerivative = derivatives
    robot = _vendor_annotation(root)
    fmu = Fmu(
        path=path,
        description=description,
        variables=_variables(description),
        members=members,
        platforms=_platforms(members, description.coSimulation.modelIdentifier),
        robot=robot.get("name", ""),
        joints=tuple(joint.get("name", "") for joint in robot.iter("Joint")),
        frame=robot.get("frame", ""),
        root=robot.get("root", ""),
        axes=robot.get("axes", ""),
        control=robot.get("control", ""),
        inside=inside,
        described=len(xml),
    )
    for name, variable in fmu.variables.items():
        try:
            _ = variable.initial_value, variable.value_type
        except ValueError:
            raise FmuError(f"'{where}': start value of {name}, '{variable.start:.50}', is not a number") from None
    return fmu


def _variables(description: ModelDescription) -> dict[str, Scalar]:
    """Return the scalars of all variables by name."""
    items = {type_.name: {item.name: int(item.value) for item in type_.items} for type_ in description.typeDefinitions}
    items[None] = {}
    declared = ((v, v.declaredType.name if v.declaredType else None) for v in description.modelVariables)
    return {scalar.name: scalar for variable, name in declared for scalar in scalars(variable, items[name])}


def problems_of(path: Path, inside: str = "") -> list[str]:
    """Return the faults of an FMU's description in schema, variables, units and model structure."""
    xml, _ = read_archive(path, inside)
    found: list[str] = []
    try:
        root = ET.fromstring(xml)
        found += problems_of_names(root)
        found += problems_of_times(root)
        aliases = [(v, alias) for v in root.iterfind("ModelVariables/*") for alias in v.findall("Alias")]
        if aliases:  # FMPy would look for them in the model structure
            read_description(root, xml)
            for variable, alias in aliases:
                variable.remove(alias)
            xml = ET.tostring(root)
        read_description(root, xml, validate_model_structure=True)
    except ValidationError as error:
        found += [" ".join(problem.split()) for problem in error.problems]
    except Exception as error:  # FMPy raises bare exceptions of several libraries
        found.append(f"{error!s:.300}")
    return found


def logged(fmu: Fmu) -> Fmu:
    """Check an FMU with outputs q[i] and v[i]; return it with joint names.

    Raises:
        FmuError: it has no such outputs, or not as many as joints, or task vectors of a wrong length, or other units
            than those of ROS 2's messages.
    """
    n = len(fmu.vector("q"))
    if not fmu.joints:
        fmu = replace(fmu, joints=tuple(f"joint{i + 1}" for i in range(n)))
    states = [fmu.variables[name] for name in fmu.vector("q") + fmu.vector("v")]
    kinds = {(variable.causality, variable.type) for variable in states}
    if len(states) != 2 * n or kinds != {("output", "Real")}:
        remedy = "; it is a controller: connect it to a robot in an SSP file" if "tau_cmd[1]" in fmu.variables else ""
        raise FmuError(f"'{fmu.path}' has no outputs q[1], q[2], … and v[1], v[2], … to log{remedy}")
    bases = {unit.name: unit.baseUnit for unit in fmu.description.unitDefinitions if unit.baseUnit is not None}
    scaled = {name for name, base in bases.items() if (base.factor or 1.0, base.offset or 0.0) != (1.0, 0.0)}
    scaled |= SCALED - bases.keys()
    for name in chain(*map(fmu.vector, RECORDED)):
        if (unit := fmu.variables[name].unit) in scaled:
            raise FmuError(f"'{fmu.path}': {name} is in {unit}; {SI}")
    if len(fmu.joints) != n:
        raise FmuError(f"'{fmu.path}' names {len(fmu.joints)} joints but has {n} outputs q[i]")
    if len({*fmu.axes} & {*"xyz"}) < len(fmu.axes):
        raise FmuError(f"'{fmu.path}': its axes '{fmu.axes:.50}' must be different letters of 'xyz'")
    for group in ("x", "x_des") if fmu.axes else ():
        names = fmu.vector(group)
        if len(names) != len(fmu.axes) and (names or group == "x"):
            raise FmuError(f"'{fmu.path}': {group} has {len(names)} elements for the axes '{fmu.axes}'")
        if group == "x_des" and any(fmu.variables[name].start is None for name in names):
            raise FmuError(f"'{fmu.path}': x_des has no start values")
    return fmu


@contextmanager
def opened(fmu: Fmu) -> Iterator[zipfile.ZipFile]:
    """Open the FMU's file, if it is still the file whose description was read; else raise FmuError."""
    try:
        with open_archive(fmu.path, fmu.inside) as archive:
            if checksums(archive) != fmu.members:
                raise FmuError(f"'{fmu.path}' was replaced by another FMU after it had been read")
            yield archive
    except ZIP_ERRORS as error:
        raise FmuError(f"cannot unzip '{fmu.path}': {error}") from error


def resource_reader(fmu: Fmu) -> Callable[[str], bytes | None]:
    """Return a function that reads files in resources/, or returns None for a missing one; it keeps the FMU open."""
    archives, kept = list[zipfile.ZipFile](), ExitStack()

    def read(name: str) -> bytes | None:
        if (member := f"resources/{name}") not in fmu.members:
            return None
        try:
            if not archives:
                archives.append(kept.enter_context(opened(fmu)))
            return read_member(archives[0], member, MAX_RESOURCE)
        except ZIP_ERRORS as error:
            raise FmuError(f"cannot unzip '{fmu.path}': {error}") from error

    return read


def _platforms(members: Iterable[str], identifier: str) -> tuple[str, ...]:
    suffixes = {"linux": ".so", "win": ".dll", "windows": ".dll", "darwin": ".dylib"}
    platforms = set()
    for folder, platform, name in (m.split("/") for m in members if m.count("/") == 2):
        suffix = suffixes.get(platform.rpartition("-")[2].rstrip("0123456789"), "")
        if folder == "binaries" and name == identifier + suffix:
            platforms.add(platform)
    return tuple(sorted(platforms))


def _vendor_annotation(root: ET.Element) -> ET.Element:
    """Return the vendor annotation with the robot's facts; empty for third-party FMUs."""
    paths = "VendorAnnotations/Tool[@name='twodof']", "Annotations/Annotation[@type='twodof']"
    robots = (root.find(f"{path}/Robot") for path in paths)
    return next((robot for robot in robots if robot is not None), ET.Element("Robot"))
