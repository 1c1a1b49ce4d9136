"""Verb export: write a bag as a table, or as one MCAP file."""

import argparse
from pathlib import Path

from .help import Parser
from .options import not_empty
from .printing import print_table


def add(export: Parser) -> None:
    """Add the options of the verb."""
    export.description = "Write a bag as a table with named columns and units, or as one MCAP file of all messages."
    export.add_argument("bag", metavar="BAG", type=Path, help="folder of the bag")
    text = "output file: .csv, .parquet (extra 'sweep') or .mcap"
    export.add_argument("-o", dest="output", required=True, type=not_empty, metavar="FILE", help=text)


def call(options: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    from ..bag.exports import export_bag

    path = export_bag(options.bag, options.output)
    print_table(("bag", str(options.bag)), ("file", f"{path} ({path.stat().st_size / 1024:.0f} KB)"))
    return 0
