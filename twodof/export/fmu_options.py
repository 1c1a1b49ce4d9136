"""Options of an FMU's build."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..errors import BuildError, choice
from ..plant.variables import CONTROLS, FREE, OF_LINKS, OF_ORIENTATION, ON_REQUEST

DEFAULT_NAME = "TwoDof"
OF_THE_FLAVOUR = ("mesh_dir", "meshes", "link_environment", "native", "fmi", "arrays", "platforms", "reference")
"""Options that do not change the model."""


@dataclass(frozen=True)
class FmuOptions:
    """Options of an FMU's build.

    Attributes:
        urdf: the URDF or xacro file; None: the shipped planar arm.
        mesh_dir: folder of the URDF's packages or meshes; None: the URDF's own folder and package.
        frame: link whose origin is controlled; None: "EndEffector", or the only last link.
        lock: positions, rad or m, at which joints are fixed, by name or shell pattern.
        meshes: whether the FMU contains the meshes.
        axes: task axes, letters of "xyz"; None: "xy" for the shipped arm, else "xyz".
        gravity: m/s² in the root frame; None: (0, −9.81, 0) for the shipped arm, else (0, 0, −9.81).
        q_start: start positions, rad or m, in the order of the joints or by name; default: the shipped arm's
            positions, or 0 if it is within the limits, or the middle of the limits.
        outputs: further outputs for controllers: "M" mass matrix, "h" nonlinear effects, "J" Jacobian, "drift" J̇ v,
            "quat" orientation, "omega" angular velocity. With one of the last two, J and drift have rows of rotations.
        free: parameters that become inputs of a native FMU: they may change during a run, and the FMU has derivatives
            with respect to them. Each is a group of ``FREE``, or a value of a link as in ``fit``: ``mass:LINK``,
            ``com:LINK`` or ``inertia:LINK``, where LINK is a name or shell pattern.
        settings: start values of variables by name, as in ``experiment``.
        control: control law, a key of ``CONTROLS``: "task", "pose" (task with the orientation of the
            frame), "joint" or "effort".
        part: "all"; "controller": the control law alone, native, with inputs q and v and outputs tau_cmd; or "split":
            a system of plant and controller, two native FMUs in an SSP file.
        clocked: whether a controller has an input clock, by which an importer with event mode samples it (FMI 3).
        name: model name and identifier; "": name of the URDF's file, "TwoDof" for the shipped arm.
        link_environment: store the folders of this Python's packages in the FMU; not for the native
            flavour, which needs no Python.
        native: build the plant as compiled C instead of Python code.
        fmi: version of a native FMU, 2 or 3; None: 2, or 3 on machines for which FMI 2.0 has no name.
        arrays: whether vectors are arrays in FMI 3; if not, each element is a scalar variable as in
            FMI 2, for tools that do not support arrays.
        platforms: FMI platforms of a native FMU, e.g. "linux64", "win64", or in FMI 3.0
            "x86_64-linux", "aarch64-linux"; empty: this machine's platform.
        reference: add experiments with reference trajectories (FMI-LS-REF) to the FMU.
    """

    urdf: str | Path | None = None
    mesh_dir: str | Path | None = None
    frame: str | None = None
    lock: Mapping[str, float] = field(default_factory=dict)
    meshes: bool = True
    axes: str | None = None
    gravity: tuple[float, float, float] | None = None
    q_start: tuple[float, ...] | Mapping[str, float] | None = None
    control: str = "task"
    settings: Mapping[str, object] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    part: str = "all"
    clocked: bool = False
    name: str = ""
    link_environment: bool = False
    native: bool = False
    fmi: int | None = None
    arrays: bool = True
    platforms: tuple[str, ...] = ()
    reference: bool = False

    def __post_init__(self) -> None:
        if not self.name:
            name = identifier(self.urdf) if self.urdf is not None else DEFAULT_NAME
            object.__setattr__(self, "name", name)
        if self.control not in CONTROLS:
            raise BuildError(f"`control` '{self.control}' is unknown{choice(self.control, CONTROLS)}")
        for name in ("gravity", "q_start"):
            if isinstance(value := getattr(self, name), int | float):
                raise BuildError(f"`{name}` is the number {value:g}; give all its elements, in a tuple")
        if not isinstance(self.lock, Mapping):
            raise BuildError(f"`lock` is {self.lock!r:.50}; give positions by joint, as {{'joint1': 0.0}}")
        if self.part not in ("all", "controller", "split"):
            raise BuildError(f"`part` '{self.part}' is unknown; it is 'all', 'controller' or 'split'")
        for name in self.outputs:
            if name not in ON_REQUEST:
                raise BuildError(f"`outputs` '{name}' is unknown{choice(name, ON_REQUEST)}")
        if self.control == "task" and OF_ORIENTATION & {*self.outputs}:
            raise BuildError("`outputs` quat and omega need a `control` other than 'task', for example 'pose'")
        for name in self.free:
            group, _, link = name.partition(":")
            if name not in FREE and not (group in OF_LINKS and link):
                known = [*FREE, *(f"{group}:LINK" for group in OF_LINKS)]
                raise BuildError(f"`free` '{name}' is not a parameter that can be an input{choice(name, known)}")
        if self.free and (not self.native or self.part != "all"):
            raise BuildError("`free` needs the whole robot as a native FMU, `native=True`")
        if self.part == "controller" and self.outputs:
            raise BuildError("`outputs` are outputs of the plant, which the controller alone does not have")
        if self.part == "split" and self.control == "effort":
            raise BuildError("a split robot needs a control law other than 'effort', which is the plant alone")
        if self.part != "all" and self.reference:
            raise BuildError("reference trajectories need the whole robot under its control law; leave out `reference`")
        if self.part == "controller" and (not self.native or self.control == "effort"):
            raise BuildError("the controller alone must be native, `native=True`, and have another law than 'effort'")

        if self.clocked and (self.part != "controller" or self.fmi != 3):
            raise BuildError("`clocked` needs `part` controller and `fmi` 3")

    @property
    def is_default_arm(self) -> bool:
        """True for the shipped arm with its default settings, in any flavour."""
        return self == replace(FmuOptions(), **{key: getattr(self, key) for key in OF_THE_FLAVOUR})


def identifier(robot: str | Path) -> str:
    """Return the name of a robot's file as an identifier."""
    stem = Path(robot).name.removesuffix(".xacro").removesuffix(".urdf").removesuffix(".fmu")
    name = re.sub(r"\W", "_", stem, flags=re.ASCII)
    return name if name.isidentifier() else f"robot_{name}"
