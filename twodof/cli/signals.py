"""Handling of Ctrl-C and of termination signals."""

import errno
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ..errors import SimulationError

INTERRUPTED = 130
"""Exit status after a request to end."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
STOP_TIMEOUT = 5.0  # s in which the work in progress ends on request
CLEAN_UP = 1.0  # s after an interrupt in which no other one disturbs what it ends
_interrupts: list[float] = []
"""Times of the interrupts, in seconds of the monotonic clock."""


def interrupt(_number: int, _frame: object) -> None:
    """Raise KeyboardInterrupt, and note it, because a C module in import turns it into an ImportError.

    Another signal within CLEAN_UP of it is ignored: it would leave the code that removes temporary files.
    """
    now = time.monotonic()
    if not _interrupts or now > _interrupts[-1] + CLEAN_UP:
        _interrupts.append(now)
        raise KeyboardInterrupt


def is_interrupt(error: ImportError | OSError) -> bool:
    """Return whether an error is a consequence of Ctrl-C.

    An OSError is where it came while a file was closed, which then is closed again and fails. So
    does ``shutil.rmtree``, which removes the folder that an FMU was unzipped to.
    """
    if isinstance(error, ImportError):
        return bool(_interrupts)
    return error.errno == errno.EBADF and isinstance(error.__context__, KeyboardInterrupt)


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Return whether a signal asked the run to end; read between steps, so that no step is cut.

    SIGINT, SIGTERM, and SIGHUP of a closed terminal. A second signal interrupts at once, and so does a
    time-out where the first is not read; further ones are ignored while the bag is closed.
    """
    asked = False

    def ask(_number: int, _frame: object) -> None:
        nonlocal asked
        if asked:
            for number in SIGNALS:
                signal.signal(number, signal.SIG_IGN)
            _interrupts.append(time.monotonic())
            raise KeyboardInterrupt
        asked = True
        signal.setitimer(signal.ITIMER_REAL, STOP_TIMEOUT)

    def is_asked() -> bool:
        if asked:  # it has its effect: what ends the run may take its time
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        return asked

    before = {number: signal.signal(number, ask) for number in SIGNALS}
    try:
        yield is_asked
    except SimulationError as error:
        if asked:  # the Python flavour discards a step that is interrupted
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
