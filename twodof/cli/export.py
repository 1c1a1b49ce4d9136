"""Verb export: write a bag as a table, one MCAP file or a dataset."""

import argparse
from pathlib import Path

from ..errors import InputError
from .help import Parser
from .options import not_empty
from .printing import print_table, written


def add(export: Parser) -> None:
    export.description = (
        "Write a bag as a table with named columns and units, as one MCAP file of all messages, or bags as the episodes"
        " of a LeRobot dataset."
    )
    export.add_argument("bags", metavar="BAG", type=Path, nargs="+", help="folder of the bag; several for .lerobot")
    text = "output: .csv or .mcap; with the extra 'sweep' also .parquet, or a folder .lerobot"
    export.add_argument("-o", dest="output", type=not_empty, metavar="FILE", help=text)


def call(options: argparse.Namespace) -> int:
    from ..bag.exports import export_bag

    if options.output is None:
        last = options.bags[-1].name
        name = last if len(options.bags) > 1 and "." in last else f"{options.bags[0].name}.csv"
        raise InputError(f"an export needs the name of its file, as in -o {name}")
    path = export_bag(options.bags, options.output)
    print_table(("bag", ", ".join(map(str, options.bags))), ("file", written(path)))
    return 0
