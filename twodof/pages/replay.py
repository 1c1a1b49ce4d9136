"""Replay of a bag in the browser, from a server or from a file with all samples; pages inline in a notebook."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from html import escape
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from ..bag.recording import Recording
from ..errors import BuildError, FmuError, PageError
from ..export.mesh_files import collect_meshes
from ..export.urdf_source import read_text
from ..files import data_file, refusing, write_file
from ..fmu import Fmu, load_fmu, resource_reader
from ..geometry.kinematics import Array
from ..geometry.meshes import ReadMesh
from ..geometry.shapes import Shape, link_shapes
from ..plant.urdf import RobotError, read_urdf
from ..plots.scripts import packed
from ..plots.track import Track, read_tracks
from ..signatures import ignore, never, with_keywords_of
from ..simulation.experiments import experiment
from .arm import RECORDED, Arm, arm_page, names_page, page_of
from .serving import HOST, PORT, Server

if TYPE_CHECKING:
    import pandas
    from typing_extensions import Unpack

FILMS = (".mp4", ".webp", ".gif", ".png")  # suffixes of films, and of the picture at the end
MOST_SAMPLES = 100_000  # of a bag with more samples, at most a quarter of this number is shown
NO_ROBOT = '<robot name="none"><link name="base"/></robot>'
IDLE = 0.05  # s between two checks of ``stop``
HEIGHT = 560  # pixels of a page in a notebook


class RobotOptions(TypedDict, total=False):
    """Keywords of ``replay``."""

    urdf: str | Path | None
    mesh_dir: str | Path | None
    frame: str | None
    fmu: str | Path | None


def replay(
    bag: Recording | str | Path,
    *,
    urdf: str | Path | None = None,
    mesh_dir: str | Path | None = None,
    frame: str | None = None,
    fmu: str | Path | None = None,
) -> tuple[bytes, Sequence[str]]:
    """Return the HTML of a bag's replay, and its remarks, one line each.

    Args:
        urdf: the robot; None: the robot in the bag, if any.
        mesh_dir: folder of that URDF's packages or meshes.
        frame: the end effector's link; None: as in the run.
        fmu: the FMU with the meshes; None: the FMU that made the bag, if it is in the working directory or in the
            bag's parent folder.

    Raises:
        BagError, PlotError, PageError, FmuError, BuildError: a file or an argument is invalid; the message names it.
    """
    if mesh_dir is not None and urdf is None:
        raise PageError("`mesh_dir` has the meshes of a URDF; give that with `urdf`")
    if fmu is not None and urdf is not None:
        raise PageError("`fmu` has the meshes of the bag's robot; leave it out with `urdf`")
    track = read_tracks([bag], urdf=urdf, frame=frame, most=MOST_SAMPLES)[0]
    remarks: list[str] = []
    shapes: Sequence[Shape] = []
    motion, text = track.motion, NO_ROBOT
    if motion is None:
        remarks.append(f"'{track.recording.path}' contains no robot; give one with `urdf`")
    else:
        text, read = _robot(track.recording, urdf, mesh_dir, fmu, remarks)
        try:
            shapes, absent = link_shapes(read_urdf(text), read)
        except RobotError as error:
            raise PageError(str(error)) from error
        if absent and urdf is None:  # for a given URDF, `collect_meshes` warns
            missing = ", ".join(absent[:3])
            remarks.append(f"without the meshes {missing}; give them with `fmu` or `urdf`")
    groups, shown = _groups(track), len(track.t)
    count = track.recording.count
    thinned = [f"{shown} of {count} samples, extremes among them"] if shown < count else []
    facts = {
        "name": track.name,
        "robot": motion.robot if motion else "",
        "joints": [joint.name for joint in track.joints],
        "frame": motion.frame if motion else "base",
        "axes": track.task.axes if track.task else track.recording.axes,
        "control": "",
        "variables": [*_variables(track, groups)],
        "step": float(track.t[-1]) / max(1, len(track.t) - 1),
        "remarks": [*track.verdict.lines, *remarks, *thinned],
    }
    samples = np.column_stack([track.t, *(groups[name] for name in RECORDED if name in groups)])
    title = " - ".join(filter(None, (motion.robot if motion else "", track.name)))
    return arm_page(title, Arm(facts, text, shapes), {"samples": packed(samples.astype("<f8").tobytes())}), remarks


def _groups(track: Track) -> dict[str, Array]:
    """Return the known values of all samples by group, N × elements."""
    bag, task, joints = track.recording, track.task, track.joints
    groups = {"q": bag.q, "q_des": bag.held("q_des", len(joints))}
    groups["v"] = np.column_stack([joint.v for joint in joints])
    groups["tau"] = np.column_stack([joint.tau for joint in joints])
    if task is not None and track.motion is not None:
        groups["x"] = track.motion.path[:, ["xyz".index(axis) for axis in task.axes]]
        groups |= {"x_des": task.target, "quat_des": bag.target_quat}
    return {name: values for name, values in groups.items() if values.size}


def _variables(track: Track, groups: dict[str, Array]) -> Iterator[dict[str, object]]:
    """Return the variables of the groups, and the parameters that pictures need."""
    values: dict[str, float | None] = {
        f"{name}[{i + 1}]": None for name, rows in groups.items() for i in range(rows.shape[1])
    }
    for i, joint in enumerate(track.joints):
        values |= {f"q_min[{i + 1}]": joint.low, f"q_max[{i + 1}]": joint.high}
    starts = track.recording.provenance.get("start_values", {})
    values |= {name: starts[name] for name in starts if name.startswith("gravity[")}
    for name, start in values.items():
        yield {"name": name, "causality": "output" if start is None else "parameter", "start": start}


def _robot(
    bag: Recording, urdf: str | Path | None, mesh_dir: str | Path | None, fmu: str | Path | None, remarks: list[str]
) -> tuple[str, ReadMesh]:
    """Return the URDF's text, and the source of its meshes."""
    if urdf is not None:
        packages = None if mesh_dir is None else Path(mesh_dir)
        text, folder = read_text(Path(urdf), packages), Path(urdf).parent
        try:
            renamed, files = collect_meshes(text, folder, packages)
        except BuildError as error:
            if mesh_dir is not None:
                raise
            remarks.append(str(error))
            return text, lambda name: None
        return renamed, files.get
    text = bag.provenance["urdf"] or ""
    if fmu is not None:
        return text, resource_reader(load_fmu(fmu))
    maker = bag.provenance["fmu"]
    for folder in (Path(), bag.path.resolve().parent):
        try:
            candidate = load_fmu(folder / Path(maker["file"]).name)
        except FmuError:
            continue
        if candidate.guid == maker["guid"]:
            return text, resource_reader(candidate)
    shipped = data_file("urdf", "2dof.urdf")
    meshes = data_file("meshes")
    renamed, files = collect_meshes(shipped.read_text("utf-8"), shipped.parent, meshes)
    return text, files.get if text.strip() == renamed.strip() else lambda name: None


@with_keywords_of(replay)
def view(
    bag: Recording | str | Path,
    stop: Callable[[], bool] = never,
    opened: Callable[[str, Sequence[str]], None] = ignore,
    *,
    host: str = HOST,
    port: int = PORT,
    **robot: Unpack[RobotOptions],
) -> None:
    """Replay a bag in the browser until ``stop`` returns true.

    Args:
        bag: the bag, or its folder.
        stop: called 20 times a second; True ends the replay.
        opened: called with the URL and remarks when the page can be opened.
        host, port: address to listen on.
        robot: options of ``replay``.
    """
    page, remarks = replay(bag, **robot)
    with Server(page, host, port) as server:
        opened(server.url, remarks)
        while not stop():
            time.sleep(IDLE)


def export(bag: Recording | str | Path, path: str | Path, **robot: Unpack[RobotOptions]) -> Sequence[str]:
    """Write a replay as one HTML file, or as a film; return its remarks. Options are those of ``replay``.

    Raises:
        PageError: the suffix is unknown, an option has no effect, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix in FILMS:
        useless = [name for name in ("mesh_dir", "fmu") if robot.get(name) is not None]
        if useless:
            raise PageError(f"a film shows the arm as lines, without meshes; leave out `{useless[0]}`")
        from ..plots.film import film  # Matplotlib takes half a second to import

        film(bag, path, urdf=robot.get("urdf"), frame=robot.get("frame"))
        return []
    if not names_page(Path(path)):
        raise PageError(f"'{path}': the name of an export ends in .html, {', '.join(FILMS)}")
    page, remarks = replay(bag, **robot)
    with refusing(PageError, f"write '{path}'"):
        write_file(Path(path), page)
    return remarks


class Inline:
    """A page that a notebook shows in an iframe."""

    def __init__(self, page: str, height: int) -> None:
        self._page, self._height = page, height

    def __repr__(self) -> str:
        return f"<page of {len(self._page) / 1024:.0f} KB>"

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{self._height}px;border:0"
        return f'<iframe srcdoc="{escape(self._page)}" style="{style}" allow="fullscreen"></iframe>'


def show(shown: Fmu | Recording | pandas.DataFrame | str | Path, *, height: int = HEIGHT) -> Inline:
    """Return the page of an FMU, a recording or a sweep for a notebook, which displays it as a cell's result.

    Args:
        shown: a native FMU, whose plant runs in the page; a recording, which is replayed; the table of a sweep, which
            becomes an interactive map; or the path of one of them.
        height: height of the iframe, pixels.

    Raises:
        FmuError, BagError, SweepError, PageError, PlotError, BuildError: as ``page``, ``view`` and ``plot`` raise.
    """
    folder = Path(shown) if isinstance(shown, (str, Path)) and Path(shown).is_dir() else None
    if isinstance(shown, (Fmu, str, Path)) and folder is None:
        page = page_of(experiment(shown, stop_time=inf))
    elif isinstance(shown, Recording) or (folder and not any(folder.glob("*.parquet"))):
        page, _ = replay(shown if isinstance(shown, Recording) else str(folder))
    elif folder or "provenance" in getattr(shown, "attrs", {}):
        from ..plots.sweeps import map_html  # needs the extra "sweep"

        page = map_html(shown)
    else:
        raise PageError("`show` shows an FMU, a recording, the table of a sweep, or the path of one of them")
    return Inline(page.decode(), height)
