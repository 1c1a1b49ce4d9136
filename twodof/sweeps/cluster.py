"""Runs of a sweep on Dask's workers, those of this machine or of a cluster. All of Dask is here."""

from __future__ import annotations

import logging
import os
import shlex
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from math import nan
from threading import Lock
from typing import Any

from .. import __version__
from ..errors import SweepError, TwoDofError
from ..files import temporary_folder
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

PATIENCE = 5.0  # s for a scheduler to answer
START_TIME = 60.0  # s for the first worker to start
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
NO_WORKER = 60.0  # s after which nobody hopes for another
BATCH_TIME = 0.25  # s, of one task
MAX_BATCH = 256
IN_HAND = 2  # tasks a worker, so that it never waits for the next
CONFIG = {
    # the scheduler of a local cluster would remember every task
    "distributed.admin.log-length": 100,
    "distributed.admin.low-level-log-length": 100,
    "distributed.scheduler.allowed-failures": 1,
    "distributed.comm.timeouts.connect": PATIENCE,
}


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


class Cluster:
    """Workers that can run a job; a context.

    Args:
        job: what all runs share.
        workers: local processes; None: as many as there are cores.
        scheduler: address of a cluster's scheduler, in place of local workers.

    Raises:
        SweepError: there are no workers, or they cannot run the job.
    """

    def __init__(self, job: Job, workers: int | None, scheduler: str | None) -> None:
        if workers is not None and workers < 1:
            raise SweepError(f"{workers} workers; at least 1 is needed")
        self._job, self._scheduler = job, scheduler
        self._workers = workers or os.cpu_count() or 1

    def __enter__(self) -> Cluster:
        with ExitStack() as stack:
            workers = _local(self._workers) if self._scheduler is None else _remote(self._scheduler)
            self._client, self._mend = stack.enter_context(workers)
            self._name = stack.enter_context(_registered(self._client, self._job))
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._exit.close()

    def run(
        self, points: Iterator[Point], stop: Callable[[], bool]
    ) -> Generator[list[Row], None, None]:
        """Rows of all points as they come, in any order, until ``stop`` is true.

        A run whose worker dies is done again elsewhere. Where that happens to it repeatedly, Dask
        gives it up, or its neighbours; each of them is then run once more with nothing beside it,
        and has the outcome "crashed" if that kills workers again.

        Raises:
            FmuError, InputError, BagError: from a run, for a reason that others will meet too.
            SweepError: a worker failed otherwise, or the scheduler is gone.
        """
        batches = _Batches(points)
        tasks: dict[Future, list[Point]] = {}
        seen = time.monotonic()
        while not stop():
            workers = len(self._client.scheduler_info(n_workers=-1)["workers"])
            now = time.monotonic()
            seen = now if workers else seen
            if now - seen > NO_WORKER:
                raise SweepError("no worker is left; go on with --resume")
            self._mend()
            width = IN_HAND * max(1, workers)
            while len(tasks) < width and (batch := batches.next(alone=not tasks)):
                tasks[self._client.submit(run_batch, self._name, batch, pure=False)] = batch
            if not tasks:
                return
            for future in _finished(tasks):
                batch = tasks.pop(future)
                try:
                    rows, duration = future.result()
                except KilledWorker:
                    rows, duration = batches.suspect(batch), 0.0
                except TwoDofError:
                    raise
                except CancelledError as error:
                    raise SweepError("the scheduler is gone; go on with --resume") from error
                except Exception as error:
                    raise SweepError(f"a worker failed: {error!r:.300}") from error
                batches.adapt(len(rows), duration)
                if rows:
                    yield rows


class _Batches:
    """Cuts points into batches of about a quarter of a second."""

    def __init__(self, points: Iterator[Point]) -> None:
        self._points = points
        self._suspects: deque[Point] = deque()
        self._tried: Point | None = None
        self._size = 1

    def next(self, *, alone: bool) -> list[Point]:
        """The next one; empty at the end, or if what is left must run with nothing beside it."""
        if self._tried is not None and not alone:
            return []
        self._tried = None
        batch = [point for _, point in zip(range(self._size), self._points)]
        if not batch and alone and self._suspects:
            self._tried = self._suspects.popleft()
            return [self._tried]
        return batch

    def suspect(self, batch: Sequence[Point]) -> list[Row]:
        """Take back what Dask gave up; the rows of what ran alone and is at fault."""
        if self._tried is not None:
            return [_crashed(*self._tried)]
        self._suspects.extend(batch)
        return []

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
def _local(count: int) -> Iterator[tuple[Client, Callable[[], object]]]:
    """Processes of this machine, and what replaces those that have died.

    They are started by hand: Dask's nannies give up on workers that die as they start, and import
    the program's main module. In a session of their own, the terminal's Ctrl-C is not for them.
    """
    with ExitStack() as stack:
        stack.enter_context(_silent(logging.getLogger("distributed")))
        stack.enter_context(dask.config.set(CONFIG))
        cluster = stack.enter_context(
            LocalCluster(
                n_workers=0, dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL
            )
        )
        folder = stack.enter_context(temporary_folder())
        command = [
            sys.executable, "-m", "distributed.cli.dask_worker", cluster.scheduler_address,
            "--no-nanny", "--nthreads", "1", "--no-dashboard", "--memory-limit", "0",
            "--death-timeout", f"{START_TIME:g}", "--local-directory", str(folder),
        ]  # fmt: skip
        path = os.pathsep.join(entry for entry in sys.path if entry)
        environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": path, "TMPDIR": str(folder)}
        start = partial(
            subprocess.Popen, command, env=environment, start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        workers: list[subprocess.Popen[Any]] = []
        stack.callback(_end, workers)

        def mend() -> None:
            workers[:] = [worker for worker in workers if worker.poll() is None]
            while len(workers) < count:
                workers.append(start())

        mend()
        client = stack.enter_context(Client(cluster))
        try:
            client.wait_for_workers(1, timeout=START_TIME)
        except TimeoutError:
            raise SweepError(f"no worker has started: try {shlex.join(command)}") from None
        yield client, mend


def _end(workers: Sequence[subprocess.Popen[Any]]) -> None:
    for worker in workers:
        worker.kill()  # what they have, they have told; their folder goes with this process
    for worker in workers:
        worker.wait()


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
def _remote(address: str) -> Iterator[tuple[Client, Callable[[], object]]]:
    """The workers of a cluster that runs already, which mends itself."""
    try:
        client = Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise SweepError(f"the scheduler '{address}' does not answer: {error!s:.200}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise SweepError(f"the scheduler '{address}' has no workers") from None
        yield client, lambda: None


@contextmanager
def _registered(client: Client, job: Job) -> Iterator[str]:
    """Name of the job's plugin, which the scheduler hands to every worker, and takes back."""
    name = f"twodof-{os.urandom(8).hex()}"
    try:
        client.register_plugin(JobPlugin(job, __version__), name=name)
    except TwoDofError:
        raise
    except Exception as error:  # Dask hands on what a worker said, as one of these
        remedy = f"install twodof {__version__} and its extra 'sweep' there"
        raise SweepError(f"a worker cannot take the job: {error!s:.300}; {remedy}") from error
    try:
        yield name
    finally:
        with suppress(OSError):  # from a worker that dies at this moment
            client.unregister_worker_plugin(name)
