"""A simulated day: flat memory, stamps without drift, a bag that opens."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bags import PERIOD, SECOND, START, both_storages, metadata
from mcap.reader import make_reader

import twodof

DAY = 8_640_000  # steps of 10 ms
MIB = 1024**2
RUN = """
import resource, sys
from pathlib import Path
import twodof

class Memory:
    first = most = 0

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass

    def write(self, sample):
        if sample.k == 4000:
            self.first = self.resident()
        elif sample.k % 4000 == 0:
            self.most = max(self.most, self.resident())

    def resident(self):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize()

fmu, path, storage, steps, start = sys.argv[1:]
run = twodof.experiment(fmu, stop_time=int(steps) / 100)
memory = Memory()
bag = twodof.Bag(path, run, storage=storage, stamp_start=int(start))
summary = twodof.simulate(run, [bag, memory])
print(memory.most - memory.first, summary.wall_time)
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@both_storages
def test_a_day_has_flat_memory_and_exact_stamps(
    native_path: Path, tmp_path: Path, storage: str, length: Callable[[int, int], int]
) -> None:
    steps = length(DAY, 60_000)
    bag = tmp_path / "bag"
    command = [sys.executable, "-c", RUN, str(native_path), str(bag), storage, str(steps)]
    done = subprocess.run([*command, str(START)], capture_output=True, text=True, check=True)
    growth, wall_time = map(float, done.stdout.split())
    size = sum(file.stat().st_size for file in bag.iterdir())
    print(
        f"{steps} steps, {storage}: memory grew by {growth / MIB:.1f} MiB,"
        f" {wall_time:.0f} s, {size / 1e9:.2f} GB"
    )
    assert growth <= 10e6
    last = START * SECOND + steps * PERIOD
    told = metadata(bag)
    assert told["message_count"] == steps + 1
    assert told["duration"]["nanoseconds"] == steps * PERIOD
    if storage == "mcap":
        with (bag / "bag.mcap").open("rb") as file:
            summary = make_reader(file).get_summary()
            assert summary is not None and summary.statistics is not None
            assert summary.statistics.message_end_time == last
            newest = next(make_reader(file).iter_messages(reverse=True))
            assert newest[2].log_time == last
    run = twodof.read_bag(bag)
    assert run.stamps[-1] == last
    np.testing.assert_array_equal(run.stamps, START * SECOND + PERIOD * np.arange(steps + 1))
    assert np.isfinite(run.q).all()
