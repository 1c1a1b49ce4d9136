"""Timing of ``twodof publish`` and ``twodof live``, and of a bare sleep loop at the same time.

    python benchmarks/realtime.py publish|live [SECONDS] [python|native]

Both step the default arm every 10 ms; a second process only sleeps until each 10 ms. It prints the missed deadlines of
both.

- publish, with the scene on the loopback interface: also the mean period and percentiles of its jitter, |period - 10
  ms|, of the bare loop, of the samples when they are published, and when a third process receives them. It needs the
  package 'cyclonedds'.
- live, behind a page that a browser of nice 19 renders in software, and whose target it sets; then, for half that time
  and with a browser of nice 0, the delay from a change of the target to the first change of the arm in the page. It
  needs Chromium, 'websockets' and 'playwright'.

Run nothing else on the machine.
"""

from __future__ import annotations

import math
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import twodof
from twodof.simulation.pace import RealTime

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


def print_missed(pace: RealTime, count: int) -> None:
    worst = f"worst {1e3 * pace.worst:.1f} ms"
    print(f"           {pace.missed} of {count} deadlines missed, {worst}", flush=True)


def bare(seconds: str) -> None:
    """Run a loop that only sleeps."""
    print("ready", flush=True)
    pace, times = RealTime(), []
    for k in range(round(float(seconds) / STEP)):
        pace.wait(k * STEP)
        times.append(time.perf_counter())
    account("bare loop", times)
    print_missed(pace, len(times))


def receive() -> None:
    """Receive JointStates until none arrives for a second."""
    from cyclonedds.core import ReadCondition, SampleState, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from twodof.ros.messages import JOINT_STATE, STREAM
    from twodof.ros.network import Network, dds_qos, dds_type, open_domain

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


def browse(url: str, seconds: str, nice: str) -> None:
    """Keep the page open, and change the target now and then; print delays in s."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    import browser

    os.nice(int(nice))
    with browser.chromium() as chromium, browser.opened(chromium, url, begin="") as page:
        page.wait_for_timeout(5000)  # shaders are compiled, the page has settled
        print("ready", flush=True)
        end = time.monotonic() + float(seconds)
        while time.monotonic() < end:
            for x in (0.17, 0.2):
                print(browser.latency(page, "x_des[1], m", x), flush=True)
                page.wait_for_timeout(800)


def beside(part: str, *arguments: object) -> subprocess.Popen[str]:
    """Start a part of this file in its own process, and wait until it is ready."""
    command = [sys.executable, __file__, part, *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    return process


class Clock(twodof.Sink):
    """A sink that records the arrival times of samples."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def write(self, sample: object) -> None:
        self.times.append(time.perf_counter())


def publish(fmu: Path, seconds: float) -> None:
    from twodof.ros.network import Network

    run = twodof.experiment(fmu, stop_time=seconds, step=STEP)
    receiver, alone = beside("receive"), beside("bare", seconds)
    pace, clock = RealTime(), Clock()
    publisher = twodof.Publisher(Network(DOMAIN, loopback=True), scene=True)
    twodof.simulate(run, clock, publisher, pace=pace)
    print(alone.communicate()[0], end="")
    account("published", clock.times)
    print_missed(pace, len(clock.times))
    print(receiver.communicate()[0], end="")


def live(fmu: Path, seconds: float) -> None:
    from twodof.pages.live_page import page_of
    from twodof.pages.loop import Loop

    run = twodof.experiment(fmu, step=STEP, stop_time=math.inf)
    loop, ended = Loop(run), threading.Event()

    def watch() -> None:
        viewer = beside("browse", page.url, seconds + 2, 19)
        alone = beside("bare", seconds)
        # only now: to start a process holds the loop up that starts it
        loop.pace.missed, loop.pace.worst, loop.steps = 0, 0.0, 0
        print(alone.communicate()[0], end="")
        print("live")
        print_missed(loop.pace, loop.steps)
        viewer.communicate()
        out, _ = beside("browse", page.url, seconds / 2, 0).communicate()
        delays = [*map(float, out.split())]
        print(
            f"target set in the browser to first change of the arm there: median"
            f" {1e3 * statistics.median(delays):.0f} ms, worst {1e3 * max(delays):.0f} ms,"
            f" {sum(delay <= 0.1 for delay in delays)} of {len(delays)} within 100 ms"
        )
        ended.set()

    with page_of(loop, run, "127.0.0.1", 0) as page:
        thread = threading.Thread(target=watch)
        thread.start()
        loop.play(ended.is_set)
        thread.join()


def main(what: str, seconds: str = "60", flavour: str = "native") -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        options = twodof.FmuOptions(native=flavour != "python")
        fmu = twodof.build_fmu(Path(folder) / "TwoDof.fmu", options)
        {"publish": publish, "live": live}[what](fmu, float(seconds))


if __name__ == "__main__":
    parts = {"bare": bare, "receive": receive, "browse": browse}
    part, *rest = sys.argv[1:] or ["publish"]
    parts[part](*rest) if part in parts else main(part, *rest)
