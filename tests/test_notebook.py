"""The notebook of the documentation runs, and the outputs stored in it are those of this version."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOK = Path(__file__).parents[1] / "docs" / "first_run.ipynb"
MAX_SIZE = 500_000  # bytes


MAKER = runpy.run_path(str(NOTEBOOK.with_name("make_notebook.py")))
executed = MAKER["executed"]


def outputs(notebook: nbformat.NotebookNode) -> list[list[tuple[list[str], str]]]:
    """Kinds of each cell's outputs, and their HTML without the numbers, which depend on the machine's speed."""
    return [
        [
            (sorted(output.data), re.sub(r"-?\d+(\.\d+)?(e[-+]\d+)?", "N", output.data.get("text/html", "")))
            for output in cell.outputs
        ]
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


def test_the_notebook_runs_and_its_stored_outputs_are_current(tmp_path: Path) -> None:
    stored = nbformat.read(NOTEBOOK, as_version=4)
    before = outputs(stored)
    assert tuple(cell.source for cell in stored.cells) == MAKER["CELLS"]
    assert outputs(executed(stored, tmp_path)) == before
    html = [html for cell in before for _, html in cell if html]
    assert len(html) == 5 and all("<svg" in text for text in html)
    assert ["image/png", "text/plain"] in [kinds for cell in before for kinds, _ in cell]
    assert NOTEBOOK.stat().st_size < MAX_SIZE


def test_a_cell_that_fails_is_an_error(tmp_path: Path) -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    notebook.cells = [nbformat.v4.new_code_cell("import twodof\ntwodof.load_fmu('absent.fmu')")]
    with pytest.raises(nbclient.exceptions.CellExecutionError, match=r"there is no FMU 'absent\.fmu'"):
        executed(notebook, tmp_path)
