"""Bags as a dataset for robot learning, in version 3.0 of LeRobot's form: an episode for each bag."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..errors import BagError
from ..files import refusing, temporary_folder
from ..version import needing
from .reader import read_bag
from .recording import Array, Recording

if TYPE_CHECKING:
    import pyarrow as pa

VERSION, TASK, FILE = "v3.0", "follow the target", "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
PLACE = {"data/chunk_index": 0, "data/file_index": 0, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}

Columns: TypeAlias = dict[str, NDArray[np.float32] | NDArray[np.int64]]
"""N numbers or N × n vectors by name of the column."""


def write_dataset(bags: Sequence[Path], path: Path) -> None:
    """Write bags as the episodes of a dataset, a new folder.

    Its ``observation.state`` has positions and velocities of the joints. Its ``action`` has the target that applies
    from a sample on, of the joints or of the end effector. Without targets, it has the efforts.

    Raises:
        BagError: the folder exists or cannot be written, pandas or pyarrow is missing, a bag cannot be read, the bags
            differ in joints, target or rate, their rate is not a whole number of Hz, or they have neither targets nor
            efforts.
    """
    if path.exists():
        raise BagError(f"'{path}' exists, and is not replaced: remove it, or choose another name")
    with needing(BagError, f"write '{path}'", "sweep"):
        import pandas as pd
        import pyarrow as pa
        import pyarrow.parquet as pq
    episodes: list[dict[str, object]] = []
    parts: list[Columns] = []
    known, end = [], 0
    for i, bag in enumerate(bags):
        run = read_bag(bag)
        vectors, rate = _vectors(run), _rate(run)
        known.append(({part: [*own] for part, own in vectors.items()}, rate, run.provenance.get("robot")))
        if known[-1][:2] != known[0][:2]:
            raise BagError(f"'{bag}' and '{bags[0]}' differ in joints, target or rate")
        parts.append(_columns(vectors, len(run.t), rate, i, end))
        span = {"dataset_from_index": end, "dataset_to_index": (end := end + len(run.t)), "length": len(run.t)}
        stats = {f"stats/{name}/{key}": v for name, own in _statistics(parts[-1]).items() for key, v in own.items()}
        episodes.append({"episode_index": i, "tasks": [TASK], **span, **PLACE, **stats})
    names, rate, robot = known[0]
    frames: Columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    features: dict[str, dict[str, object]] = {
        name: {"dtype": str(values.dtype), "shape": [1], "names": None} for name, values in frames.items()
    }
    features |= {part: {"dtype": "float32", "shape": [len(own)], "names": own} for part, own in names.items()}
    info = {
        **{"codebase_version": VERSION, "robot_type": robot, "fps": rate},
        **{"total_episodes": len(bags), "total_frames": end, "total_tasks": 1, "splits": {"train": f"0:{len(bags)}"}},
        **{"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200},
        **{"data_path": f"data/{FILE}", "video_path": None, "features": features},
    }
    data = pa.table({name: _arrow(values) for name, values in frames.items()})
    with refusing(BagError, f"write '{path}'"), temporary_folder(path.absolute().parent) as draft:
        for folder, table in (("data", data), ("meta/episodes", pa.Table.from_pylist(episodes))):
            file = draft / "dataset" / folder / FILE.format(chunk_index=0, file_index=0)
            file.parent.mkdir(parents=True)
            pq.write_table(table, file)
        pd.DataFrame({"task_index": [0]}, index=[TASK]).to_parquet(draft / "dataset/meta/tasks.parquet")
        for name, facts in (("info", info), ("stats", _statistics(frames))):
            (draft / f"dataset/meta/{name}.json").write_text(json.dumps(facts, indent=4), "utf-8")
        (draft / "dataset").rename(path)


def _vectors(run: Recording) -> dict[str, dict[str, Array]]:
    """Return states and actions: N values by name."""
    parts = {"position": run.q, "velocity": run.v, "effort": run.tau}
    own = {part: {f"{name}.{part}": v for name, v in zip(run.joints, values.T)} for part, values in parts.items()}
    targets = {f"{joint}.position": q for joint, q in zip(run.joints, run.held("q_des", len(run.joints)).T)}
    targets |= {f"x_des.{axis}": x for axis, x in zip(run.axes or "xyz", run.target.T)}
    targets |= {f"quat_des.{axis}": values for axis, values in zip("xyzw", run.target_quat.T)}
    ahead = {name: np.append(values[1:], values[-1]) for name, values in targets.items()}  # in effect after a sample
    if not (action := ahead or own["effort"]):
        raise BagError(f"'{run.path}' has neither targets nor efforts; record them with `effort`")
    return {"observation.state": own["position"] | own["velocity"], "action": action}


def _rate(run: Recording) -> int:
    """Return the number of samples a second."""
    steps = np.diff(run.t)
    rate = round(1.0 / float(np.median(steps))) if len(steps) and min(steps) > 0.0 else 0
    if not rate or abs(steps * rate - 1.0).max() > 0.1 or abs(steps.mean() * rate - 1.0) > 1e-3:
        raise BagError(
            f"'{run.path}' has no even rate of a whole number of Hz, as LeRobot needs; choose another `step`"
        )
    return rate


def _columns(vectors: dict[str, dict[str, Array]], count: int, rate: int, episode: int, first: int) -> Columns:
    """Return the columns of an episode, whose first sample has the index ``first`` in the dataset."""
    k = np.arange(count)
    columns: Columns = {part: np.column_stack([*own.values()]).astype(np.float32) for part, own in vectors.items()}
    columns |= {"timestamp": (k / rate).astype(np.float32), "frame_index": k, "episode_index": np.full(count, episode)}
    return columns | {"index": first + k, "task_index": np.zeros(count, np.int64)}


def _arrow(values: NDArray[np.float32] | NDArray[np.int64]) -> pa.Array:
    """Return a column of numbers or lists for Arrow; a Python object for each row would take a kilobyte."""
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values)
    return pa.ListArray.from_arrays(np.arange(0, values.size + 1, values.shape[1], dtype=np.int32), values.ravel())


def _statistics(columns: Columns) -> dict[str, dict[str, list[float]]]:
    found = {}
    for name, column in columns.items():
        values = column.reshape(len(column), -1)
        moments = {key: getattr(np, key)(values, axis=0).tolist() for key in ("min", "max", "mean", "std")}
        quantiles = {f"q{p:02}": np.percentile(values, p, axis=0).tolist() for p in (1, 10, 50, 90, 99)}
        found[name] = moments | quantiles | {"count": [len(values)]}
    return found
