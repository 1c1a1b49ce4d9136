"""Verb linearise: show the linear model of a native FMU about an operating point."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from .help import Parser
from .options import add_options, parse_settings, variables
from .printing import print_json, print_table, say

if TYPE_CHECKING:
    from ..linear import LinearModel


def add(linearise: Parser) -> None:
    linearise.add_argument("fmu", metavar="FMU", help="native FMU")
    linearise.add_repeatable(
        "--at",
        metavar="NAME=VALUE",
        help="operating point: q=0.5,0.35 or q[1]=0.5, v=0, and inputs and parameters, such as"
        " tau_cmd=0.1,0; without q and v it is the equilibrium near q_start",
        completer=variables,
    )
    add_options(linearise, "--json")


def call(options: argparse.Namespace) -> int:
    from ..linear import linearise

    (_print_json if options.json else _print)(linearise(options.fmu, parse_settings(options.at, "--at")))
    return 0


def _print_json(model: LinearModel) -> None:
    values = model._asdict()
    for name in "ABCD":
        values[name] = values[name].tolist()
    modes = [
        {"eigenvalue": [z.real, z.imag], "damping": damping, "frequency": frequency}
        for z, damping, frequency in model.modes
    ]
    print_json(kind="linear model", **values, modes=modes)


def _print(model: LinearModel) -> None:
    print_table(*((name, f"{value:.6g} {model.units[name]}".strip()) for name, value in model.point.items()))
    for remark in model.remarks:
        say(f"note: {remark}")
    say("\neigenvalue, 1/s          damping  frequency, rad/s")
    for z, damping, frequency in model.modes:
        number = f"{z.real:.6g}{z.imag:+.6g}j" if z.imag else f"{z.real:.6g}"
        ratio = f"{damping:7.4f}" if z else f"{'–':>7}"
        say(f"{number:<24} {ratio}  {frequency:.6g}")
    for name in "ABCD":
        say(f"\n{name}")
        rows = model.states if name in "AB" else model.outputs
        columns = model.states if name in "AC" else model.inputs
        values = ((f"{x + 0.0:.6g}" for x in row) for row in getattr(model, name).tolist())
        print_table(["", *columns], *([row, *texts] for row, texts in zip(rows, values)), align=str.rjust)
