"""layouts: files in which other tools show a robot."""

from __future__ import annotations

import argparse
from typing import Any

from .common import chosen_fmu, print_next, print_table, quote
from .options import add_fmu


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    layouts = verbs.add_parser(
        "layouts", help="write layouts of a robot for RViz, PlotJuggler and Foxglove",
        description="Write files in which RViz, PlotJuggler and Foxglove show a robot that is"
        " published, or recorded with --scene and --effort.",
    )  # fmt: skip
    add_fmu(layouts)
    layouts.add_argument("-o", dest="folder", default=".", metavar="FOLDER", help="(%(default)s)")
    layouts.add_argument("--namespace", default="", metavar="NS", help="of the topics")
    layouts.add_argument("--overwrite", action="store_true", help="replace files that differ")
    layouts.set_defaults(call=call, native=False)


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    from ..ros.layouts import layouts

    chosen = chosen_fmu(options)
    rviz, juggler, foxglove = layouts(
        chosen, options.folder, namespace=options.namespace, overwrite=options.overwrite
    )
    print_table(
        ("RViz", str(rviz)),
        ("PlotJuggler", f"{juggler}: File, Load Layout"),
        ("Foxglove", f"{foxglove}: Layouts, Import from file"),
    )
    space = f" --namespace {options.namespace}" if options.namespace else ""
    print_next(f"twodof publish {quote(chosen)} --scene --effort{space}", f"rviz2 -d {quote(rviz)}")
    return 0
