"""The command line: calls the function behind each verb, and prints.

Imports are inside the verbs, so that ``twodof --help`` is instant.
"""

from __future__ import annotations

import argparse
import errno
import io
import logging
import math
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import BuildError, InputError, TwoDofError
from .options import parser

if TYPE_CHECKING:
    from pandas import DataFrame

    from .bag import Bag, Run
    from .figure import Drawing
    from .fmu import Fmu
    from .master import Experiment, RealTime, Sink, Summary
    from .publish import Publisher

INTERRUPTED = 130
LONGEST_LINE = 2000
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = parser().parse_args(arguments)
    options.command_line = shlex.join(["twodof", *arguments])
    if isinstance(sys.stdout, io.TextIOWrapper):  # as stderr: no name of a file ends in a traceback
        sys.stdout.reconfigure(errors="backslashreplace")
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING)
    # the FMU's errors come back with the exception that they cause
    logging.getLogger("twodof.fmu").addFilter(lambda record: record.levelno < logging.ERROR)
    try:
        status = VERBS[options.verb](options)
        if sys.stdout is not None:
            sys.stdout.flush()
        if status == INTERRUPTED:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process is at its end
        return status
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        return _fail("interrupted", INTERRUPTED)
    except TwoDofError as error:
        return _fail(str(error))
    except BrokenPipeError:  # the reader of our output has left: nothing more to say
        _silence()
        return 1
    except OSError as error:
        if _is_interrupt(error):
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            return _fail("interrupted", INTERRUPTED)
        _silence()
        culprit = "" if error.filename is None else f"'{error.filename}': "
        return _fail(f"{culprit}{error.strerror or error}")


def _is_interrupt(error: OSError) -> bool:
    """Whether Ctrl-C came while a file was closed, which then is closed again and fails.

    So does ``shutil.rmtree``, which removes the folder that an FMU was unzipped to.
    """
    return error.errno == errno.EBADF and isinstance(error.__context__, KeyboardInterrupt)


def _fail(message: str, status: int = 1) -> int:
    line = " ".join(message.split())
    if len(line) > LONGEST_LINE:  # a name of a file from elsewhere can have any length
        line = f"{line[: LONGEST_LINE // 2]} … {line[-LONGEST_LINE // 2 :]}"
    print("twodof: error:", line, file=sys.stderr)
    return status


def _silence() -> None:
    """What is still in the output's buffer cannot be written and must not fail again at exit."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _build(options: argparse.Namespace) -> int:
    from .build import FmuOptions, build_fmu

    gravity = None if options.gravity is None else tuple(options.gravity)
    chosen = FmuOptions(
        urdf=options.urdf,
        mesh_dir=options.mesh_dir,
        frame=options.frame,
        axes=options.axes,
        gravity=gravity,
        q_start=None if options.q_start is None else tuple(options.q_start),
        name=options.name,
        link_environment=options.link_environment,
        native=options.native,
        platforms=_platforms(options.platforms),
    )
    path = build_fmu(options.output, chosen)
    from .fmu import load_fmu

    fmu = load_fmu(path)
    _print_table(
        ("FMU", f"{path} ({path.stat().st_size / 1024:.0f} KB, {', '.join(fmu.platforms)})"),
        ("robot", f"{fmu.robot}: {', '.join(fmu.joints)}"),
        ("controlled", _controlled(fmu)),
    )
    _print_next(f"twodof run {_quote(path)}", f"twodof info {_quote(path)}")
    return 0


def _platforms(chosen: Sequence[str]) -> tuple[str, ...]:
    from .native import TARGETS

    return tuple(TARGETS) if "all" in chosen else tuple(dict.fromkeys(chosen))


def _run(options: argparse.Namespace) -> int:
    from .master import RealTime, simulate

    run = _experiment(options, options.stop_time, options.step)
    bag = _bag(options, run, options.output or time.strftime("rosbag2_%Y_%m_%d-%H_%M_%S"))
    pace = RealTime() if options.realtime else None
    with _asked_to_stop() as asked:
        summary = simulate(run, [bag, _Progress(run)], pace=pace, stop=asked)
    _print_summary(run, bag, options.storage, summary, pace)
    file = bag.path / f"{bag.path.name}.{'mcap' if options.storage == 'mcap' else 'db3'}"
    viewer = "Foxglove: open" if options.storage == "mcap" else "RViz: play"
    _print_next(
        f"twodof info {_quote(bag.path)}",
        f"ros2 bag play {_quote(bag.path)}",
        f"{viewer} {_quote(file)}",
    )
    return INTERRUPTED if summary.stopped else 0


def _experiment(options: argparse.Namespace, stop_time: float | None, step: float) -> Experiment:
    from .inputs import parse_settings
    from .master import endless, experiment

    settings = parse_settings(options.settings)
    made: dict[str, Any] = {"step": step, "settings": settings, "input_file": options.input}
    fmu = _chosen_fmu(options)
    return (
        endless(fmu, **made) if stop_time is None else experiment(fmu, stop_time=stop_time, **made)
    )


def _bag(options: argparse.Namespace, run: Experiment, path: str, **more: bool) -> Bag:
    from .bag import Bag

    return Bag(
        path,
        run,
        storage=options.storage,
        scene=options.scene,
        effort=options.effort,
        stamp_start=options.stamp_start,
        overwrite=options.overwrite,
        fsync=options.fsync,
        command_line=options.command_line,
        **more,
    )


def _publish(options: argparse.Namespace) -> int:
    from .bag.messages import Stamps
    from .master import RealTime, simulate
    from .publish import Publisher, network

    if not 0.0 < options.rate < math.inf:
        raise InputError(f"--rate {options.rate:g}: not a number of steps a second")
    if options.output is None and (options.overwrite or options.fsync):
        raise InputError("--overwrite and --fsync are for a bag; name it with -o")
    place = network(subnet=options.subnet)
    run = _experiment(options, options.stop_time, 1.0 / options.rate)
    bag = _bag(options, run, options.output, open_ended=True) if options.output else None
    stamps = bag.stamps if bag else Stamps(run, options.stamp_start)
    wire = Publisher(
        run, place, stamps=stamps, scene=options.scene, effort=options.effort,
        opened=_print_network,
    )  # fmt: skip
    sinks: list[Sink] = [wire] if bag is None else [wire, bag]
    pace = RealTime()
    with _asked_to_stop() as asked:
        summary = simulate(run, sinks, pace=pace, stop=asked, steer=wire.command)
    _print_summary(run, bag, options.storage, summary, pace)
    if bag is not None:
        _print_next(f"twodof plot {_quote(bag.path)}", f"ros2 bag play {_quote(bag.path)}")
    return INTERRUPTED if summary.stopped else 0


def _fast_fmu(options: argparse.Namespace) -> Path:
    """The FMU that is named, else the default arm's, native where it can be built."""
    from .build import FmuOptions, build_fmu

    if options.fmu:
        return Path(options.fmu)
    try:
        return build_fmu(None, FmuOptions(native=True))
    except BuildError as error:
        print(f"{error}; running the Python flavour, which is slower", file=sys.stderr)
        return build_fmu(None, FmuOptions())


def _print_network(wire: Publisher) -> None:
    place = wire.place
    _print_table(
        ("topics", ", ".join(wire.topics)),
        ("network", f"DDS domain {place.domain} on {wire.interface}, {place.reach}"),
        ("targets", f"from {', '.join(wire.commands)}" if wire.commands else "fixed"),
        ("end", "Ctrl-C"),
    )
    _print_next("ros2 topic echo /joint_states")
    sys.stdout.flush()


def _chosen_fmu(options: argparse.Namespace) -> Path:
    """The FMU that is named, else the default arm's, built if need be."""
    from .build import FmuOptions, build_fmu
    from .native import host_platform

    if options.fmu:
        if options.native:
            raise InputError("--native builds the default arm's FMU; leave it out beside an FMU")
        return Path(options.fmu)
    native = options.native or host_platform() != "linux64"
    if native and not options.native:
        print("the Python flavour is for Linux x86-64: building the native one", file=sys.stderr)
    return build_fmu(None, FmuOptions(native=native))


@contextmanager
def _asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Whether a signal asked the run to end; read between steps, so that a step is never cut.

    SIGINT, SIGTERM, and SIGHUP from a terminal that is closed. A second one interrupts at once;
    more are ignored, as all that is left is closing the bag.
    """
    asked = False

    def ask(_number: int, _frame: object) -> None:
        nonlocal asked
        if asked:
            for number in SIGNALS:
                signal.signal(number, signal.SIG_IGN)
            raise KeyboardInterrupt
        asked = True

    before = {number: signal.signal(number, ask) for number in SIGNALS}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Progress:
    """A sink that shows a bar on a terminal and nothing in a pipe."""

    def __init__(self, run: Experiment) -> None:
        self._run = run

    def __enter__(self) -> _Progress:
        from tqdm import tqdm

        seconds = self._run.steps * self._run.step
        self._bar = tqdm(
            total=seconds, unit="s", disable=None, leave=False, desc="simulating",
            bar_format="{desc} {percentage:3.0f}% |{bar}| {n:.1f}/{total:.1f} s, {remaining} left",
        )  # fmt: skip
        return self

    def write(self, sample: object) -> None:
        self._bar.update(self._run.step if sample.k else 0.0)  # type: ignore[attr-defined]

    def __exit__(self, *exception: object) -> None:
        self._bar.close()


def _print_summary(
    run: Experiment, bag: Bag | None, storage: str, summary: Summary, pace: RealTime | None
) -> None:
    last = summary.last
    simulated = last.k * run.step
    rows = [("FMU", f"{run.fmu.path}")]
    if bag is not None:
        rows.append(("bag", f"{bag.path} ({last.k + 1} messages on /joint_states, {storage})"))
    if summary.error is not None:
        target = ", ".join(f"{last.inputs[f'x_des[{k + 1}]']:g}" for k in range(len(last.x)))
        rows.append(("end effector", f"{_length(summary.error)} from its target ({target}) m"))
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
    _print_table(*rows)


def _length(metres: float) -> str:
    for factor, unit in ((1.0, "m"), (1e3, "mm"), (1e6, "µm")):
        if metres * factor >= 1.0:
            return f"{metres * factor:.3g} {unit}"
    return f"{metres * 1e9:.3g} nm" if metres >= 1e-9 else "less than 1 nm"


def _info(options: argparse.Namespace) -> int:
    path = options.path
    if path.is_dir():
        from .bag import read_ends

        _print_bag(*read_ends(path))
    elif path.suffix in (".mcap", ".db3") and path.is_file():
        raise InputError(f"'{path}' is a bag's file; give the bag's folder, '{path.parent}'")
    else:
        from .fmu import load_fmu

        _print_fmu(load_fmu(path))
    return 0


def _print_fmu(fmu: Fmu) -> None:
    simulation = fmu.description.coSimulation
    capabilities = [
        name
        for name in (
            "needsExecutionTool",
            "canHandleVariableCommunicationStepSize",
            "canGetAndSetFMUstate",
            "canSerializeFMUstate",
            "providesDirectionalDerivative",
        )
        if getattr(simulation, name)
    ]
    _print_table(
        ("FMU", f"{fmu.path} ({fmu.name}, {fmu.description.generationTool})"),
        ("digest", fmu.guid),
        ("platforms", ", ".join(fmu.platforms) or "none"),
        ("capabilities", ", ".join(capabilities)),
        ("robot", fmu.robot or "unknown"),
        ("joints", ", ".join(fmu.joints)),
        ("controlled", _controlled(fmu)),
    )
    rows = [("variable", "unit", "start", "")]
    for causality in ("input", "output", "parameter"):
        for group, names in fmu.groups(causality).items():
            variables = [fmu.variables[name] for name in names]
            size = "" if names == [group] else f"[{len(names)}]"
            starts = ", ".join(_start(v.start) for v in variables if v.start is not None)
            units = ", ".join(dict.fromkeys(variable.unit or "" for variable in variables))
            rows.append((f"{group}{size}", units, starts, causality))
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    print()
    for row in rows:
        print("  ".join([*(cell.ljust(w) for cell, w in zip(row, widths)), row[3]]).rstrip())


def _controlled(fmu: Fmu) -> str:
    return f"{fmu.frame}, axes {' '.join(fmu.axes)} of {fmu.root}" if fmu.frame else "unknown"


def _start(text: str) -> str:
    try:
        value = float(text)
    except ValueError:
        return text
    return "none" if abs(value) > 1e300 else f"{value:g}"


def _print_bag(run: Run, count: int) -> None:
    duration = float(run.t[-1])
    rate = (count - 1) / duration if duration else 0.0
    rows = [
        ("bag", str(run.path)),
        ("joints", ", ".join(run.joints)),
        ("duration", f"{duration:g} s, {count} joint states, {rate:g} Hz"),
        ("first stamp", f"{run.stamps[0] / 1e9:.9f} s"),
        ("first state", _state(run, 0)),
        ("last state", _state(run, -1)),
    ]
    if run.provenance:
        fmu = run.provenance["fmu"]
        rows.append(("FMU", f"{fmu['file']} ({fmu['name']}, {fmu['guid']})"))
        rows.append(("made by", run.provenance["command_line"] or "the Python API"))
    _print_table(*rows)
    print()
    width = max(len(topic.name) for topic in run.topics)
    for topic in run.topics:
        print(f"{topic.name.ljust(width)}  {topic.count:8d}  {topic.type}")


def _plot(options: argparse.Namespace) -> int:
    from .figure import file_kind

    if options.output is not None:
        file_kind(options.output)  # before the bags are read
    sweeps = [folder for folder in options.bags if any(Path(folder).glob("*.parquet"))]
    if not sweeps:
        return _plot_bags(options)
    if len(options.bags) > 1:
        raise InputError(f"'{sweeps[0]}' is a sweep; it is drawn alone")
    return _plot_sweep(options, Path(sweeps[0]))


def _plot_bags(options: argparse.Namespace) -> int:
    from .plot import drawing
    from .track import labels, outcome, read_tracks

    tracks = read_tracks(options.bags, urdf=options.urdf, frame=options.frame)
    results = [pair for pair in zip(labels(tracks), map(outcome, tracks)) if pair[1]]
    _show_or_save(drawing(tracks), options.output, *results)
    return 0


def _plot_sweep(options: argparse.Namespace, folder: Path) -> int:
    from .sweeps import read_sweep
    from .sweeps.map import drawing

    table, provenance = read_sweep(folder)
    _show_or_save(drawing(table, provenance, folder.resolve().name), options.output)
    _print_best(table)
    return 0


def _show_or_save(drawing: Drawing, output: str | None, *results: tuple[str, str]) -> None:
    """A window where there is a terminal and a display, else a file and a word about it."""
    from .figure import save, show

    if output is None and sys.stdout.isatty() and show(drawing):
        return
    path = save(drawing, output)
    _print_table(("plot", f"{path} ({path.stat().st_size / 1024:.0f} KB)"), *results)


def _sweep(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from .inputs import parse_settings
    from .sweeps import parse_grids, parse_ranges, sweep

    if options.resume and not options.output:
        raise InputError("--resume needs the sweep to go on with: -o OUT")
    grid, ranges = parse_grids(options.grids), parse_ranges(options.ranges)
    settings = parse_settings(options.settings)
    fmu = _fast_fmu(options)
    output = Path(options.output or time.strftime("sweep_%Y_%m_%d-%H_%M_%S"))
    begin = time.perf_counter()
    total = 0
    with (
        _asked_to_stop() as asked,
        tqdm(unit="run", disable=None, leave=False, desc="sweeping", smoothing=0.05) as bar,
    ):

        def progress(done: int, runs: int) -> None:
            nonlocal total
            if not total:  # what an earlier sweep has done says nothing about the rate
                bar.total, bar.initial, bar.n = runs, done, done
            total = runs
            bar.update(done - bar.n)

        table = sweep(
            fmu, grid=grid, ranges=ranges, random=options.random, seed=options.seed,
            stop_time=options.stop_time, step=options.step, settings=settings, output=output,
            resume=options.resume, bags=options.bags, workers=options.workers,
            scheduler=options.scheduler, progress=progress, stop=asked,
            command_line=options.command_line,
        )  # fmt: skip
    stopped = len(table) < total
    counts = table["outcome"].value_counts()
    outcomes = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    _print_table(
        ("FMU", f"{fmu}"),
        ("sweep", f"{output} ({len(table)} of {total} runs{outcomes and f': {outcomes}'})"),
        ("time", f"{time.perf_counter() - begin:.1f} s"),
    )
    _print_best(table)
    again = options.command_line if options.resume else f"{options.command_line} --resume"
    again += "" if options.output else f" -o {_quote(output)}"
    _print_next(*([again] if stopped else []), f"twodof plot {_quote(output)}")
    return INTERRUPTED if stopped else 0


def _print_best(table: DataFrame) -> None:
    """The first few runs by settling time, effort and final error."""
    from .sweeps import METRICS, ranked

    best = ranked(table).head(5)
    columns = [*best.columns]
    columns = columns[: columns.index("end_time")]
    units = [METRICS[name].unit if name in METRICS else "" for name in columns]
    rows = [[f"{row[name]:.4g}" for name in columns] for row in best.to_dict("records")]
    widths = [max(map(len, cells)) for cells in zip(columns, units, *rows)]
    print("\nbest: settled first, with least effort" if rows else "\nno run was finished")
    for cells in [columns, units, *rows] if rows else []:
        print("  " + "  ".join(cell.rjust(width) for cell, width in zip(cells, widths)))


def _view(options: argparse.Namespace) -> int:
    from .view import export, view

    robot = {name: getattr(options, name) for name in ("urdf", "mesh_dir", "frame", "fmu")}
    if options.export:
        for remark in export(options.bag, options.export, **robot):
            print(f"WARNING: {remark}", file=sys.stderr)
        print(f"page  {options.export}; it needs no network")
        return 0
    with _asked_to_stop() as asked:
        view(
            options.bag, asked, lambda url, remarks: _open(options, url, remarks),
            host=options.host, port=options.port, **robot,
        )  # fmt: skip
    return 0


def _live(options: argparse.Namespace) -> int:
    from .inputs import parse_settings
    from .live import live

    fmu = _fast_fmu(options)
    with _asked_to_stop() as asked:
        bags = live(
            fmu, asked, lambda url: _open(options, url, fmu=fmu),
            host=options.host, port=options.port, step=options.step,
            settings=parse_settings(options.settings), bag=options.output,
            command_line=options.command_line,
        )  # fmt: skip
    for bag in bags:
        print(f"bag   {bag}")
    if bags:
        _print_next(f"twodof plot {_quote(bags[-1])}", f"twodof view {_quote(bags[-1])}")
    return INTERRUPTED


def _open(
    options: argparse.Namespace, url: str, remarks: Sequence[str] = (), fmu: Path | None = None
) -> None:
    for remark in remarks:
        print(f"WARNING: {remark}", file=sys.stderr)
    what = f"{fmu}; " if fmu is not None else ""
    print(f"open  {url} ({what}Ctrl-C ends)", flush=True)
    if not options.no_browser and {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        import webbrowser

        webbrowser.open(url)


def _recover(options: argparse.Namespace) -> int:
    from .bag import recover

    done = recover(options.bag)
    if done.original is None:
        print(f"'{done.path}' is complete; there is nothing to recover")
        return 0
    _print_table(
        ("bag", f"{done.path} ({sum(done.counts.values())} messages)"),
        *((topic, f"{count}") for topic, count in sorted(done.counts.items())),
        *([("damage", done.damage)] if done.damage else []),
        ("original", f"{done.original}, as it was; delete it when you are content"),
    )
    _print_next(f"twodof info {_quote(done.path)}", f"ros2 bag play {_quote(done.path)}")
    return 0


def _state(run: Run, k: int) -> str:
    q = ", ".join(f"{value:.6g}" for value in run.q[k])
    v = ", ".join(f"{value:.6g}" for value in run.v[k])
    return f"q = ({q}), v = ({v})"


def _quote(path: Path) -> str:
    return shlex.quote(str(path))


def _print_table(*rows: tuple[str, str]) -> None:
    width = max(len(label) for label, _ in rows)
    for label, text in rows:
        print(f"{label.ljust(width)}  {text}")


def _print_next(*commands: str) -> None:
    print("\nnext")
    for command in commands:
        print(f"  {command}")


VERBS = {
    "build": _build,
    "run": _run,
    "publish": _publish,
    "info": _info,
    "plot": _plot,
    "view": _view,
    "live": _live,
    "sweep": _sweep,
    "recover": _recover,
}
