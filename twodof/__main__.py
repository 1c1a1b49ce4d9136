# PYTHON_ARGCOMPLETE_OK
"""``twodof``, and ``python -m twodof``: the process around the command line."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status.

    Ctrl-C ends the process at once while the command line is loaded, and not any more when the
    command has ended.
    """
    heard = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # or to be ignored
    if heard:
        signal.signal(signal.SIGINT, lambda number, _: os._exit(128 + number))
    from .cli.main import main as command
    from .cli.signals import INTERRUPTED, interrupt

    try:
        if heard:
            signal.signal(signal.SIGINT, interrupt)
        return command(arguments)
    except KeyboardInterrupt:  # a second one, or between two lines here
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(main())
