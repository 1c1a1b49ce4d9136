"""Interactive pages of runs: the data for plotly, and the page in a browser."""

import base64
import re
import shutil
from html.parser import HTMLParser
from typing import Any

import browser
import numpy as np
import plotly.graph_objects
import pytest
from recordings import long_run

from twodof.plots.figure import save
from twodof.plots.interactive import in_workspace, over_time
from twodof.plots.runs import drawing
from twodof.plots.track import read_tracks


def traces(figure: dict[str, Any], joint: str, kind: str) -> list[np.ndarray]:
    """Curves of a figure on a page, N × 2 each, from little-endian doubles."""

    def numbers(packed: dict[str, str]) -> np.ndarray:
        assert packed["dtype"] == "f8"
        return np.frombuffer(base64.b64decode(packed["bdata"]), "<f8")

    return [
        np.column_stack([numbers(trace["x"]), numbers(trace["y"])])
        for trace in figure["data"]
        if trace["meta"][1:] == [joint, kind]
    ]


def test_a_page_has_the_curves_of_the_bags(gains):
    """plotly itself reads them; it refuses unknown properties."""
    tracks = read_tracks([gains[20].bag, gains[50].bag])
    time, view = over_time(tracks), *in_workspace(tracks)
    for figure in (time, view):
        plotly.graph_objects.Figure(figure)
    for i, recording in enumerate((gains[20], gains[50])):
        for j in range(2):
            for kind in ("q", "v"):
                found = traces(time, f"joint{j + 1}", kind)[i]
                np.testing.assert_allclose(found[:, 0], recording.t, rtol=1e-15)
                np.testing.assert_array_equal(found[:, 1], getattr(recording, kind)[:, j])
        error = np.linalg.norm(recording.x - (0.2, 0.05), axis=1)
        np.testing.assert_allclose(traces(time, "", "error")[i][:, 1], error, atol=1e-15)


def test_a_page_of_an_hour_is_small_and_names_the_omitted_parts(default, tmp_path):
    """It keeps extremes, and a jump of one sample in a curve with larger swings."""
    n, jumps = 360_000, np.array([11_113, 130_077, 347_042])
    noise = np.random.default_rng(0).normal(scale=0.01, size=(n, 2))
    noise[41_152] = 0.3, -0.2  # a spike of one sample
    run = long_run(default, np.array([0.5, 0.35]) + noise)
    run.v[:] = np.sin(np.arange(n) / 120)[:, None]
    for k in jumps:
        run.v[k:, 0] += 0.2
    tracks = read_tracks([run])
    over = over_time(tracks)
    (line,), (jumping,) = traces(over, "joint1", "q"), traces(over, "joint1", "v")
    at = np.rint(line[:, 0] * 1000).astype(int)
    np.testing.assert_array_equal(run.q[at, 0], line[:, 1])
    for part in np.array_split(np.arange(n), 500):
        kept = line[(at >= part[0]) & (at <= part[-1]), 1]
        assert (kept.min(), kept.max()) == (run.q[part, 0].min(), run.q[part, 0].max())
    assert {*jumps, *jumps - 1} <= {*np.rint(jumping[:, 0] * 1000).astype(int)}
    page = save(drawing(tracks), tmp_path / "hour.html")
    assert page.stat().st_size <= 6e6
    (told,) = re.findall(r"'Kp50' is drawn through at most (\d+) of 360000 samples", page.read_text("utf-8"))
    assert max(len(line), len(jumping)) <= int(told) <= 30_000


class Links(HTMLParser):
    """Resources that a page would load or run."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("link", "iframe", "object", "embed", "image", "img"):
            self.found.append((tag, ""))
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "data", "action") and (value or "")[:1] != "#":
                self.found.append((tag, str(value)))


def test_a_page_needs_no_network(default, tmp_path):
    """Names in it are shown as text."""
    bag = tmp_path / "<script src=x> & co"
    shutil.copytree(default.bag, bag)
    page = save(drawing(read_tracks([bag])), tmp_path / "a.html").read_text("utf-8")
    links = Links()
    links.feed(page)
    assert links.found == []
    assert "url(http" not in page
    assert "is drawn through" not in page
    assert "@import" not in page
    assert "&lt;script src=x&gt; &amp; co" in page


SEEN = """() => {
  const y = (place) =>
    place._fullData.filter((t) => t.visible === true).map((t) => t.meta.join(" "));
  const [time, view] = document.querySelectorAll(".plot");
  return { time: y(time), view: y(view) };
}"""


@pytest.fixture(scope="module")
def chromium():
    with browser.chromium() as started:
        yield started


def test_a_page_answers(gains, chromium, tmp_path):
    """Boxes switch joints and bags in all figures, and the cursor shows the values of all panels."""
    tracks = read_tracks([gains[20].bag, gains[50].bag])
    page = save(drawing(tracks), tmp_path / "a.html")
    said: list[str] = []
    with chromium.new_context(offline=True) as context:
        shown = context.new_page()
        shown.on("console", lambda message: said.append(message.text))
        shown.on("pageerror", lambda error: said.append(str(error)))
        shown.goto(page.as_uri())
        shown.wait_for_selector("#plots[data-ready]")
        whole = shown.evaluate(SEEN)
        assert {"0 joint1 q", "1 joint2 v", "1  error"} <= set(whole["time"])
        boxes = shown.locator("#legend input")  # Kp 20, its joints, Kp 50, its joints
        boxes.nth(1).click()
        assert "0 joint1 q" not in shown.evaluate(SEEN)["time"]
        assert shown.evaluate(SEEN)["view"] == whole["view"]
        boxes.nth(1).click()
        boxes.nth(3).click()
        seen = shown.evaluate(SEEN)
        assert {meta[0] for meta in seen["time"]} == {"0"}
        assert "1  " not in seen["view"]
        boxes.nth(3).click()
        panel = shown.locator(".plot .xy").first.bounding_box()
        assert panel is not None
        shown.mouse.move(panel["x"] + 0.4 * panel["width"], panel["y"] + 0.5 * panel["height"])
        cells = shown.locator("#legend tr").nth(5).locator("td")
        browser.until(shown, lambda words: words != "", lambda _: cells.nth(1).inner_text())
        told = float(shown.locator("#legend th").first.inner_text().split()[0])
        k = int(np.argmin(np.abs(gains[50].t - told)))
        assert told == pytest.approx(2.0, abs=0.1)
        found = [float(cells.nth(i).inner_text().replace("−", "-")) for i in (1, 2)]
        assert found == pytest.approx([gains[50].q[k, 0], gains[50].v[k, 0]], rel=1e-4)
        ended = shown.locator("#legend tr").nth(2).locator("td")  # Kp 20, which lasts 1 s
        assert ended.all_inner_texts()[1:] == ["", "", ""]
        shown.mouse.move(panel["x"] + 0.1 * panel["width"], panel["y"] + 0.5 * panel["height"])
        browser.until(shown, lambda words: words != "", lambda _: ended.nth(1).inner_text())
    assert said == []


def test_buttons_of_a_page_cover_no_heading(default, chromium, tmp_path):
    """This includes phones, where they are always visible."""
    page = save(drawing(read_tracks([default.bag])), tmp_path / "a.html")
    phone = {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "has_touch": True}
    with chromium.new_context(offline=True, **phone) as context:
        shown = context.new_page()
        shown.goto(page.as_uri())
        shown.wait_for_selector("#plots[data-ready]")
        for plot in shown.locator(".plot").all():
            buttons = plot.locator(".modebar").bounding_box()
            heading = plot.locator(".annotation-text").first.bounding_box()
            assert buttons["width"] > 40 and heading["width"] > 40
            assert buttons["y"] + buttons["height"] <= heading["y"]
