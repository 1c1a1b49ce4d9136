"""How well ``twodof live`` keeps time, against a bare sleep loop at the same time.

    python benchmarks/live.py [SECONDS] [python|native]

Steps the default arm every 10 ms behind a page that a browser of nice 19 has open, renders in
software and sets the target of; a second process does nothing but sleep until each 10 ms. Prints
what both missed. Then, for half that time and with a browser of nice 0: how long it takes there
from a change of the target to the first change of the arm. Needs chromium and the packages
'websockets' and 'playwright'.
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

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

STEP = 0.01


def bare_loop(seconds: float) -> None:
    """Print how many deadlines a loop missed that does nothing else, and the worst in s."""
    from twodof.simulation.pace import RealTime

    print("begins", flush=True)
    pace = RealTime()
    for k in range(round(seconds / STEP)):
        pace.wait(k * STEP)
    print(pace.missed, pace.worst)


def browse(url: str, seconds: float, nice: int) -> None:
    """Keep the page open, and change the target now and then; print delays in s."""
    import browser

    os.nice(nice)
    with browser.chromium() as chromium, browser.opened(chromium, url, begin="") as page:
        print("open", flush=True)
        page.wait_for_timeout(3000)  # shaders are compiled, the page has settled
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for x in (0.17, 0.2):
                print(browser.latency(page, "x_des[1], m", x), flush=True)
                page.wait_for_timeout(800)


def main() -> None:
    """Measure and print."""
    if sys.argv[1:2] == ["--bare"]:
        return bare_loop(float(sys.argv[2]))
    if sys.argv[1:2] == ["--browse"]:
        return browse(sys.argv[2], float(sys.argv[3]), int(sys.argv[4]))
    seconds = float(sys.argv[1]) if sys.argv[1:] else 60.0
    from twodof import FmuOptions, build_fmu
    from twodof.pages.live import page_of
    from twodof.pages.loop import Loop
    from twodof.simulation.experiments import experiment

    with tempfile.TemporaryDirectory() as folder:
        native = sys.argv[2:3] != ["python"]
        fmu = build_fmu(Path(folder) / "TwoDof.fmu", FmuOptions(native=native))
        run = experiment(fmu, step=STEP, stop_time=math.inf)
        loop = Loop(run)
        with page_of(loop, run, "127.0.0.1", 0) as page:
            ended = threading.Event()
            bare, live, delays = [], [], []

            def begin_browser(seconds: float, nice: int) -> subprocess.Popen[str]:
                command = [sys.executable, __file__, "--browse", page.url, f"{seconds}", f"{nice}"]
                viewer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
                assert viewer.stdout is not None and viewer.stdout.readline() == "open\n"
                time.sleep(2.0)
                return viewer

            def watch() -> None:
                viewer = begin_browser(seconds + 2, 19)
                command = [sys.executable, __file__, "--bare", f"{seconds}"]
                alone = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
                assert alone.stdout is not None and alone.stdout.readline() == "begins\n"
                # only now: to start a process holds the loop up that starts it
                loop.pace.missed, loop.pace.worst, loop.steps = 0, 0.0, 0
                out, _ = alone.communicate()
                live.extend([loop.pace.missed, loop.pace.worst, loop.steps])
                bare.extend(map(float, out.split()))
                viewer.communicate()
                out, _ = begin_browser(seconds / 2, 0).communicate()
                delays.extend(map(float, out.split()))
                ended.set()

            thread = threading.Thread(target=watch)
            thread.start()
            loop.play(ended.is_set)
            thread.join()
    count = round(seconds / STEP)
    print(f"bare loop  {bare[0]:6.0f} of {count} missed, worst {1e3 * bare[1]:.1f} ms")
    print(f"live       {live[0]:6d} of {live[2]} missed, worst {1e3 * live[1]:.1f} ms")
    print(
        f"target set in the browser to first change of the arm there: median"
        f" {1e3 * statistics.median(delays):.0f} ms, worst {1e3 * max(delays):.0f} ms,"
        f" {sum(delay <= 0.1 for delay in delays)} of {len(delays)} within 100 ms"
    )


if __name__ == "__main__":
    main()
