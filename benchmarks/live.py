"""How well ``twodof live`` keeps time, against a bare sleep loop at the same time.

    python benchmarks/live.py [SECONDS] [python|native]

Steps the default arm every 10 ms behind a page that a browser of nice 19 has open, renders in
software and drags the target of; a second process does nothing but sleep until each 10 ms. Prints
what both missed, and how long it took from a change of the target in the browser to the first
change of the arm's picture there. Needs chromium and the packages 'viser' and 'playwright'.
"""

from __future__ import annotations

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
    from twodof.master import RealTime

    pace = RealTime()
    for k in range(round(seconds / STEP)):
        pace.wait(k * STEP)
    print(pace.missed, pace.worst)


def browse(url: str, seconds: float) -> None:
    """Keep the page open, and change the target now and then; print delays in s."""
    import browser

    os.nice(19)
    with browser.chromium() as chromium, browser.opened(chromium, url) as page:
        print("open", flush=True)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for x in (0.17, 0.2):
                print(browser.latency(page, "x", x), flush=True)
                page.wait_for_timeout(1500)


def main() -> None:
    """Measure and print."""
    if sys.argv[1:2] == ["--bare"]:
        return bare_loop(float(sys.argv[2]))
    if sys.argv[1:2] == ["--browse"]:
        return browse(sys.argv[2], float(sys.argv[3]))
    seconds = float(sys.argv[1]) if sys.argv[1:] else 60.0
    from twodof import FmuOptions, build_fmu
    from twodof.live import Loop, page_of
    from twodof.master import endless

    with tempfile.TemporaryDirectory() as folder:
        native = sys.argv[2:3] != ["python"]
        fmu = build_fmu(Path(folder) / "TwoDof.fmu", FmuOptions(native=native))
        run = endless(fmu, step=STEP)
        loop = Loop(run)
        with page_of(loop, run, "127.0.0.1", 0) as (url, page):
            ended = threading.Event()
            bare, delays = [], []

            def watch() -> None:
                me = [sys.executable, __file__]
                command = [*me, "--browse", url, f"{seconds}"]
                viewer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
                assert viewer.stdout is not None and viewer.stdout.readline() == "open\n"
                time.sleep(2.0)
                loop.pace.missed, loop.pace.worst, loop.steps = 0, 0.0, 0
                alone = subprocess.run(
                    [*me, "--bare", f"{seconds}"], capture_output=True, text=True, check=True
                )
                bare.extend(map(float, alone.stdout.split()))
                delays.extend(map(float, viewer.stdout.read().split()))
                ended.set()

            thread = threading.Thread(target=watch)
            thread.start()
            loop.play(page, ended.is_set)
            thread.join()
    steps, pace = loop.steps, loop.pace
    count = round(seconds / STEP)
    print(f"bare loop  {bare[0]:6.0f} of {count} missed, worst {1e3 * bare[1]:.1f} ms")
    print(f"live       {pace.missed:6d} of {steps} missed, worst {1e3 * pace.worst:.1f} ms")
    if delays:
        print(
            f"target set in the browser to first change of the arm there: median"
            f" {1e3 * statistics.median(delays):.0f} ms, worst {1e3 * max(delays):.0f} ms"
            f" of {len(delays)}"
        )


if __name__ == "__main__":
    main()
