"""Verb plot: draw bags, or the map of a sweep, into one figure."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from .help import Parser
from .options import CommandLineError, add_options, add_output, add_robot_options, joints, output_file
from .printing import print_table, written
from .sweep import print_best

if TYPE_CHECKING:
    from ..plots.figure import Drawing


def add(plot: Parser) -> None:
    plot.description = (
        "Draw joint positions, velocities and efforts, the end effector's path and its error; for a"
        " sweep, each metric over the variables."
    )
    plot.add_argument("bags", nargs="+", metavar="BAG|SWEEP", help="bags to draw; several are compared")
    text = "output file .png, .svg, .pdf or .html (opens a window); - is the standard output, as PNG"
    add_output(plot, "FILE", text, output_file)
    plot.add_argument("--joints", metavar="A,B", help="joints to draw, in that order (all)", completer=joints)
    add_options(plot, "--cost")
    add_robot_options(plot)


def call(options: argparse.Namespace) -> int:
    from ..plots.figure import file_kind

    if options.output is not None:
        file_kind(options.output)  # refuses the file before the bags are read
    sweeps = [folder for folder in options.bags if any(Path(folder).glob("*.parquet"))]
    if not sweeps:
        if options.cost is not None:
            raise CommandLineError("--cost ranks the runs of a sweep, and there is no sweep here")
        return _plot_bags(options)
    for option in ("joints", "urdf", "frame"):
        if getattr(options, option) is not None:
            raise CommandLineError(f"'{sweeps[0]}' is a sweep; --{option} is for bags")
    if len(options.bags) > 1:
        raise CommandLineError(f"'{sweeps[0]}' is a sweep; it is drawn alone")
    from ..plots.sweeps import drawing
    from ..sweeps.ranking import cost_of
    from ..sweeps.results import read_sweep

    folder, cost = Path(sweeps[0]), cost_of(options.cost)
    table = read_sweep(folder)
    _show_or_save(drawing(table, folder.resolve().name, cost, folder / "bags"), options.output)
    print_best(table, cost)
    return 0


def _plot_bags(options: argparse.Namespace) -> int:
    from ..plots.panels import with_joints
    from ..plots.runs import drawing, each_of
    from ..plots.track import read_tracks
    from ..plots.words import difference, labels, outcome

    tracks = read_tracks(each_of(options.bags), urdf=options.urdf, frame=options.frame)
    if options.joints is not None:
        tracks = with_joints(tracks, options.joints.split(","))
    results = []
    for label, track in zip(labels(tracks), tracks):
        apart = difference(tracks[0], track) if track is not tracks[0] else ""
        lines = outcome(track) if len(tracks) == 1 else ["; ".join(filter(None, (track.verdict.lines[0], apart)))]
        results += [("" if i else label, line) for i, line in enumerate(lines)]
    _show_or_save(drawing(tracks), options.output, *results)
    return 0


def _show_or_save(drawing: Drawing, output: str | None, *results: tuple[str, str]) -> None:
    """Show a window if there is a terminal and a display; otherwise save a file and print its name."""
    from ..plots.figure import save, show

    if output is None and sys.stdout.isatty() and show(drawing):
        return
    path = save(drawing, output)
    print_table(("plot", written(path)), *results)
