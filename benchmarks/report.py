"""Tables of benchmarks, and processor time."""

from __future__ import annotations

import os
import platform
import re
import resource
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import twodof
from twodof.cli.printing import print_table


class Figure(NamedTuple):
    """A measured value and its bound; the name has the settings of both sides."""

    what: str
    measured: str
    wanted: str


def print_rows(title: str, *rows: Iterable[object]) -> None:
    """Print a table with a title; the first column is aligned to the left."""
    texts = [[*map(str, row)] for row in rows]
    width = max(len(row[0]) for row in texts)
    print(f"\n{title}\n")
    print_table(*([row[0].ljust(width), *row[1:]] for row in texts), align=str.rjust, before="  ")


def print_figures(figures: Iterable[Figure]) -> None:
    """Print a table in Markdown."""
    print("\n| what | measured | wanted |\n| --- | --- | --- |")
    for figure in figures:
        print("| " + " | ".join(figure) + " |")


def print_judged(rows: Iterable[tuple[Sequence[str], bool]]) -> int:
    """Print rows in Markdown as they come, the first as the head; mark wrong ones, and return 1 if there is one."""
    wrong = 0
    for k, (row, right) in enumerate(rows):
        print(f"| {' | '.join(row)} |", *(() if right else ("wrong",)), flush=True)
        if k == 0:
            print("|" + " --- |" * len(row))
        wrong += not right
    return 1 if wrong else 0


def machine() -> str:
    """Return the versions and the processor; a virtual one may hide its name, and seldom its numbers."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        text = ""
    facts = dict(re.findall(r"^(.+?)\t*: (.+)$", text, re.M))
    keys = ("cpu family", "model", "stepping")
    parts = [facts.get("model name") or platform.processor() or platform.machine()]
    parts += [f"{key} {facts[key]}" for key in keys if key in facts]
    parts += [f"{os.cpu_count()} cores", f"load {os.getloadavg()[0]:.1f}"]
    return f"twodof {twodof.__version__}, Python {platform.python_version()}; {', '.join(parts)}"


def spent(work: Callable[[], object]) -> tuple[float, float]:
    """Return the processor time of some work, s: of this process, and of children that end during it."""

    def now() -> list[float]:
        usages = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        return [usage.ru_utime + usage.ru_stime for usage in usages]

    before = now()
    work()
    own, others = (end - begin for begin, end in zip(before, now()))
    return own, others
