"""A native FMU in one HTML file that needs neither a network nor a server."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import inf
from pathlib import Path

from ..errors import PageError
from ..export.arm_page import CONTAINER, Arm, arm_page, live_part
from ..files import head_of, read_member, refusing, write_file
from ..fmu import Fmu, opened, read_resource
from ..geometry.shapes import link_shapes
from ..plant.urdf import RobotError, read_urdf
from ..simulation.experiments import Experiment, Setting, experiment

MAX_SOURCE = 16 * 1024**2  # bytes of a file
NO_SOURCES: Mapping[str, bytes] = {}
MAX_HEAD = 64 * 1024  # bytes in which a page says that it is one


def page(
    fmu: Fmu | str | Path,
    output: str | Path,
    *,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
) -> Path:
    """Write an FMU as a page: the robot in 3D, its plant alive, what it is told and does; its path.

    The FMU's own C sources are compiled to WebAssembly: its numbers are the FMU's.

    Args:
        fmu: a native FMU of this package.
        output: the HTML file, written whole or not at all.
        step: communication step, s; None: the FMU's own.
        settings: start values of inputs and parameters, as for ``experiment``.

    Raises:
        FmuError, InputError: the file is no FMU, or a setting is at fault.
        PageError: the FMU is not a native one of this package, or the page cannot be written.
        BuildError: there is no compiler.
    """
    run = experiment(fmu, stop_time=inf, step=step, settings=settings)
    path, sources = Path(output), _sources(run.fmu)
    if not run.fmu.control or not sources:
        raise PageError(
            f"'{run.fmu.path}' has no plant in C, as native FMUs of this package have;"
            " build one with 'twodof build --native'"
        )
    arm = arm_of(run, sources)
    content = arm_page(arm.robot or arm.name, live_part(arm))
    with refusing(PageError, f"write '{path}'"):
        write_file(path, content)
    return path


def is_page(path: Path) -> bool:
    """Whether a file is such a page."""
    return CONTAINER in head_of(path, MAX_HEAD)


def arm_of(run: Experiment, sources: Mapping[str, bytes] = NO_SOURCES) -> Arm:
    """What a page of a run's FMU is made of.

    Raises:
        PageError: its robot cannot be shown.
    """
    fmu = run.fmu
    urdf = fmu.urdf or ""
    try:
        shapes, _ = link_shapes(read_urdf(urdf), partial(read_resource, fmu))
    except RobotError as error:
        raise PageError(f"'{fmu.path}': its robot cannot be shown: {error}") from error
    variables = [
        {
            "name": name, "reference": variable.reference + variable.element,
            "causality": variable.causality,
            "unit": variable.unit or "", "start": run.start_values.get(name),
            "description": variable.description,
        }
        for name, variable in fmu.variables.items()
        if variable.causality != "local"
    ]  # fmt: skip
    return Arm(
        name=fmu.name, guid=fmu.guid, file=fmu.path.name, robot=fmu.robot, joints=fmu.joints,
        frame=fmu.frame, root=fmu.root, axes=fmu.axes, control=fmu.control, variables=variables,
        step=run.step, urdf=urdf, shapes=shapes, sources=sources,
    )  # fmt: skip


def _sources(fmu: Fmu) -> dict[str, bytes]:
    """The C files of sources/ and their headers, by file name."""
    with opened(fmu) as archive:
        return {
            Path(name).name: read_member(archive, name, MAX_SOURCE)
            for name in fmu.members
            if name.count("/") == 1 and name[:8] == "sources/" and name[-2:] in (".c", ".h")
        }
