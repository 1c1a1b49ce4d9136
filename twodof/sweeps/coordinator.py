"""Coordinate many runs of one FMU: a design, runs in other processes, and a table of metrics."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..files import temporary_folder
from ..fmu import Fmu, opened
from ..notebook import in_notebook
from ..signatures import never
from ..simulation.experiments import Experiment, ExperimentOptions, experiment
from ..simulation.input_values import Setting
from ..simulation.progress import counting
from ..version import versions
from .design import Design, make_design
from .pool import Pool
from .results import Results, read_sweep
from .runner import Batches, Job, Row

if TYPE_CHECKING:
    import pandas

PACKAGES = ("numpy", "fmpy", "pandas", "pyarrow")


def sweep(
    fmu: Fmu | str | Path,
    *,
    grid: Mapping[str, Iterable[float]] | None = None,
    ranges: Mapping[str, Sequence[float]] | None = None,
    random: int = 0,
    seed: int = 0,
    stop_time: float | None = None,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
    output: str | Path | None = None,
    resume: bool = False,
    bags: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    stop: Callable[[], bool] = never,
    command_line: str = "",
) -> pandas.DataFrame:
    """Run every point of a design; return the table, one row per run.

    The columns are ``run``, the variables that are varied, the metrics (``METRICS``), ``end_time``
    in s, ``outcome`` (finished, discarded, diverged, failed or crashed) and ``message``.

    Args:
        fmu: the FMU or its path.
        grid: values by variable; a name without an index sets all elements. All combinations are run.
        ranges: low and high by variable; values are drawn uniformly, ``random`` times for each grid combination.
        random, seed: number of draws, and their seed.
        stop_time, step, settings: settings of each run, as in ``experiment``.
        output: folder for the table; None: it is not stored.
        resume: continue the sweep in ``output`` without repeating finished runs.
        bags: write a bag of each run, ``output``/bags/<run>; workers need access to that folder.
        workers: number of local processes; None: one for each core.
        scheduler: address of a Dask scheduler whose workers are used instead. Anybody who can reach it can
            run code as you, unless Dask is configured to use TLS.
        progress: called with the numbers of finished and of all runs; None: a notebook's bar, if not TQDM_DISABLE.
        stop: called at least twice a second; True ends the sweep with the finished runs.
        command_line: command line for the provenance.

    Raises:
        InputError, FmuError: the design or the FMU is invalid.
        SweepError: the folder, the scheduler or the workers failed; the message names them.
        ChildError: a worker failed for another reason.
        BagError: a bag cannot be written.
    """
    run = experiment(fmu, stop_time=stop_time, step=step, settings=settings)
    design = make_design(run.fmu, grid or {}, ranges or {}, random, seed, run.given)
    with temporary_folder() as spare, counting("sweeping", "run", shown=progress is None and in_notebook()) as show:
        progress = progress or show
        path = spare / "sweep" if output is None else Path(output)
        job = _job(run, stop_time, design.names, path.resolve() / "bags" if bags else None)
        provenance = _provenance(run.fmu, design, job, command_line)
        results = Results(path, design.names, _units(run.fmu, design.names), len(design), provenance, resume=resume)
        progress(int(results.done.sum()), len(results.done))
        with _workers(job, design, ~results.done, workers, scheduler, stop) as news, results:  # in this order
            for rows in news:
                results.add(rows)
                progress(int(results.done.sum()), len(results.done))
        return read_sweep(path)


def _job(run: Experiment, stop_time: float | None, names: tuple[str, ...], bags: Path | None) -> Job:
    end = run.time(run.steps) if stop_time is None else stop_time
    options: ExperimentOptions = {"stop_time": end, "step": run.step, "settings": dict(run.given)}
    with opened(run.fmu):
        return Job(run.fmu.path.read_bytes(), run.fmu.path.name, names, options, bags)


def _provenance(fmu: Fmu, design: Design, job: Job, command_line: str) -> dict[str, object]:
    return {
        "fmu": {
            "file": fmu.path.name,
            "name": fmu.name,
            "guid": fmu.guid,
            "sha256": hashlib.sha256(job.content).hexdigest(),
        },
        "design": asdict(design),
        "options": job.options,
        "bags": job.bags is not None,
        "versions": versions(*PACKAGES),
        "command_line": command_line,
    }


def _workers(
    job: Job,
    design: Design,
    missing: NDArray[np.bool_],
    count: int | None,
    scheduler: str | None,
    stop: Callable[[], bool],
) -> AbstractContextManager[Iterable[list[Row]]]:
    """Return a context that yields rows from the workers."""
    numbers, values = np.flatnonzero(missing).tolist(), design.points()
    if not numbers:
        return nullcontext(())
    batches = Batches(((k, tuple(values[k].tolist())) for k in numbers), len(numbers))
    if scheduler is None:
        return Pool(job, batches, os.cpu_count() or 1 if count is None else count, stop)
    from .cluster import Cluster  # Dask takes a second to import

    return Cluster(job, batches, scheduler, stop)


def _units(fmu: Fmu, names: Sequence[str]) -> list[str]:
    elements = [[fmu.variables[element] for element in fmu.vector(name)] for name in names]
    return [" or ".join(dict.fromkeys(variable.unit or "" for variable in group)) for group in elements]
