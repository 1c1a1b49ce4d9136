"""The content of a sweep's map, and the report of its best runs."""

import io
import json
import re
import struct
from pathlib import Path
from typing import Any

import browser
import numpy as np
import pytest
from bags import HEADER, channel, chunk, message, record, texts
from figures import points
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from PIL import Image
from tables import SMALL, table_of

from twodof import read_bag, sweep
from twodof.bag.mcap import zstd
from twodof.bag.recording import Recording
from twodof.bag.records import ReadBudget
from twodof.bounds import MAX_CHUNK
from twodof.cli.main import main
from twodof.plots import maps
from twodof.plots.figure import drawn, save
from twodof.plots.sweeps import drawing
from twodof.sweeps.ranking import METRICS
from twodof.sweeps.results import read_sweep


@pytest.fixture(scope="module")
def grid_sweep(native_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("sweep") / "whole"
    grid = {"Kp": np.linspace(10, 200, 20), "Kd": np.linspace(5, 80, 16)}
    sweep(native_path, grid=grid, stop_time=10, output=path)
    return path


def panels(path: Path) -> dict[str, Axes]:
    figure = drawn(drawing(read_sweep(path), "a"))
    labels = [str(axes.get_label()) for axes in figure.axes]
    return {label: axes for label, axes in zip(labels, figure.axes) if " over " in label}


LINES = """() => [...document.querySelectorAll(".runs td")].map(cell => {
    const words = document.createRange();
    words.selectNodeContents(cell);
    return new Set([...words.getClientRects()].map(box => box.top)).size;
})"""


def test_a_page_of_maps_has_their_colours_in_the_dark_and_whole_numbers_on_a_phone(grid_sweep, tmp_path):
    page = save(drawing(read_sweep(grid_sweep), "a"), tmp_path / "a.html")
    seen = []
    with browser.chromium() as chromium:
        for scheme in ("light", "dark"):
            with chromium.new_context(color_scheme=scheme, offline=True) as context:
                context.set_default_timeout(1e3 * browser.TIMEOUT)
                shown = context.new_page()
                shown.set_viewport_size({"width": 390, "height": 844})
                shown.goto(page.as_uri())
                seen.append(shown.locator("body > svg[viewBox]").screenshot())
                ground = shown.evaluate("getComputedStyle(document.body).backgroundColor")
                shown.wait_for_selector("#maps[data-ready]", state="attached")
                behind = shown.evaluate("getComputedStyle(document.querySelector('#maps .bg')).fill")
                assert max(shown.evaluate(LINES)) == 1
                assert shown.evaluate("document.documentElement.scrollWidth") == 390
    assert ground == "rgb(20, 20, 20)"
    level = np.mean([int(part) for part in re.findall(r"\d+", behind)[:3]])
    assert 100 < level < 180, behind  # Viridis is from violet, which black hides, to yellow
    light, dark = (np.asarray(Image.open(io.BytesIO(picture))) for picture in seen)
    inner = (slice(2, -2), slice(2, -2))  # without the edge, which is mixed with the ground
    apart = np.abs(light[inner].astype(int) - dark[inner])
    assert apart.max() <= 1  # the browser inverts twice, and rounds where a pixel mixes two cells
    assert np.count_nonzero(apart) < 1e-4 * apart.size


def test_map_of_two_variables_holds_the_table_and_marks_the_best(grid_sweep):
    table = table_of(grid_sweep)
    found = panels(grid_sweep)
    told = ("settling_time", "overshoot", "final_error", "rms_error", "peak_effort", "chatter")
    assert list(found) == [f"{metric} over Kp and Kd" for metric in (*told, "peak_velocity")]
    for label, axes in found.items():
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("Kp, s⁻²", "Kd, s⁻¹")
        metric = label.split()[0]
        (mesh,) = (c for c in axes.collections if isinstance(c, QuadMesh))
        values = mesh.get_array()
        assert values is not None
        cells = np.ma.filled(values, np.nan).reshape(16, 20)
        assert np.asarray(cells).T.ravel() == pytest.approx(table[metric].to_numpy(), nan_ok=True, abs=0)
        (below,) = (text.get_text() for text in axes.texts)
        ascending = np.sort(table[metric].dropna())
        if ascending[1] - ascending[0] > 1e-12:
            (best,) = np.asarray(axes.collections[-1].get_offsets())
            chosen = table[(table["Kp"] == best[0]) & (table["Kd"] == best[1])]
            assert chosen[metric].item() == ascending[0]
            assert below == f"★ {ascending[0]:.3g} at Kp {best[0]:g}, Kd {best[1]:g}"
        else:  # rounding ranks nothing
            assert metric in ("overshoot", "final_error")
            equal = np.count_nonzero(ascending - ascending[0] < 1e-12)
            assert below == f"least in {equal} runs: 0"
            assert not any(c.get_zorder() == 3 for c in axes.collections)
        edges = np.asarray(mesh.get_coordinates())
        x, y = edges[0, :, 0], edges[:, 0, 1]
        assert (x[:-1] + x[1:]) / 2 == pytest.approx(np.linspace(10, 200, 20))
        assert (y[:-1] + y[1:]) / 2 == pytest.approx(np.linspace(5, 80, 16))
        critical = points(axes.get_lines()[0])
        assert critical[:, 1] ** 2 == pytest.approx(4 * critical[:, 0])


def test_map_of_one_variable_is_curves(native_path, tmp_path):
    table = sweep(native_path, grid={"Kp": np.linspace(10, 90, 9)}, output=tmp_path / "s")
    for label, axes in panels(tmp_path / "s").items():
        metric = label.split()[0]
        x, y = axes.get_lines()[0].get_data()
        assert np.array(x) == pytest.approx(np.linspace(10, 90, 9))
        assert np.array(y) == pytest.approx(table[metric].to_numpy(), nan_ok=True, abs=0)


def test_map_of_three_variables_is_the_best_over_the_third(native_path, tmp_path):
    grid = {**SMALL, "tau_ext[1]": [-0.05, 0.0, 0.05]}
    table = sweep(native_path, grid=grid, stop_time=2.0, output=tmp_path / "s")
    found = panels(tmp_path / "s")
    assert len(found) == 9
    (mesh,) = (c for c in found["overshoot over Kp and Kd"].collections if isinstance(c, QuadMesh))
    values = mesh.get_array()
    assert values is not None
    cells = values.reshape(2, 3)
    for i, kd in enumerate(SMALL["Kd"]):
        for j, kp in enumerate(SMALL["Kp"]):
            runs = table[(table["Kp"] == kp) & (table["Kd"] == kd)]
            assert len(runs) == 3 and cells[i, j] == runs["overshoot"].min()


def test_map_of_random_values_is_dots(native_path, tmp_path):
    ranges = {"Kp": (10, 90), "Kd": (10, 30)}
    table = sweep(native_path, ranges=ranges, random=25, stop_time=2.0, output=tmp_path / "s")
    axes = panels(tmp_path / "s")["peak_effort over Kp and Kd"]
    dots = axes.collections[1]
    assert np.asarray(dots.get_offsets()) == pytest.approx(table[["Kp", "Kd"]].to_numpy(), abs=0)
    assert np.asarray(dots.get_array()) == pytest.approx(table["peak_effort"].to_numpy(), abs=0)


def test_plot_of_a_sweep_prints_the_best_runs(grid_sweep, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["plot", str(grid_sweep)]) == 0
    out = capsys.readouterr().out
    assert "plot  whole.png" in out and (tmp_path / "whole.png").stat().st_size > 20_000
    table = table_of(grid_sweep)
    best = table.sort_values(["settling_time", "peak_effort"]).iloc[0]
    assert "best: by settling time, then by peak effort" in out
    row = out.splitlines()[5].split()
    assert [float(cell) for cell in row[:4]] == pytest.approx(
        [best["run"], best["Kp"], best["Kd"], best["settling_time"]]
    )
    assert main(["plot", str(grid_sweep), str(grid_sweep)]) == 2
    assert "is a sweep; it is drawn alone" in capsys.readouterr().err
    found = drawing(read_sweep(grid_sweep), "a")
    assert f"{best['Kp']:g}" in save(found, tmp_path / "a.html").read_text("utf-8")


def test_where_no_run_settles_the_best_is_another(native_path, tmp_path, capsys):
    sweep(native_path, grid={"Kp": [20.0, 60.0]}, stop_time=0.05, output=tmp_path / "s")
    assert main(["info", str(tmp_path / "s")]) == 0
    out = capsys.readouterr().out
    assert "best: by peak effort, then by final error\n" in out
    assert "settl" not in out.partition("best:")[2]


POINT = """run => {
    const {div} = sweepPage.charts[0], {xaxis, yaxis} = div._fullLayout, {x, y} = div.data[0];
    const box = div.getBoundingClientRect();
    return [box.x + xaxis._offset + xaxis.d2p(x[run]), box.y + yaxis._offset + yaxis.d2p(y[run])];
}"""
"""Place of a run in the first map, in pixels of the window."""


def test_a_page_judges_no_run(native_path, tmp_path, monkeypatch):
    """Thousands of killed runs have no stored verdict."""
    folder = tmp_path / "s"
    sweep(native_path, grid={"Kp": [20, 60]}, stop_time=0.1, output=folder, bags=True)
    run = folder / "bags" / "000001" / "run.json"
    run.write_text(json.dumps({name: v for name, v in json.loads(run.read_text()).items() if name != "verdict"}))
    monkeypatch.setattr(Recording, "_judged", None)
    curves = maps._curves(read_sweep(folder), folder / "bags")
    assert [bool(curves[run]["verdict"]) for run in ("0", "1")] == [True, False]
    assert curves["1"]["lines"]


def test_the_bags_of_a_page_share_a_read_budget(native_path, tmp_path, monkeypatch):
    """Each of 2000 bags of 500 bytes could unpack to 64 MB of records."""
    folder, spent = tmp_path / "s", []
    sweep(native_path, grid={"Kp": [10, 20, 30, 40]}, stop_time=0.02, output=folder, bags=True)
    schema = record(3, struct.pack("<H", 1), texts("std_msgs/msg/String", "ros2msg", ""))
    records = schema + (channel(1, "/x") + message(b"")) * 100_000
    packed = zstd.compress(records)
    for bag in (folder / "bags").iterdir():
        (bag / f"{bag.name}.mcap").write_bytes(HEADER + chunk(packed, len(records), "zstd"))
    spend = ReadBudget.spend

    def counted(budget: ReadBudget, size: int) -> None:
        spent.append(size)
        spend(budget, size)

    monkeypatch.setattr(ReadBudget, "spend", counted)
    assert maps._curves(read_sweep(folder), folder / "bags") == {}
    assert sum(spent) < 1.5 * MAX_CHUNK


def test_a_click_in_the_map_opens_the_runs_curves(native_path, tmp_path):
    folder = tmp_path / "s"
    sweep(native_path, grid={"Kp": [20, 60, 100], "Kd": [10, 20]}, stop_time=1, output=folder, bags=True)
    page = save(drawing(read_sweep(folder), "s", bags=folder / "bags"), tmp_path / "s.html")
    with browser.chromium() as chromium, chromium.new_context(offline=True) as context:
        shown = context.new_page()
        for width, run in ((1200, 4), (1200, 1), (390, 4), (390, 1)):
            if shown.viewport_size != {"width": width, "height": 844}:
                shown.set_viewport_size({"width": width, "height": 844})
                shown.goto(page.as_uri())
                shown.wait_for_selector("#maps[data-ready]")
            shown.evaluate("scrollTo(0, sweepPage.charts[0].div.getBoundingClientRect().y + scrollY - 100)")
            shown.mouse.click(*shown.evaluate(POINT, run))
            shown.wait_for_function("run => sweepPage.chosen === run", arg=run)
            bag = read_bag(folder / "bags" / f"{run:06d}")
            texts = shown.locator("section.run").inner_text()
            assert f"run {run}: Kp" in texts and bag.verdict.lines[0] in texts
            curves = shown.evaluate("sweepPage.curve.data.map(({name, x, y}) => [name, [...x], [...y]])")
            assert [name for name, *_ in curves] == ["distance from the target, m", "joint1", "joint2"]
            for (_, x, y), truth in zip(curves, (np.linalg.norm(bag.x - bag.target, axis=1), *bag.q.T)):
                np.testing.assert_allclose(y, np.interp(x, bag.t, truth), rtol=1e-6, atol=1e-8)
            assert shown.evaluate("document.documentElement.scrollWidth") == width


CHARTS = """() => sweepPage.charts.map(({kind, shown, div}) => {
    const data = div.data.map(({x, y, mode}) => ({x: [...x], y: [...y], lines: mode.includes("lines")}));
    return {kind, shown, data, box: div.getBoundingClientRect().toJSON()};
})"""


def test_two_maps_stand_side_by_side_with_crosses_and_a_pareto_front(native_path, tmp_path):
    folder = tmp_path / "s"
    sweep(native_path, grid={"Kp": [20, 60, 200, 600, 2000], "Kd": [10, 20, 40, 80]}, stop_time=3, output=folder)
    table = table_of(folder)
    page = save(drawing(read_sweep(folder), "a"), tmp_path / "a.html")
    with browser.chromium() as chromium, chromium.new_context(offline=True) as context:
        shown = context.new_page()
        shown.set_viewport_size({"width": 1200, "height": 900})
        shown.goto(page.as_uri())
        shown.wait_for_selector("#maps[data-ready]")
        key = shown.locator("#maps").evaluate("(maps) => maps.previousElementSibling.textContent")
        left, right, front = shown.evaluate(CHARTS)
    assert "hollow: not defined" in key and "×: beyond the URDF" in key
    assert [chart["kind"] for chart in (left, right, front)] == ["map", "map", "front"]
    assert left["box"]["top"] == right["box"]["top"] and left["box"]["right"] <= right["box"]["left"]
    impossible = (table.effort_use > 1.0) | (table.velocity_use > 1.0)
    marked = table[impossible]
    assert 0 < len(marked) < len(table)
    for chart in (left, right):
        x, y, _ = chart["shown"]
        _, crosses, _ = chart["data"]
        assert sorted(zip(crosses["x"], crosses["y"])) == sorted(zip(marked[x], marked[y]))
    x, y = front["shown"]
    possible = table[~impossible & table[x].notna() & table[y].notna()]
    points = [*zip(possible[x], possible[y])]
    best = {p for p in points if not any(a <= p[0] and b <= p[1] and (a, b) != p for a, b in points)}
    (line,) = (trace for trace in front["data"] if trace["lines"])
    assert len(best) > 2
    np.testing.assert_allclose([*zip(line["x"], line["y"])], sorted(best), rtol=1e-8)  # a page has nine digits


def test_a_page_has_a_limited_number_of_values(grid_sweep, monkeypatch):
    table, pages = read_sweep(grid_sweep), list[dict[str, Any]]()
    monkeypatch.setattr(maps, "figures_html", lambda content, _: pages.append(content))
    for most in (maps.MOST_VALUES, 4 * (2 + len(METRICS))):
        monkeypatch.setattr(maps, "MOST_VALUES", most)
        maps.map_page(table, ["Kp", "Kd"], None, [])
    whole, some = (page["columns"]["run"] for page in pages)
    assert len(whole) == len(table) > 4 >= len(some) > 1 and some == whole[:: whole.index(some[1])]
