"""Measure the numbers of docs/speed.md on the engine and the runs around it, in one table.

    python benchmarks/run.py

The parts ``steps.py``, ``engine.py`` and ``around.py`` also run alone. The docstring of each describes its method, and
each prints more than the table has. Times are processor times, and compared programs take turns. It takes six minutes
or more, 1.3 GB of disk, the packages of the extra "test" and a C compiler.
"""

from __future__ import annotations

import around
import engine
import steps
from report import machine, print_figures


def main() -> None:
    """Run the parts; print the table."""
    print(machine())
    print_figures([*steps.main(), *engine.main(), *around.main()])
    print(f"\n{machine()}")


if __name__ == "__main__":
    main()
