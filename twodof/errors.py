"""Exceptions of the package, and the remedies in their messages.

Each message is one line with the culprit and the remedy.
"""

from __future__ import annotations

import shlex
import zipfile
import zlib
from collections.abc import Iterable
from contextlib import suppress
from difflib import SequenceMatcher, get_close_matches
from heapq import nlargest
from itertools import islice
from os import PathLike, scandir
from pathlib import Path

MAX_COMPARED = 2_000_000  # characters of all known names: their comparison takes a second
LIKELY, LONGEST = 100, 100  # names that are compared in full, and their length: the time grows with its cube
MAX_LISTED = 4000  # characters of the names in a message
MOST_NEIGHBOURS = 1000  # files of a folder among which the nearest name is searched
KINDS = {
    "bag": ("a bag", "twodof view"),
    "sweep": ("a sweep", "twodof plot"),
    "FMU": ("an FMU", "twodof run"),
    "system": ("a system of FMUs", "twodof run"),
    "URDF": ("a robot description", "twodof build"),
    "page": ("a page", "xdg-open"),
    "CSV": ("a CSV file, for `changes` of a run", ""),
    "folder": ("a folder without a bag or a sweep", ""),
}
"""Kinds of paths: the kind in words, and the command that accepts it."""
SUFFIXES = {
    ".fmu": "FMU",
    ".ssp": "system",
    ".urdf": "URDF",
    ".xacro": "URDF",
    ".mcap": "bag",
    ".html": "page",
    ".csv": "CSV",
}
MAKERS = {"FMU": "twodof build", "bag": "twodof run", "sweep": "twodof sweep"}
ZIP_ERRORS = (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError)
"""Exceptions of a damaged, encrypted or foreign zip archive."""


class TwoDofError(Exception):
    """Root of all errors that a user's input or machine causes."""


class BuildError(TwoDofError):
    """An FMU cannot be built: the URDF, its meshes, an option or the compiler is at fault."""


class FmuError(TwoDofError):
    """The file is not an FMU that this master can run."""


class SspError(FmuError):
    """The connections of a system violate SSP 1.0."""


class InputError(TwoDofError):
    """A setting, an input file or a time of the run is invalid."""


class SimulationError(TwoDofError):
    """The FMU refused or failed a call, or returned a value that is not finite.

    Attributes:
        k: number of communication steps before the failure.
        outcome: "discarded" (fmi2Discard), "diverged" (not finite) or "failed" (any other).
    """

    def __init__(self, message: str, k: int = 0, outcome: str = "failed") -> None:
        super().__init__(message)
        self.k, self.outcome = k, outcome


class BagError(TwoDofError):
    """A bag cannot be written or read."""


class SweepError(TwoDofError):
    """A sweep cannot be run, stored or read because of its workers, Dask or the folder."""


class ChildError(TwoDofError):
    """A child process failed with an unexpected exception."""


class PlotError(TwoDofError):
    """A bag cannot be drawn because of matplotlib, the robot, its joints or the output file."""


class PageError(TwoDofError):
    """A page cannot be shown because of its port, the robot or the output file."""


class PublishError(TwoDofError):
    """A run cannot be published because of Cyclone DDS, the network or a ROS 2 variable."""


def diverged(k: int, t: float) -> SimulationError:
    """Return the error for a sample at time t, after k steps, that is not finite."""
    return SimulationError(f"the FMU gave a value that is not finite at t = {t:g} s", k, "diverged")


def step_failure(k: int, t: float, error: SimulationError, remark: str = "") -> SimulationError:
    """Return the error for a step that failed at time t, after k steps."""
    return SimulationError(f"step {k + 1} at t = {t:g} s: {error}{remark}", k, error.outcome)


def nearest(name: str, known: Iterable[str], cutoff: float = 0.6) -> str | None:
    """Return the most similar known name, ignoring case; None without a similar one, or with too many to compare."""
    by_lower = {each.lower(): each for each in reversed([*known]) if len(each) <= LONGEST}
    if len(name) > LONGEST or sum(map(len, by_lower)) > MAX_COMPARED:
        return None
    matcher = SequenceMatcher(b=name.lower())

    def share_of_letters(candidate: str) -> float:
        matcher.set_seq1(candidate)
        return matcher.quick_ratio()

    likely = nlargest(LIKELY, by_lower, key=share_of_letters)
    near = get_close_matches(name.lower(), likely, n=1, cutoff=cutoff)
    return by_lower[near[0]] if near else None


def choice(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return the end of a message about an unknown name: the nearest known one, or all."""
    names = [*known]
    near = nearest(name, names, cutoff)
    if near is not None:
        return f"; did you mean '{near}'?"
    listed = ", ".join(names)
    if len(listed) > MAX_LISTED:
        listed = f"{listed[:MAX_LISTED].rpartition(', ')[0]}, …, {len(names)} in all"
    return f"; there are: {listed}"


def kind_of(path: Path) -> str:
    """Return the kind of a path, a key of ``KINDS``; "" for any other file, or no file."""
    if not path.is_dir():
        return SUFFIXES.get(path.suffix, "") if path.is_file() else ""
    suffixes = {Path(name).suffix for name in _names(path)}
    if ".parquet" in suffixes:
        return "sweep"
    return "bag" if suffixes & {".mcap", ".db3"} or (path / "metadata.yaml").exists() else "folder"


def path_of(value: object, wanted: str) -> Path:
    """Return a value as the path of a file or folder of the kind ``wanted``; raise TypeError if it is no path."""
    if not isinstance(value, str | PathLike):
        raise TypeError(f"{value!r:.50} is not a path; give the path of the {wanted}")
    return Path(value)


def no_such(wanted: str, path: Path, *others: str) -> str:
    """Return the message for a path that does not exist, or has another kind than ``wanted`` and ``others``.

    Kinds are keys of ``KINDS``. The message has a remedy: the command for the path's kind, or a similar path.
    """
    near = neighbour(path, wanted, *others)
    if others:
        wanted = f"{', '.join([wanted, *others[:-1]])} or {others[-1]}"
    words, command = KINDS.get(kind_of(path), ("", ""))
    if words:
        use = f"; use '{command} {shlex.quote(str(path))}'" if command else ""
        article = "an" if wanted.startswith("FMU") else "a"
        return f"'{path}' is not {article} {wanted}: it is {words}{use}"
    made = f"; make one with '{MAKERS[wanted]}'" if wanted in MAKERS else ""
    if path.exists():
        return f"'{path}' is not a {wanted}{made}"
    if str(path).startswith(("http:/", "https:/")):
        return f"'{path}' is a web address, which is not read; download the {wanted} first"
    if not path.parent.is_dir():
        return f"there is no {wanted} '{path}': there is no folder '{path.parent}'"
    return f"there is no {wanted} '{path}'" + (f"; did you mean '{near}'?" if near else made)


def neighbour(path: Path, *kinds: str) -> Path | None:
    """Return the path of one of these kinds with the nearest name in the same folder, or None."""
    others = (path.parent / name for name in _names(path.parent))
    stems = {other.stem: other for other in others if kind_of(other) in kinds}
    alike = (stem for stem in stems if stem.startswith(path.stem) or path.stem.startswith(stem))
    return stems.get(nearest(path.stem, stems) or next(alike, ""))


def _names(folder: Path) -> list[str]:
    with suppress(OSError), scandir(folder) as entries:
        return sorted(entry.name for entry in islice(entries, MOST_NEIGHBOURS))
    return []
