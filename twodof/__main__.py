# PYTHON_ARGCOMPLETE_OK
"""Entry point of ``twodof`` and ``python -m twodof``."""

import os
import signal
import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status.

    Ctrl-C ends the process at once while the command line is loaded, and is ignored after the command has ended.
    """
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # otherwise it is ignored
    if interruptible:
        signal.signal(signal.SIGINT, lambda number, _: os._exit(128 + number))
    _open_streams()
    from .cli.main import main as command
    from .cli.signals import INTERRUPTED, interrupt

    try:
        try:
            if interruptible:
                signal.signal(signal.SIGINT, interrupt)
            return command(arguments)
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    except KeyboardInterrupt:  # Ctrl-C at the very end; the next one is ignored
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        return INTERRUPTED


def _open_streams() -> None:
    """Open closed standard streams, so that no file takes their descriptors.

    Printed lines are discarded, but a file written to the descriptor is an error.
    """
    closed = []
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDONLY if number == 1 else os.O_RDWR)  # takes the lowest free descriptor
            closed.append(name)
    for name in closed:
        setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115


if __name__ == "__main__":
    sys.exit(main())
