"""One directional derivative against one evaluation of the right-hand side, for each control.

    python benchmarks/derivatives.py

Processor time in native FMUs as they are shipped, called from C (derivatives.c), both sides in
turns. Needs the packages of the extra "test", and a C compiler; takes about two minutes.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import fmpy
import pinocchio as pin

import twodof
from twodof.plant.variables import CONTROLS

HERE = Path(__file__).resolve().parent
BAR = 4.0
ROBOTS = {"2 joints": None, "UR5": "ur_description/urdf/ur5_robot.urdf",
          "Panda": "panda_description/urdf/panda.urdf"}  # fmt: skip
FRAMES = {"UR5": "tool0", "Panda": "panda_hand_tcp"}


def costs(program: Path, fmu: Path, folder: Path) -> list[float]:
    """µs of the right-hand side and of a derivative."""
    unzipped = fmpy.extract(str(fmu), str(folder / fmu.stem))
    description = fmpy.read_model_description(unzipped)
    references = {v.name: v.valueReference for v in description.modelVariables}
    (library,) = Path(unzipped, "binaries", "linux64").iterdir()
    arguments = (library, description.guid, description.numberOfContinuousStates // 2,
                 references["q[1]"], references["der(q[1])"])  # fmt: skip
    command = [str(program), *map(str, arguments)]
    return [float(word) for word in subprocess.check_output(command, text=True).split()]


def main() -> None:
    """Print the table."""
    shared = (path / "share" / "example-robot-data" for path in Path(pin.__file__).parents)
    robots = next(path for path in shared if path.is_dir()) / "robots"
    with tempfile.TemporaryDirectory() as name:
        folder, program = Path(name), Path(name, "derivatives")
        headers = Path(fmpy.__file__).parent / "c-code"
        subprocess.run(["cc", "-O2", f"-I{headers}", str(HERE / "derivatives.c"), "-o",
                        str(program), "-ldl"], check=True)  # fmt: skip
        print(f"{'':10}{'control':10}{'right-hand side':>17}{'derivative':>12}{'ratio':>7}")
        for robot, path in ROBOTS.items():
            for control in CONTROLS:
                options = twodof.FmuOptions(
                    urdf=None if path is None else robots / path, frame=FRAMES.get(robot),
                    control=control, native=True, meshes=False, live_documentation=False,
                )  # fmt: skip
                fmu = twodof.build_fmu(folder / f"{robot}-{control}.fmu", options)
                side, derivative = costs(program, fmu, folder)
                ratio = derivative / side
                told = "" if ratio <= BAR else f"  above {BAR:g}"
                print(
                    f"{robot:10}{control:10}{side:14.3f} µs{derivative:9.3f} µs{ratio:7.2f}{told}"
                )


if __name__ == "__main__":
    main()
