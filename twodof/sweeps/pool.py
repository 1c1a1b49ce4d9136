"""Run a sweep in processes of this machine, over private pipes."""

import pickle
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from multiprocessing.connection import Connection, wait
from pathlib import Path
from subprocess import DEVNULL

from ..children import Child
from ..errors import SweepError
from ..files import temporary_folder
from .runner import LOOK, Batches, Job, Point, Row, Runner

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
MOST_FAILURES = 5  # successive failures of starting workers


class Pool:
    """Worker processes, which are replaced when they die, as a context that needs at least one of them.

    Args:
        stop: called repeatedly; True ends the sweep.

    Raises:
        SweepError: the processes die while they start.
        FmuError, InputError, BagError, ChildError: a run failed for a reason that affects all runs.
    """

    def __init__(self, job: Job, batches: Batches, count: int, stop: Callable[[], bool]) -> None:
        if count < 1:
            raise SweepError(f"{count} workers; at least 1 is needed")
        self._job, self._batches, self._stop = job, batches, stop
        self._count, self._failures = min(count, batches.left), 0
        self._workers: dict[Child, list[Point] | None] = {}
        """Current batch of each worker, [] while it starts, or None."""

    def __enter__(self) -> Iterator[list[Row]]:
        self._exit = ExitStack()
        self._folder = self._exit.enter_context(temporary_folder())
        try:
            (self._folder / "job").write_bytes(pickle.dumps(self._job))
            while None not in self._workers.values() and not self._stop():
                list(self._look())
        except BaseException:
            self.__exit__()
            raise
        return self._rows()

    def __exit__(self, *exception: object) -> None:
        for worker in self._workers:
            worker.close()  # it has sent all rows; the folder is removed with its files
        self._exit.close()

    def _rows(self) -> Iterator[list[Row]]:
        while self._batches.left and not self._stop():
            yield from self._look()

    def _look(self) -> Iterator[list[Row]]:
        """Return the rows that arrive within a short time, while all workers are busy."""
        while len(self._workers) < self._count and self._failures < MOST_FAILURES:
            environment = {**ONE_THREAD, "TMPDIR": str(self._folder)}
            child = Child(work, self._folder, environment=environment, output=DEVNULL)
            self._workers[child] = []
        for worker, batch in self._workers.items():
            if batch is None and (points := self._batches.next(alone=True)):
                self._workers[worker] = points
                worker.send(points)
        ready = wait(self._workers, LOOK)
        for worker, batch in [item for item in self._workers.items() if item[0] in ready]:
            starts = batch == []
            try:
                rows, duration = worker.recv()
            except EOFError as end:
                del self._workers[worker]
                worker.close()
                self._failures += starts
                if self._failures >= MOST_FAILURES and not self._workers:
                    raise SweepError(f"workers die as they start: {end}") from None
                yield self._batches.died(batch or [])
            else:
                self._workers[worker] = None
                self._failures = 0 if starts else self._failures
                yield self._batches.done(rows, duration)


def work(pipe: Connection, folder: Path) -> None:
    """Report the start, then run batches and send their rows and durations; this is a worker's function."""
    with Runner(pickle.loads((folder / "job").read_bytes())) as runner:
        pipe.send(([], 0.0))
        while True:
            pipe.send(runner.run_all(pipe.recv()))
