"""A native FMU in one HTML file that needs neither a network nor a server."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from functools import partial
from math import inf
from pathlib import Path

from ..errors import ZIP_ERRORS, FmuError, PageError
from ..experiments import Experiment, Setting, experiment
from ..export.arm_page import Arm, arm_page
from ..files import read_member, refusing, write_file
from ..fmu import Fmu, read_resource
from ..plant.urdf import RobotError

MAX_SOURCE = 16 * 1024**2  # bytes of a file


def page(
    fmu: Fmu | str | Path,
    output: str | Path,
    *,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
) -> Path:
    """Write an FMU as a page: the robot in 3D, its plant alive, what it is told and what it does.

    The FMU's own C sources are compiled to WebAssembly: its numbers are the FMU's.

    Args:
        fmu: a native FMU of this package.
        output: the HTML file, written whole or not at all.
        step: communication step, s; None: the FMU's own.
        settings: start values of inputs and parameters, as for ``experiment``.

    Returns:
        The path of the page.

    Raises:
        FmuError, InputError: the file is no FMU, or a setting is at fault.
        PageError: the FMU is not a native one of this package, or the page cannot be written.
        BuildError: there is no compiler.
    """
    run = experiment(fmu, stop_time=inf, step=step, settings=settings)
    path = Path(output)
    try:
        content = arm_page(_arm(run))
    except RobotError as error:
        raise PageError(f"'{run.fmu.path}': its robot cannot be shown: {error}") from error
    with refusing(PageError, f"write '{path}'"):
        write_file(path, content)
    return path


def _arm(run: Experiment) -> Arm:
    fmu = run.fmu
    sources = _sources(fmu)
    if not fmu.control or not sources:
        raise PageError(
            f"'{fmu.path}' has no plant in C, as native FMUs of this package have;"
            " build one with 'twodof build --native'"
        )
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
        step=run.step, urdf=fmu.urdf or "", read=partial(read_resource, fmu), sources=sources,
    )  # fmt: skip


def _sources(fmu: Fmu) -> dict[str, bytes]:
    """The C files of sources/ and their headers, by file name."""
    try:
        with zipfile.ZipFile(fmu.path) as archive:
            return {
                Path(name).name: read_member(archive, name, MAX_SOURCE)
                for name in archive.namelist()
                if name.count("/") == 1 and name[:8] == "sources/" and name[-2:] in (".c", ".h")
            }
    except ZIP_ERRORS as error:
        raise FmuError(f"cannot read the sources of '{fmu.path}': {error}") from error
