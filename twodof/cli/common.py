"""What several verbs do and print."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import BuildError, InputError, SimulationError

if TYPE_CHECKING:
    from pandas import DataFrame

    from ..bag.writer import Bag
    from ..fmu import Fmu
    from ..simulation.experiments import Experiment, Setting
    from ..simulation.master import Summary
    from ..simulation.pace import RealTime

INTERRUPTED = 130
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
PATIENCE = 5.0  # s for what is under way to end when it was asked to


ARGUMENT = re.compile(r"`(\w+)(?:=True)?`")
OPTIONS = {
    "path": "-o", "output": "-o", "platforms": "--platform", "changes": "--input",
    "robots": "NAME=FMU",
}  # fmt: skip
"""Options that are not called as the argument of the library which they give."""
POSE = "control 'pose'"
"""Which is two options."""


class CommandLineError(InputError):
    """An option is wrong, or does not go with another."""


def in_options(text: str) -> str:
    """A message of the library, which has its arguments in backticks, for the command line."""
    text = text.replace(POSE, "control 'task --orientation'")
    return plain(ARGUMENT.sub(lambda m: OPTIONS.get(m[1], "--" + m[1].replace("_", "-")), text))


def parse_settings(texts: Iterable[str], option: str = "--set") -> dict[str, Setting]:
    """NAME=VALUE texts of an option: ``Kp=80``, ``x_des=0.25,0.1``, ``limit_effort=true``."""
    settings: dict[str, Setting] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise CommandLineError(f"{option} {text}: expected NAME=VALUE")
        if name in settings:
            raise CommandLineError(f"{option} {name} is given twice")
        settings[name] = _parse_value(f"{option} {name}", value.strip())
    return settings


def _parse_value(name: str, text: str) -> Setting:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise CommandLineError(f"{name}={text}: '{text}' is not a number") from None
    return numbers[0] if len(numbers) == 1 else numbers


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Whether a signal asked the run to end; read between steps, so that a step is never cut.

    SIGINT, SIGTERM, and SIGHUP from a terminal that is closed. A second one interrupts at once, and
    so does the clock where the first has no effect; more are ignored, as all that is left is
    closing the bag.
    """
    asked = False

    def ask(_number: int, _frame: object) -> None:
        nonlocal asked
        if asked:
            for number in SIGNALS:
                signal.signal(number, signal.SIG_IGN)
            raise KeyboardInterrupt
        asked = True
        signal.setitimer(signal.ITIMER_REAL, PATIENCE)

    before = {number: signal.signal(number, ask) for number in SIGNALS}
    try:
        yield lambda: asked
    except SimulationError as error:
        if asked:  # the Python flavour discards a step that is interrupted
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def experiment_of(
    options: argparse.Namespace, stop_time: float | None, step: float | None
) -> Experiment:
    """The experiment that the options ask for."""
    from ..fmu import load_fmu
    from ..simulation.experiments import experiment

    fmu, table, changes = load_fmu(chosen_fmu(options)), options.input, None
    settings = parse_settings(options.settings)
    if table is not None:
        folder, _, topic = (table, "", None) if Path(table).is_dir() else table.rpartition(":")
        if Path(folder).is_dir() and folder:
            from ..bag.commands import read_commands
            from ..bag.provenance import robots_of

            if topic in robots_of(Path(folder)):  # of one of several robots, as it was driven
                folder, topic = table, None
            table = None
            changes = read_commands(fmu, folder, topic, step=step, settings=settings)
    return experiment(
        fmu, stop_time=stop_time, step=step, settings=settings,
        input_file=table, changes=changes, stamp_start=options.stamp_start,
    )  # fmt: skip


def bag_of(options: argparse.Namespace, path: str | Path) -> Bag:
    """The bag that the options ask for."""
    from ..bag.writer import Bag

    return Bag(
        path,
        storage=options.storage,
        scene=options.scene,
        effort=options.effort,
        overwrite=options.overwrite,
        fsync=options.fsync,
        command_line=options.command_line,
    )


def dated(stem: str) -> Path:
    """The default name of what a run leaves."""
    from ..files import free_name

    return free_name(time.strftime(f"{stem}_%Y_%m_%d-%H_%M_%S"))


def fast_fmu(options: argparse.Namespace) -> Path:
    """The FMU that is named, else the default arm's, native where it can be built."""
    if options.fmu:
        return Path(options.fmu)
    from ..export.options import FmuOptions
    from ..export.package import build_fmu

    try:
        return build_fmu(None, FmuOptions(native=True))
    except BuildError as error:
        print(f"{error}; running the Python flavour, which is slower", file=sys.stderr)
        return build_fmu(None, FmuOptions())


def chosen_fmu(options: argparse.Namespace) -> Path:
    """The FMU that is named, else that of the URDF or of the default arm, built if need be."""
    of_urdf = bool(options.fmu) and Path(options.fmu).suffix in (".urdf", ".xacro")
    if options.frame is not None and not of_urdf:
        what = "an FMU" if options.fmu else "none"
        raise CommandLineError(f"--frame is of a URDF that is given; leave it out beside {what}")
    if options.fmu and not of_urdf:
        if options.native:
            raise CommandLineError(
                "--native builds the default arm's FMU; leave it out beside an FMU"
            )
        return Path(options.fmu)
    from ..export.compiler import host_platform
    from ..export.options import FmuOptions
    from ..export.package import build_fmu

    native = options.native or host_platform() != "linux64"
    if native and not options.native:
        print("the Python flavour is for Linux x86-64: building the native one", file=sys.stderr)
    if not of_urdf:
        return build_fmu(None, FmuOptions(native=native))
    robot, frame = Path(options.fmu), options.frame
    name = identifier(robot)
    return build_fmu(None, FmuOptions(urdf=robot, name=name, frame=frame, native=native))


def identifier(robot: Path) -> str:
    """A robot's name for a program, from that of its file."""
    stem = robot.name.removesuffix(".xacro").removesuffix(".urdf").removesuffix(".fmu")
    name = re.sub(r"\W", "_", stem, flags=re.ASCII)
    return name if name.isidentifier() else f"robot_{name}"


def facts_of(
    run: Experiment, bag: Bag | None, summary: Summary, pace: RealTime | None
) -> dict[str, Any]:
    """How a run went, for another program."""
    last = summary.last
    return dict(
        fmu=str(run.fmu.path),
        bag=None if bag is None else bag.address,
        joint_states=last.k + 1,
        end_time=last.t,
        stopped=summary.stopped,
        q=last.q, v=last.v, x=last.x, x_des=last.target, error=summary.error,
        wall_time=summary.wall_time,
        missed=None if pace is None else pace.missed,
        worst=None if pace is None else pace.worst,
    )  # fmt: skip


def print_summary(
    options: argparse.Namespace,
    run: Experiment,
    bag: Bag | None,
    summary: Summary,
    pace: RealTime | None,
) -> None:
    """How a run went."""
    last = summary.last
    simulated = last.k * run.step
    if options.json:
        print_json(**facts_of(run, bag, summary, pace))
        return
    rows = [("FMU", f"{run.fmu.path}")]
    for name, value in parse_settings(options.settings).items():
        elements = run.fmu.vector(name)
        if len(elements) > 1 and isinstance(value, int | float):
            rows.append((f"{name}", f"{value:g}, all {len(elements)} elements"))
    if bag is not None:
        messages = f"{last.k + 1} messages on {bag.topic}, {options.storage}"
        rows.append(("bag", f"{bag.address} ({messages})"))
    if summary.error is not None:
        target = ", ".join(f"{value:g}" for value in last.target or ())
        rows.append(("end effector", f"{summary.error:.3g} m from its target ({target}) m"))
    speed = simulated / summary.wall_time if summary.wall_time else 0.0
    rows.append(
        ("time", f"{simulated:g} s simulated in {summary.wall_time:.2f} s, {speed:.1f} × real time")
    )
    if pace is not None:
        rows.append(
            ("deadlines", f"{pace.missed} of {last.k + 1} missed, worst {pace.worst * 1e3:.1f} ms")
        )
    if summary.stopped:
        complete = "" if bag is None else "; the bag is complete up to there"
        rows.append(("stopped", f"on request at {last.t:g} s{complete}"))
    print_table(*rows)


def controlled(fmu: Fmu) -> str:
    """What an FMU controls."""
    if not fmu.frame:
        return "unknown"
    of = f"{fmu.frame}, axes {' '.join(fmu.axes)} of {fmu.root}"
    law = "task control with --orientation" if fmu.control == "pose" else f"{fmu.control} control"
    return f"{of}; {law}" if fmu.control else of


def open_page(
    options: argparse.Namespace, url: str, remarks: Sequence[str] = (), fmu: Path | None = None
) -> None:
    """Tell where the page is, and open it where there is a display."""
    for remark in remarks:
        print(f"WARNING: {in_options(remark)}", file=sys.stderr)
    what = f"{fmu}; " if fmu is not None else ""
    print(f"open  {url} ({what}Ctrl-C ends)", flush=True)
    if not options.no_browser and {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        import webbrowser

        webbrowser.open(url)


def best_runs(table: DataFrame) -> DataFrame:
    """The first few runs by settling time, effort and final error: variables, metrics known."""
    from ..sweeps.results import ranked

    best = ranked(table).head(5)
    columns = [*best.columns]
    return best[columns[: columns.index("end_time")]].dropna(axis="columns", how="all")


def print_best(table: DataFrame) -> None:
    """The best runs, with units."""
    from ..sweeps.metrics import METRICS
    from ..sweeps.results import RANKED

    best = best_runs(table)
    units = [METRICS[name].unit if name in METRICS else "" for name in best.columns]
    rows = [[f"{value:.4g}" for value in row] for row in best.to_numpy()]
    ranks = [RANKED[name] for name in RANKED if name in best.columns][:2]
    title = f"best: {', '.join(ranks) or 'no metric ranks them'}"
    print(f"\n{title}" if rows else "\nno run was finished")
    if rows:
        print_table(best.columns, units, *rows, align=str.rjust, before="  ")


def quote(path: Path) -> str:
    """A path as a shell takes it."""
    return shlex.quote(str(path))


def print_json(**facts: object) -> None:
    """Facts for another program, in SI units; null where there is no finite number."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [plain(inner) for inner in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    print(json.dumps(plain(facts), indent=2))


def print_table(
    *rows: Iterable[str], align: Callable[[str, int], str] = str.ljust, before: str = ""
) -> None:
    """Texts in columns, a row a line; each line begins with what is to stand before."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    for row in rows:
        print(plain(before + "  ".join(map(align, row, widths)).rstrip()))


def plain(text: str) -> str:
    """A text with its control characters as escapes: files from elsewhere write on no terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


def print_next(*commands: str) -> None:
    """What to type next."""
    print("\nnext")
    for command in commands:
        print(f"  {command}")
