"""Verb live: run an FMU in the browser and drag its target."""

import argparse

from .fmus import fast_fmu
from .help import Parser
from .options import OF_A_PAGE, add_fmu, add_options, add_output, parse_settings
from .printing import busy, print_next, quote, say
from .signals import INTERRUPTED, asked_to_stop
from .view import address, open_page


def add(live: Parser) -> None:
    live.description = "Step an FMU in real time behind a page in the browser: drag the target."
    add_fmu(live, "the default arm's FMU", "FMU")
    add_output(live, "BAG", "name of the recorded bags (rosbag2_<date and time>)")
    add_options(live, "--step", "--set", *OF_A_PAGE)


def call(options: argparse.Namespace) -> int:
    settings = parse_settings(options.settings)
    with busy("loading libraries", silent=True):
        from ..pages.live_page import live
    fmu = fast_fmu(options)
    with asked_to_stop() as asked:
        bags = live(
            fmu,
            asked,
            lambda url: open_page(options, url, fmu=fmu),
            **address(options),
            step=options.step,
            settings=settings,
            bag=options.output,
            command_line=options.command_line,
        )
    for bag in bags:
        say(f"bag   {bag}")
    if bags:
        print_next(f"twodof plot {quote(bags[-1])}", f"twodof view {quote(bags[-1])}")
    return INTERRUPTED
