"""Verb check: check an FMU of any vendor against the standard."""

import argparse

from .help import Parser
from .options import add_options
from .printing import busy, print_json, print_table, say


def add(check: Parser) -> None:
    check.description = "Check an FMU of any vendor; exit with status 1 if a test fails."
    check.add_argument("fmu", metavar="FMU", help="co-simulation FMU of FMI 2.0 or 3.0, or SSP file")
    tools = ("fmpy", "libcosim", "ecos", "fmuloader", "pathsim")
    text = "also run the reference experiments in the FMU with this FMI tool; repeatable"
    check.add_repeatable("--with", dest="tools", choices=tools, help=text)
    add_options(check, "--json")


def call(options: argparse.Namespace) -> int:
    from ..fmu.checking import check

    with busy("checking", silent=True):
        done = check(options.fmu, tools=options.tools)
    if options.json:
        print_json(kind="check", **done.facts())
    else:
        print_table(*((row.outcome, row.name, row.text) for row in done.rows))
        say(f"\n'{done.path}' {'passes' if done.passed else 'fails'}")
    return 0 if done.passed else 1
