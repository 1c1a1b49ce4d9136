"""Make the notebooks in examples/: execute their cells and store what they show.

    python examples/make_notebooks.py [NAME…]

Needs the extras native, sweep, view and test.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import nbclient
import nbformat

FOLDER = Path(__file__).parent
SECONDS = 600  # by the clock, a cell: a guard against hanging
MOST_HTML = 400_000  # characters: larger pages are shown when a cell is run, and not stored
FIRST_RUN = (
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
    """## Move it

The page of an FMU is its plant, which runs in this cell: drag the target. It needs neither a server nor a network.""",
    "twodof.show(fmu)",
    """## Compare gains

A sweep runs the FMU at each combination of gains, on all cores, and returns a table with a row for each run.""",
    """table = twodof.sweep(fmu, grid={"Kp": [20, 40, 80, 160], "Kd": [10, 20]}, stop_time=2)
table""",
    """## Linearise

The linear model comes from the FMU's directional derivatives, here at the equilibrium. Its eigenvalues are those of
the gains: s² + Kd s + Kp = 0.""",
    "twodof.linearise(fmu)",
)
MY_ROBOT = (
    """# My robot

A URDF becomes an FMU, and the FMU a page, a run and a verdict. It needs `pip install '.[native,view]'`. An FMU
(Functional Mock-up Unit) is one file with a model, its variables and its program; FMI, the Functional Mock-up
Interface, is the standard by which tools run it.""",
    """%matplotlib inline
from pathlib import Path

import twodof""",
    """## The URDF

Masses in kg, lengths in m, angles in rad. Each link that moves needs a mass and an inertia; limits of effort and
velocity let the verdict report what the motors cannot do.""",
    '''LINK = """<link name="{name}"><inertial><origin xyz="{x} 0 {z}"/><mass value="{mass}"/>
<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{xyz}"/><axis xyz="{axis}"/><limit lower="-2.5" upper="2.5" effort="{effort}" velocity="3"/></joint>"""

parts = [
    '<link name="base"/>',
    JOINT.format(name="turn", parent="base", child="column", xyz="0 0 0", axis="0 0 1", effort=20),
    LINK.format(name="column", x=0, z=0.15, mass=2.0, i=0.01),
    JOINT.format(name="shoulder", parent="column", child="upper", xyz="0 0 0.3", axis="0 1 0", effort=40),
    LINK.format(name="upper", x=0.15, z=0, mass=1.5, i=0.01),
    JOINT.format(name="elbow", parent="upper", child="lower", xyz="0.3 0 0", axis="0 1 0", effort=20),
    LINK.format(name="lower", x=0.1, z=0, mass=0.8, i=0.005),
    '<joint name="flange" type="fixed"><parent link="lower"/><child link="tool0"/><origin xyz="0.25 0 0"/></joint>',
    '<link name="tool0"/>',
]
Path("my_robot.urdf").write_text(f'<robot name="my_robot">{"".join(parts)}</robot>');''',
    """## The FMU

`frame` is the link that is controlled, `q_start` the pose at the start, in rad. A robot of an installed package has a
name instead: `twodof.stock_robot("panda")`.""",
    """options = twodof.FmuOptions(urdf="my_robot.urdf", frame="tool0", native=True, q_start=(0.3, -0.5, 1.2))
fmu = twodof.load_fmu(twodof.build_fmu("my_robot.fmu", options))
fmu""",
    """## The robot in a page

Without visual shapes a robot is drawn as sticks. Drag the target, and read the verdict above the robot.""",
    "twodof.show(fmu)",
    """## A run, and its verdict

The first line says whether the target was reached, and if not, why.""",
    """reached = twodof.run(fmu, twodof.Bag("reached"), stop_time=3, settings={"x_des": (0.3, 0.2, 0.4), "Kp": 60})
print(reached.verdict)""",
    """too_far = twodof.run(fmu, twodof.Bag("too_far"), stop_time=3, settings={"x_des": (0.6, 0.2, 0.4), "Kp": 60})
print(too_far.verdict)""",
    'twodof.plot(twodof.read_bag("too_far"))',
)
MY_CONTROLLER = (
    """# My controller

The bare plant takes torques, and a controller in Python closes the loop, once each communication step. It needs
`pip install '.[native,view]'`.""",
    """%matplotlib inline
import numpy as np
import pinocchio as pin

import twodof""",
    """fmu = twodof.load_fmu(twodof.build_fmu("Bare.fmu", twodof.FmuOptions(control="effort", native=True)))
model = pin.buildModelFromXML(fmu.urdf)
model.gravity.linear = np.array([0.0, -9.81, 0.0])
data = model.createData()""",
    """## The loop

`samples` yields a sample at each communication point, and accepts the inputs that apply from there on. The law is a PD
of the joints with inverse dynamics (computed torque).""",
    """def run(law, bag, steps=2000):
    sink = twodof.Bag(bag, effort=True)
    experiment = twodof.experiment(fmu, step=0.001, stop_time=0.001 * steps)
    with sink.begin(experiment):
        source = twodof.samples(experiment)
        sample = next(source)
        while sample.k < steps:
            sink.write(sample)
            sample = source.send({"tau_cmd": law(np.array(sample.q), np.array(sample.v))})
        sink.write(sample)
    return twodof.read_bag(bag), sample


goal = np.array([0.9, -0.6])
computed, last = run(lambda q, v: pin.rnea(model, data, q, v, 60 * (goal - q) - 14 * v), "computed")
last""",
    """## Against a plain PD

Without the model, gravity holds the arm away from its goal, by its torque divided by the gain.""",
    """plain, last = run(lambda q, v: 4.0 * (goal - q) - 0.4 * v, "plain")
print(goal - computed.q[-1], "rad by inverse dynamics")
print(goal - plain.q[-1], "rad by the PD alone")""",
    "twodof.plot(computed, plain)",
)
GAINS = (
    """# Gains

A sweep runs an FMU at many gains, on all cores, and evaluates each run: settling, overshoot, and effort
relative to the limits of the URDF. It needs `pip install '.[native,sweep,view]'`.""",
    """%matplotlib inline
import twodof""",
    """fmu = twodof.build_fmu("TwoDof.fmu", twodof.FmuOptions(native=True))
grid = {"Kp": [20, 40, 80, 160, 320], "Kd": [5, 10, 20, 40]}
table = twodof.sweep(fmu, grid=grid, stop_time=3, output="gains", bags=True)
table""",
    """## The best run by your own cost

The cost is an expression of the table's columns, which pandas evaluates.""",
    """table["cost"] = table.eval("settling_time + 0.1 * peak_effort")
table.sort_values("cost")[["Kp", "Kd", "cost", "settling_time", "overshoot", "peak_effort", "effort_use"]].head()""",
    """## The map

A click on a run opens its curves. The map is drawn where this cell is run, and is not stored in the file.""",
    'twodof.show("gains")',
    """## Between two gains

Two runs in one figure: Kp = 80 with Kd = 5 and with Kd = 20. Critical damping is Kd² = 4 Kp.""",
    'twodof.plot("gains/bags/000008", "gains/bags/000010")',
)
LINEAR_MODEL = (
    """# Linear model

`linearise` returns A, B, C and D at an operating point, from the FMU's exact derivatives; here they give a
linear-quadratic regulator that holds the arm upright. It needs `pip install '.[native]'`.""",
    """import math

import numpy as np
from scipy.linalg import solve_continuous_are

import twodof""",
    """## The bare arm, upright

Two of its four eigenvalues grow: it falls.""",
    """fmu = twodof.load_fmu(twodof.build_fmu("Bare.fmu", twodof.FmuOptions(control="effort", native=True)))
upright = [math.pi / 2, 0.0]
model = twodof.linearise(fmu, {"q": upright}, inputs=["tau_cmd"], outputs=["q"])
model""",
    """## The regulator

K minimises the integral of xᵀ Q x + uᵀ R u, by SciPy's Riccati equation.""",
    """Q, R = np.diag([100.0, 100.0, 0.01, 0.01]), 100.0 * np.eye(2)
P = solve_continuous_are(model.A, model.B, Q, R)
K = np.linalg.solve(R, model.B.T @ P)
K.round(3)""",
    """## In closed loop with the full plant

The arm starts 0.1 rad from upright; a step is 1 ms.""",
    """start = {"q_start": (upright[0] + 0.1, -0.1)}
source = twodof.samples(fmu, step=0.001, stop_time=3.0, settings=start)
sample, trace = next(source), []
while sample.k < 3000:
    x = np.array([*sample.q, *sample.v]) - [*upright, 0.0, 0.0]
    trace.append((sample.t, *x[:2]))
    sample = source.send({"tau_cmd": -K @ x})
print(f"{np.abs(x).max():.1e} from upright after {sample.t:g} s")""",
    """from matplotlib import pyplot as plt

t, *off = np.array(trace).T
plt.plot(t, np.transpose(off))
plt.xlabel("time in s")
plt.ylabel("angle from upright in rad");""",
)
NOTEBOOKS = {
    "first_run": FIRST_RUN,
    "my_robot": MY_ROBOT,
    "my_controller": MY_CONTROLLER,
    "gains": GAINS,
    "linear_model": LINEAR_MODEL,
}
"""Cells of each notebook, by the name of its file."""


def executed(notebook: nbformat.NotebookNode, folder: Path) -> nbformat.NotebookNode:
    """Execute a notebook in a folder, and drop large pages; raise CellExecutionError of nbclient where a cell fails."""
    resources = {"metadata": {"path": str(folder)}}
    client = nbclient.NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources=resources)
    done = client.execute(env={**os.environ, "TQDM_DISABLE": "1"})  # bars would be there on a slow machine alone
    for cell in done.cells:
        for output in cell.get("outputs", []):
            if len(output.get("data", {}).get("text/html", "")) > MOST_HTML:
                del output.data["text/html"]
    return done


def notebook_of(cells: tuple[str, ...]) -> nbformat.NotebookNode:
    """Return a notebook that has not been run; cells that begin with # are text."""
    notebook = nbformat.v4.new_notebook()
    for i, text in enumerate(cells):
        is_text = text.startswith("#")
        cell = nbformat.v4.new_markdown_cell(text) if is_text else nbformat.v4.new_code_cell(text)
        cell["id"] = f"cell-{i}"  # the same in every run of this script
        notebook.cells.append(cell)
    return notebook


def main() -> None:
    """Write the notebooks that are named, or all."""
    for name in sys.argv[1:] or NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            done = executed(notebook_of(NOTEBOOKS[name]), Path(folder))
        for cell in done.cells:
            cell.metadata = {}  # times of execution
        done.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
        path = FOLDER / f"{name}.ipynb"
        nbformat.write(done, path)
        print(path, path.stat().st_size, "bytes", file=sys.stderr)


if __name__ == "__main__":
    main()
