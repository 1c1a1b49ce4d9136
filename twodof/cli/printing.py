"""What goes to the terminal: tables, facts as JSON, and the library's messages in options."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterable
from pathlib import Path

ARGUMENT = re.compile(r"`(\w+)(?:=True)?`")
OPTIONS = {
    "path": "-o", "output": "-o", "platforms": "--platform", "changes": "--input",
    "robots": "NAME=FMU",
}  # fmt: skip
"""Options that are not called as the argument of the library which they give."""
POSE = "control 'pose'"
"""Which is two options."""


def in_options(text: str) -> str:
    """A message of the library, which has its arguments in backticks, for the command line."""
    text = text.replace(POSE, "control 'task --orientation'")
    return plain(ARGUMENT.sub(lambda m: OPTIONS.get(m[1], "--" + m[1].replace("_", "-")), text))


def plain(text: str) -> str:
    """A text with its control characters as escapes: files from elsewhere write on no terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


def quote(path: Path) -> str:
    """A path as a shell takes it."""
    return shlex.quote(str(path))


def print_table(
    *rows: Iterable[str], align: Callable[[str, int], str] = str.ljust, before: str = ""
) -> None:
    """Texts in columns, a row a line; each line begins with what is to stand before."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    for row in rows:
        print(plain(before + "  ".join(map(align, row, widths)).rstrip()))


def print_next(*commands: str) -> None:
    """What to type next."""
    print("\nnext", *commands, sep="\n  ")


def print_json(**facts: object) -> None:
    """Facts for another program, in SI units; null where there is no finite number."""
    finite = json.loads(json.dumps(facts), parse_constant=lambda _: None)
    print(json.dumps(finite, indent=2))
