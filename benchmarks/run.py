"""All that docs/speed.md tells of the engine and of what is around it, in one run and one table.

    python benchmarks/run.py

The parts, which can be run alone too, are ``steps.py``, ``engine.py``, ``around.py`` and
``sweep.py``; each says at its top how it measures, and prints more than the table has. All is
processor time but where it says otherwise, and what is compared takes turns. Takes six minutes
or more, 1.3 GB of disk, the packages of the extra "test" and a C compiler.
"""

from __future__ import annotations

import os
import platform
import time

import around
import engine
import steps
import sweep

PARTS = (steps, engine, around, sweep)


def main() -> None:
    """Run the parts; print the table."""
    begin, figures = time.perf_counter(), []
    for part in PARTS:
        print(f"\n==== {part.__name__}.py\n", flush=True)
        figures += part.main()
    print(
        f"\n{steps.processor()}, Python {platform.python_version()}, load {os.getloadavg()[2]:.1f}"
    )
    print("\n| what | measured | wanted |\n| --- | --- | --- |")
    for figure in figures:
        print("| " + " | ".join(figure) + " |")
    print(f"\n{(time.perf_counter() - begin) / 60:.0f} minutes in all")


if __name__ == "__main__":
    main()
