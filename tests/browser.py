"""A browser on a page of ``twodof view`` or ``twodof live``, and the command that serves the page."""

import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import numpy as np
import websockets.sync.client
from PIL import Image, ImageDraw
from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright
from scipy import ndimage
from scipy.spatial import ConvexHull
from tools import needs

LINKS = (
    lambda r, g, b: (r < 110) & (g < 120) & (b < 130) & (b >= r),
    lambda r, g, b: (r > 190) & (g > 110) & (g < 180) & (b < 100),
)
"""Colours of the default arm's two links."""
TIMEOUT = 120.0  # s: a guard against hanging; a busy machine takes its time
VIEWPORT: ViewportSize = {"width": 900, "height": 560}
ARGUMENTS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
HOSTILE = (
    "<img src=x onerror=\"document.title='ran'\"><script>document.title='ran'</script>"
    "<iframe srcdoc=\"<script>parent.document.title='ran'</script>\"></iframe>"
    "[link](javascript:document.title='ran') &lt;"
)
"""Text that a page must show as it is."""
COMMAND = [sys.executable, "-m", "twodof"]
READY = "#arm-scene[data-ready]"
ROWS = """() => ({
    time: document.getElementById("arm-time").textContent,
    ...Object.fromEntries([...document.querySelectorAll("[data-value]")].map(
        cell => [cell.dataset.value, cell.textContent.replaceAll("\\u2212", "-")])),
})"""
DRAWN = """async () => {
    for (let i = 0; i < 3; i++) await new Promise(requestAnimationFrame);
}"""
EVERY_OTHER_FRAME = """{
    const next = requestAnimationFrame.bind(window);
    window.requestAnimationFrame = (show) => next(() => next(show));
}"""
"""To draw in software 30 times a second in place of 60 leaves a processor to who runs beside it."""
EVEN_FRAMES = """{
    const next = requestAnimationFrame.bind(window);
    let time = performance.now();
    window.requestAnimationFrame = (show) => next(() => show((time += 35)));
}"""
"""Frames of 35 ms each, however slow the machine is: a page of slow frames leaves the shadow out."""
AT_REST = """async () => {
    const asked = () => arm.news === undefined || arm.news.received === arm.sent && !arm.news.playing;
    if (arm.playing || !asked()) return false;
    const {run, count} = arm;
    await new Promise((resolve) => setTimeout(resolve, 200));
    for (let i = 0; i < 3; i++) await new Promise(requestAnimationFrame);
    return !arm.playing && asked() && arm.run === run && arm.count === count;
}"""
"""Script that tells whether the arm stands still for longer than a step, news of it and a picture of the numbers
take, so that these are shown as they are now."""
NOTES = ".arm .bar, .arm .message { visibility: hidden }"
LATENCY = """([label, text, row]) => new Promise(resolve => {
    const cell = document.querySelector(`[data-value="${row}"]`), before = cell.textContent;
    const field = document.querySelector(`input[aria-label="${label}"]`);
    field.value = text;
    const start = performance.now();
    field.dispatchEvent(new Event("change"));
    const observer = new MutationObserver(() => {
        if (cell.textContent !== before) {
            observer.disconnect();
            resolve((performance.now() - start) / 1000);
        }
    });
    observer.observe(cell, {childList: true, characterData: true});
})"""


@contextmanager
def chromium() -> Iterator[Browser]:
    """A headless browser with software rendering."""
    program = needs("chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=ARGUMENTS, timeout=1e3 * TIMEOUT)
        yield browser
        browser.close()


@contextmanager
def opened(
    browser: Browser, url: str, *, ready: str = READY, scale: int = 1, begin: str = EVERY_OTHER_FRAME
) -> Iterator[Page]:
    """A page that is shown, on a screen of so many pixels for one of the page's, and that begins
    with a script; at its end, no error is in its console but of a server that has ended."""
    with browser.new_context(viewport=VIEWPORT, device_scale_factor=scale) as context:
        context.set_default_timeout(1e3 * TIMEOUT)
        page = context.new_page()
        page.add_init_script(begin)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
        page.goto(url)
        page.wait_for_selector("canvas")
        page.wait_for_selector(ready)
        yield page
        errors = [error for error in errors if not error.startswith("WebSocket connection to")]
        assert errors == [], errors


class Served:
    """A command that serves a page: started, its URL read; ended by Ctrl-C."""

    def __init__(self, *arguments: str | Path, cwd: Path, port: int = 0) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, *map(str, arguments), "--port", str(port), "--no-browser"],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "XDG_STATE_HOME": str(cwd / "state")},
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        found = re.match(r"open +(http://127\.0\.0\.1:\d+\S*)", line)
        if not found:
            self.process.kill()
            raise AssertionError(line + self.process.communicate()[1])
        self.url = found[1]

    def interrupt(self, number: int = signal.SIGINT) -> tuple[int, str, str]:
        """Send Ctrl-C; return the exit status and the texts on stdout and stderr."""
        self.process.send_signal(number)
        output, errors = self.process.communicate(timeout=TIMEOUT)
        return self.process.returncode, output, errors

    def children(self) -> list[int]:
        """Its child processes."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return [int(word) for word in children.read_text().split()]

    def status(self, name: str, pid: int | None = None) -> int:
        """A number of /proc/…/status, e.g. Threads, or VmRSS in KiB."""
        text = Path(f"/proc/{pid or self.process.pid}/status").read_text()
        return int(re.findall(rf"^{name}:\s+(\d+)", text, re.M)[0])


@contextmanager
def served(*arguments: str | Path, cwd: Path, port: int = 0) -> Iterator[Served]:
    """A command that is asked to end if it still runs, so that it removes its temporary folder."""
    command = Served(*arguments, cwd=cwd, port=port)
    try:
        yield command
    finally:
        try:
            command.process.terminate()
            command.process.communicate(timeout=TIMEOUT)
        finally:
            command.process.kill()


def socket_of(url: str) -> str:
    """The websocket of a page, with the page's token."""
    parts = urlsplit(url)
    return urlunsplit(parts._replace(scheme="ws", path="/socket"))


def connect(url: str) -> None:
    """Connect as a browser with the open page does, and disconnect at once."""
    with websockets.sync.client.connect(socket_of(url)) as connection:
        connection.recv()
        time.sleep(0.1)


UPGRADE = (
    ("Connection", "Upgrade"),
    ("Upgrade", "websocket"),
    ("Sec-WebSocket-Version", "13"),
    ("Sec-WebSocket-Key", "MDEyMzQ1Njc4OWFiY2RlZg=="),
)


NOBODY = 65534


def connected(url: str, host: str) -> socket.socket:
    """A connection by a program of another user than root, to whom the socket belongs."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(NOBODY)
    try:
        return socket.create_connection((host, urlsplit(url).port or 0), timeout=60)
    finally:
        if root:
            os.seteuid(0)


def answer(url: str, *headers: tuple[str, str], path: str = "/") -> int:
    """The status of the answer to a request with these headers and no others."""
    with closing(HTTPConnection(urlsplit(url).netloc, timeout=60)) as connection:
        connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
        for header in headers:
            connection.putheader(*header)
        connection.endheaders()
        return connection.getresponse().status


def hostile_arm() -> ET.Element:
    """The URDF of the default arm with spheres for meshes, and with names that begin with HOSTILE."""
    robot = ET.parse(Path(__file__).parents[1] / "urdf/2dof.urdf").getroot()
    for element in robot.iter():
        for key in {"name", "link"} & element.attrib.keys():
            element.set(key, HOSTILE + element.attrib[key])
    for mesh in robot.iter("mesh"):
        mesh.tag, mesh.attrib = "sphere", {"radius": "0.02"}
    first = robot.findall("joint")[0]
    first.set("name", f"1 {first.get('name')}")  # of names alike, pages show the rest
    return robot


def assert_shown_as_text(page: Page, *texts: str) -> None:
    """Assert that HOSTILE and the text after it are shown literally, and that no part becomes an element or runs."""
    page.wait_for_timeout(500)  # a script would run by now
    assert page.title() != "ran"
    for text in texts:
        assert page.get_by_text(HOSTILE + text).count() > 0, text
    assert page.locator("img[src=x], iframe, a[href^=javascript], a:text-is('link')").count() == 0


def rows(page: Page) -> dict[str, str]:
    """The readout at one moment, and its time."""
    return page.evaluate(ROWS)


def samples(page: Page) -> np.ndarray:
    """All samples, N × values; as text, which the browser transfers faster than numbers."""
    held = "[...arm.data.subarray(0, arm.count * arm.width)]"
    width, text = page.evaluate(f"[arm.width, JSON.stringify({held})]")
    return np.array(json.loads(text)).reshape(-1, width)


def numbers(text: str) -> list[float]:
    """Numbers in a text."""
    return [float(word) for word in re.findall(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?", text)]


def until(page: Page, condition: Callable[[Any], bool], look: Callable[[Page], Any] = rows) -> Any:
    """Return a page's text, by default its readout, when it meets a condition."""
    end = time.monotonic() + TIMEOUT
    while not condition(found := look(page)):
        assert time.monotonic() < end, found
        page.wait_for_timeout(20)
    return found


def at_rest(page: Page) -> dict[str, str]:
    """The readout when the arm is at rest and everything is shown."""
    until(page, bool, lambda page: page.evaluate(AT_REST))
    return rows(page)


def press(page: Page, name: str) -> None:
    """Press a button whose label begins with a text."""
    page.get_by_role("button", name=re.compile(f"^{name}")).first.click()


def type_into(page: Page, label: str, value: float) -> None:
    """Type a number into the field with a label."""
    field = page.get_by_label(label, exact=True)
    field.evaluate("(field) => { field.closest('details').open = true; }")
    field.fill(f"{value:g}")
    field.press("Enter")


def latency(page: Page, label: str, value: float) -> float:
    """Time from a change of the field to the first change of the end effector, s."""
    return float(page.evaluate(LATENCY, [label, f"{value}", "end effector"]))


def picture(page: Page) -> np.ndarray:
    """Return the picture of the 3D scene without its notes, height × width × 3."""
    page.evaluate(DRAWN)
    return still(page)


def still(page: Page) -> np.ndarray:
    """The same for a page whose time stands still, so that it draws nothing."""
    shot = page.screenshot(clip=page.locator("canvas").first.bounding_box(), style=NOTES)
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))


def target_place(page: Page) -> tuple[float, float]:
    """The centre of the target's ball in the window, on a page with an arm."""
    ball = pixels(picture(page), lambda r, g, b: (r - b > 100) & (g < 105) & (r < 225))
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    x, y = np.median(ball, axis=0)
    return float(box["x"] + x), float(box["y"] + y)


def pixels(shown: np.ndarray, seen: Callable[..., np.ndarray]) -> np.ndarray:
    """The largest patch of pixels whose red, green and blue meet the conditions; x and y, N × 2."""
    patches, count = ndimage.label(seen(*np.moveaxis(shown.astype(int), -1, 0)))
    assert count > 0
    return np.argwhere(patches == np.bincount(patches.flat)[1:].argmax() + 1)[:, ::-1]


def area(shown: np.ndarray, seen: Callable[..., np.ndarray]) -> np.ndarray:
    """The convex hull of all such pixels except isolated ones; objects in front of them leave no gap."""
    points = np.argwhere(ndimage.binary_opening(seen(*np.moveaxis(shown.astype(int), -1, 0))))
    hull = Image.new("1", shown.shape[1::-1])
    corners = points[ConvexHull(points).vertices, ::-1]
    ImageDraw.Draw(hull).polygon([(int(x), int(y)) for x, y in corners], fill=1)
    return np.argwhere(np.asarray(hull))[:, ::-1]


def direction(link: np.ndarray) -> float:
    """Return the direction of a patch's longest extent, rad, or the opposite; y of its pixels is downwards."""
    x, y = np.linalg.eigh(np.cov(link.T))[1][:, -1]
    return float(np.arctan2(-y, x))


def colours(shown: np.ndarray) -> int:
    """Number of different colours."""
    return len(np.unique(shown.reshape(-1, 3), axis=0))
