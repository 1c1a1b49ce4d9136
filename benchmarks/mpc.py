"""Optimal control of a Panda with CasADi and IPOPT: the FMU's derivatives, imported or compiled in, and differences.

    python benchmarks/mpc.py

The problem is a move of 1 s from rest to rest with least effort: multiple shooting, 40 intervals of one Runge-Kutta
step each, bounds on positions, speeds and efforts; 854 variables, 560 constraints. Times are processor times of the
solver, without its set-up.

- All sides have the same FMU (native, FMI 2.0, effort control, fixed fingers), problem and options of IPOPT. For
  finite differences, the model description lacks `providesDirectionalDerivative`, so that CasADi differences the
  right-hand side with its defaults. casadi_rates.c has the right-hand side and its Jacobian, of the FMU's sources, as
  external functions of CasADi. The sides are solved in turns.
- Hessians: of the objective alone (Gauss-Newton), CasADi's differences of first derivatives (exact; not of external
  functions), and IPOPT's limited-memory BFGS.
- The FMU runs the plan by `twodof.samples` at rtol 1e-10. Its distance from the plan is the error of the Runge-Kutta
  method of order 4: sixteen steps an interval, with the same efforts, divide it by 16^4.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import NamedTuple

import casadi as ca
import fmpy
import numpy as np
from arms import HERE
from report import Figure, machine, print_figures, print_rows

import twodof
from twodof.export.compiler import compile_library, host_platform
from twodof.export.stock_robots import stock_robot

INTERVALS, H, FINE = 40, 0.025, 16
EFFORT = np.array([87.0] * 4 + [12.0] * 3)  # N·m, of the URDF
SPEED = np.array([2.175] * 4 + [2.61] * 3)  # rad/s
MARGIN = 0.01  # rad, to the stops
HOME = np.array([0.0, -0.785398, 0.0, -2.35619, 0.0, 1.5707, 0.785398])
MOVE = np.array([1.2, 0.6, 0.0, 0.6, 0.0, 0.0, -0.6])
FMU, EXTERNAL, DIFFERENCES = "the FMU's derivatives", "external functions", "finite differences"
REFERENCES = ("-DFIRST_EFFORT=(TAU_CMD+1)", "-DFIRST_STATE=(Q+1)", "-DFIRST_RATE=(DER_Q+1)")
ROUNDS = {"Gauss-Newton": 7, "exact": 1, "limited-memory": 1}  # by Hessian
IPOPT = {"print_level": 0, "sb": "yes", "tol": 1e-6, "max_iter": 500}


class Solution(NamedTuple):
    """Processor time, s, and the plan: states (41, 14), rad and rad/s, and efforts (40, 7), N·m."""

    seconds: float
    iterations: int
    status: str
    objective: float
    states: np.ndarray
    efforts: np.ndarray


def models(folder: Path) -> tuple[Path, dict[str, ca.Function]]:
    """Build the FMU; return it, and its right-hand side by each side's way of derivatives."""
    stock = stock_robot("panda")
    options = replace(stock, native=True, control="effort", meshes=False, lock={"*finger*": 0.0}, q_start=tuple(HOME))
    path = twodof.build_fmu(folder / "Panda.fmu", options)
    exact, differences = folder / "exact", folder / "differences"
    fmpy.extract(str(path), str(exact))
    shutil.copytree(exact, differences)
    description = differences / "modelDescription.xml"
    description.write_text(description.read_text("utf-8").replace("providesDirectionalDerivative", "hidden"), "utf-8")
    sources = {file.name: file.read_bytes() for file in (exact / "sources").iterdir()}
    sources |= {file: (HERE / file).read_bytes() for file in ("casadi_rates.c", "fmu_jacobian.c")}
    units = ("directional.c", "casadi_rates.c")
    library = folder / "rates.so"
    library.write_bytes(compile_library(sources, host_platform(), "rates", units=units, flags=REFERENCES))
    external = ca.external("rates", str(library))
    return path, {FMU: imported_rates(exact), EXTERNAL: external, DIFFERENCES: imported_rates(differences)}


def imported_rates(unzipped: Path) -> ca.Function:
    """Return the right-hand side of an FMU by state and efforts."""
    dae = ca.DaeBuilder("panda", str(unzipped), {})
    for name in dae.u():
        if not name.startswith("tau_cmd"):
            dae.set_category(name, "c")
    return dae.create("rates", ["x", "u"], ["ode"])


def shooting(rates: ca.Function, steps: int = 1) -> ca.Function:
    """Return the state after an interval of constant effort, by Runge-Kutta steps."""
    runge_kutta = ca.simpleRK(rates, steps, 4)
    x, tau = ca.MX.sym("x", 14), ca.MX.sym("tau", 7)
    return ca.Function("interval", [x, tau], [runge_kutta(x, tau, H)])


def solve(rates: ca.Function, stops: list[np.ndarray], hessian: str) -> Solution:
    """Return the plan; the variables of an interval are its first state, and its efforts over their limits."""
    w = ca.MX.sym("w", 21 * INTERVALS + 14)
    states = [w[21 * k : 21 * k + 14] for k in range(INTERVALS + 1)]
    efforts = [w[21 * k + 14 : 21 * k + 21] for k in range(INTERVALS)]
    interval = shooting(rates)
    gaps = [interval(x, u * EFFORT) - after for x, u, after in zip(states, efforts, states[1:])]
    f, g = H * sum(ca.sumsqr(u) for u in efforts), ca.vertcat(*gaps)
    options = {"ipopt": dict(IPOPT), "print_time": False}
    if hessian == "limited-memory":
        options["ipopt"]["hessian_approximation"] = hessian
    elif hessian == "Gauss-Newton":
        p, scale, multipliers = ca.MX.sym("p", 0), ca.MX.sym("scale"), ca.MX.sym("multipliers", g.numel())
        given, names = [w, p, scale, multipliers], ["x", "p", "lam_f", "lam_g"]
        upper = ca.triu(scale * ca.hessian(f, w)[0])
        options["hess_lag"] = ca.Function("hessian", given, [upper], names, ["triu_hess_gamma_x_x"])
    solver = ca.nlpsol("solver", "ipopt", {"x": w, "f": f, "g": g}, options)

    begin, end = np.r_[HOME, np.zeros(7)], np.r_[HOME + MOVE, np.zeros(7)]
    guess = np.r_[np.hstack([np.linspace(begin, end, INTERVALS + 1)[:-1], np.zeros((INTERVALS, 7))]).ravel(), end]
    bounds = []
    for sign, stop in zip((-1.0, 1.0), stops):
        inner = np.r_[stop - sign * MARGIN, sign * SPEED, sign * np.ones(7)]
        bounds.append(np.r_[begin, inner[14:], np.tile(inner, INTERVALS - 1), end])
    before = time.process_time()
    found = solver(x0=guess, lbx=bounds[0], ubx=bounds[1], lbg=0.0, ubg=0.0)
    seconds, stats, best = time.process_time() - before, solver.stats(), found["x"].full().ravel()
    plan = best[:-14].reshape(INTERVALS, 21)
    states = np.vstack([plan[:, :14], best[-14:]])
    return Solution(
        seconds, stats["iter_count"], stats["return_status"], float(found["f"]), states, plan[:, 14:] * EFFORT
    )


def joint_stops(fmu: Path) -> list[np.ndarray]:
    """Return the lowest and the highest position of each joint."""
    starts = twodof.load_fmu(fmu).start_values
    return [np.array([starts[f"q_{end}[{i}]"] for i in range(1, 8)]) for end in ("min", "max")]


def errors(fmu: Path, rates: ca.Function, plan: Solution) -> tuple[float, float]:
    """Return the largest differences of an angle from the FMU's, rad: of the plan, and of FINE steps an interval."""
    changes = [(k * H, {"tau_cmd": tuple(tau)}) for k, tau in enumerate(plan.efforts)]
    settings = {"rtol": 1e-10, "atol": 1e-10}
    run = twodof.samples(fmu, step=H, stop_time=INTERVALS * H, settings=settings, changes=changes)
    q = np.array([sample.q for sample in run])
    interval, fine = shooting(rates, FINE), [plan.states[0]]
    for tau in plan.efforts:
        fine.append(interval(fine[-1], tau).full().ravel())
    return tuple(float(np.abs(states[:, :7] - q).max()) for states in (plan.states, np.array(fine)))


def main() -> Iterator[Figure]:
    """Measure and print; yield the figures."""
    with tempfile.TemporaryDirectory(prefix="twodof_") as name:
        fmu, sides = models(Path(name))
        stops = joint_stops(fmu)
        rounds: dict[str, list[dict[str, Solution]]] = {}
        for hessian, count in ROUNDS.items():
            measured = {side: f for side, f in sides.items() if hessian != "exact" or side != EXTERNAL}
            rounds[hessian] = [{side: solve(f, stops, hessian) for side, f in measured.items()} for _ in range(count)]
        planned, fine = errors(fmu, sides[FMU], rounds["Gauss-Newton"][0][FMU])
    rows = [("Hessian", "side", "time", "iterations", "objective", "status")]
    for hessian, of in rounds.items():
        for side, last in of[-1].items():
            seconds = f"{median(solutions[side].seconds for solutions in of):.2f} s"
            rows.append((hessian, side, seconds, str(last.iterations), f"{last.objective:.6f}", last.status))
    print_rows(f"A move of a Panda, {INTERVALS} intervals; IPOPT {IPOPT}", *rows)
    for side, wanted in ((FMU, 1), (EXTERNAL, 3)):
        ratio = median(of[DIFFERENCES].seconds / of[side].seconds for of in rounds["Gauss-Newton"])
        yield Figure(f"Gauss-Newton: {DIFFERENCES} / {side}, processor time", f"{ratio:.2f}", f">= {wanted}")
    print(f"largest error of an angle of the plan: {planned:.1e} rad; with {FINE} steps an interval: {fine:.1e} rad")
    yield Figure(f"the first error / the second, over {FINE}^4", f"{planned / fine / FINE**4:.2f}", "0.5 to 2")


if __name__ == "__main__":
    print(machine())
    print_figures(list(main()))
