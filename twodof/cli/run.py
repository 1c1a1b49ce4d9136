"""Verb run: simulate an FMU and write a bag."""

from __future__ import annotations

import argparse
import logging
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .fmus import chosen_fmu
from .help import Parser
from .options import OF_A_RUN, CommandLineError, add_fmu, add_options, add_output, dated, given_options, parse_settings
from .printing import print_json, print_next, print_table, quote, say
from .signals import INTERRUPTED, asked_to_stop

FAILED_IF = 3  # exit status of a run for which a condition of --fail-if holds

if TYPE_CHECKING:
    from ..bag.writer import Bag
    from ..fmu import Fmu, Setting
    from ..simulation.experiments import Experiment
    from ..simulation.pace import RealTime
    from ..simulation.run_summary import Summary


def add(run: Parser) -> None:
    run.description = "Simulate an FMU and write each step as sensor_msgs/JointState into a bag."
    add_output(run, "BAG", "folder of the bag (rosbag2_<date and time>)")
    add_options(run, "--stop-time", "--step")
    run.add_argument("--measured", action="store_true", help="record the measured joint states, and the true ones")
    run.add_argument("--signals", action="store_true", help="record all real outputs of all FMUs")
    run.add_argument("--realtime", action="store_true", help="pace the run to the wall clock")
    add_fmu(run, "TwoDof.fmu, built if it is missing", "FMU|SSP|URDF")
    add_options(run, "--robot", "--frame", *OF_A_RUN)
    text = "exit with status 3 if the condition holds, such as 'error > 1e-3' or 'saturated > 0.1'; repeatable"
    run.add_repeatable("--fail-if", metavar="CONDITION", help=text)


def call(options: argparse.Namespace) -> int:
    from ..simulation.expressions import expression
    from ..simulation.master import simulate
    from ..simulation.pace import RealTime
    from ..simulation.progress import Progress
    from ..simulation.verdict import RESULTS

    if options.stop_time == math.inf:
        raise CommandLineError("stop time inf s: must be finite; 'twodof publish' runs until Ctrl-C")
    for condition in options.fail_if:
        expression(condition, RESULTS, condition=True)  # checked before a run that may take hours
    run = experiment_of(options, options.stop_time, options.step)
    bag = bag_of(options, options.output or dated("rosbag2"), measured=options.measured)
    pace = RealTime() if options.realtime else None
    bars = [Progress()] if sys.stderr.isatty() else []
    with asked_to_stop() as asked:
        summary = simulate(run, bag, *bars, pace=pace, stop=asked)
    decided = summary.verdict.failed_by(*options.fail_if)
    if options.json:
        print_json(**facts_of(run, bag, summary, pace), failed_by=decided or None)
    else:
        print_summary(options, run, bag, summary, pace)
        path = quote(bag.path)
        print_next(f"twodof plot {path}", f"twodof view {path}", f"ros2 bag play {path}")
    if decided:
        say(f"twodof: failed: {decided}", error=True)
    return INTERRUPTED if summary.stopped else FAILED_IF if decided else 0


def experiment_of(options: argparse.Namespace, stop_time: float | None, step: float | None) -> Experiment:
    """Return the experiment of the options."""
    from ..fmu import load_fmu
    from ..simulation.experiments import experiment

    logging.getLogger("twodof.simulation.input_values").setLevel(logging.INFO)  # columns that set vectors
    fmu, table, changes = load_fmu(chosen_fmu(options), getattr(options, "robot", "")), options.input, None
    settings = _settings(options, fmu)
    if table is not None:
        folder, _, topic = (table, "", None) if Path(table).is_dir() else table.rpartition(":")
        if Path(folder).is_dir() and folder:
            from ..bag.provenance import robots_of
            from ..bag.recorded_commands import read_commands

            if topic in robots_of(Path(folder)):  # replay the inputs of one of several robots
                folder, topic = table, None
            table = None
            changes = read_commands(fmu, folder, topic, step=step, settings=settings)
    return experiment(
        fmu,
        stop_time=stop_time,
        step=step,
        settings=settings,
        input_file=table,
        changes=changes,
        stamp_start=options.stamp_start,
        signals=getattr(options, "signals", False),
    )


def _settings(options: argparse.Namespace, fmu: Fmu) -> dict[str, Setting]:
    """Return the settings of the options; values of texts and enumerations are text."""
    words = {name for name, variable in fmu.variables.items() if variable.type in ("String", "Enumeration")}
    words |= {name.partition("[")[0] for name in words}
    words |= {name for name, own in fmu.aliases.items() if own in words}
    return parse_settings(options.settings, words=words)


def bag_of(options: argparse.Namespace, path: str | Path, *, measured: bool = False) -> Bag:
    """Return the bag of the options."""
    from ..bag.writer import Bag

    names = ("storage", "compress", "scene", "meshes", "effort", "overwrite", "fsync", "command_line")
    return Bag(path, measured=measured, **given_options(options, *names))


def facts_of(run: Experiment, bag: Bag | None, summary: Summary, pace: RealTime | None) -> dict[str, object]:
    """Return the facts of a run for another program."""
    last = summary.last
    return dict(
        fmu=str(run.fmu.path),
        bag=None if bag is None else bag.address,
        joint_states=last.k + 1,
        end_time=last.t,
        stopped=summary.stopped,
        **{key: getattr(last, key) for key in ("q", "v", "x")},
        x_des=last.target,
        **{key: getattr(summary, key) for key in ("error", "turn_error", "joint_error")},
        verdict=summary.verdict.facts(),
        wall_time=summary.wall_time,
        missed=None if pace is None else pace.missed,
        worst=None if pace is None else pace.worst,
    )


def print_summary(
    options: argparse.Namespace, run: Experiment, bag: Bag | None, summary: Summary, pace: RealTime | None
) -> None:
    """Print the summary of a run."""
    last = summary.last
    rows = [("FMU", f"{run.fmu.path}")]
    for name, value in _settings(options, run.fmu).items():
        elements = run.fmu.vector(name)
        if len(elements) > 1 and isinstance(value, int | float):
            rows.append((f"{name}", f"{value:g}, all {len(elements)} elements"))
    if bag is not None:
        rows.append(("bag", f"{bag.address} ({last.k + 1} messages on {bag.topic}, {options.storage})"))
    rows += verdict_rows(summary.verdict.lines)
    simulated = last.k * run.step
    speed = simulated / summary.wall_time if summary.wall_time else 0.0
    rows.append(("time", f"{simulated:g} s simulated in {summary.wall_time:.2f} s, {speed:.1f} × real time"))
    if pace is not None:
        rows.append(("deadlines", f"{pace.missed} of {last.k + 1} missed, worst {pace.worst * 1e3:.1f} ms"))
    if summary.stopped:
        complete = "" if bag is None else "; the bag is complete up to there"
        rows.append(("stopped", f"on request at {last.t:g} s{complete}"))
    print_table(*rows)


def verdict_rows(lines: Sequence[str]) -> list[tuple[str, str]]:
    """Return rows of a table with the lines of a verdict."""
    return [("" if i else "verdict", line) for i, line in enumerate(lines)]
