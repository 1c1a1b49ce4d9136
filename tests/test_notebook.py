"""The notebooks of ``examples`` run, and the outputs stored in them are those of this version."""

import ast
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import browser
import nbclient
import nbformat
import pytest

import twodof

EXAMPLES = Path(__file__).parents[1] / "examples"
MAKER = runpy.run_path(str(EXAMPLES / "make_notebooks.py"))
MAX_SIZE = 600_000  # bytes
executed, notebook_of, NOTEBOOKS = MAKER["executed"], MAKER["notebook_of"], MAKER["NOTEBOOKS"]
PICTURES = {"first_run": 5, "my_robot": 1, "my_controller": 0, "gains": 1, "linear_model": 1}
"""SVG pictures in the HTML of each."""


def outputs(notebook: nbformat.NotebookNode) -> list[list[tuple[list[str], str]]]:
    """Kinds of each cell's outputs, and their HTML without numbers, which depend on the machine's speed."""
    return [
        [(sorted(output.get("data", ())), without_numbers(output)) for output in cell.outputs]
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


def without_numbers(output: nbformat.NotebookNode) -> str:
    html = output.get("data", {}).get("text/html", "")
    return "a page" if html.startswith("<iframe") else re.sub(r"-?\d+(\.\d+)?(e[-+]\d+)?", "N", html)


def test_each_notebook_is_there():
    assert {path.stem for path in EXAMPLES.glob("*.ipynb")} == {*NOTEBOOKS} == {*PICTURES}


@pytest.mark.parametrize("name", sorted(NOTEBOOKS))
def test_a_notebook_runs_and_its_stored_outputs_are_current(name, tmp_path):
    path = EXAMPLES / f"{name}.ipynb"
    stored = nbformat.read(path, as_version=4)
    before = outputs(stored)
    assert [cell.source for cell in stored.cells] == [cell.source for cell in notebook_of(NOTEBOOKS[name]).cells]
    assert outputs(executed(stored, tmp_path)) == before
    html = [html for cell in before for _, html in cell if html]
    assert sum("<svg" in text for text in html) == PICTURES[name]
    assert ["image/png", "text/plain"] in [kinds for cell in before for kinds, _ in cell]
    assert path.stat().st_size < MAX_SIZE


def test_an_arm_is_shown_without_slow_imports(native_path):
    code = "import sys, twodof; twodof.show(sys.argv[1]); print({*sys.modules} & {'matplotlib', 'pinocchio', 'pandas'})"
    done = subprocess.run([sys.executable, "-c", code, native_path], check=True, stdout=subprocess.PIPE, text=True)
    assert done.stdout == "set()\n"


@pytest.mark.parametrize(("silence", "shown"), [(0, True), (1e6, False)])
def test_a_notebook_shows_progress_bars_of_long_tasks(native_path, tmp_path, silence, shown):
    """They are text without ipywidgets, else widgets; a script shows none."""
    shutil.copy(native_path, tmp_path / "arm.fmu")
    begin = f"import os, twodof\nfrom twodof.simulation import progress\nprogress.SILENCE = {silence}"
    begin += "\nos.environ.pop('TQDM_DISABLE', None);"
    run, sweep = "twodof.run('arm.fmu', stop_time=60);", "twodof.sweep('arm.fmu', grid={'Kp': [20, 60]}, stop_time=1);"
    notebook = executed(notebook_of((begin, run, sweep)), tmp_path)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    told = ["".join(o.get("text") or o["data"]["text/plain"] for o in cell.outputs) for cell in cells]
    assert ["simulating" in told[1], "/60.0 s, " in told[1], "sweeping" in told[2], "/2 " in told[2]] == [shown] * 4
    assert shown or told == ["", "", ""]
    script = subprocess.run([sys.executable, "-c", "\n".join((begin, run, sweep))], cwd=tmp_path, capture_output=True)
    assert (script.returncode, script.stderr) == (0, b"")


@pytest.mark.parametrize(("tick", "shown"), [(0.001, True), (1e6, False)])
def test_a_notebook_shows_a_line_of_a_slow_build(tmp_path, tick, shown):
    """It returns each text of the line, and the cell's output after the build; a script shows none."""
    begin = f"import os, twodof\nfrom twodof import notebook\nnotebook.TICK = {tick}"
    begin += "\nos.environ.pop('TQDM_DISABLE', None);"
    watch = """from IPython.display import DisplayHandle
seen = []
def watched(method):
    return lambda self, data, **options: (seen.append(data["text/plain"]), method(self, data, **options))
DisplayHandle.display, DisplayHandle.update = watched(DisplayHandle.display), watched(DisplayHandle.update)"""
    build = "twodof.build_fmu('new.fmu');"
    done = executed(notebook_of((f"{begin}\n{watch}", build, "print(seen)")), tmp_path)
    assert [output["data"]["text/plain"] for output in done.cells[1].outputs] == [""] * shown
    seen = ast.literal_eval(done.cells[2].outputs[0]["text"])
    assert seen[-1:] == [""] * shown and all(re.fullmatch(r"building an FMU: \d+ s", text) for text in seen[:-1])
    assert len(seen) > 2 or not shown
    script = subprocess.run(
        [sys.executable, "-c", f"{begin}\n{build.replace('new', 'other')}"], cwd=tmp_path, capture_output=True
    )
    assert (script.returncode, script.stdout, script.stderr) == (0, b"", b"")


def test_a_cell_that_fails_is_an_error(tmp_path):
    notebook = notebook_of(("import twodof\ntwodof.load_fmu('absent.fmu')",))
    with pytest.raises(nbclient.exceptions.CellExecutionError, match=r"there is no FMU 'absent\.fmu'"):
        executed(notebook, tmp_path)


def test_pages_are_shown_inline_without_a_network(native_path, tmp_path):
    """An arm that moves, a replay and a map, in iframes of the notebook."""
    folder = tmp_path / "sweep"
    twodof.run(native_path, twodof.Bag(tmp_path / "bag"), stop_time=1)
    table = twodof.sweep(native_path, grid={"Kp": [20, 60]}, stop_time=1, output=folder)
    fmu, bag = twodof.load_fmu(native_path), twodof.read_bag(tmp_path / "bag")
    shown = [twodof.show(of)._repr_html_() for of in (fmu, native_path, bag, tmp_path / "bag", table, folder)]
    assert shown[0::2] == shown[1::2] and max(map(len, shown[:4])) < 600_000
    with browser.chromium() as chromium, chromium.new_context(offline=True) as context:
        page = context.new_page()
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: asked.append(str(error)))
        for html, ready in zip(shown[::2], (browser.READY, browser.READY, "#maps[data-ready]")):
            page.set_content(f"<!DOCTYPE html><html><body>{html}</body></html>")
            page.frame_locator("iframe").locator(ready).wait_for(timeout=1e3 * browser.TIMEOUT)
            if html is shown[0]:
                browser.until(page, lambda k: k > 5, lambda page: page.frames[-1].evaluate("arm.k"))
        assert asked == ["about:srcdoc"] * len(asked)


@pytest.mark.parametrize("other", [3, [1.0, 2.0]])
def test_objects_that_cannot_be_shown_are_named(other):
    with pytest.raises(twodof.TwoDofError, match="`show` shows an FMU, a recording, the table of a sweep, or the path"):
        twodof.show(other)
