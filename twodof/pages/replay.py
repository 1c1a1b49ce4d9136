"""Replay of a bag in the browser, and as one file that replays offline."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import inf, nextafter
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from ..bag.recording import Recording
from ..errors import BuildError, FmuError, PageError
from ..export.meshes import collect_meshes
from ..files import data_file, refusing, shown, write_file
from ..fmu import load_fmu, read_resource
from ..geometry.meshes import ReadMesh
from ..plots.scales import SMALLEST_ERROR
from ..plots.track import read_tracks
from .page import HOST, PATH, PLOT_RATE, PORT, RATE, TRAIL, Array, Page
from .robot import PageRobot
from .widgets import Plot, Readout, Switch

SPEEDS = {f"{speed:g} ×": speed for speed in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)}
SETTLING = 0.3  # s after which scrubbing is over
SLIDER_RATE = 4.0  # Hz: a slider that moves more often is hard to use in a slow browser
TRAIL_TIME = 1.5  # s
TRAIL_POINTS, PATH_POINTS = 60, 1500
MOST_FRAMES = 2000
MOST_SAMPLES = 1_000_000  # of which a quarter is shown at most where there are more


class Replay:
    """A bag on a page: robot, target, end effector's path, plots, and what moves them.

    Args:
        page: the page.
        bag: the bag, or its folder.
        urdf: the robot; None: the one that the bag carries, if any.
        mesh_dir: folder of that URDF's packages or meshes.
        frame: the end effector's link; None: as in the run.
        fmu: the FMU that the meshes are in; None: the one that made the bag, where it lies in the
            working directory or beside the bag.

    Attributes:
        remarks: what is not as it should be, one line each.

    Raises:
        BagError, PlotError, PageError, FmuError, BuildError: naming what is wrong.
    """

    def __init__(
        self,
        page: Page,
        bag: Recording | str | Path,
        *,
        urdf: str | Path | None = None,
        mesh_dir: str | Path | None = None,
        frame: str | None = None,
        fmu: str | Path | None = None,
    ) -> None:
        if mesh_dir is not None and urdf is None:
            raise PageError("`mesh_dir` has the meshes of a URDF; give that with `urdf`")
        if fmu is not None and urdf is not None:
            raise PageError("`fmu` has the meshes of the bag's robot; leave it out beside `urdf`")
        self._page = page
        self._track = track = read_tracks([bag], urdf=urdf, frame=frame, most=MOST_SAMPLES)[0]
        bag, self._t = track.recording, track.t
        self.remarks: list[str] = []
        self._figure: PageRobot | None = None
        if track.motion is None:
            self.remarks.append(f"'{bag.path}' carries no robot; give one with `urdf`")
        else:
            text, read = self._robot(bag, urdf, mesh_dir, fmu)
            names = [joint.name for joint in track.joints]
            self._figure = PageRobot(page, text, names, track.motion.frame, read)
            if self._figure.missing and urdf is None:  # of a URDF given, `collect_meshes` says it
                missing = ", ".join(self._figure.missing[:3])
                self.remarks.append(f"without the meshes {missing}; give them with `fmu` or `urdf`")
        self._set_scene()

    def _robot(
        self,
        bag: Recording,
        urdf: str | Path | None,
        mesh_dir: str | Path | None,
        fmu: str | Path | None,
    ) -> tuple[str, ReadMesh]:
        """The URDF's text, and where its meshes are from."""
        if urdf is not None:
            text, folder = Path(urdf).read_text("utf-8"), Path(urdf).parent
            packages = None if mesh_dir is None else Path(mesh_dir)
            try:
                renamed, files = collect_meshes(text, folder, packages)
            except BuildError as error:
                if mesh_dir is not None:
                    raise
                self.remarks.append(str(error))
                return text, lambda name: None
            return renamed, files.get
        text = bag.provenance["urdf"]
        if fmu is not None:
            return text, partial(read_resource, load_fmu(fmu))
        maker = bag.provenance["fmu"]
        for folder in (Path(), bag.path.resolve().parent):
            try:
                candidate = load_fmu(folder / Path(maker["file"]).name)
            except FmuError:
                continue
            if candidate.guid == maker["guid"]:
                return text, partial(read_resource, candidate)
        shipped = data_file("urdf", "2dof.urdf")
        meshes = data_file("meshes")
        renamed, files = collect_meshes(shipped.read_text("utf-8"), shipped.parent, meshes)
        return text, files.get if text.strip() == renamed.strip() else lambda name: None

    # --- what is shown ---

    def _set_scene(self) -> None:
        page, track, motion = self._page, self._track, self._track.motion
        starts = track.recording.provenance.get("start_values", {})
        self._target: Any = None
        self._targets = np.empty((0, 3))
        if motion is not None and self._figure is not None:
            q = track.recording.q
            shown = [self._figure.points(q[k]) for k in np.linspace(0, len(q) - 1, 9).astype(int)]
            points = [*shown, motion.path[:: max(1, len(q) // PATH_POINTS)]]
            if track.task is not None:
                self._targets = motion.path.copy()
                for k, axis in enumerate(track.task.axes):
                    self._targets[:, "xyz".index(axis)] = track.task.target[:, k]
                points.append(self._targets[:: max(1, len(q) // PATH_POINTS)])
            gravity = [-starts.get(f"gravity[{i}]", 0.0) for i in (1, 2, 3)]
            up = gravity if any(gravity) else (0.0, 0.0, 1.0)
            size = page.frame(np.vstack(points), track.task.axes if track.task else "", up)
            if track.task is not None:
                turns = track.recording.target_quat
                self._turns = np.roll(turns, 1, axis=1)
                self._target = page.add_target(
                    size, track.task.axes, draggable=False, turns=bool(turns.size)
                )
                if turns.size:
                    self._figure.show_axes(page, size)
            chosen = np.unique(np.linspace(0, len(q) - 1, PATH_POINTS).astype(int))
            page.add_line("/path", PATH, 1.5).show(motion.path[chosen])
            self._trail = page.add_line("/trail", TRAIL, 4.0)

    def add_controls(self) -> None:
        """The control panel: time line, play, speed, readout and plots."""
        page, gui, track = self._page, self._page.gui, self._track
        self._duration = float(self._t[-1])
        self._time, self._playing, self._speed = 0.0, True, 1.0
        self._slid, self._due = 0.0, inf  # when the slider was moved, and is to be
        self._asked: SimpleQueue[bool | float] = SimpleQueue()
        """By the user: to play, to pause, or a time, s."""
        step = 0.001 if self._duration >= 1.0 else max(self._duration / 1000, 1e-9)
        self._slider = gui.add_slider("time, s", 0.0, max(self._duration, step), step, 0.0)
        self._switch = Switch(page, "Play", "Pause", self._asked.put, True)
        speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1 ×")

        async def scrubbed(event: Any) -> None:  # at once: the value is still the user's
            if event.client is not None:  # else moved by the replay itself
                self._asked.put(float(self._slider.value))

        def sped(event: Any) -> None:
            self._speed = SPEEDS[speed.value]

        self._slider.on_update(scrubbed)
        speed.on_update(sped)
        names = [joint.name for joint in track.joints]
        self._readout = Readout(page, names)
        units = " or ".join(dict.fromkeys(j.unit for j in track.joints if j.unit)) or "rad or m"
        lines = {f"position, {units}": (names, track.recording.q)}
        if track.recording.v.shape == track.recording.q.shape:
            lines[f"velocity, {units} per s"] = (names, track.recording.v)
        if track.task is not None:
            error = np.log10(np.maximum(track.task.error, SMALLEST_ERROR))
            lines["log₁₀ of the distance from the target in m"] = (["error"], error[:, None])
        self._plots = [
            Plot(page, title, names, self._t, rows, marked=True)
            for title, (names, rows) in lines.items()
        ]
        for remark in self.remarks:
            page.add_text(remark)

    def show(self, k: int) -> None:
        """Set the scene to sample k."""
        track = self._track
        with self._page.atomic():
            if self._figure is not None and track.motion is not None:
                self._figure.pose(track.recording.q[k])
                first = nearest(self._t, self._t[k] - TRAIL_TIME)
                chosen = np.unique(np.linspace(first, k, TRAIL_POINTS).astype(int))
                self._trail.show(track.motion.path[chosen])
            if self._target is not None:
                self._target.position = self._targets[k]
                if self._turns.size:
                    self._target.wxyz = self._turns[k]

    def _tell(self, k: int) -> None:
        track = self._track
        rows = {"time": f"{self._t[k]:.3f} s"}
        if track.recording.count == len(self._t):
            rows["sample"] = f"{k} of {len(self._t) - 1}"
        for joint in track.joints:
            rows[joint.name] = f"{joint.q[k]:+.5f} {joint.unit}"
        if track.motion is not None:
            place = ", ".join(f"{value:+.5f}" for value in track.motion.path[k])
            rows["end effector"] = f"({place}) m"
        if track.task is not None:
            place = ", ".join(f"{value:+.4f}" for value in self._targets[k])
            rows["target"] = f"({place}) m"
            rows["error"] = f"{track.task.error[k]:.4g} m"
        self._readout.show(rows)

    # --- what moves ---

    def play(self, stop: Callable[[], bool]) -> None:
        """Replay, as the page's controls say, until ``stop`` is true."""
        before = drawn = time.perf_counter()
        shown = marked = None
        while not stop():
            now = time.perf_counter()
            self._advance(now, now - before)
            before = now
            self._switch.show(self._playing)
            if self._time != shown:
                shown = self._time
                k = nearest(self._t, shown)
                self.show(k)
                self._tell(k)
            if self._time != marked and (now - drawn > 1 / PLOT_RATE or not self._playing):
                marked, drawn = self._time, now
                for plot in self._plots:
                    plot.mark(marked)
            if now >= self._due:
                self._slid, self._due = now, inf
                # equal to what the user set is not sent
                same = self._slider.value == self._time
                self._slider.value = (
                    nextafter(self._time, self._duration / 2) if same else self._time
                )
            time.sleep(1 / RATE)

    def _advance(self, now: float, passed: float) -> None:
        """Do what the user has asked for, else go on by a time that has passed, s."""
        while not self._asked.empty():
            asked = self._asked.get()
            if isinstance(asked, bool):
                self._playing = asked
                if asked and self._time >= self._duration:
                    self._time = 0.0
            else:
                if self._playing or self._due < inf:
                    self._due = now + SETTLING  # what was sent before may arrive after
                self._time, self._playing = asked, False
            passed = 0.0
        if passed and self._playing and self._page.viewers:
            self._time = min(self._time + passed * self._speed, self._duration)
            self._playing = self._time < self._duration
            self._due = min(self._due, self._slid + 1 / SLIDER_RATE)

    # --- a file ---

    def export(self, path: Path) -> None:
        """Write one HTML file that replays the scene offline.

        Raises:
            PageError: it cannot be written.
        """
        content = self._page.recording(self._frames(), f"{self._track.name} - twodof")
        with refusing(PageError, f"write '{path}'"):
            write_file(path, content)

    def _frames(self) -> Iterator[float]:
        duration = float(self._t[-1])
        count = max(2, min(MOST_FRAMES, int(duration * RATE) + 1))
        pause = duration / (count - 1)
        for i in range(count):
            self.show(nearest(self._t, i * pause))
            yield pause


def nearest(t: Array, time: float) -> int:
    """Index of the time in t, ascending, that is nearest to a time."""
    k = int(np.searchsorted(t, time))
    if k == 0:
        return 0
    return k - 1 if k == len(t) or time - t[k - 1] <= t[k] - time else k


def view(
    bag: Recording | str | Path,
    stop: Callable[[], bool] = lambda: False,
    opened: Callable[[str, Sequence[str]], None] = lambda url, remarks: None,
    *,
    host: str = HOST,
    port: int = PORT,
    **robot: Any,
) -> None:
    """Replay a bag in the browser until ``stop`` is true.

    Args:
        bag: the bag, or its folder.
        stop: asked 30 times a second.
        opened: told the URL, when it can be opened, and of what is not as it should be.
        host, port: where to listen.
        robot: options of ``Replay``.
    """
    path = bag.path if isinstance(bag, Recording) else Path(bag)
    with Page(f"twodof - {shown(path.resolve().name)}", host, port) as page:
        replay = Replay(page, bag, **robot)
        replay.add_controls()
        opened(page.url, replay.remarks)
        replay.play(stop)


def export(bag: Recording | str | Path, path: str | Path, **robot: Any) -> Sequence[str]:
    """Write a replay as one HTML file; what is not as it should be. Options as ``Replay``'s."""
    with Page("twodof", HOST, 0) as page:
        replay = Replay(page, bag, **robot)
        replay.export(Path(path))
        return replay.remarks
