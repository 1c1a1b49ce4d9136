"""run: an FMU simulated, and its bag."""

from __future__ import annotations

import argparse
import math
import sys
from typing import TYPE_CHECKING, Any

from .common import (
    INTERRUPTED,
    CommandLineError,
    asked_to_stop,
    bag_of,
    dated,
    experiment_of,
    print_next,
    print_summary,
    quote,
)
from .options import add_fmu, add_output, add_run_options, add_time_options

if TYPE_CHECKING:
    from ..simulation.experiments import Experiment
    from ..simulation.sample import Sample, Sink


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    run = verbs.add_parser(
        "run", help="simulate an FMU and write a bag",
        description="Simulate an FMU and write each step as sensor_msgs/JointState into a bag.",
    )  # fmt: skip
    add_output(run, "BAG", "default: rosbag2_<date and time>")
    add_time_options(run)
    run.add_argument("--realtime", action="store_true", help="pace the run to the wall clock")
    add_fmu(run)
    add_run_options(run)
    run.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    from ..simulation.master import simulate
    from ..simulation.pace import RealTime

    if options.stop_time == math.inf:
        raise CommandLineError(
            "stop time inf s: 'twodof run' ends; 'twodof publish' goes on until Ctrl-C"
        )
    run = experiment_of(options, options.stop_time, options.step)
    bag = bag_of(options, options.output or dated("rosbag2"))
    pace = RealTime() if options.realtime else None
    with asked_to_stop() as asked:
        summary = simulate(run, bag, *progress(), pace=pace, stop=asked)
    print_summary(options, run, bag, summary, pace)
    if not options.json:
        print_next(
            f"twodof plot {quote(bag.path)}",
            f"twodof view {quote(bag.path)}",
            f"ros2 bag play {quote(bag.path)}",
        )
    return INTERRUPTED if summary.stopped else 0


def progress() -> list[Sink]:
    """A sink that shows a bar on a terminal; none in a pipe."""
    if not sys.stderr.isatty():
        return []
    from tqdm import tqdm

    from ..simulation.sample import Sink

    class Progress(Sink):
        def begin(self, run: Experiment) -> Progress:
            self._run = run
            return self

        def __enter__(self) -> Progress:
            run = self._run
            self._bar = tqdm(
                total=run.steps * run.step, unit="s", leave=False, desc="simulating",
                bar_format="{desc} {percentage:3.0f}% |{bar}| {n:.1f}/{total:.1f} s,"
                " {remaining} left",
            )  # fmt: skip
            return self

        def write(self, sample: Sample) -> None:
            self._bar.update(self._run.step if sample.k else 0.0)

        def __exit__(self, *exception: object) -> None:
            self._bar.close()

    return [Progress()]
