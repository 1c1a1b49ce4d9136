"""Help texts: examples of each verb, and hints for mistyped command lines."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

from ..errors import choice, nearest
from ..files import data_file
from ..plant.numerals import number, whole_number
from .printing import plain

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

_BLOCKS = [block.splitlines() for block in data_file("cli", "examples.txt").read_text("utf-8").split("\n\n")]
EXAMPLES = {"": _BLOCKS[0], **{lines[0].split()[1]: lines for lines in _BLOCKS[1:]}}  # command lines by verb
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
