"""Help texts: examples of each verb, and hints for mistyped command lines."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

from ..errors import choice, nearest
from ..plant.numerals import number, whole_number
from .printing import plain

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

EXAMPLES = {
    "": ["twodof build", "twodof run", "twodof help run"],
    "build": [
        "twodof build",
        "twodof build my_robot.urdf --mesh-dir my_packages --frame tool0",
        "twodof build --robot panda --native",
        "twodof build my_robot.urdf --control joint --native --platform all",
    ],
    "run": [
        "twodof run",
        "twodof run my_robot.fmu -o my_bag --set x_des=0.4,0.1,0.5 --set Kp=100 --scene",
        "twodof run my_robot.fmu --input targets.csv --stop-time 20 --step 0.005",
    ],
    "publish": [
        "twodof publish my_robot.fmu --scene --effort",
        "twodof publish left=my_robot.fmu right=my_robot.fmu --clock -o my_bag",
    ],
    "layouts": [
        "twodof layouts my_robot.fmu -o layouts",
        "twodof layouts left.fmu --namespace left -o layouts_of_left",
    ],
    "info": ["twodof info my_robot.fmu", "twodof info my_bag", "twodof info my_sweep --json"],
    "check": ["twodof check my_robot.fmu", "twodof check my_robot.fmu --with libcosim"],
    "linearise": ["twodof linearise TwoDof-native.fmu", "twodof linearise my_robot.fmu --at q=0.5,0.35 --at Kp=100"],
    "fit": [
        "twodof fit my_robot.urdf my_bag --free 'friction[*]' --free payload",
        "twodof fit my_robot.urdf --design 20 --free 'friction[*]' --free payload -o excite.csv",
        "twodof fit my_robot.urdf monday tuesday --free 'mass:*' --free 'com:*' --free 'inertia:*' -o fitted",
    ],
    "plot": [
        "twodof plot my_bag",
        "twodof plot my_bag other_bag -o comparison.png --joints joint1,joint2",
        "twodof plot my_sweep -o map.html",
    ],
    "view": ["twodof view my_bag", "twodof view my_bag --export my_bag.html"],
    "live": ["twodof live", "twodof live my_robot.fmu --set Kp=100"],
    "page": ["twodof page", "twodof page my_robot.fmu -o my_robot.html"],
    "sweep": [
        "twodof sweep --grid Kp=20:200:10 --grid Kd=5:40:8",
        "twodof sweep my_robot.fmu --range Kp=20:200 --random 500 -o my_sweep",
    ],
    "export": [
        "twodof export my_bag -o my_bag.csv",
        "twodof export my_bag -o my_bag.mcap",
        "twodof export monday tuesday -o my_robot.lerobot",
    ],
    "recover": ["twodof recover my_bag", "twodof recover /media/stick/my_bag"],
}
ALIKE = 0.7  # ratio of difflib from which on a verb or option may be meant
MEANT = {
    word: meant
    for meant, words in {
        "run": "simulate",
        "info": "show list",
        "view": "replay render",
        "build": "new make create split system systems ssp",
        "sweep": "tune",
        "check": "validate test",
        "fit": "identify calibrate",
        "page": "html",
        "export": "convert csv",
        "recover": "repair",
        "publish": "ros",
        "--step": "--dt --timestep --step-size --stepsize --output-interval",
        "--stamp-start": "--start-time",
        "--set rtol=1e-6": "--tolerance --rtol",
        "--set": "--start-values --parameters -s --param --target",
        "--stop-time": "--duration --time --stop --end",
        "-o": "--out --output",
        "--overwrite": "--force -f -y",
        "--input": "--csv",
        "--storage": "--format",
        "--fail-if": "--cost",
    }.items()
    for word in words.split()
}
"""Verbs and options of this program, by those of other tools."""
COMPLETION = 'completion in bash and zsh: eval "$(register-python-argcomplete twodof)"'


class Parser(argparse.ArgumentParser):
    """Parser without abbreviations, with errors in one line, and with examples at the end of its help."""

    def __init__(self, **named: Any) -> None:
        super().__init__(allow_abbrev=False, **named)
        self.register("type", float, number)
        self.register("type", int, whole_number)
        self._optionals.title = "options (defaults in parentheses)"

    def add_argument(self, *names: str, completer: Callable[..., Any] | None = None, **named: Any) -> argparse.Action:
        """Add an argument whose values the shell completes by ``completer``."""
        action = super().add_argument(*names, **named)
        if completer is not None:
            action.completer = completer  # type: ignore[attr-defined]  # of argcomplete
        return action

    def add_repeatable(self, name: str, **named: Any) -> None:
        """Add an option that collects its values in a list."""
        self.add_argument(name, action="append", default=[], **named)

    def format_help(self) -> str:
        """Return the help with its examples."""
        verb = self.prog.removeprefix("twodof").strip()
        shown = "".join(f"  {line}\n" for line in EXAMPLES.get(verb, ()))
        last = "" if verb else f"\n{COMPLETION}\n"
        return super().format_help() + (f"\nexamples:\n{shown}" if shown else "") + last

    def error(self, message: str) -> NoReturn:
        """Exit with an error in one line."""
        message = re.sub(r"invalid int value: ('.*')$", r"\1 is not a whole number", message)
        message = re.sub(r"invalid float value: ('.*')$", r"\1 is not a number; leave units out", message)
        message = re.sub(r"expected (\d) arguments$", r"expected \1 numbers with spaces between them", message)
        message = re.sub(
            r"argument (\S+): ignored explicit argument ('.*')$", r"\1 takes no value; leave out \2", message
        )
        named = re.match(r"argument ([-\w]+)[^:]*: expected one argument$", message)
        if named and (action := self._option_string_actions.get(named[1])):
            message += f": {action.metavar or action.dest.upper()}, {action.help}"
        self.exit(2, f"{self.prog}: error: {plain(message)}\n")

    def _print_message(self, message: str, file: SupportsWrite[str] | None = None) -> None:
        """Write help; raise an error of the write, which argparse ignores if output is unbuffered."""
        if file is not None and file is sys.stdout:
            file.write(message)
        else:
            super()._print_message(message, file)

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """Flush the help before the process ends, so that the error of a closed pipe can be caught."""
        if sys.stdout is not None:
            sys.stdout.flush()
        super().exit(status, message)


def check_verb(program: Parser, verbs: Iterable[str], arguments: Sequence[str]) -> None:
    """Refuse an unknown verb, or an unknown option before it; name the one that is probably meant."""
    word, named = next(iter(arguments), ""), [*verbs]
    if not arguments:
        program.error("there is no verb; begin with 'twodof build', or see 'twodof --help'")
    if word[:1] == "-" and word not in program._option_string_actions:
        check_arguments(program, arguments)
    if word and word[0] != "-" and word not in named:
        program.error(f"there is no verb '{word}'{_meant(word, named) or choice(word, named)}")


def check_arguments(parser: Parser, unknown: Sequence[str]) -> None:
    """Refuse unknown arguments of a verb; name the option that is probably meant."""
    if not unknown:
        return
    known, lists = [*parser._option_string_actions], f"; '{parser.prog} --help' lists them"
    word = unknown[0].partition("=")[0]
    if re.fullmatch(r"-?[\d.][-+.,\deE]*", unknown[0]) and "--set" in known:
        parser.error(f"'{unknown[0]}' belongs to no option: a setting is one word, as in --set Kp={unknown[0]}")
    if word[:1] == "-":
        parser.error(f"there is no option '{word}'{_meant(word, known) or lists}")
    if "=" in unknown[0] and "--set" in known:
        parser.error(f"'{unknown[0]}' belongs to no option: repeat --set, as in --set {unknown[0]}")
    if f"--{word}" in known:
        parser.error(f"'{word}' is one argument too many; did you mean '--{word}'?")
    name = f"; a name for what the command writes needs -o, as in -o {unknown[0]}" if "-o" in known else ""
    parser.error(f"'{unknown[0]}' is one argument too many{name}{lists}")


def _meant(word: str, known: Sequence[str]) -> str:
    """Return a question for the verb or option that is probably meant; "" for none."""
    meant = MEANT.get(word, "")
    if meant.partition(" ")[0] not in known:
        bare = {name.lstrip("-"): name for name in known}  # dashes make all options alike
        meant = bare.get(nearest(word.lstrip("-").replace("_", "-"), bare, ALIKE) or "", "")
    return f"; did you mean '{meant}'?" if meant else ""
