"""All output to the terminal: lines, tables, JSON, and the library's messages."""

import json
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread
from time import perf_counter

ARGUMENT = re.compile(r"`(\w+)(?:=True)?`")
OPTIONS = {
    "path": "-o",
    "output": "-o",
    "platforms": "--platform",
    "tools": "--with",
    "changes": "--input",
    "robots": "NAME=FMU",
    "set_gains": "--foxglove-control",
    "settings": "--set",
}
"""Options whose names differ from the library's argument."""
NEEDS = {"plot": "matplotlib", "view": "websockets"}  # modules of the extra 'view' that verbs need
POSE = "control 'pose'"  # an argument of the library that corresponds to two options

LONGEST, WIDEST = 1000, 120  # characters of a table's cell that are printed, and of a cell that widens its column
MOMENT, TICK = 0.4, 0.5  # seconds of silence before a task is named, and between two updates of its time
CLEAR = "\r\x1b[K"  # terminal sequence that moves to the start of the line and clears it


def in_options(text: str) -> str:
    """Replace arguments in backticks, as in messages of the library, by options of the command line."""
    text = text.replace(POSE, "control 'task --orientation'")
    return plain(ARGUMENT.sub(lambda m: OPTIONS.get(m[1], "--" + m[1].replace("_", "-")), text))


def plain(text: str) -> str:
    """Return a text with control and bidirectional characters, and line breaks, as escapes.

    Names in untrusted files can then neither control the terminal, nor reverse a line, nor look like another line.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def quote(path: Path) -> str:
    """Quote a path for the shell."""
    return shlex.quote(str(path))


def say(text: str = "", *, error: bool = False) -> None:
    """Print a line to stdout, or an error to stderr; empty lines may precede it. Every verb prints by this."""
    line = text.lstrip("\n")
    print("\n" * (len(text) - len(line)) + plain(line), file=sys.stderr if error else sys.stdout, flush=True)


def print_table(*rows: Iterable[str], align: Callable[[str, int], str] = str.ljust, before: str = "") -> None:
    """Print rows of texts in aligned columns, each line after a prefix; a line break in a text is an escape.

    A long text is cut, and does not widen the column of the others: a text of an untrusted file may have megabytes.
    """
    cells = [[_cell(text) for text in row] for row in rows]
    widths = [max((len(text) for text in column if len(text) <= WIDEST), default=0) for column in zip(*cells)]
    for row in cells:
        say(before + "  ".join(map(align, row, widths)).rstrip())


def _cell(text: str) -> str:
    shown = text if len(text) <= LONGEST else f"{text[:LONGEST]}… ({len(text)} characters)"
    return plain(shown)


def written(path: Path, *facts: str) -> str:
    """Return an output with its size and further facts; a pipe has no size."""
    files = [file for file in (path, *path.rglob("*")) if file.is_file()]
    size = [f"{sum(file.stat().st_size for file in files) / 1024:.0f} KB"] if files else []
    inside = ", ".join([*size, *facts])
    return f"{path} ({inside})" if inside else str(path)


def print_next(*commands: str) -> None:
    """Print the next command to type in this shell, if its packages are installed."""
    from ..version import install

    missing = {verb for verb, module in NEEDS.items() if find_spec(module) is None}
    here = [command for command in commands if shutil.which(command.split()[0]) or command.startswith("twodof ")]
    shown = [command for command in here if not {*command.split()[1:2]} & missing]
    program = _program()
    lines = [re.sub("^twodof ", lambda _: f"{program} ", command) for command in shown]
    if lines:
        for line in ("\nnext", *(f"  {line}" for line in lines)):
            say(line)
    if len(shown) < len(here):
        say(f"\nto plot and view: {install('view')}")


def _program() -> str:
    """Return this program's name if the shell finds it, else its path."""
    own = Path(sys.executable).with_name("twodof")
    found = shutil.which("twodof")
    if found is not None and own.exists() and own.samefile(found):
        return "twodof"
    own = own if own.exists() else Path(sys.executable)
    inside = own.is_relative_to(Path.cwd())
    path = quote(own.relative_to(Path.cwd()) if inside else own)
    return path if own.name == "twodof" else f"{path} -m twodof"


@contextmanager
def busy(what: str, *, silent: bool = False) -> Iterator[None]:
    """Print the name of a slow task: on a terminal with its duration in s, elsewhere unless ``silent``."""
    done, begin, live = Event(), perf_counter(), sys.stderr is not None and sys.stderr.isatty()

    def show() -> None:
        if done.wait(MOMENT) or (silent and not live):
            return
        while True:
            line = f"{plain(what)}: {perf_counter() - begin:.0f} s" if live else f"{plain(what)} …"
            print(f"{CLEAR}{line}" if live else line, end="" if live else "\n", file=sys.stderr, flush=True)
            if done.wait(TICK if live else None):
                break
        if live:
            print(end=CLEAR, file=sys.stderr, flush=True)

    thread = Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def print_json(**facts: object) -> None:
    """Print facts for another program, in SI units; null for numbers that are not finite."""
    finite = json.loads(json.dumps(facts), parse_constant=lambda _: None)
    print(json.dumps(finite, indent=2), flush=True)  # in ASCII
