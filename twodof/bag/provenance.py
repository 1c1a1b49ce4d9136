"""Where a run came from: run.json, written beside the messages before the first of them."""

from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import BagError
from ..files import read_file
from ..fmu import read_urdf
from ..master import Experiment

FILE = "run.json"
FORMAT = 1
MAX_SIZE = 64 * 1024**2
PACKAGES = ("numpy", "fmpy", "rosbags", "pin")


def provenance(run: Experiment, stamp_start: int, command_line: str) -> str:
    """What plots, replay and recovery need to know, as JSON without a single space.

    Writers of YAML, which holds it too, fold at spaces, and not all do it right.
    """
    fmu = run.fmu
    content = {
        "format": FORMAT,
        "fmu": {"name": fmu.name, "guid": fmu.guid, "file": fmu.path.name},
        "robot": fmu.robot,
        "frame": fmu.frame,
        "root": fmu.root,
        "axes": fmu.axes,
        "joints": list(fmu.joints),
        "start_time": run.start_time,
        "step": run.step,
        "steps": run.steps,
        "stamp_start_ns": stamp_start,
        "start_values": dict(run.start_values),
        "input_changes": [[t, values] for t, values in run.changes],
        "versions": versions(*PACKAGES),
        "command_line": command_line,
        "urdf": read_urdf(fmu),
    }
    return json.dumps(content, separators=(",", ":")).replace(" ", "\\u0020")


def versions(*packages: str) -> dict[str, str]:
    """Of this package, and of others that are installed."""
    installed = {name: importlib.metadata.version(name) for name in packages}
    return {"twodof": __version__, **installed}


def read_provenance(path: Path) -> dict[str, Any]:
    """The provenance in a bag's folder; {} where there is none, or a file of another tool.

    Raises:
        BagError: it cannot be read, or is not what was written.
    """
    file = path / FILE
    try:
        content = read_file(file, MAX_SIZE)
        if content.count(b"{") + content.count(b"[") > len(content) // 8 + 1000:
            # an empty one takes 24 times as much memory
            raise ValueError("it is damaged")
        found = json.loads(content.decode("utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise BagError(f"cannot read '{file}': {error}") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT or "fmu" not in found:
        return {}
    if not _is_sound(found):
        raise BagError(f"cannot read '{file}': it is damaged")
    return found


def _is_sound(found: dict[str, Any]) -> bool:
    texts = [found.get(key) for key in ("robot", "frame", "root", "axes", "command_line")]
    numbers = [found.get(key) for key in ("start_time", "step", "steps", "stamp_start_ns")]
    fmu, joints = found["fmu"], found.get("joints")
    starts, changes = found.get("start_values"), found.get("input_changes")
    return (
        isinstance(fmu, dict)
        and isinstance(joints, list)
        and isinstance(changes, list)
        and isinstance(found.get("versions"), dict)
        and all(isinstance(text, str) for text in texts)
        and all(isinstance(fmu.get(key), str) for key in ("name", "guid", "file"))
        and all(isinstance(joint, str) for joint in joints)
        and isinstance(found.get("urdf"), str | None)
        and all(isinstance(number, int | float) for number in numbers)
        and _are_values(starts)
        and all(
            isinstance(change, list)
            and len(change) == 2
            and isinstance(change[0], int | float)
            and _are_values(change[1])
            for change in changes
        )
    )


def _are_values(found: object) -> bool:
    return isinstance(found, dict) and all(isinstance(v, int | float) for v in found.values())
