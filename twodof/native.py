"""The native flavour: the header of a robot's constants, and compiling the C engine with it.

The engine in ``fmu_src/native/`` is generic. Its constants are a C header, ``model.h``, in which
each joint turns about, or slides along, the z axis of its own frame: frames are rotated here, once,
so that the engine has one kind of axis. Pinocchio has read the URDF.
"""

from __future__ import annotations

import importlib.util
import os
import platform as host
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import BuildError
from .files import temporary_folder
from .plant.robot import Robot
from .plant.variables import Variable

Array = NDArray[np.float64]

MAX_JOINTS = 128
"""The engine's working memory is on the stack: 0.2 MB at this number."""
GROUPS = (
    "x_des", "xd_des", "xdd_des", "Kp", "Kd", "tau_ext", "Kn",
    "q", "v", "x", "tau",
    "q_start", "v_start", "q_min", "q_max", "gravity",
    "rcond", "rtol", "atol", "max_step", "limit_effort",
)  # fmt: skip
"""The order of variables that the engine relies on: inputs, outputs, parameters."""
FIRST_OUTPUT, FIRST_PARAMETER = "q", "q_start"

TARGETS: dict[str, tuple[str, ...]] = {
    "linux64": ("x86_64-linux-gnu.2.17",),
    "win64": ("x86_64-windows-gnu",),
    "darwin64": ("x86_64-macos.11.0", "aarch64-macos.11.0"),
}
"""zig's targets by FMI platform; several are joined into one universal library."""
EXTENSIONS = {"linux64": ".so", "win64": ".dll", "darwin64": ".dylib"}
FLAGS = (
    "-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden",
    "-Wall", "-Wextra", "-pedantic", "-shared",
)  # fmt: skip
"""Multiplications are never fused with additions, so that platforms agree."""


def model_header(robot: Robot, table: Sequence[Variable], guid: str) -> str:
    """The text of ``model.h``: all constants of a robot and its variables, exact to the bit.

    Names from the URDF, which may be anybody's, are string literals and nothing else.

    Args:
        robot: the robot, n joints in Pinocchio's order.
        table: its variables; a variable's place is its value reference.
        guid: as the modelDescription has it.

    Raises:
        BuildError: more joints than the engine's working memory has room for.
    """
    n, m = len(robot.joints), len(robot.axes)
    if n > MAX_JOINTS:
        raise BuildError(f"the robot has {n} joints; the native flavour has room for {MAX_JOINTS}")
    groups = [variable.group for variable in table]
    assert tuple(dict.fromkeys(groups)) == GROUPS
    model = robot.model
    to_z = [_rotation_to_z(_axis(joint)) for joint in list(model.joints)[1:]]
    turned = [np.eye(3), *to_z]  # by Pinocchio's joint index, 0 the root
    parents = [int(parent) for parent in list(model.parents)[1:]]
    placements = list(model.jointPlacements)[1:]
    inertias = list(model.inertias)[1:]
    frame = model.frames[robot.frame_id]
    path = [int(i) - 1 for i in model.supports[frame.parentJoint]][1:]
    sections = [
        "/* Constants of a robot, generated from its URDF. SI units. Each joint turns about, or\n"
        "   slides along, the z axis of its own frame. */\n"
        "#ifndef MODEL_H\n#define MODEL_H\n\n#include <math.h>\n",
        f"#define MODEL_GUID {_quoted(guid)}\n"
        f"#define N_JOINTS {n}\n#define N_AXES {m}\n"
        f"#define N_PATH {len(path)} /* joints that move the task frame */\n",
        _value_references(groups),
        _table("char *const VARIABLE_NAME", (variable.name for variable in table)),
        _table("double START", (0.0 if v.start is None else float(v.start) for v in table)),
        _table("char *const JOINT_NAME", robot.joints),
        "/* The tree: parents are -1 for the root; joints from the root to the task frame. */\n"
        + _table("int PARENT", (parent - 1 for parent in parents)),
        _table("int PRISMATIC", map(int, robot.prismatic)),
        _table("int PATH", path or [0]),
        _table("int AXIS", ("xyz".index(axis) for axis in robot.axes)),
        "/* Joint frames in their parents' at q = 0; the task frame in its joint's. */\n"
        + _table(
            "double JOINT_R",
            (turned[p].T @ M.rotation @ R for p, M, R in zip(parents, placements, to_z)),
        ),
        _table(
            "double JOINT_P", (turned[p].T @ M.translation for p, M in zip(parents, placements))
        ),
        f"static const double FRAME_P[3] = "
        f"{_literal(turned[frame.parentJoint].T @ frame.placement.translation)};\n",
        "/* Bodies: mass, centre of mass, inertia about it, in the joint's frame. */\n"
        + _table("double MASS", (inertia.mass for inertia in inertias)),
        _table("double COM", (R.T @ inertia.lever for R, inertia in zip(to_z, inertias))),
        _table("double INERTIA", (R.T @ inertia.inertia @ R for R, inertia in zip(to_z, inertias))),
        "/* Effort limits, HUGE_VAL where there is none, and viscous damping of the joints. */\n"
        + _table("double EFFORT", robot.effort),
        _table("double DAMPING", robot.damping),
        "#endif\n",
    ]
    return "\n".join(sections)


def compile_library(
    sources: Mapping[str, bytes],
    platform: str,
    name: str,
    *,
    flags: Sequence[str] = (),
) -> bytes:
    """The shared library of an FMU.

    Args:
        sources: contents of the C files and headers by file name, ``model.h`` and the headers of
            the FMI standard among them.
        platform: FMI platform, a key of ``TARGETS``.
        name: model identifier, the library's name without extension.
        flags: further flags for the compiler.

    Raises:
        BuildError: the platform does not exist, there is no compiler for it, or the compiler
            failed.
    """
    if platform not in TARGETS:
        raise BuildError(f"there is no platform '{platform}'; there are {', '.join(TARGETS)}")
    with temporary_folder() as folder:
        for file, content in sources.items():
            (folder / file).write_bytes(content)
        files = sorted(file for file in sources if file.endswith(".c"))
        output = name + EXTENSIONS[platform]
        built = []
        for compiler in _compilers(platform):
            _run([*compiler, *FLAGS, *flags, *_link_flags(platform, output), *files], folder)
            built.append((folder / output).read_bytes())
    return built[0] if len(built) == 1 else universal(built)


def host_platform() -> str:
    """FMI platform of this machine; "" where the native flavour knows none."""
    if host.machine().lower() in ("x86_64", "amd64") or sys.platform == "darwin":
        return {"linux": "linux64", "win32": "win64", "darwin": "darwin64"}.get(sys.platform, "")
    return ""


def universal(libraries: Sequence[bytes]) -> bytes:
    """Mach-O libraries of several architectures as one file.

    Its header is that of ``mach-o/fat.h``: magic and count, and per architecture CPU type and
    subtype (from its own header), offset, size and alignment (2¹⁴), big-endian.
    """
    align = 14
    entries, body = [], b""
    offset = 1 << align
    for library in libraries:
        cpu, subtype = struct.unpack_from("<II", library, 4)
        body += b"\0" * (-len(body) % (1 << align)) + library
        entries.append(struct.pack(">5I", cpu, subtype, offset, len(library), align))
        offset = (1 << align) + len(body) + -len(body) % (1 << align)
    header = struct.pack(">II", 0xCAFEBABE, len(libraries)) + b"".join(entries)
    return header.ljust(1 << align, b"\0") + body


def _compilers(platform: str) -> list[list[str]]:
    """Commands that compile for a platform, one for each architecture."""
    if importlib.util.find_spec("ziglang") is not None:
        zig = [sys.executable, "-m", "ziglang", "cc", "-target"]
        return [[*zig, target] for target in TARGETS[platform]]
    own = next((cc for cc in ("cc", "gcc", "clang") if shutil.which(cc)), None)
    if platform == host_platform() and own:
        architectures = ["-arch", "x86_64", "-arch", "arm64"] if platform == "darwin64" else []
        return [[own, *architectures]]
    missing = f"this machine's own compiler builds for {host_platform() or 'no FMI platform'} only"
    if platform == host_platform():
        missing = "this machine has no C compiler"
    raise BuildError(
        f"cannot compile for {platform}: {missing}; install the package 'ziglang'"
        " (the extra 'native'), which compiles for every platform"
    )


def _link_flags(platform: str, output: str) -> list[str]:
    """Flags that leave nothing of this machine and this moment in the library."""
    flags = ["-s", "-o", output]
    if platform == "linux64":
        return ["-fPIC", *flags, f"-Wl,-soname,{output}", "-lm"]
    if platform == "darwin64":
        return [*flags, f"-Wl,-install_name,@rpath/{output}"]
    return flags


def _run(command: Sequence[str], folder: Path) -> None:
    try:
        done = subprocess.run(
            command, cwd=folder, env=_environment(folder),
            capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
    except OSError as error:
        raise BuildError(f"cannot run the compiler '{command[0]}': {error}") from error
    if done.returncode != 0:
        raise BuildError(
            f"the compiler failed (exit status {done.returncode}): {' '.join(command)}\n"
            f"{done.stderr.strip() or done.stdout.strip()}"
        )


def _environment(folder: Path) -> dict[str, str]:
    """This process's environment; zig's cache is in the folder where home has no room for it."""
    environment = dict(os.environ)
    if os.name == "posix" and not environment.get("ZIG_GLOBAL_CACHE_DIR"):
        home = environment.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
        cache = Path(home, "zig")
        try:
            cache.mkdir(parents=True, exist_ok=True)
            usable = os.access(cache, os.W_OK)
        except OSError:
            usable = False
        environment["ZIG_GLOBAL_CACHE_DIR"] = str(cache if usable else folder / "zig-cache")
    return environment


def _axis(joint: object) -> Array:
    """Unit axis of a joint with one coordinate, in its own frame."""
    data = joint.createData()  # type: ignore[attr-defined]
    joint.calc(data, np.zeros(1))  # type: ignore[attr-defined]
    subspace = np.asarray(data.S).reshape(6)  # linear, angular
    axis: Array = subspace[:3] + subspace[3:]
    return axis


def _rotation_to_z(axis: Array) -> Array:
    """A rotation R with R e_z = axis; a permutation, so exact, where the axis is x, y or z."""
    k = int(np.argmax(np.abs(axis)))
    x = np.roll(np.eye(3)[0], k + 1)  # the coordinate axis after the largest component
    x -= axis * axis.dot(x)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])


def _value_references(groups: Sequence[str]) -> str:
    lines = [f"    {group.upper()} = {groups.index(group)}," for group in GROUPS]
    lines.append(f"    N_VARIABLES = {len(groups)},")
    for constant, group in (("FIRST_OUTPUT", FIRST_OUTPUT), ("FIRST_PARAMETER", FIRST_PARAMETER)):
        lines.append(f"    {constant} = {group.upper()},")
    body = "\n".join(lines)
    return f"/* Value references: the first of each vector. */\nenum {{\n{body}\n}};\n"


def _table(declaration: str, values: Iterable[object]) -> str:
    rows = list(values)
    shape = "".join(f"[{size}]" for size in (len(rows), *np.asarray(rows[0]).shape))
    body = "".join(f"\n    {_literal(row)}," for row in rows)
    return f"static const {declaration}{shape} = {{{body}\n}};\n"


def _literal(value: object) -> str:
    if isinstance(value, np.ndarray):
        return "{" + ", ".join(_literal(element) for element in value) + "}"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, int):
        return str(value)
    number = float(value)  # type: ignore[arg-type]
    return "HUGE_VAL" if np.isinf(number) else repr(number)


def _quoted(text: str) -> str:
    """A C string literal; what is not printable ASCII as octal escapes of its UTF-8."""
    escaped = "".join(
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
        for byte in text.encode()
    )
    return f'"{escaped}"'
