"""Run a sweep on the workers of an existing Dask cluster; all uses of Dask are here.

Anybody who can reach the scheduler can run code on its workers and in this process. Dask's configuration
``distributed.comm.tls`` restricts access.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from threading import Event, Lock, Thread

from ..errors import SweepError, TwoDofError
from ..version import __version__, needing
from .runner import LOOK, Batches, Job, Point, Row, Runner

with needing(SweepError, "use a cluster", "cluster"):
    from distributed import Client, Future, KilledWorker, Worker, WorkerPlugin, get_worker, wait

SCHEDULER_TIMEOUT = 5.0  # s for a scheduler to answer
NO_WORKER = 60.0  # s of waiting for a worker
IN_HAND = 2  # tasks for each worker, so that it never waits for the next one


class JobPlugin(WorkerPlugin):  # type: ignore[misc]
    """Sends a job to each worker once, later workers included."""

    def __init__(self, job: Job, version: str) -> None:
        self._job, self._version = job, version
        self._runner: Runner | None = None

    def setup(self, worker: Worker) -> None:
        """Refuse different versions, whose results might differ."""
        if __version__ != self._version:
            raise SweepError(f"worker {worker.address} has twodof {__version__}, not {self._version}")
        self._lock = Lock()  # a worker may have several threads, but the FMU has one instance

    def teardown(self, worker: Worker) -> None:
        """Free the FMU."""
        with self._lock:
            if self._runner is not None:
                self._runner.__exit__(None, None, None)

    def run_all(self, points: Sequence[Point]) -> tuple[list[Row], float]:
        """Return the rows of some points, and their duration, s."""
        with self._lock:
            if self._runner is None:
                self._runner = Runner(self._job)
            return self._runner.run_all(points)


def run_batch(name: str, points: Sequence[Point]) -> tuple[list[Row], float]:
    """Run a batch on a worker."""
    plugin: JobPlugin = get_worker().plugins[name]
    return plugin.run_all(points)


class Cluster:
    """The workers of a cluster, as a context that needs at least one of them.

    A thread communicates with Dask, because Dask can wait without end for a peer that does not answer.

    Args:
        stop: called repeatedly; True ends the sweep.

    Raises:
        SweepError: there are no workers, they cannot run the job, or the scheduler does not answer.
        FmuError, InputError, BagError: a run failed for a reason that affects all runs.
    """

    def __init__(self, job: Job, batches: Batches, address: str, stop: Callable[[], bool]) -> None:
        self._job, self._batches, self._address, self._stop = job, batches, address, stop
        self._news: SimpleQueue[list[Row] | Exception | None] = SimpleQueue()
        self._ended = Event()

    def __enter__(self) -> Iterator[list[Row]]:
        self._thread = Thread(target=self._serve, daemon=True)
        self._thread.start()
        self._answers = self._next() is not None
        return iter(self._next, None)

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        if self._answers:
            self._thread.join(SCHEDULER_TIMEOUT)  # the thread unregisters the job

    def _next(self) -> list[Row] | None:
        """Return the thread's next message; None at its end, or if the sweep is to stop."""
        while not self._stop():
            with suppress(Empty):
                news = self._news.get(timeout=LOOK)
                if isinstance(news, Exception):
                    raise news
                return news
        return None

    def _serve(self) -> None:
        try:
            with _client(self._address) as client, _registered(client, self._job) as name:
                self._news.put([])
                self._run(client, name)
            self._news.put(None)
        except Exception as error:
            self._news.put(error)

    def _run(self, client: Client, name: str) -> None:
        batches = self._batches
        tasks: dict[Future, list[Point]] = {}
        seen = time.monotonic()
        while batches.left and not self._ended.is_set():
            workers = len(client.scheduler_info(n_workers=-1)["workers"])
            now = time.monotonic()
            seen = now if workers else seen
            if now - seen > NO_WORKER:
                raise SweepError("no worker is left; continue with `resume=True`")
            width = IN_HAND * max(1, workers)
            # all batches of a dead worker may have caused its death
            while len(tasks) < width and (batch := batches.next(alone=not tasks)):
                tasks[client.submit(run_batch, name, batch, pure=False)] = batch
            with suppress(TimeoutError):
                wait(list(tasks), timeout=LOOK, return_when="FIRST_COMPLETED")
            for future in [future for future in tasks if future.done()]:
                self._news.put(_result(future, tasks.pop(future), batches))


def _result(future: Future, batch: list[Point], batches: Batches) -> list[Row]:
    try:
        return batches.done(*future.result())
    except KilledWorker:
        return batches.died(batch)
    except TwoDofError:
        raise
    except CancelledError as error:
        raise SweepError("the scheduler does not answer any more; continue with `resume=True`") from error
    except Exception as error:
        raise SweepError(f"a worker failed: {error!r:.300}") from error


@contextmanager
def _client(address: str) -> Iterator[Client]:
    try:
        client = Client(address, timeout=SCHEDULER_TIMEOUT)
    except (OSError, ValueError, TypeError) as error:
        raise SweepError(f"the scheduler '{address}' does not answer: {error!s:.200}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT)
        except TimeoutError:
            raise SweepError(f"the scheduler '{address}' has no workers") from None
        yield client


@contextmanager
def _registered(client: Client, job: Job) -> Iterator[str]:
    """Register the job's plugin at the scheduler, which sends it to every worker; unregister at the end."""
    name = f"twodof-{os.urandom(8).hex()}"
    try:
        client.register_plugin(JobPlugin(job, __version__), name=name)
    except TwoDofError:
        raise
    except Exception as error:  # Dask re-raises a worker's exception as one of these
        remedy = f"install twodof {__version__} and its extra 'cluster' there"
        raise SweepError(f"a worker cannot take the job: {error!s:.300}; {remedy}") from error
    try:
        yield name
    finally:
        with suppress(OSError):  # a worker may die at this moment
            client.unregister_worker_plugin(name)
