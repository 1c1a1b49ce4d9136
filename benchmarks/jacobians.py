"""The whole Jacobian of the forward dynamics: the FMU's, Pinocchio's in C++, and CasADi's generated C, in one program.

    python benchmarks/jacobians.py

The Jacobian has the derivatives of the accelerations with respect to positions, velocities and efforts, of a robot
without damping. All ways run in turns at the same random points, in processor time. The FMU's library is compiled as
in its archive. g++ compiles Pinocchio's templates (computeABADerivatives), and gcc CasADi's code, with -O3 for the
same processors. CasADi generates two functions: the Jacobian of Pinocchio's ABA, and computeABADerivatives itself.

It needs g++, the wheels of the extra `test`, and Eigen: `pip install cmeel-eigen`, or Debian's libeigen3-dev.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from statistics import median

import pinocchio as pin
from arms import HERE, Arm, compiled, panda, shipped_arm, ur5
from report import Figure, machine, print_figures, print_rows

from twodof.plant.variables import variable_table

WAYS = (
    "right-hand side",
    "FMU, a column a call",
    "engine, one call",
    "Pinocchio",
    "CasADi, of ABA",
    "CasADi, of ABADerivatives",
)
PINOCCHIO_BAR, CASADI_BAR, AGREEMENT = 0.6, 1.2, 1e-9
# Pinocchio has more types of joints than Boost expects
TYPES = (
    "-DBOOST_MPL_LIMIT_LIST_SIZE=30",
    "-DBOOST_MPL_LIMIT_VECTOR_SIZE=30",
    "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
)
OPTIMISED = ("-O3", "-march=x86-64")


def includes() -> list[str]:
    """Return CasADi's folder, and the flags for all headers; exit if something is missing."""
    casadi = importlib.util.find_spec("casadi")
    if casadi is None or casadi.origin is None:
        sys.exit("there is no CasADi: pip install casadi")
    if not shutil.which("g++"):
        sys.exit("there is no g++: install it, on Debian by apt-get install g++")
    prefix = next(each for each in Path(pin.__file__).parents if each.name == "cmeel.prefix")
    eigen = next((at for at in (prefix / "include/eigen3", Path("/usr/include/eigen3")) if at.is_dir()), None)
    if eigen is None:
        sys.exit("there is no Eigen: pip install cmeel-eigen, or on Debian apt-get install libeigen3-dev")
    library = Path(casadi.origin).parent
    return [str(library), *(f"-isystem{at}" for at in (prefix / "include", eigen, library / "include"))]


def numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{float(value)!r}" for value in values)


def robot_header(arms: dict[str, Arm]) -> str:
    """Return a C++ function that makes the Pinocchio model of a robot by its name."""
    lines = ["#include <pinocchio/multibody.hpp>", "", "static pinocchio::Model robot(const std::string &name)", "{"]
    lines += ["    pinocchio::Model model;"]
    for name, arm in arms.items():
        model = arm.robot.model
        lines += [f'    if (name == "{name}") {{']
        for i in range(1, model.njoints):
            place, body, kind = model.jointPlacements[i], model.inertias[i], model.joints[i].shortname()
            rotation, inertia = (
                f"(Eigen::Matrix3d() << {numbers(M.flat)}).finished()" for M in (place.rotation, body.inertia)
            )
            at, lever = (f"Eigen::Vector3d({numbers(vector)})" for vector in (place.translation, body.lever))
            joint = f"pinocchio::{kind}(), pinocchio::SE3({rotation}, {at})"
            lines += [f'        model.addJoint({model.parents[i]}, {joint}, "joint{i}");']
            lines += [f"        model.appendBodyToJoint({i}, pinocchio::Inertia({body.mass!r}, {lever}, {inertia}));"]
        gravity = arm.starts.get("gravity", (0.0, 0.0, -9.81))
        lines += [f"        model.gravity.linear() << {numbers(gravity)};", "    }"]
    return "\n".join([*lines, "    return model;", "}", ""])


def measured(arms: dict[str, Arm], folder: Path) -> Iterator[tuple[str, float, list[list[float]]]]:
    """Yield each robot's name, the largest relative difference between Jacobians, and times, s, by round and way."""

    def run(*command: str) -> str:
        return subprocess.run(command, cwd=folder, check=True, stdout=subprocess.PIPE, text=True).stdout

    (folder / "robot.hpp").write_text(robot_header(arms), "utf-8")
    casadi, *headers = includes()
    cpp = ("g++", "-std=c++17", "-w", *TYPES, f"-I{folder}", *headers)
    link = (f"-L{casadi}", "-lcasadi", f"-Wl,-rpath,{casadi}")
    run(*cpp, "-O0", str(HERE / "jacobian_code.cpp"), "-o", "code", *link)
    run(*cpp, *OPTIMISED, "-DNDEBUG", "-c", str(HERE / "jacobians.cpp"))
    for name, arm in arms.items():
        names = [variable.name for variable in variable_table(arm.robot, arm.starts, arm.control)]
        first = {"EFFORT": "tau_cmd[1]", "STATE": "q[1]", "RATE": "der(q[1])"}
        defines = [f"-DFIRST_{what}={names.index(variable) + 1}" for what, variable in first.items()]
        engine = Path(compiled(arm, folder, "fmu_jacobian.c", flags=defines)._name)
        engine.rename(engine := engine.with_suffix(".so"))  # its name for the linker
        run("./code", name)
        run("gcc", *OPTIMISED, "-w", "-c", "rival.c")
        run("g++", "jacobians.o", "rival.o", engine.name, f"-Wl,-rpath,{folder}", "-o", "jacobians")
        difference, *rounds = run("./jacobians", name).splitlines()
        yield name, float(difference), [[*map(float, line.split())] for line in rounds]


def without_damping(arm: Arm) -> Arm:
    still = (0.0,) * len(arm.robot.joints)
    return Arm(arm.robot, {**arm.starts, "damping": still, "friction": still}, "effort")


def main() -> list[Figure]:
    """Measure and print; return the figures that have a bound."""
    arms = {robot.__name__: without_damping(robot("effort")) for robot in (shipped_arm, ur5, panda)}
    rows: list[tuple[str, ...]] = [("", *WAYS)]
    figures = []
    with tempfile.TemporaryDirectory(prefix="twodof_") as folder:
        for name, difference, rounds in measured(arms, Path(folder)):
            times = [*zip(*rounds)]
            for kind, of in (("least", min), ("median", median)):
                rows.append((f"{name}, {kind}", *(f"{1e6 * of(each):.3f} µs" for each in times)))
            figures.append(Figure(f"{name}: largest difference", f"{difference:.1e}", f"<= {AGREEMENT:g}"))
            for at, ours in ((1, "FMU"), (2, "engine")):
                against = median(each[at] / each[3] for each in rounds)
                figures.append(Figure(f"{name}: {ours} / Pinocchio", f"{against:.2f}", f"<= {PINOCCHIO_BAR}"))
                against = median(each[at] / min(each[4:]) for each in rounds)
                figures.append(Figure(f"{name}: {ours} / CasADi's faster", f"{against:.2f}", f"<= {CASADI_BAR}"))
    print_rows("The whole Jacobian", *rows)
    return figures


if __name__ == "__main__":
    print(machine())
    print_figures(main())
