"""A simulated day: flat memory, stamps without drift, a bag that opens."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bags import PERIOD, SECOND, START, both_storages, metadata
from mcap.reader import make_reader

import twodof

DAY = 8_640_000  # steps of 10 ms
MIB = 1024**2
RUN = """
import sys
import twodof
from sinks import Memory

fmu, path, storage, steps, start = sys.argv[1:]
run = twodof.experiment(fmu, stop_time=int(steps) / 100, stamp_start=int(start))
memory = Memory(4000)
bag = twodof.Bag(path, storage=storage)
summary = twodof.simulate(run, bag, memory)
print(memory.growth, summary.wall_time)
"""


@pytest.mark.long
@pytest.mark.needs("linux")
@both_storages
def test_a_day_has_flat_memory_and_exact_stamps(native_path, tmp_path, storage, length):
    steps = length(DAY, 60_000)
    bag = tmp_path / "bag"
    command = [sys.executable, "-c", RUN, str(native_path), str(bag), storage, str(steps)]
    done = subprocess.run([*command, str(START)], cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    growth, wall_time = map(float, done.stdout.split())
    size = sum(file.stat().st_size for file in bag.iterdir())
    print(f"{steps} steps, {storage}: memory grew by {growth / MIB:.1f} MiB, {wall_time:.0f} s, {size / 1e9:.2f} GB")
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
