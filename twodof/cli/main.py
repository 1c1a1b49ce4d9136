"""The command line: parse, call the function behind each verb, and print.

Imports are inside the verbs, so that ``twodof --help`` is instant.
"""

import argparse
import io
import logging
import os
import re
import shlex
import sys
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, redirect_stdout
from itertools import takewhile

from ..errors import TwoDofError
from ..version import __version__
from . import build, check, export, fit, info, layouts, linearise, live, page, plot, publish, recover, run, sweep, view
from .help import Parser, check_arguments, check_verb
from .options import CommandLineError
from .printing import CLEAR, in_options, say
from .signals import INTERRUPTED, is_interrupt

INPUTS = ("fmu", "urdf", "robot", "bag", "bags", "robots", "input")
VERBS = (build, run, publish, layouts, check, info, linearise, fit, plot, view, live, page, sweep, export, recover)
"""The verbs in the order of the help, which has the first line of each docstring."""
LONGEST_LINE = 2000
MOST_MESSAGES = 50  # a minute; a file may cause thousands, for example of a font without its characters


def parser() -> tuple[Parser, dict[str, Parser]]:
    """Return the parser, which sets ``verb`` and the verb's function ``call``, and the parsers of the verbs."""
    program = Parser(
        prog="twodof",
        description="From a URDF to an FMU, and from a co-simulation to a ROS 2 bag.",
        epilog="'twodof run' alone builds the default arm's FMU, runs it for 5 s and writes a bag.",
    )
    program.add_argument("--version", action="version", version=f"twodof {__version__}")
    verbs = program.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb in VERBS:
        name = verb.__name__.rpartition(".")[2]
        text = (verb.__doc__ or f": {name}").partition(": ")[2].rstrip(".\n")  # PYTHONOPTIMIZE=2 leaves docstrings out
        added = verbs.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        added.set_defaults(call=verb.call)
        verb.add(added)
    helped = verbs.add_parser("help", help="show this help, or the options of a command")
    helped.add_argument("about", nargs="?", metavar="VERB", help="command to explain")

    def call(options: argparse.Namespace) -> int:
        check_verb(program, verbs.choices, [options.about or "help"])
        verbs.choices.get(options.about, program).print_help()
        return 0

    helped.set_defaults(call=call)
    return program, verbs.choices


class _Words(logging.Formatter):
    """Log formatter that replaces arguments by options in messages of the library."""

    def format(self, record: logging.LogRecord) -> str:
        line = _shortened(in_options(super().format(record)))
        return f"{CLEAR}{line}" if sys.stderr.isatty() else line  # overwrites a progress line


class _Few(logging.Filter):
    """Log filter that passes a limited number of messages a minute; the last one says so."""

    _count, _since = 0, -60.0

    def filter(self, record: logging.LogRecord) -> bool:
        if record.created - self._since >= 60.0:  # a robot that is connected for days may cause more
            self._count, self._since = 0, record.created
        self._count += 1
        if self._count == MOST_MESSAGES:
            record.msg, record.args = "further messages of this minute are not shown", ()
        return self._count <= MOST_MESSAGES


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads cost a tenth of a short run
    os.environ.pop("MPLBACKEND", None)  # a notebook's backend may not be installed here
    os.environ.pop("SOURCE_DATE_EPOCH", None)  # NumPy fails to load if it is invalid; no output has a date
    try:
        options = _options(arguments)
        output = getattr(options, "output", None) or getattr(options, "export", None)
        _check_output(options, output)
        with _facts_beside(output):
            status: int = options.call(options)
        if sys.stdout is not None:
            sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return _fail("interrupted", INTERRUPTED)
    except CommandLineError as error:
        return _fail(str(error), 2)
    except TwoDofError as error:
        return _fail(in_options(" ".join(str(error).split())))
    except BrokenPipeError:  # the reader of the output has left
        _silence()
        return 1
    except MemoryError:
        return _fail("there is not enough memory")
    except (ImportError, OSError) as error:
        if is_interrupt(error):
            return _fail("interrupted", INTERRUPTED)
        if isinstance(error, ImportError):  # a broken environment, or too little memory
            return _fail(f"cannot load what it needs: {error}")
        _silence()
        culprit = "" if error.filename is None else f"'{error.filename}': "
        return _fail(f"{culprit}{error.strerror or error}")


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments, and configure output and messages."""
    program, verbs = parser()
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(program, validator=lambda word, begun: word.startswith(begun) and word.isprintable())
    for argument in takewhile("--".__ne__, arguments):  # argparse would read it as an empty list
        if re.fullmatch(r"(-\w|--[\w-]+=)--", argument):
            program.error(f"argument {argument[:-2].rstrip('=')}: '--' is not a value")
    check_verb(program, verbs, arguments)
    options, unknown = program.parse_known_args(arguments)
    check_arguments(verbs[options.verb], unknown)
    options.command_line = shlex.join(["twodof", *arguments])
    if isinstance(sys.stdout, io.TextIOWrapper):  # as for stderr, so that no file name raises
        sys.stdout.reconfigure(errors="backslashreplace")
    log = logging.StreamHandler()
    log.setFormatter(_Words("%(levelname)s: %(message)s"))
    log.addFilter(_Few())
    logging.basicConfig(handlers=[log], level=logging.WARNING)
    # messages of matplotlib contain names from untrusted files
    warnings.showwarning = lambda warning, *_, **__: logging.getLogger("twodof").warning("%s", warning)
    # exceptions contain the FMU's errors already
    logging.getLogger("twodof.fmu").addFilter(lambda record: record.levelno < logging.ERROR)
    return options


def _check_output(options: argparse.Namespace, output: str | None) -> None:
    """Refuse an output that replaces an input, or, with --overwrite, a folder that contains one."""
    if output is None:
        return
    given = {name: getattr(options, name, None) for name in INPUTS}
    if isinstance(given["robot"], str):  # the name of a robot, not a file
        del given["robot"]
    new, overwrites = os.path.realpath(output), getattr(options, "overwrite", False)
    for text in (str(each) for it in given.values() if it for each in (it if isinstance(it, list) else [it])):
        names = text, text.rpartition(":")[0] or text, text.partition("=")[2] or text  # BAG:ROBOT, BAG:TOPIC, NAME=FMU
        for path in map(os.path.realpath, names):
            if path == new or (overwrites and path.startswith(os.path.join(new, ""))):
                raise CommandLineError(f"'{output}' would replace the input '{text}'; give another output")


def _facts_beside(output: str | None) -> AbstractContextManager[object]:
    """Print facts to stderr if the output file is the standard output."""
    from ..files import descriptor_of

    beside = output is not None and descriptor_of(output) == 1
    return redirect_stdout(sys.stderr) if beside else nullcontext()


def _fail(message: str, status: int = 1) -> int:
    say(f"twodof: error: {_shortened(' '.join(message.split()))}", error=True)
    return status


def _shortened(line: str) -> str:
    """Return a message without its middle if it is long: names in untrusted files can have any length."""
    half = LONGEST_LINE // 2
    return line if len(line) <= LONGEST_LINE else f"{line[:half]} … {line[-half:]}"


def _silence() -> None:
    """Discard unwritable buffered output, so that it does not fail again at exit."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
