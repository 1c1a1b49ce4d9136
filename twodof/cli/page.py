"""Verb page: write a running robot as one HTML file."""

import argparse

from .fmus import chosen_fmu, is_robot
from .help import Parser
from .options import add_fmu, add_options, add_output, output_file, parse_settings
from .printing import busy, print_table, written


def add(page: Parser) -> None:
    page.description = (
        "Write a native FMU as one HTML file: the robot in 3D, its plant running in the browser, a"
        " target to drag. It needs no network and no server."
    )
    add_fmu(page, "the default arm's native FMU")
    add_output(page, "FILE.html", "output file (<name>.html); - is the standard output", output_file)
    add_options(page, "--frame", "--step", "--set")


def call(options: argparse.Namespace) -> int:
    from ..files import free_name

    settings = parse_settings(options.settings)
    with busy("loading libraries", silent=True):
        from ..pages.arm import is_page, page
    options.native = not options.fmu or is_robot(options.fmu)
    fmu = chosen_fmu(options)
    output = options.output or free_name(fmu.stem, ".html", is_page)
    with busy(f"compiling {fmu} for the browser"):
        path = page(fmu, output, step=options.step, settings=settings)
    print_table(("FMU", str(fmu)), ("page", f"{written(path)}; it needs no network"))
    return 0
