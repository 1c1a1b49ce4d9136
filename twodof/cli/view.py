"""Verb view: replay a bag in the browser."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from .help import Parser
from .options import OF_A_PAGE, Keywords, add_options, add_robot_options, check_company, given_options, output_file
from .printing import busy, in_options, say
from .signals import asked_to_stop


def add(view: Parser) -> None:
    view.description = "Replay a bag in the browser, or write a page or a film that replays it offline."
    view.add_argument("bag", metavar="BAG", type=Path, help="folder of the bag")
    text = "write a page (.html), a film (.mp4, .webp, .gif) or a picture (.png) instead; - is the standard output"
    view.add_argument("--export", type=output_file, metavar="FILE", help=text)
    add_robot_options(view)
    view.add_argument("--mesh-dir", type=Path, metavar="FOLDER", help="folder of the URDF's packages or meshes")
    view.add_argument("--fmu", metavar="FMU", help="FMU that contains the robot's meshes")
    add_options(view, *OF_A_PAGE)


def call(options: argparse.Namespace) -> int:
    check_company(options, excludes={"--host": "--export", "--port": "--export"})
    with busy("loading libraries", silent=True):
        from ..pages.replay import FILMS, export, view

    robot = given_options(options, "urdf", "mesh_dir", "frame", "fmu")
    if options.export:
        _print_remarks(export(options.bag, options.export, **robot))
        film = Path(options.export).suffix.lower() in FILMS
        say(f"film  {options.export}" if film else f"page  {options.export}; it needs no network")
        return 0
    with asked_to_stop() as asked:
        view(options.bag, asked, lambda url, remarks: open_page(options, url, remarks), **address(options), **robot)
    return 0


def address(options: argparse.Namespace) -> Keywords:
    """Return the host and port options of a served page."""
    return {key: value for key, value in given_options(options, "host", "port").items() if value is not None}


def open_page(options: argparse.Namespace, url: str, remarks: Sequence[str] = (), fmu: Path | None = None) -> None:
    """Print the URL of a page, and open it if there is a display."""
    _print_remarks(remarks)
    what = f"{fmu}; " if fmu is not None else ""
    say(f"open  {url} ({what}Ctrl-C ends)")
    if not options.no_browser and {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        import webbrowser

        webbrowser.open(url)


def _print_remarks(remarks: Sequence[str]) -> None:
    for remark in remarks:
        say(f"WARNING: {in_options(remark)}", error=True)
