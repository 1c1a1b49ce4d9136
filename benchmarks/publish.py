"""How well ``twodof publish`` keeps its period, beside a bare sleep loop at the same time.

    python benchmarks/publish.py [SECONDS] [python|native]

Publishes the default arm with its scene at 100 Hz on the loopback interface. Prints the mean of the
period and percentiles of its jitter, |period - 10 ms|: of a second process that does nothing but
sleep until each 10 ms, of the samples when they are published, and when a third process receives
them. Needs the package 'cyclonedds'. Have nothing else to do for the machine.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from twodof import Sink

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

STEP = 0.01
DOMAIN = 42


def account(name: str, times: list[float]) -> None:
    """Print the statistics of a series of times, s."""
    periods = 1e3 * np.diff(times)
    jitter = np.abs(periods - 1e3 * STEP)
    half, most, nearly_all = np.percentile(jitter, [50, 99, 99.9])
    print(
        f"{name:10s} {len(times):6d} times, period {periods.mean():.4f} ms, jitter median"
        f" {half:.3f}, 99 % {most:.3f}, 99.9 % {nearly_all:.3f}, worst {jitter.max():.3f} ms",
        flush=True,
    )


def bare_loop(count: int) -> None:
    """A loop that does nothing else."""
    from twodof.simulation.pace import RealTime

    pace, times = RealTime(), []
    for k in range(count):
        pace.wait(k * STEP)
        times.append(time.perf_counter())
    account("bare loop", times)
    print(f"           {pace.missed} deadlines missed, worst {1e3 * pace.worst:.1f} ms")


def receive() -> None:
    """Take JointStates as they come, until there are none for a second."""
    from cyclonedds.core import ReadCondition, SampleState, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from twodof.ros.dds import dds_qos, dds_type
    from twodof.ros.messages import JOINT_STATE, STREAM
    from twodof.ros.network import Network, open_domain

    _domain = open_domain(Network(DOMAIN, loopback=True))
    participant = DomainParticipant(DOMAIN)
    topic = Topic(participant, "rt/joint_states", dds_type(JOINT_STATE))
    reader = DataReader(participant, topic, dds_qos(STREAM, JOINT_STATE))
    new = WaitSet(participant)
    new.attach(ReadCondition(reader, SampleState.NotRead))
    print("ready", flush=True)
    stamps: list[float] = []
    while new.wait(1_000_000_000 if stamps else 60_000_000_000):
        now = time.perf_counter()
        stamps += [now] * sum(it.sample_info.valid_data for it in reader.take(10))
    account("received", stamps)


class Clock(Sink):
    """A sink that notes when samples come, after the start has settled."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def write(self, sample: object) -> None:
        self.times.append(time.perf_counter())


def main() -> None:
    """Measure and print."""
    if sys.argv[1:2] == ["--bare"]:
        return bare_loop(int(sys.argv[2]))
    if sys.argv[1:2] == ["--receive"]:
        return receive()
    seconds = float(sys.argv[1]) if sys.argv[1:] else 60.0
    from twodof import FmuOptions, Publisher, build_fmu, experiment, simulate
    from twodof.ros.network import Network
    from twodof.simulation.pace import RealTime

    with tempfile.TemporaryDirectory() as folder:
        native = sys.argv[2:3] != ["python"]
        fmu = build_fmu(Path(folder) / "TwoDof.fmu", FmuOptions(native=native))
        run = experiment(fmu, stop_time=seconds, step=STEP)
        me = [sys.executable, __file__]
        receiver = subprocess.Popen([*me, "--receive"], stdout=subprocess.PIPE, text=True)
        assert receiver.stdout is not None and receiver.stdout.readline() == "ready\n"
        bare = subprocess.Popen(
            [*me, "--bare", f"{run.steps:.0f}"], stdout=subprocess.PIPE, text=True
        )
        pace, clock = RealTime(), Clock()
        wire = Publisher(Network(DOMAIN, loopback=True), scene=True)
        summary = simulate(run, clock, wire, pace=pace, steer=wire.command)
    print(bare.communicate()[0], end="")
    account("published", clock.times)
    print(
        f"           {pace.missed} of {summary.last.k + 1} deadlines missed, worst"
        f" {1e3 * pace.worst:.1f} ms, {summary.last.t:g} s in {summary.wall_time:.3f} s"
    )
    print(receiver.communicate()[0], end="")


if __name__ == "__main__":
    main()
