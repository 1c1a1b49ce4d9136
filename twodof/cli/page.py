"""page: a native FMU in one HTML file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .common import chosen_fmu, parse_settings, print_table
from .options import add_frame_option, add_output, add_set_option, add_step_option, not_empty


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    page = verbs.add_parser(
        "page", help="write a robot as one HTML file that runs",
        description="Write a native FMU as one HTML file: the robot in 3D, its plant running in the"
        " browser, a target to drag. It needs no network and no server.",
    )  # fmt: skip
    page.add_argument(
        "fmu", nargs="?", type=not_empty, metavar="FMU|URDF",
        help="default: the default arm's native FMU",
    )  # fmt: skip
    add_output(page, "FILE.html", "default: <name>.html")
    add_frame_option(page)
    add_step_option(page)
    add_set_option(page)
    page.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    from ..files import free_name
    from ..pages.arm import is_page, page

    options.native = not options.fmu or Path(options.fmu).suffix in (".urdf", ".xacro")
    fmu = chosen_fmu(options)
    output = options.output or free_name(fmu.stem, ".html", is_page)
    path = page(fmu, output, step=options.step, settings=parse_settings(options.settings))
    size = path.stat().st_size / 1024
    print_table(("FMU", str(fmu)), ("page", f"{path} ({size:.0f} KB); it needs no network"))
    return 0
