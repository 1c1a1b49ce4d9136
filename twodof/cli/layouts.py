"""Verb layouts: write layouts of a robot for RViz, PlotJuggler and Foxglove."""

import argparse

from .fmus import chosen_fmu
from .help import Parser
from .options import add_fmu, add_options, folder
from .printing import print_next, print_table, quote


def add(layouts: Parser) -> None:
    layouts.description = (
        "Write files in which RViz, PlotJuggler and Foxglove show a robot that is published, or"
        " recorded with --scene and --effort."
    )
    add_fmu(layouts, "TwoDof.fmu, built if it is missing")
    add_options(layouts, "--frame")
    text = "folder of the layout files (%(default)s)"
    layouts.add_argument("-o", dest="folder", type=folder, default=".", metavar="FOLDER", help=text)
    add_options(layouts, "--namespace")
    layouts.add_argument("--overwrite", action="store_true", help="replace existing files that differ")
    layouts.set_defaults(native=False)


def call(options: argparse.Namespace) -> int:
    from ..ros.viewer_layouts import layouts

    chosen = chosen_fmu(options)
    rviz, juggler, foxglove = layouts(chosen, options.folder, namespace=options.namespace, overwrite=options.overwrite)
    print_table(
        ("RViz", str(rviz)),
        ("PlotJuggler", f"{juggler}: File, Load Layout"),
        ("Foxglove", f"{foxglove}: Layouts, Import from file"),
    )
    space = f" --namespace {options.namespace}" if options.namespace else ""
    print_next(f"twodof publish {quote(chosen)} --scene --effort{space}", f"rviz2 -d {quote(rviz)}")
    return 0
