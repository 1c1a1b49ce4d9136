"""From a URDF to an FMU: what goes into the zip, its digest, and the zip itself."""

from __future__ import annotations

import hashlib
import json
import math
import os
import site
import sysconfig
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pythonfmu

from . import __version__
from .documentation import documentation
from .errors import ZIP_ERRORS, BuildError
from .meshes import collect_meshes
from .model_description import model_description
from .plant import Plant, Robot, RobotError, Variable, load_robot, variable_table

Files = dict[str, bytes]
"""Contents of the FMU by path inside the zip."""

DEFAULT_FRAME = "EndEffector"
DEFAULT_ARM = {"q_start": (0.5, 0.35), "x_des": (0.2, 0.05), "gravity": (0.0, -9.81, 0.0)}
"""Start values of the shipped arm; nothing else knows that it has two joints."""

ZIP_DATE = (1980, 1, 1, 0, 0, 0)
PYTHONFMU_FILES = (
    "_version.py", "default_experiment.py", "enums.py", "fmi2slave.py", "logmsg.py", "variables.py",
)  # fmt: skip


@dataclass(frozen=True)
class FmuOptions:
    """What an FMU is made of.

    Attributes:
        urdf: the URDF; None for the shipped planar arm.
        mesh_dir: folder in which ``package://`` names are looked up; None: around the URDF.
        frame: link whose origin is controlled.
        axes: task axes, letters of "xyz"; None: "xy" for the shipped arm, else "xyz".
        gravity: m/s² in the root frame; None: (0, −9.81, 0) for the shipped arm, else
            (0, 0, −9.81).
        q_start: start positions, rad or m, in the order of the joints; None: the shipped arm's,
            else 0 where the limits allow and their middle where not.
        name: model name and identifier.
        link_environment: remember the folders of this Python's packages in the FMU.
    """

    urdf: Path | None = None
    mesh_dir: Path | None = None
    frame: str = DEFAULT_FRAME
    axes: str | None = None
    gravity: tuple[float, float, float] | None = None
    q_start: tuple[float, ...] | None = None
    name: str = "TwoDof"
    link_environment: bool = False


def build_fmu(output: str | Path | None = None, options: FmuOptions | None = None) -> Path:
    """Build the Python flavour's FMU.

    Args:
        output: the file; None: ``<name>.fmu`` in the working directory. Written whole or not
            at all.
        options: what to build; None: the shipped planar arm.

    Returns:
        The path of the FMU. A file that already holds exactly this FMU is left alone.

    Raises:
        BuildError: naming what is wrong with the URDF, a mesh, an option or the output folder.
    """
    options = options or FmuOptions()
    path = Path(output) if output is not None else Path(f"{options.name}.fmu")
    files = compose(options)
    if not _holds(path, files):
        _write_zip(path, files)
    return path


def compose(options: FmuOptions) -> Files:
    """All files of the FMU by their path in it."""
    if not options.name.isidentifier() or not options.name.isascii():
        raise BuildError(f"name '{options.name}' must be an identifier: letters, digits and _")
    path = options.urdf or data_file("urdf", "2dof.urdf")
    text = _read_urdf(path)
    robot, table, starts = _model(options, text)
    urdf, meshes = collect_meshes(text, path.parent, _mesh_dir(options))
    sources = _slave_sources()
    config: dict[str, Any] = {
        "frame": options.frame,
        "axes": robot.axes,
        "starts": starts,
        "site_packages": _site_packages() if options.link_environment else [],
    }
    identity = hashlib.sha256(urdf.encode() + json.dumps(config, sort_keys=True).encode())
    config["identity"] = identity.hexdigest()
    resources = {
        **sources,
        **meshes,
        "robot.urdf": urdf.encode(),
        "plant.json": (json.dumps(config, indent=1, sort_keys=True) + "\n").encode(),
        "requirements.txt": data_file("fmu_src", "requirements.txt").read_bytes(),
    }
    files = {f"resources/{name}": content for name, content in resources.items()}

    def describe(guid: str) -> bytes:
        return model_description(
            robot,
            table,
            name=options.name,
            guid=guid,
            version=__version__,
            flavour={"needsExecutionTool": "true", "canNotUseMemoryManagementFunctions": "true"},
        )

    digest = hashlib.sha256(describe(""))
    for name in sorted(files):
        digest.update(name.encode() + b"\0" + files[name])
    guid = digest.hexdigest()
    files["modelDescription.xml"] = describe(guid)
    files["model.png"] = data_file("fmu_src", "model.png").read_bytes()
    files.update(
        documentation(
            robot,
            table,
            name=options.name,
            guid=guid,
            version=__version__,
            urdf=urdf,
            templates=data_file("fmu_src"),
            licence=data_file("LICENSE"),
        )
    )
    wrapper = Path(pythonfmu.__file__).parent / "resources/binaries/linux64/libpythonfmu-export.so"
    files[f"binaries/linux64/{options.name}.so"] = wrapper.read_bytes()
    return files


def data_file(*parts: str) -> Path:
    """A file that the package ships: inside the package when installed, else in the checkout."""
    package = Path(__file__).parent
    installed = package.joinpath(*parts)
    return installed if installed.exists() else package.parent.joinpath(*parts)


def _read_urdf(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except OSError as error:
        raise BuildError(f"cannot read the URDF '{path}': {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BuildError(f"the URDF '{path}' is not UTF-8 text") from error


def _mesh_dir(options: FmuOptions) -> Path | None:
    if options.mesh_dir is not None and not options.mesh_dir.is_dir():
        raise BuildError(f"the mesh folder '{options.mesh_dir}' does not exist")
    return options.mesh_dir if options.urdf else data_file("meshes")


def _model(options: FmuOptions, urdf: str) -> tuple[Robot, list[Variable], dict[str, Any]]:
    """The robot, its variables, and the start values that are not the table's own."""
    shipped = options.urdf is None
    axes = options.axes or ("xy" if shipped else "xyz")
    try:
        robot = load_robot(urdf, options.frame, axes)
    except RobotError as error:
        raise BuildError(f"{options.urdf or '2dof.urdf'}: {error}") from error
    starts: dict[str, Any] = dict(DEFAULT_ARM) if shipped else {"q_start": _rest(robot)}
    for key in ("gravity", "q_start"):
        given = getattr(options, key)
        if given is not None:
            if not all(map(math.isfinite, given)):
                raise BuildError(f"{key} {given} must be finite numbers")
            starts[key] = tuple(float(value) for value in given)
    if len(starts["q_start"]) != len(robot.joints):
        raise BuildError(
            f"q_start has {len(starts['q_start'])} values, the robot has {len(robot.joints)}"
            f" joints: {', '.join(robot.joints)}"
        )
    starts.setdefault("x_des", (0.0,) * len(axes))
    if not shipped:
        plant = Plant(robot, variable_table(robot, starts))
        plant.initialise()
        starts["x_des"] = tuple(plant.x)
    elif axes != "xy":
        raise BuildError("the shipped arm moves in the x-y plane: its axes are xy")
    return robot, variable_table(robot, starts), starts


def _rest(robot: Robot) -> tuple[float, ...]:
    """0 where it is inside the limits, else their middle."""
    return tuple(
        0.0 if low <= 0.0 <= high else 0.5 * (low + high)
        for low, high in zip(robot.q_min, robot.q_max, strict=True)
    )


def _slave_sources() -> Files:
    """The Python code of the FMU under names that no other FMU's code has."""
    here = Path(__file__).parent
    package = {f"plant/{path.name}": path.read_bytes() for path in (here / "plant").glob("*.py")}
    wrapper = Path(pythonfmu.__file__).parent
    package.update({f"pythonfmu/{name}": (wrapper / name).read_bytes() for name in PYTHONFMU_FILES})
    package["pythonfmu/__init__.py"] = package["__init__.py"] = b""
    slave = data_file("fmu_src", "slave.py").read_bytes()
    digest = hashlib.sha256(slave)
    for name in sorted(package):
        digest.update(name.encode() + b"\0" + package[name])
    tag = digest.hexdigest()[:12]
    files = {f"twodof_{tag}/{name}": content for name, content in package.items()}
    files[f"slave_{tag}.py"] = slave
    files["slavemodule.txt"] = f"slave_{tag}\n".encode()
    return files


def _site_packages() -> list[str]:
    folders = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
    if site.ENABLE_USER_SITE:
        folders.append(site.getusersitepackages())
    return list(dict.fromkeys(folders))


def _holds(path: Path, files: Files) -> bool:
    """Whether the file is already this FMU; its guid is a digest of all that matters."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.read("modelDescription.xml") == files["modelDescription.xml"]
    except (*ZIP_ERRORS, KeyError):
        return False


def _write_zip(path: Path, files: Files) -> None:
    """Sorted entries with fixed dates, so that equal inputs give equal bytes; whole or not."""
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=path.name, delete=False) as file:
            partial = Path(file.name)
            try:
                with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
                    for name in sorted(files):
                        entry = zipfile.ZipInfo(name, ZIP_DATE)
                        entry.compress_type = zipfile.ZIP_DEFLATED
                        entry.external_attr = 0o644 << 16
                        archive.writestr(entry, files[name])
                os.chmod(partial, 0o644)
                os.replace(partial, path)
            except BaseException:
                partial.unlink(missing_ok=True)
                raise
    except OSError as error:
        raise BuildError(f"cannot write '{path}': {error.strerror}") from error
