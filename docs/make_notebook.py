"""Make docs/first_run.ipynb: execute its cells and store what they show.

    python docs/make_notebook.py

Needs the extras native, sweep, view and test.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import nbclient
import nbformat

NOTEBOOK = Path(__file__).parent / "first_run.ipynb"
SECONDS = 600  # by the clock, a cell: a guard against hanging
CELLS = (
    """# A first run

This notebook builds the FMU of the default arm, a planar robot with two joints under operational-space control, runs
it, reads the bag and compares gains. It needs `pip install '.[native,sweep,view]'`.""",
    """%matplotlib inline
import twodof""",
    """## Build

`native=True` builds the plant as C; it starts in a millisecond and has exact derivatives. An FMU shows its variables
and the robot at its start.""",
    """fmu = twodof.load_fmu(twodof.build_fmu("TwoDof.fmu", twodof.FmuOptions(native=True)))
fmu""",
    """## Run

The end effector goes to the target `x_des`, in m. The bag receives each sample as `sensor_msgs/JointState`. Any
variable can be set by name.""",
    """settings = {"x_des": (0.25, 0.1), "Kp": 80, "Kd": 20}
summary = twodof.run(fmu, twodof.Bag("first_bag"), stop_time=2, settings=settings)
summary""",
    """## Read the bag

A recording has arrays over the samples: `t`, `q`, `v`, `x`, `target`; `to_pandas()` makes a table of them.""",
    """bag = twodof.read_bag("first_bag")
bag""",
    """## Draw it

The figure compares the distance from the target with the exact solution of the control law.""",
    "twodof.plot(bag)",
    """## Compare gains

A sweep runs the FMU at each combination of gains, on all cores, and returns a table with a row for each run.""",
    """table = twodof.sweep(fmu, grid={"Kp": [20, 40, 80, 160], "Kd": [10, 20]}, stop_time=2)
table""",
    """## Linearise

The linear model comes from the FMU's directional derivatives, here at the equilibrium. Its eigenvalues are those of
the gains: s² + Kd s + Kp = 0.""",
    "twodof.linearise(fmu)",
)


def executed(notebook: nbformat.NotebookNode, folder: Path) -> nbformat.NotebookNode:
    """Execute a notebook in a folder; raise nbclient's CellExecutionError where a cell fails."""
    resources = {"metadata": {"path": str(folder)}}
    return nbclient.NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources=resources).execute()


def main() -> None:
    """Write the notebook."""
    notebook = nbformat.v4.new_notebook()
    for i, text in enumerate(CELLS):
        is_text = text.startswith("#")
        cell = nbformat.v4.new_markdown_cell(text) if is_text else nbformat.v4.new_code_cell(text)
        cell["id"] = f"cell-{i}"  # the same in every run of this script
        notebook.cells.append(cell)
    with tempfile.TemporaryDirectory() as folder:
        done = executed(notebook, Path(folder))
    for cell in done.cells:
        cell.metadata = {}  # times of execution
    done.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    nbformat.write(done, NOTEBOOK)
    print(NOTEBOOK, NOTEBOOK.stat().st_size, "bytes", file=sys.stderr)


if __name__ == "__main__":
    main()
