"""An FMU in real time behind a page in the browser: the page, and what joins it to the loop.

The page has a process of its own, so that nothing that it does holds up the loop that steps.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from math import degrees, inf, isfinite, pi
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from ..children import Child
from ..errors import PageError
from ..experiments import Experiment, Setting, Value, experiment
from ..fmu import Fmu, load_fmu, read_resource
from ..plant.urdf import Joint, RobotError, read_urdf
from .loop import IDLE, Loop, News
from .page import HOST, PLOT_RATE, PORT, RATE, TRAIL, Array, Page
from .robot import PageRobot
from .widgets import Plot, Readout, Switch, add_sliders

PLOTTED = 10.0  # s
PLOT_POINTS = 250  # while it plays: drawing holds a browser up
AWAITED = 0.3  # s after a change for which the arm comes first,
LONGEST = 1.0  # s, and the plots wait at most
TRAIL_POINTS = 45
WINDOW = 1.0  # s over which the real-time factor is taken
GAINS = {"Kp": "s⁻²", "Kd": "s⁻¹", "Kp_rot": "s⁻²", "Kd_rot": "s⁻¹"}


class Controls:
    """A page that shows what a loop tells, and asks what its controls say.

    Args:
        page: the page.
        fmu: the FMU that is run.
        start_values: its inputs and parameters at the start.
        step: communication step, s.
        loop: the connection to the loop.

    Raises:
        PageError: the FMU's robot cannot be read.
    """

    def __init__(
        self, page: Page, fmu: Fmu, start_values: Mapping[str, Value], step: float, loop: Connection
    ) -> None:
        urdf = fmu.urdf or ""
        try:
            robot = read_urdf(urdf)
            joints = [robot.joints[name] for name in fmu.joints]
        except (RobotError, KeyError) as error:
            raise PageError(f"'{fmu.path}': its robot cannot be shown: {error}") from error
        self._page, self._fmu, self._starts, self._loop = page, fmu, start_values, loop
        self._sending = Lock()
        self._changed = -inf
        self._news: News = self._ask("more", False)
        self._past: deque[tuple[float, float]] = deque()  # wall clock and time, s
        self._step, self._most = step, max(2, round(PLOTTED / step))
        self._rows = np.array(self._news.rows[-1:])
        self._robot = PageRobot(page, urdf, fmu.joints, fmu.frame, partial(read_resource, fmu))
        self._set_scene()
        self._add_controls(joints)

    def _change(self, values: dict[str, Setting]) -> None:
        self._changed = time.perf_counter()
        self._tell("change", values)

    def _tell(self, order: str, value: Any = None) -> None:
        with self._sending:
            self._loop.send((order, value))

    def _ask(self, order: str, value: Any) -> Any:
        self._tell(order, value)
        return self._loop.recv()

    def show(self) -> None:
        """Show what the loop tells, until it ends."""
        trail: deque[Array] = deque(maxlen=TRAIL_POINTS)
        shown, since = -1.0, 0.0
        plotted: tuple[float, bool] | None = None
        while True:
            begin = time.perf_counter()
            news: News = self._ask("more", self._page.viewers > 0)
            self._news, sample = news, news.sample
            if news.again:
                trail.clear()
                self._rows = self._rows[:0]
                shown, plotted = -1.0, None
            if news.rows:
                self._rows = np.concatenate([self._rows, news.rows])[-self._most :]
            if sample.t != shown:
                trail.append(self._robot.end_effector(sample.q))
                with self._page.atomic():
                    self._robot.pose(sample.q)
                    self._trail.show(np.array(trail))
            self._show_numbers(begin)
            pause = 1 / PLOT_RATE if begin - self._changed > AWAITED else LONGEST
            if (sample.t, news.playing) != plotted and begin - since > pause:
                plotted, since = (sample.t, news.playing), begin
                thin = max(1, self._most // PLOT_POINTS) if news.playing else 1
                rows = self._rows[::-1][::thin][::-1]
                age = np.arange(1.0 - len(rows), 1.0) * self._step * thin
                self._plots[0].show(age, rows[:, :-1])
                for plot in self._plots[1:]:
                    plot.show(age, rows[:, -1:])
            shown = sample.t
            for title, text in news.notes:
                self._page.notify(title, text)
            time.sleep(max(0.0, begin + 1 / RATE - time.perf_counter()))

    def _set_scene(self) -> None:
        fmu, sample = self._fmu, self._news.sample
        starts = self._starts
        end = self._robot.end_effector(sample.q)
        self._target_place = end.copy()
        for axis, value in zip(fmu.axes, sample.target or ()):
            self._target_place["xyz".index(axis)] = value
        shown = np.vstack([self._robot.points(sample.q), end, self._target_place])
        gravity = [-float(starts.get(f"gravity[{i}]", 0.0)) for i in (1, 2, 3)]
        middle = (shown.min(axis=0) + shown.max(axis=0)) / 2
        around = middle + 1.35 * (shown - middle)  # room to drag the target
        size = self._page.frame(around, fmu.axes, gravity if any(gravity) else (0.0, 0.0, 1.0))
        self._target: Any = None
        if sample.target:
            turns = sample.target_quat is not None
            self._target = self._page.add_target(size, fmu.axes, draggable=True, turns=turns)
            self._target.position = self._target_place
            if sample.target_quat:
                self._target.wxyz = np.roll(sample.target_quat, 1)
                self._robot.show_axes(self._page, size)
        self._trail = self._page.add_line("/trail", TRAIL, 4.0)
        self._robot.pose(sample.q)

    def _add_controls(self, joints: Sequence[Joint]) -> None:
        page, gui, fmu = self._page, self._page.gui, self._fmu
        tell = self._tell
        self._play = Switch(page, "Play", "Pause", partial(tell, "play"), True)
        others = gui.add_button_group("", ("Single step", "Reset"))
        others.on_click(lambda event: tell("step" if others.value == "Single step" else "reset"))
        record = partial(tell, "record")
        self._record = Switch(page, "Record", "Stop recording", record, False, color="red")
        self._readout = Readout(page, fmu.joints)

        if self._target is not None:
            self._add_target_fields(self._target)
        if fmu.vector("Kp"):
            with gui.add_folder("Gains"):
                for group, unit in GAINS.items():
                    self._add_gain(group, unit)
        self._add_joint_inputs(joints)
        self._units = ["m" if joint.prismatic else "rad" for joint in joints]
        units = " or ".join(dict.fromkeys(self._units))
        age, rows = np.array([-self._step, 0.0]), np.repeat(self._rows, 2, axis=0)
        position, error = f"position, {units}", "distance from the target, m"
        self._plots = [Plot(page, position, fmu.joints, age, rows[:, :-1], marked=False)]
        if self._target is not None:
            self._plots.append(Plot(page, error, ["error"], age, rows[:, -1:], marked=False))

    def _add_target_fields(self, target: Any) -> None:
        """Numbers that go with the marker in the scene."""
        gui = self._page.gui
        axes = {axis: "xyz".index(axis) for axis in self._fmu.axes}
        with gui.add_folder("Target, m"):
            fields = {
                axis: gui.add_number(axis, float(self._target_place[k]), step=0.001)
                for axis, k in axes.items()
            }

        moving = Lock()  # viser calls from several threads

        def move(place: Array) -> None:
            asked = {"x_des": tuple(float(place[k]) for k in axes.values())}
            if self._fmu.vector("quat_des"):
                asked["quat_des"] = tuple(np.roll(target.wxyz, -1).tolist())
            self._change(asked)

        def dragged(event: Any) -> None:
            with moving:
                for axis, k in axes.items():
                    fields[axis].value = round(float(target.position[k]), 4)
                move(target.position)

        def typed(k: int, event: Any) -> None:
            if event.client is None:  # set by ``dragged``
                return
            with moving:
                place = np.array(target.position)
                place[k] = event.target.value
                target.position = place
                move(place)

        target.on_update(dragged)
        for axis, k in axes.items():
            fields[axis].on_update(partial(typed, k))

    def _add_joint_inputs(self, joints: Sequence[Joint]) -> None:
        """Sliders for what drives or disturbs the joints and the frame, as far as there are any."""
        efforts = [f"{j.name}, {'N' if j.prismatic else 'N·m'}" for j in joints]
        most = [joint.effort if isfinite(joint.effort) else 10.0 for joint in joints]
        reach = [(max(j.low, -2 * pi), min(j.high, 2 * pi)) for j in joints]
        places = [f"{j.name}, {'m' if j.prismatic else 'rad'}" for j in joints]
        self._add_sliders("Joint targets", "q_des", places, reach, "")
        self._add_sliders("Efforts", "tau_cmd", efforts, [(-m, m) for m in most], "No effort")
        pushes = [(-0.1 * m, 0.1 * m) for m in most]
        self._add_sliders("Disturbance", "tau_ext", efforts, pushes, "No disturbance")
        force = [f"{axis}, N" for axis in "xyz"]
        self._add_sliders("Force", "f_ext", force, [(-10.0, 10.0)] * 3, "No force")

    def _add_sliders(
        self, title: str, group: str, labels: Sequence[str],
        ranges: Sequence[tuple[float, float]], release: str,
    ) -> None:  # fmt: skip
        """A folder of sliders for a vector, if there is one; with a button that sets all to 0."""
        names = self._fmu.vector(group)
        if names:
            starts = [float(self._starts[name]) for name in names]
            opened = len(names) <= 3 and group != "f_ext"
            with self._page.gui.add_folder(title, expand_by_default=opened):
                add_sliders(
                    self._page, labels, ranges, starts, release,
                    lambda values: self._change(dict(zip(names, values))),
                )  # fmt: skip

    def _add_gain(self, group: str, unit: str) -> None:
        names = self._fmu.vector(group)
        if not names:
            return
        start = float(self._starts[names[0]])
        most = max(4 * start, 200.0 if group.startswith("Kp") else 100.0)
        slider = self._page.gui.add_slider(f"{group}, {unit}", 0.0, most, most / 400, start)
        slider.on_update(lambda event: self._change({group: float(slider.value)}))

    def _show_numbers(self, now: float) -> None:
        news, sample = self._news, self._news.sample
        self._play.show(news.playing)
        samples = f" ({news.recorded} samples)" if news.recorded else ""
        self._record.show(news.recorded > 0, f"Stop recording{samples}")
        if not news.playing or (self._past and sample.t < self._past[-1][1]):
            self._past.clear()
        self._past.append((now, sample.t))
        while now - self._past[0][0] > WINDOW:
            self._past.popleft()
        elapsed = now - self._past[0][0]
        factor = (sample.t - self._past[0][1]) / elapsed if elapsed > 0.5 * WINDOW else None
        rows = {
            "time": f"{sample.t:.2f} s",
            "real-time factor": "-" if factor is None else f"{factor:.2f}",
            "deadlines missed": f"{news.missed} of {news.steps}, worst {1e3 * news.worst:.1f} ms",
            "end effector": f"({', '.join(f'{value:+.5f}' for value in sample.x)}) m",
        }
        if sample.target:
            rows["target"] = f"({', '.join(f'{value:+.5f}' for value in sample.target)}) m"
            rows["error"] = f"{sample.error or 0.0:.4g} m"
        if sample.turn_error is not None:
            rows["orientation error"] = f"{degrees(sample.turn_error):.4g}°"
        for name, q, unit in zip(self._fmu.joints, sample.q, self._units):
            rows[name] = f"{q:+.5f} {unit}"
        self._readout.show(rows)


def serve_page(
    loop: Connection, path: Path, start_values: Mapping[str, Value], step: float,
    host: str, port: int,
) -> None:  # fmt: skip
    """The process of the page, which tells the loop its URL first."""
    if hasattr(os, "nice"):
        os.nice(5)  # the loop goes first
    fmu = load_fmu(path)
    with Page(f"twodof - {fmu.name}", host, port) as page:
        controls = Controls(page, fmu, start_values, step, loop)
        loop.send(("url", page.url))
        controls.show()


@contextmanager
def page_of(
    loop: Loop, run: Experiment, host: str, port: int, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[str | None, Connection]]:
    """The URL of a loop's page, None if ``stop`` came first, and the connection to its process.

    Raises:
        PageError: it cannot be shown.
    """
    starts, url = dict(run.start_values), None
    with Child(serve_page, run.fmu.path, starts, run.step, host, port) as page:
        try:
            while url is None and not stop():
                if page.poll(IDLE):
                    order, value = page.recv()
                    if order == "more":
                        page.send(loop.news())
                    else:
                        url = value
        except EOFError as error:
            raise PageError(f"the process of the page has ended: {error}") from error
        yield url, page


def live(
    fmu: Fmu | str | Path,
    stop: Callable[[], bool] = lambda: False,
    opened: Callable[[str], None] = lambda url: None,
    *,
    host: str = HOST,
    port: int = PORT,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
    bag: str | None = None,
    command_line: str = "",
) -> list[Path]:
    """Step an FMU in real time behind a page until ``stop`` is true; the bags recorded.

    Args:
        fmu: the FMU or its path.
        stop: asked between two steps.
        opened: told the URL, when it can be opened.
        host, port: where to listen.
        step: communication step, s; None: the FMU's own.
        settings: start values, as of ``experiment``.
        bag: name of the first recording; None: rosbag2_<date and time>.
        command_line: for the provenance of recordings.
    """
    run = experiment(fmu, step=step, stop_time=inf, settings=settings)
    loop = Loop(run, bag=bag, command_line=command_line)
    with page_of(loop, run, host, port, stop) as (url, page):
        if url is not None:
            opened(url)
        loop.play(page, stop)
    return loop.recorded
