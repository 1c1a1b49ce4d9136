"""view: the replay of a bag in the browser."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from .common import asked_to_stop, in_options, open_page
from .options import add_page_options, add_robot_options, check_company, not_empty, page_place


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    view = verbs.add_parser(
        "view", help="replay a bag in the browser",
        description="Replay a bag in the browser, or write a page that replays it offline.",
    )  # fmt: skip
    view.add_argument("bag", metavar="BAG", type=Path)
    view.add_argument(
        "--export", type=not_empty, metavar="FILE.html",
        help="write one self-contained file instead",
    )  # fmt: skip
    add_robot_options(view)
    view.add_argument(
        "--mesh-dir", type=Path, metavar="M", help="folder of that URDF's packages or meshes"
    )
    view.add_argument("--fmu", metavar="FMU", help="where the robot's meshes are")
    add_page_options(view)
    view.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    check_company(options, excludes={"--host": "--export", "--port": "--export"})
    from ..pages.replay import export, view

    robot = {name: getattr(options, name) for name in ("urdf", "mesh_dir", "frame", "fmu")}
    if options.export:
        for remark in export(options.bag, options.export, **robot):
            print(f"WARNING: {in_options(remark)}", file=sys.stderr)
        print(f"page  {options.export}; it needs no network")
        return 0
    with asked_to_stop() as asked:
        view(
            options.bag, asked, lambda url, remarks: open_page(options, url, remarks),
            **page_place(options), **robot,
        )  # fmt: skip
    return 0
