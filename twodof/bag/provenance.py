"""Provenance of a run: run.json, flushed before the messages that it describes.

In a bag of several robots, each robot has a file run.NAME.json, where NAME is its namespace.
"""

import json
import re
from pathlib import Path
from typing import Any, Final, TypedDict, cast
from urllib.parse import quote, unquote

from ..bounds import CHANGE, MAX_HELD, MAX_NAME, MAX_PROVENANCE, MAX_ROBOTS, MAX_VARIABLES, MIB
from ..errors import BagError
from ..files import NUMBER, VALUES, JsonObject, fits, parsed, read_file
from ..fmu import System
from ..simulation.experiments import Experiment
from ..simulation.input_values import Changes, Value
from ..simulation.setup import controller_of
from ..version import versions
from .mcap import read_metadata
from .records import DamageError

FILE = "run.json"
FORMAT = 1
KEY = "twodof"  # key of the provenance in a bag's own metadata
MAX_YAML = 256 * 1024  # bytes of changes in metadata.yaml: YAML libraries take seconds per MiB
KNOWN_UNTIL: Final = "inputs_known_until"
"""Key of the time, s, after which changes of inputs are missing because the file is full."""
MAX_TAIL = 64 * 1024  # bytes of commanders and verdict; 20 commanders have fewer
PACKAGES = ("numpy", "fmpy", "rosbags", "pin")

SHAPE = {
    "fmu": {"name": str, "guid": str, "file": str},
    "robot": str,
    "frame": str,
    "root": str,
    "axes": str,
    "joints": [str],
    "start_time": NUMBER,
    "step": NUMBER,
    "start_values": VALUES,
    "versions": dict,
    "command_line": str,
    "urdf": str | None,
    "input_changes": [(NUMBER, VALUES)],
}
"""Shape of a valid run.json, for ``fits``."""
NAMES = ("name", "file", "robot", "frame", "root")
"""Keys of run.json, and of its facts about the FMU, whose values are names."""


class Provenance(TypedDict, total=False):
    """Content of run.json; empty for a third-party bag.

    ``texts`` has start values of variables of type String, ``signals`` the names of the recorded signals, and
    ``system`` the FMUs of a system and their connections, and ``controller`` the name of its robot's controller.
    ``input_changes`` has pairs of a time, s, and values by name; ``commanders`` has pairs of a time and facts of a
    third party. ``verdict`` is missing if the writer died.
    """

    format: int
    fmu: dict[str, str]
    robot: str
    frame: str
    root: str
    axes: str
    joints: list[str]
    start_time: float
    step: float
    start_values: dict[str, Value]
    texts: dict[str, str]
    versions: dict[str, str]
    command_line: str
    urdf: str | None
    signals: list[str]
    system: dict[str, object]
    controller: str
    input_changes: list[list[Any]]
    inputs_known_until: float
    commanders: list[object]
    verdict: JsonObject


class ProvenanceFile:
    """run.json of a bag in progress, a valid file with all changes so far at any moment.

    The changes of inputs are almost at the end of the file, so that a further change rewrites few bytes.

    Raises:
        OSError: the file cannot be written. ``add`` raises it too, and can be called again.
    """

    def __init__(self, folder: Path, namespace: str, run: Experiment, command_line: str) -> None:
        self.path, self.key = folder / file_of(namespace), key_of(namespace)
        self._head = _as_json(provenance_of(run, command_line))[:-1] + b',"input_changes":['
        if len(self._head) > MAX_PROVENANCE - MAX_TAIL:
            much = (
                f"the robot description, names and start values of '{run.fmu.path}' have {len(self._head) // MIB} MiB"
            )
            most = (MAX_PROVENANCE - MAX_TAIL) // MIB
            raise BagError(f"cannot write '{self.path}': {much}; at most {most} are stored")
        self._run, self._commanders = run, len(run.commanders)
        self._verdict: JsonObject | None = None
        self._until: float | None = None
        self.path.write_bytes(self._head + self._tail())
        self._start, self._end = run.start_time, len(self._head)
        self._separator, self._full = b"", False

    def add(self, changes: Changes, verdict: JsonObject | None = None) -> None:
        """Append times and the inputs that changed at them, up to the size that readers accept, and set the verdict."""
        commanders = len(self._run.commanders)
        same = commanders == self._commanders and verdict is self._verdict
        self._verdict = verdict
        if (self._full or not changes) and same:
            return
        text, tail = b",".join(_as_json([t, v]) for t, v in changes), self._tail()
        text = self._separator + text if text else text
        if self._full or self._end + len(text) > MAX_PROVENANCE - MAX_TAIL:
            self._until = changes[0][0] if self._until is None else self._until
            text, tail = b"", self._tail(self._until)
            self._full = True
        with self.path.open("r+b") as file:
            file.seek(self._end)
            file.write(text + tail)
        self._end += len(text)
        self._separator, self._commanders = b"," if changes else self._separator, commanders

    def text(self) -> str:
        """Return the provenance for the bag's metadata, without the changes of inputs if these are long."""
        content = self.path.read_bytes()
        if len(content) > len(self._head) + MAX_YAML:
            content = self._head + self._tail(self._start)
        return _for_yaml(content)

    def _tail(self, until: float | None = None) -> bytes:
        """Return the commanders, the verdict, and the time until which the changes of inputs are complete."""
        rest: Provenance = {}
        if self._verdict is not None and len(_as_json(self._verdict)) < MAX_TAIL // 2:  # names have no length limit
            rest["verdict"] = self._verdict
        if self._run.commanders:
            rest["commanders"] = [*self._run.commanders]
        if until is not None:
            rest[KNOWN_UNTIL] = until
        return (b"]," if rest else b"]") + _as_json(rest)[1:] + b"\n"


def for_metadata(text: bytes, provenance: Provenance) -> str:
    """Return the text of a run.json for metadata.yaml, without the changes of inputs if it is long."""
    if len(text) > MAX_YAML:
        text = _as_json({**provenance, "input_changes": [], KNOWN_UNTIL: provenance["start_time"]})
    return _for_yaml(text)


def provenance_of(run: Experiment, command_line: str) -> Provenance:
    """Return a run's provenance without the changes of inputs."""
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
        "urdf": fmu.urdf,
        **({"texts": dict(run.texts)} if run.texts else {}),
        **({"signals": [*run.signals]} if run.signals else {}),
        **(_system(fmu) if isinstance(fmu, System) else {}),
    }


def _system(system: System) -> Provenance:
    fmus = {name: {"name": fmu.name, "guid": fmu.guid} for name, fmu in system.components.items()}
    return {"system": {"components": fmus, "connections": system.connections}, "controller": controller_of(system)}


def file_of(namespace: str) -> str:
    """Return the name of a robot's provenance file in its bag's folder."""
    return f"run.{quote(namespace, safe='')}.json" if namespace else FILE


def key_of(namespace: str) -> str:
    """Return the key of a robot's provenance in the bag's metadata."""
    return f"{KEY}/{namespace}" if namespace else KEY


def robots_of(folder: Path) -> list[str]:
    """Return the namespaces of a bag's robots that have provenance, [""] for one robot or none."""
    if (folder / FILE).exists():
        return [""]
    names = (file.name for file in folder.glob("run.*.json"))  # "run.left (1).json" is a copy
    matches = (re.fullmatch(r"run\.([\w%]+)\.json", name, re.ASCII) for name in names)
    robots = (unquote(match[1]) for match in matches if match)
    return sorted(robot for robot in robots if re.fullmatch(r"\w+(/\w+)*", robot, re.ASCII)) or [""]


def robot_in(path: Path) -> tuple[Path, str]:
    """Split an address such as "pair:left" into the bag's folder and the robot's namespace.

    Raises:
        BagError: the bag does not have this robot, or has several robots and the address names none.
    """
    text, _, name = str(path).rpartition(":")
    if path.exists() or not text or not Path(text).is_dir():
        text, name = str(path), ""
    folder = Path(text)
    robots = robots_of(folder)
    if name in robots or (not name and len(robots) == 1):
        return folder, name or robots[0]
    if robots == [""]:
        raise BagError(f"the bag '{folder}' has one robot; leave ':{name}' out")
    choice = ", ".join(f"'{folder}:{robot}'" for robot in robots)
    reason = f"has no robot '{name}'; there are" if name else "is of several robots; give one,"
    raise BagError(f"the bag '{folder}' {reason} {choice}")


def each_robot(path: Path) -> list[Path]:
    """Return the addresses of a bag's robots, as ``robot_in`` accepts them."""
    robots = robots_of(path) if path.is_dir() else [""]
    if len(robots) == 1:
        return [path]
    one = f"give one, such as '{path}:{robots[0]}'"
    if len(robots) > MAX_ROBOTS:
        raise BagError(f"the bag '{path}' is of {len(robots)} robots, more than {MAX_ROBOTS} at a time; {one}")
    if sum((path / file_of(robot)).stat().st_size for robot in robots) > MAX_PROVENANCE:
        raise BagError(f"the run.*.json files of '{path}' have more than {MAX_PROVENANCE // MIB} MiB together; {one}")
    return [Path(f"{path}:{robot}") for robot in robots]


def _as_json(content: object) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode()


def _for_yaml(text: bytes) -> str:
    """Return JSON without spaces, because some YAML writers fold lines incorrectly at spaces."""
    return text.decode("utf-8").strip().replace(" ", "\\u0020")


def read_provenance(path: Path, namespace: str = "") -> Provenance:
    """Return the provenance of a bag's robot; {} for a third-party bag.

    It is in the bag's folder, or in the metadata of a bag that is a single file.
    """
    single = path.suffix == ".mcap" and path.is_file()
    file = path if single else path / file_of(namespace)
    try:
        text = read_metadata(path, KEY, FILE).encode() if single else read_file(file, MAX_PROVENANCE, follow=False)
        if single and not text:
            return {}
        content = parsed(text)
        if isinstance(content, dict) and content.get("format") == FORMAT and "fmu" in content:
            optional = (KNOWN_UNTIL, 0.0, NUMBER), ("controller", "", str)
            if not fits(content, SHAPE) or not all(fits(content.get(key, none), of) for key, none, of in optional):
                raise ValueError("it is damaged")
            if len(content["start_values"]) > MAX_VARIABLES:
                raise ValueError(f"it has more than {MAX_VARIABLES} start values")
            facts = {**content, **content["fmu"]}
            if max(map(len, (*content["joints"], *(facts[key] for key in NAMES)))) > MAX_NAME:
                raise ValueError(f"it has a name of more than {MAX_NAME} characters")
            if len({*content["axes"]} & {*"xyz"}) < len(content["axes"]):
                raise ValueError(f"its axes '{content['axes']:.50}' are not different letters of 'xyz'")
            return _limited(cast(Provenance, content))
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError, RecursionError, DamageError) as error:
        raise BagError(f"cannot read '{file}': {error}") from error
    return {}


def _limited(provenance: Provenance) -> Provenance:
    """Return a provenance with a limited number of changes of inputs; later changes count as unknown."""
    names, room = set[str](), MAX_HELD
    for i, (time, values) in enumerate(provenance["input_changes"]):
        names.update(values)
        room -= len(names) + CHANGE
        if room < 0:
            provenance["input_changes"] = provenance["input_changes"][:i]
            provenance[KNOWN_UNTIL] = time
            break
    return provenance
