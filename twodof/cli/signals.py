"""Handling of Ctrl-C and of termination signals."""

import errno
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ..errors import SimulationError

INTERRUPTED = 130  # exit status after a request to end
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
STOP_TIMEOUT = 5.0  # s in which the present work must end after a request
CLEAN_UP = 1.0  # s after an interrupt in which further ones are ignored
_interrupts: list[float] = []  # times of the interrupts by the monotonic clock, s


def interrupt(_number: int, _frame: object) -> None:
    """Raise KeyboardInterrupt and note its time, because an import of a C module may turn it into an ImportError.

    Another signal within CLEAN_UP is ignored, because it would interrupt the removal of temporary files.
    """
    now = time.monotonic()
    if not _interrupts or now > _interrupts[-1] + CLEAN_UP:
        _interrupts.append(now)
        raise KeyboardInterrupt


def is_interrupt(error: ImportError | OSError) -> bool:
    """Return whether an error is a consequence of Ctrl-C.

    An OSError is a consequence if Ctrl-C came while a file was closed: the second close fails. ``shutil.rmtree``, which
    removes the folder of an unzipped FMU, fails in the same way.
    """
    if isinstance(error, ImportError):
        return bool(_interrupts)
    return error.errno == errno.EBADF and isinstance(error.__context__, KeyboardInterrupt)


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Return whether a signal asked the run to end; read between steps, so that no step is cut.

    It handles SIGINT, SIGTERM, and SIGHUP of a closed terminal. A second signal interrupts at once, and so does a
    time-out if the first request is not read. Further signals are ignored while the bag is closed.
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
        if asked:  # the request was read; the end of the run may take longer
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        return asked

    before = {number: signal.signal(number, ask) for number in SIGNALS}
    try:
        yield is_asked
    except SimulationError as error:
        if asked:  # a Python FMU discards an interrupted step
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
