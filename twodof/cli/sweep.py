"""sweep: an FMU over many gains."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from math import isfinite
from pathlib import Path
from typing import Any

from .common import (
    INTERRUPTED,
    CommandLineError,
    asked_to_stop,
    best_runs,
    dated,
    fast_fmu,
    parse_settings,
    print_best,
    print_json,
    print_next,
    print_table,
    quote,
)  # fmt: skip
from .options import (
    add_json_option,
    add_output,
    add_set_option,
    add_time_options,
    check_company,
    not_empty,
)


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    sweep = verbs.add_parser(
        "sweep", help="run an FMU over many gains, and map what comes out",
        description="Run an FMU over a grid or random values of any of its inputs and parameters."
        " The native default FMU is built where none is named.",
    )  # fmt: skip
    sweep.add_argument(
        "fmu", nargs="?", type=not_empty, metavar="FMU", help="default: the default arm's"
    )
    sweep.add_argument(
        "--grid", dest="grids", action="append", default=[], metavar="NAME=LOW:HIGH:COUNT",
        help="values evenly spaced; all combinations of several",
    )  # fmt: skip
    sweep.add_argument("--random", type=int, metavar="N", help="draws of each --range")
    sweep.add_argument("--seed", type=int, metavar="S", help="of the draws (0)")
    sweep.add_argument(
        "--range", dest="ranges", action="append", default=[], metavar="NAME=LOW:HIGH",
        help="values drawn uniformly",
    )  # fmt: skip
    add_time_options(sweep)
    add_set_option(sweep)
    add_output(sweep, "OUT", "default: sweep_<date and time>")
    sweep.add_argument(
        "--resume", action="store_true", help="go on with OUT; what is done is not repeated"
    )
    sweep.add_argument("--bags", action="store_true", help="keep a bag of each run in OUT/bags")
    sweep.add_argument("--workers", type=int, metavar="N", help="local processes (one for a core)")
    sweep.add_argument("--scheduler", metavar="tcp://…", help="of a Dask cluster to use instead")
    add_json_option(sweep)
    sweep.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    from tqdm import tqdm

    from ..sweeps.coordinator import sweep

    check_company(
        options,
        needs={"--resume": "-o", "--seed": "--random"},
        excludes={"--workers": "--scheduler"},
    )
    grid, ranges = parse_grids(options.grids), parse_ranges(options.ranges)
    settings = parse_settings(options.settings)
    fmu = fast_fmu(options)
    output = Path(options.output or dated("sweep"))
    begin = time.perf_counter()
    total = 0
    with (
        asked_to_stop() as asked,
        tqdm(unit="run", disable=None, leave=False, desc="sweeping", smoothing=0.05) as bar,
    ):

        def progress(done: int, runs: int) -> None:
            nonlocal total
            if not total:  # what an earlier sweep has done says nothing about the rate
                bar.total, bar.initial, bar.n = runs, done, done
            total = runs
            bar.update(done - bar.n)

        table = sweep(
            fmu, grid=grid, ranges=ranges, random=options.random or 0, seed=options.seed or 0,
            stop_time=options.stop_time, step=options.step, settings=settings, output=output,
            resume=options.resume, bags=options.bags, workers=options.workers,
            scheduler=options.scheduler, progress=progress, stop=asked,
            command_line=options.command_line,
        )  # fmt: skip
    stopped = len(table) < total
    counts = table["outcome"].value_counts()
    outcomes = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    if options.json:
        print_json(
            fmu=str(fmu), sweep=str(output), runs=total, done=len(table),
            outcomes=counts.to_dict(), best=best_runs(table).to_dict("records"),
        )  # fmt: skip
        return INTERRUPTED if stopped else 0
    print_table(
        ("FMU", f"{fmu}"),
        ("sweep", f"{output} ({len(table)} of {total} runs{outcomes and f': {outcomes}'})"),
        ("time", f"{time.perf_counter() - begin:.1f} s"),
    )
    print_best(table)
    again = options.command_line if options.resume else f"{options.command_line} --resume"
    again += "" if options.output else f" -o {quote(output)}"
    print_next(*([again] if stopped else []), f"twodof plot {quote(output)}")
    return INTERRUPTED if stopped else 0


def parse_grids(texts: Iterable[str]) -> dict[str, tuple[float, ...]]:
    """NAME=LOW:HIGH:COUNT texts of a command line: evenly spaced values, both ends included."""
    import numpy as np

    from ..sweeps.design import MAX_RUNS

    grids: dict[str, tuple[float, ...]] = {}
    for text in texts:
        name, (low, high, number) = _parse("--grid", text, "NAME=LOW:HIGH:COUNT", grids)
        if number != int(number) or number < 2:
            raise CommandLineError(f"--grid {text}: COUNT {number:g} is no whole number from 2 on")
        if number > MAX_RUNS:
            raise CommandLineError(f"--grid {text}: COUNT must be at most {MAX_RUNS}")
        if not low < high:
            raise CommandLineError(f"--grid {text}: LOW {low:g} must be below HIGH {high:g}")
        grids[name] = tuple(np.linspace(low, high, int(number)).tolist())
    return grids


def parse_ranges(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """NAME=LOW:HIGH texts of a command line."""
    ranges: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, (low, high) = _parse("--range", text, "NAME=LOW:HIGH", ranges)
        if not low < high:
            raise CommandLineError(f"--range {text}: LOW {low:g} must be below HIGH {high:g}")
        ranges[name] = (low, high)
    return ranges


def _parse(option: str, text: str, form: str, before: Iterable[str]) -> tuple[str, list[float]]:
    name, equals, value = text.partition("=")
    name = name.strip()
    try:
        numbers = [float(part) for part in value.split(":")]
    except ValueError:
        numbers = []
    if not equals or not name or len(numbers) != form.count(":") + 1:
        raise CommandLineError(f"{option} {text}: expected {form}")
    if not all(map(isfinite, numbers)):
        raise CommandLineError(f"{option} {text}: its numbers must be finite")
    if name in before:
        raise CommandLineError(f"{option} {name} is given twice")
    return name, numbers
