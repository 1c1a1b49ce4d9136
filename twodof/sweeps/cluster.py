"""Runs of a sweep on Dask's workers, those of this machine or of a cluster. All of Dask is here."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from math import nan
from threading import Lock
from typing import Any

from .. import __version__
from ..errors import SweepError, TwoDofError
from .metrics import METRICS
from .runner import Job, Point, Row, Runner

try:
    import dask
    from distributed import (
        Client,
        Future,
        KilledWorker,
        LocalCluster,
        Worker,
        WorkerPlugin,
        get_worker,
        wait,
    )
except ImportError as missing:
    raise SweepError(
        f"cannot sweep: {missing}; install the extra 'sweep' (pip install 'twodof[sweep]')"
    ) from missing

PATIENCE = 10.0  # s for a scheduler to answer
BATCH_TIME = 0.5  # s, of one task
MAX_BATCH = 256
IN_HAND = 2  # tasks a worker, so that it never waits for the next
CONFIG = {
    # the scheduler of a local cluster would remember every task
    "distributed.admin.log-length": 100,
    "distributed.admin.low-level-log-length": 100,
    "distributed.worker.preload": ["twodof.sweeps.cluster"],
    "distributed.comm.timeouts.connect": PATIENCE,
}


def dask_setup(worker: Worker) -> None:
    """The terminal's Ctrl-C is for the sweep, not for a local worker, which preloads this."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class JobPlugin(WorkerPlugin):  # type: ignore[misc]
    """Brings a job to each worker once, also to those that come later."""

    def __init__(self, job: Job, version: str) -> None:
        self._job, self._version = job, version
        self._runner: Runner | None = None

    def setup(self, worker: Worker) -> None:
        """Refuse to mix versions, whose results might differ."""
        if __version__ != self._version:
            raise SweepError(
                f"worker {worker.address} has twodof {__version__}, not {self._version}"
            )
        self._lock = Lock()  # for workers of several threads: the FMU has one instance

    def teardown(self, worker: Worker) -> None:
        """Free the FMU."""
        with self._lock:
            if self._runner is not None:
                self._runner.__exit__(None, None, None)

    def run(self, points: Sequence[Point]) -> tuple[list[Row], float]:
        """Rows of some points, and the time it took, s."""
        with self._lock:
            if self._runner is None:
                self._runner = Runner(self._job)
            begin = time.perf_counter()
            rows = [self._runner.run(point) for point in points]
            return rows, time.perf_counter() - begin


def run_batch(name: str, points: Sequence[Point]) -> tuple[list[Row], float]:
    """What a task does on a worker."""
    plugin: JobPlugin = get_worker().plugins[name]
    return plugin.run(points)


def run_all(
    job: Job,
    points: Iterator[Point],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Generator[list[Row], None, None]:
    """Rows of all points as they come, in any order.

    A run whose worker dies is done again elsewhere; one that brings death to several workers has
    the outcome "crashed".

    Args:
        job: what all runs share.
        points: the runs.
        workers: local processes; None: as many as there are cores.
        scheduler: address of a cluster's scheduler, in place of local workers.
        stop: asked twice a second; True ends the iteration.

    Raises:
        SweepError: there are no workers, or they cannot run the job.
        FmuError, InputError, BagError: from a run, for a reason that others will meet too.
    """
    with ExitStack() as stack:
        client = stack.enter_context(
            _local(workers or os.cpu_count() or 1) if scheduler is None else _remote(scheduler)
        )
        name = stack.enter_context(_registered(client, job))
        batches = _Batches(points)
        tasks: dict[Future, list[Point]] = {}
        while not stop():
            width = IN_HAND * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
            while len(tasks) < width and (batch := batches.next()):
                tasks[client.submit(run_batch, name, batch, pure=False)] = batch
            if not tasks:
                return
            for future in _finished(tasks):
                batch = tasks.pop(future)
                try:
                    rows, duration = future.result()
                except KilledWorker:
                    if len(batch) > 1:
                        batches.again_alone(batch)
                        continue
                    rows, duration = [_crashed(*batch[0])], 0.0
                except TwoDofError:
                    raise
                except Exception as error:
                    raise SweepError(f"a worker failed: {error!r:.300}") from error
                batches.adapt(len(rows), duration)
                yield rows


class _Batches:
    """Cuts points into batches of about half a second."""

    def __init__(self, points: Iterator[Point]) -> None:
        self._points = points
        self._alone: deque[Point] = deque()
        self._size = 1

    def next(self) -> list[Point]:
        """The next one; empty at the end."""
        if self._alone:
            return [self._alone.popleft()]
        return [point for _, point in zip(range(self._size), self._points)]

    def again_alone(self, batch: Sequence[Point]) -> None:
        """One of them kills workers: which one, each alone will show."""
        self._alone.extend(batch)

    def adapt(self, count: int, duration: float) -> None:
        """Learn how long runs take, s."""
        if duration > 0.0:
            fitting = int(BATCH_TIME * count / duration)
            self._size = max(1, min(MAX_BATCH, fitting, 4 * self._size))


def _finished(tasks: dict[Future, Any]) -> list[Future]:
    """Those that are done, after a wait of half a second at most."""
    try:
        return list(wait(list(tasks), timeout=0.5, return_when="FIRST_COMPLETED").done)
    except TimeoutError:
        return []


def _crashed(number: int, values: tuple[float, ...]) -> Row:
    metrics = [nan] * len(METRICS)
    return (number, *values, *metrics, nan, "crashed", "the process that ran it died, repeatedly")


@contextmanager
def _local(workers: int) -> Iterator[Client]:
    """Processes of this machine; those that die are replaced."""
    with (
        _silent(logging.getLogger("distributed")),
        dask.config.set(CONFIG),
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True,
            dashboard_address="127.0.0.1:0", memory_limit=None, silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        yield client


@contextmanager
def _silent(logger: logging.Logger) -> Iterator[None]:
    """It tells of every worker that comes and goes, and of some that are slow to."""
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextmanager
def _remote(address: str) -> Iterator[Client]:
    """The workers of a cluster that runs already."""
    try:
        client = Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise SweepError(f"the scheduler '{address}' does not answer: {error!s:.200}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise SweepError(f"the scheduler '{address}' has no workers") from None
        yield client


@contextmanager
def _registered(client: Client, job: Job) -> Iterator[str]:
    """Name of the job's plugin, which the scheduler hands to every worker, and takes back."""
    name = f"twodof-{os.urandom(8).hex()}"
    try:
        client.register_plugin(JobPlugin(job, __version__), name=name)
    except ImportError as error:
        raise SweepError(f"a worker cannot import {error.name}; install twodof there") from error
    try:
        yield name
    finally:
        client.unregister_worker_plugin(name)
