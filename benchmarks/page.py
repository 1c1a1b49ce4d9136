"""Cost of pages in a browser: time until ready, of a frame, and of a drag.

    python benchmarks/page.py [ARM.html|PLOT.html ...]

It opens each page from its file in headless Chromium, without a network, with software rendering in a window of 900 ×
560. Without arguments, it makes the pages of the default arm and of a Panda under pose control, and the plot of one
hour of that Panda at 100 Hz (some minutes). It prints

- the size, and, next to those of an empty page, the time from navigation until the page is ready and the processor time
  of all browser processes until then;
- for a running arm: frames a second, processor time of a frame, largest delay of the plant behind the clock, and
  longest frame, which bounds this delay;
- for a dragged target: the time from the event until the frame after the one that shows it begins.

Other programs lengthen the times, but hardly the processor times. It needs Chromium and the packages 'playwright',
'psutil' and 'example-robot-data'.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
from arms import ROBOTS
from playwright.sync_api import Browser, Page

import twodof

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import browser

SECONDS = 10.0  # of frames
DRAGS = 30
HOUR = 3600.0  # s
READY = """() => new Promise(resolve => {
    const look = () => document.querySelector("[data-ready]")
        ? requestAnimationFrame(() => resolve(performance.now())) : setTimeout(look, 5);
    look();
})"""
FRAMES = """seconds => new Promise(resolve => {
    const frames = [];
    const frame = now => {
        frames.push([now / 1000, arm.time(arm.k)]);
        if (now / 1000 - frames[0][0] < seconds) requestAnimationFrame(frame);
        else resolve(frames);
    };
    requestAnimationFrame(frame);
})"""
DELAYS = """() => {
    globalThis.delays = [];
    document.querySelector("canvas").addEventListener("pointermove", event => {
        requestAnimationFrame(() => requestAnimationFrame(now => {
            delays.push(now - event.timeStamp);
        }));
    });
}"""


def main() -> None:
    """Measure and print."""
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} before it")
    with tempfile.TemporaryDirectory() as name, browser.chromium() as chromium:
        empty = Path(name) / "empty.html"
        empty.write_text("<canvas data-ready></canvas>")
        measure(chromium, empty)
        for path in map(Path, sys.argv[1:]) if sys.argv[1:] else pages(Path(name)):
            measure(chromium, path)


def pages(folder: Path) -> Iterator[Path]:
    """Make the default pages."""
    arm = twodof.build_fmu(folder / "arm.fmu", twodof.FmuOptions(native=True))
    yield twodof.page(arm, folder / "arm.html")
    robot = {
        "urdf": ROBOTS / "panda_description/urdf/panda.urdf",
        "mesh_dir": ROBOTS.parent,
        "frame": "panda_hand_tcp",
        "native": True,
    }
    options = twodof.FmuOptions(**robot, control="pose")
    panda = twodof.build_fmu(folder / "panda.fmu", options)
    yield twodof.page(panda, folder / "panda.html")
    random = np.random.default_rng(0)
    changes = [(t, {"x_des": random.uniform((0.3, -0.2, 0.3), (0.6, 0.2, 0.6))}) for t in np.arange(0.0, HOUR, 5.0)]
    run = twodof.experiment(panda, stop_time=HOUR, changes=changes)
    twodof.simulate(run, twodof.Bag(folder / "hour", effort=True))
    plot = [sys.executable, "-m", "twodof", "plot", "hour", "-o", "hour.html"]
    subprocess.run(plot, cwd=folder, check=True, capture_output=True)
    yield folder / "hour.html"


def measure(chromium: Browser, path: Path) -> None:
    """Open a page, and print its cost."""
    with chromium.new_context(viewport=browser.VIEWPORT, offline=True) as context:
        context.set_default_timeout(1e3 * browser.TIMEOUT)
        page = context.new_page()
        with spent() as processor:
            page.goto(path.absolute().as_uri(), wait_until="commit")
            ready = page.evaluate(READY) / 1000
        print(
            f"{path.name}: {path.stat().st_size / 1e6:.2f} MB, ready after {ready:.2f} s"
            f" ({processor[0]:.2f} s of processor time)"
        )
        if page.locator("#arm-scene").count():
            frames(page)
            if page.evaluate("arm.groups.has('x_des')"):
                drag(page)


def frames(page: Page) -> None:
    """Print frame rate and delays of a running arm."""
    page.wait_for_timeout(1000)
    with spent() as processor:
        shown = np.array(page.evaluate(FRAMES, SECONDS))  # when, and the time of the arm
    between = np.diff(shown[:, 0])
    late = shown[:, 0] - shown[0, 0] - (shown[:, 1] - shown[0, 1])
    print(
        f"  {1 / between.mean():.0f} frames a second, {1e3 * processor[0] / len(shown):.0f} ms of"
        f" processor time each; the plant late by at most {1e3 * late.max():.0f} ms, longest frame"
        f" {1e3 * between.max():.0f} ms"
    )


def drag(page: Page) -> None:
    """Print the delays of dragging a target."""
    page.locator("#arm-reset").click()
    place = browser.target_place(page)
    before = page.evaluate("arm.held('x_des')")
    page.evaluate(DELAYS)
    page.mouse.move(*place)
    page.mouse.down()
    for i in range(DRAGS):
        page.mouse.move(place[0] - i, place[1])
        page.wait_for_timeout(100)
    page.mouse.up()
    page.wait_for_timeout(200)
    assert page.evaluate("arm.held('x_des')") != before
    delays = page.evaluate("delays")
    print(f"  a drag is seen after {statistics.median(delays):.0f} ms, at most {max(delays):.0f} ms")


@contextmanager
def spent() -> Iterator[list[float]]:
    """Measure the processor time, s, of all browser processes during the context."""
    before, seconds = processor_time(), [0.0]
    yield seconds
    seconds[0] = processor_time() - before


def processor_time() -> float:
    """Return the processor time of all descendants of this process, s, including ended ones."""
    total = 0.0
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # it has ended since
            total += sum(child.cpu_times()[:4])
    return total


if __name__ == "__main__":
    main()
