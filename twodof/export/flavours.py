"""The two flavours of the FMU: the files that each adds to the common ones."""

import hashlib
import json
import logging
import os
import site
import sysconfig
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pythonfmu

from ..errors import BuildError
from ..files import data_file
from ..plant.robot import Robot
from ..plant.variables import CONTROLS, OF_ORIENTATION, Starts, Variable
from .bodies import FreeLink
from .compiler import EXTENSIONS, UNITS, compile_library, standard_headers
from .fmi3_files import build_description, terminals_and_icons
from .fmu_options import FmuOptions
from .mechanism_source import mechanism_source
from .native import model_header
from .python_wrapper import repaired_wrapper

LOG = logging.getLogger(__name__)

Files = dict[str, bytes]  # contents by path inside the FMU

PYTHONFMU = Path(pythonfmu.__file__).parent
PYTHONFMU_FILES = ("_version.py", "default_experiment.py", "enums.py", "fmi2slave.py", "logmsg.py", "variables.py")


@dataclass(frozen=True)
class Flavour:
    """Files that one flavour adds."""

    native: bool  # whether the flavour is C, with sources, Model Exchange and derivatives
    files: Files  # resources and sources; the GUID is a digest of them
    platforms: Sequence[str]  # FMI platforms of the binaries
    # function that returns the files that contain the GUID, for example compiled libraries
    signed: Callable[[str], Files]
    fmi: int = 2  # version of FMI, 2 or 3
    arrays: bool = False  # whether vectors are arrays of FMI 3


def python_flavour(options: FmuOptions, robot: Robot, urdf: str, starts: Starts) -> Flavour:
    """Return the Python flavour: the plant behind pythonfmu's wrapper, for linux64."""
    folders = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
    folders += [site.getusersitepackages()] if site.ENABLE_USER_SITE else []
    config: dict[str, object] = {
        "frame": robot.frame,
        "axes": robot.axes,
        "control": options.control,
        "outputs": options.outputs,
        "starts": starts,
        "site_packages": [*dict.fromkeys(folders)] if options.link_environment else [],
    }
    identity = hashlib.sha256(urdf.encode() + json.dumps(config, sort_keys=True).encode())
    config["identity"] = identity.hexdigest()
    path = PYTHONFMU / "resources/binaries/linux64/libpythonfmu-export.so"
    if (wrapper := repaired_wrapper(path.read_bytes())) is None:
        remedy = "run 'pip install --force-reinstall pythonfmu==0.7.0'"
        raise BuildError(f"'{path}' is not the library of pythonfmu 0.7.0; {remedy}")
    config["wrapper"] = hashlib.sha256(wrapper).hexdigest()  # the GUID covers it too
    resources = {
        **_slave_sources(),
        "plant.json": (json.dumps(config, indent=1, sort_keys=True) + "\n").encode(),
        "requirements.txt": data_file("fmu_src", "requirements.txt").read_bytes(),
    }
    return Flavour(
        native=False,
        files={f"resources/{path}": content for path, content in resources.items()},
        platforms=("linux64",),
        signed=lambda guid: {f"binaries/linux64/{options.name}.so": wrapper},
    )


def engine_sources(control: str, fmi: int = 2, outputs: Sequence[str] = ()) -> Files:
    """Return the engine's C files with one control law, requested outputs and the functions of one FMI version."""
    law = "task" if control == "pose" else control
    left_out = {f"{other}_control.c" for other in CONTROLS if other != law}
    left_out |= set() if law == "task" else {"pseudo_inverse.c", "task_slopes.c"}
    left_out |= set() if OF_ORIENTATION & {*CONTROLS[control].outputs, *outputs} else {"orientation.c"}
    left_out |= {"fmi2.c"} if fmi == 3 else {"fmi3.c", "clock.c"}
    return {
        path.name: path.read_bytes() for path in data_file("fmu_src", "native").iterdir() if path.name not in left_out
    }


def native_flavour(
    options: FmuOptions,
    robot: Robot,
    table: Sequence[Variable],
    fmi: int,
    platforms: Sequence[str],
    links: Sequence[FreeLink] = (),
) -> Flavour:
    """Return the native flavour: the plant as C99 sources, compiled for the platforms."""
    name, control, arrays = options.name, options.control, options.arrays and fmi == 3
    headers = standard_headers()
    sources = engine_sources(control, fmi, options.outputs)
    sources["mechanism.c"] = mechanism_source(robot, table, links).encode()
    if fmi == 2:  # in 3.0 the importer provides them, so that compilers check arguments
        sources |= {file: text for file, text in headers.items() if file.startswith("fmi2")}

    def header(guid: str) -> bytes:
        return model_header(robot, table, control, guid, fmi, arrays, options.clocked).encode()

    def signed(guid: str) -> Files:
        all_sources = {**headers, **sources, "model.h": header(guid)}

        def library(platform: str) -> bytes:
            LOG.info("compiling for %s", platform)
            return compile_library(all_sources, platform, name)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            libraries = {
                f"binaries/{platform}/{name}{EXTENSIONS[platform]}": content
                for platform, content in zip(platforms, pool.map(library, platforms))
            }
        return {"sources/model.h": all_sources["model.h"], **libraries}

    files = {f"sources/{path}": content for path, content in sources.items()}
    files["sources/model.h"] = header("")
    if fmi == 3:
        files["sources/buildDescription.xml"] = build_description(name, UNITS)
        files["terminalsAndIcons/terminalsAndIcons.xml"] = terminals_and_icons([v for v in table if v.shown], arrays)
    return Flavour(native=True, files=files, platforms=platforms, signed=signed, fmi=fmi, arrays=arrays)


def _slave_sources() -> Files:
    """Return the Python code of the FMU, under module names that are unique to the FMU."""
    plant = Path(__file__).parents[1] / "plant"
    package = {f"plant/{path.name}": path.read_bytes() for path in plant.glob("*.py")}
    for name in PYTHONFMU_FILES:
        package[f"pythonfmu/{name}"] = (PYTHONFMU / name).read_bytes()
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
