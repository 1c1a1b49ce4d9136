"""Where a run came from: run.json, written beside the messages, and never behind them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..errors import BagError
from ..experiments import Changes, Experiment
from ..files import read_file
from ..fmu import urdf_text
from ..version import versions

FILE = "run.json"
FORMAT = 1
MAX_YAML = 256 * 1024  # bytes of changes: a writer of YAML takes 2 s for a MiB
TAIL = b"]}\n"
KNOWN_UNTIL = "inputs_known_until"
"""Key of the time, s, from which on more inputs changed than the file has room for."""
MAX_SIZE = 64 * 1024**2
PACKAGES = ("numpy", "fmpy", "rosbags", "pin")


class ProvenanceFile:
    """run.json of a bag that is being written: whole at any moment, with the changes so far.

    The changes of inputs stand at its end, so that adding some writes no other byte anew.

    Args:
        folder: of the bag.
        run: the experiment.
        command_line: that made the bag; "" where none did.

    Raises:
        OSError: it cannot be written; so does ``add``, which can be called again then.
    """

    def __init__(self, folder: Path, run: Experiment, command_line: str) -> None:
        self.path = folder / FILE
        self._head = _as_json(_provenance(run, command_line))[:-1] + b',"input_changes":['
        self.path.write_bytes(self._head + TAIL)
        self._start, self._end = run.start_time, len(self._head)
        self._separator, self._full = b"", False

    def add(self, changes: Changes) -> None:
        """Add times and the inputs that changed there, as many as a reader is ready for."""
        if self._full or not changes:
            return
        text, tail = self._separator + b",".join(_as_json([t, v]) for t, v in changes), TAIL
        if self._end + len(text) > MAX_SIZE - 100:
            text, tail = b"", self._until(changes[0][0])
            self._full = True
        with self.path.open("r+b") as file:
            file.seek(self._end)
            file.write(text + tail)
        self._end += len(text)
        self._separator = b","

    def text(self) -> str:
        """What the bag's own metadata holds: the whole, or where that is long no changes."""
        content = self.path.read_bytes()
        if len(content) > len(self._head) + MAX_YAML:
            content = self._head + self._until(self._start)
        return content.decode().strip()

    def _until(self, time: float) -> bytes:
        return b'],"%s":%r}\n' % (KNOWN_UNTIL.encode(), time)


def _provenance(run: Experiment, command_line: str) -> dict[str, Any]:
    """All but the changes of inputs."""
    fmu = run.fmu
    return {
        "format": FORMAT,
        "fmu": {"name": fmu.name, "guid": fmu.guid, "file": fmu.path.name},
        "robot": fmu.robot,
        "frame": fmu.frame,
        "root": fmu.root,
        "axes": fmu.axes,
        "joints": list(fmu.joints),
        "start_time": run.start_time,
        "step": run.step,
        "start_values": dict(run.start_values),
        "versions": versions(*PACKAGES),
        "command_line": command_line,
        "urdf": urdf_text(fmu),
    }


def _as_json(content: Any) -> bytes:
    """Without a single space: writers of YAML, which holds it too, fold there, not all rightly."""
    return json.dumps(content, separators=(",", ":")).replace(" ", "\\u0020").encode()


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
    numbers = [found.get(key) for key in ("start_time", "step")]
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
