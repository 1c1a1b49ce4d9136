"""Verb sweep: run an FMU over many gains, and map the results."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from ..bounds import MAX_RUNS
from ..plant.numerals import number
from .fmus import fast_fmu
from .help import Parser
from .options import (
    CommandLineError,
    add_fmu,
    add_options,
    add_output,
    check_company,
    dated,
    given_options,
    parse_settings,
    variables,
)
from .printing import print_json, print_next, print_table, quote, say
from .signals import INTERRUPTED, asked_to_stop

if TYPE_CHECKING:
    from pandas import DataFrame

    from ..simulation.expressions import Expression


def add(sweep: Parser) -> None:
    sweep.description = (
        "Run an FMU over a grid or random values of any of its inputs and parameters. Without an FMU,"
        " the native FMU of the default arm is used."
    )
    option, flag = sweep.add_argument, partial(sweep.add_argument, action="store_true")
    add_fmu(sweep, "the default arm's FMU", "FMU")
    varied = partial(sweep.add_repeatable, completer=variables)
    text = "evenly spaced values; several variables give all combinations"
    varied("--grid", dest="grids", metavar="NAME=LOW:HIGH:COUNT", help=text)
    option("--random", type=int, metavar="N", help="number of random draws from the --range options")
    option("--seed", type=int, metavar="S", help="seed of the random draws (0)")
    varied("--range", dest="ranges", metavar="NAME=LOW:HIGH", help="range of uniformly drawn values")
    add_options(sweep, "--stop-time", "--step", "--set")
    add_output(sweep, "OUT", "folder of the results (sweep_<date and time>)")
    flag("--resume", help="continue the sweep in OUT without repeating finished runs")
    flag("--bags", help="keep a bag of each run in OUT/bags")
    option("--workers", type=int, metavar="N", help="number of local processes (one per core)")
    option("--scheduler", metavar="tcp://…", help="address of a Dask scheduler, whose workers are used instead")
    add_options(sweep, "--cost", "--json")


def call(options: argparse.Namespace) -> int:
    from ..simulation.progress import counting
    from ..sweeps.coordinator import sweep
    from ..sweeps.ranking import cost_of

    check_company(options, needs={"--resume": "-o", "--seed": "--random"}, excludes={"--workers": "--scheduler"})
    grid, ranges = _grids(options.grids), _ranges(options.ranges)
    settings = parse_settings(options.settings)
    cost = cost_of(options.cost)
    fmu = fast_fmu(options)
    output = Path(options.output or dated("sweep"))
    begin = time.perf_counter()
    total = 0
    with asked_to_stop() as asked, counting("sweeping", "run", shown=sys.stderr.isatty()) as show:

        def progress(done: int, runs: int) -> None:
            nonlocal total
            total = runs
            show(done, runs)

        table = sweep(
            fmu,
            grid=grid,
            ranges=ranges,
            random=options.random or 0,
            seed=options.seed or 0,
            settings=settings,
            output=output,
            progress=progress,
            stop=asked,
            **given_options(options, "stop_time", "step", "resume", "bags", "workers", "scheduler", "command_line"),
        )
    stopped = len(table) < total
    counts = table["outcome"].value_counts()
    outcomes = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    if options.json:
        print_json(
            fmu=str(fmu),
            sweep=str(output),
            runs=total,
            done=len(table),
            outcomes=counts.to_dict(),
            **best_facts(table, cost),
        )
        return INTERRUPTED if stopped else 0
    print_table(
        ("FMU", f"{fmu}"),
        ("sweep", f"{output} ({len(table)} of {total} runs{outcomes and f': {outcomes}'})"),
        ("time", f"{time.perf_counter() - begin:.1f} s"),
    )
    print_best(table, cost)
    again = options.command_line if options.resume else f"{options.command_line} --resume"
    again += "" if options.output else f" -o {quote(output)}"
    print_next(*([again] if stopped else []), f"twodof plot {quote(output)}")
    return INTERRUPTED if stopped else 0


def best_runs(table: DataFrame, cost: Expression | None) -> DataFrame:
    """Return variables and known metrics of the best runs."""
    from ..sweeps.ranking import ranked

    best = ranked(table, cost).head(5)
    columns = [*best.columns]
    return best[columns[: columns.index("end_time")]].dropna(axis="columns", how="all")


def best_facts(table: DataFrame, cost: Expression | None = None) -> dict[str, object]:
    """Return the best runs, their cost, and the number of runs beyond the URDF's limits, for JSON."""
    from ..sweeps.ranking import beyond_limits

    best = best_runs(table, cost).to_dict("records")
    return dict(cost=None if cost is None else cost.text, best=best, beyond_limits=int(beyond_limits(table).sum()))


def print_best(table: DataFrame, cost: Expression | None = None) -> None:
    """Print the best runs with units; report ties, and mark runs that exceed the URDF's limits."""
    from ..simulation.verdict import METRICS
    from ..sweeps.ranking import RANKED, beyond_limits, equals, ranked, remark

    best = best_runs(table, cost)
    units = [METRICS[name].unit if name in METRICS else "" for name in best.columns]
    rows = [[f"{value:.4g}" for value in row] for row in best.to_numpy()]
    names = [*best.columns]
    beyond = beyond_limits(table).loc[best.index]
    if beyond.any():
        rows = [[*row, "no" if impossible else "yes"] for row, impossible in zip(rows, beyond)]
        names, units = [*names, "possible"], [*units, ""]
    ranks = [RANKED[name] for name in RANKED if name in best.columns][:2]
    title = f"best: {', then '.join(ranks)}" if ranks else "finished; no metric ranks them"
    if cost is not None:
        title = f"best: least cost, {cost.text}"
    runs = ranked(table, cost)
    if (ranks or cost) and (count := equals(runs, cost)) > 1:
        title = f"no single best run: {count} are equal up to rounding"
    if cost is not None and rows and not runs["cost"].abs().lt(inf).any():
        title = f"no run is best: the cost '{cost.text}' is not a finite number for any of them"
    say(f"\n{title}" if rows else "\nno run was finished")
    if text := remark(table):
        say(f"note: {text}")
    if rows:
        print_table(names, units, *rows, align=str.rjust, before="  ")


def _grids(texts: Iterable[str]) -> dict[str, tuple[float, ...]]:
    """Return the grids of --grid: evenly spaced values, including both ends."""
    import numpy as np

    grids: dict[str, tuple[float, ...]] = {}
    for text in texts:
        name, (low, high, count) = _parse("--grid", text, "NAME=LOW:HIGH:COUNT", grids)
        if count != int(count) or count < 2:
            raise CommandLineError(f"--grid {text}: COUNT {count:g} must be a whole number of at least 2")
        if count > MAX_RUNS:
            raise CommandLineError(f"--grid {text}: COUNT must be at most {MAX_RUNS}")
        grids[name] = tuple(np.linspace(low, high, int(count)).tolist())
    return grids


def _ranges(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    ranges: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, (low, high) = _parse("--range", text, "NAME=LOW:HIGH", ranges)
        ranges[name] = (low, high)
    return ranges


def _parse(option: str, text: str, form: str, before: Iterable[str]) -> tuple[str, list[float]]:
    name, equals, value = text.partition("=")
    name = name.strip()
    try:
        numbers = [number(part) for part in value.split(":")]
    except ValueError:
        numbers = []
    if not equals or not name or len(numbers) != form.count(":") + 1:
        example = f"{name or 'Kp'}=20:200{':10' * (option == '--grid')}"
        raise CommandLineError(f"{option} {text}: expected {form}, as in {option} {example}")
    if not all(map(isfinite, numbers)):
        raise CommandLineError(f"{option} {text}: its numbers must be finite")
    if name in before:
        raise CommandLineError(f"{option} {name} is given twice")
    low, high = numbers[:2]
    if not low < high:
        raise CommandLineError(f"{option} {text}: LOW {low:g} must be below HIGH {high:g}")
    return name, numbers
