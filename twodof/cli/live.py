"""live: an FMU driven in the browser."""

from __future__ import annotations

import argparse
from typing import Any

from .common import (
    INTERRUPTED,
    asked_to_stop,
    fast_fmu,
    open_page,
    parse_settings,
    print_next,
    quote,
)  # fmt: skip
from .options import (
    add_output,
    add_page_options,
    add_set_option,
    add_step_option,
    not_empty,
    page_place,
)


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    live = verbs.add_parser(
        "live", help="drive an FMU in the browser",
        description="Step an FMU in real time behind a page in the browser: drag the target.",
    )  # fmt: skip
    live.add_argument(
        "fmu", nargs="?", type=not_empty, metavar="FMU", help="default: the default arm's"
    )
    add_output(live, "BAG", "name of recordings")
    add_step_option(live)
    add_set_option(live)
    add_page_options(live)
    live.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    from ..pages.live import live

    fmu = fast_fmu(options)
    with asked_to_stop() as asked:
        bags = live(
            fmu, asked, lambda url: open_page(options, url, fmu=fmu),
            **page_place(options), step=options.step,
            settings=parse_settings(options.settings), bag=options.output,
            command_line=options.command_line,
        )  # fmt: skip
    for bag in bags:
        print(f"bag   {bag}")
    if bags:
        print_next(f"twodof plot {quote(bags[-1])}", f"twodof view {quote(bags[-1])}")
    return INTERRUPTED
