"""Verb recover: repair a bag whose writer died."""

import argparse
from pathlib import Path

from .help import Parser
from .printing import print_next, print_table, quote, say


def add(recover: Parser) -> None:
    recover.description = "Repair a bag whose writer died, so that every reader can open it."
    recover.add_argument("bag", metavar="BAG", type=Path, help="folder of the bag")


def call(options: argparse.Namespace) -> int:
    from ..bag.recovery import recover

    done = recover(options.bag)
    if done.original is None:
        say(f"'{done.path}' is complete; there is nothing to recover")
        return 0
    print_table(
        ("bag", f"{done.path} ({sum(done.counts.values())} messages)"),
        *((topic, f"{count}") for topic, count in sorted(done.counts.items())),
        *([("damage", done.damage)] if done.damage else []),
        ("original", f"{done.original}, the damaged bag; delete it when the new one is right"),
    )
    print_next(f"twodof info {quote(done.path)}", f"ros2 bag play {quote(done.path)}")
    return 0
