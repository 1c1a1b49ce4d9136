"""Optimal control of a Panda with CasADi and IPOPT: the FMU's derivatives, and finite differences.

    python benchmarks/mpc.py

The problem is a move of 1 s from rest to rest with least effort: multiple shooting, 40 intervals of one Runge-Kutta
step each, bounds on positions, speeds and efforts; 854 variables, 560 constraints. Times are processor times of the
solver, without its set-up.

- Both sides have the same FMU (native, FMI 2.0, effort control, fixed fingers), problem and options of IPOPT. For
  finite differences, the model description lacks `providesDirectionalDerivative`, so that CasADi differences the
  right-hand side with its defaults. The sides are solved in turns.
- Hessians: of the objective alone (Gauss-Newton), CasADi's differences of first derivatives (exact), and IPOPT's
  limited-memory BFGS.
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
from report import Figure, machine, print_figures, print_rows

import twodof
from twodof.export.stock_robots import stock_robot

INTERVALS, H, FINE = 40, 0.025, 16
EFFORT = np.array([87.0] * 4 + [12.0] * 3)  # N·m, of the URDF
SPEED = np.array([2.175] * 4 + [2.61] * 3)  # rad/s
MARGIN = 0.01  # rad, to the stops
HOME = np.array([0.0, -0.785398, 0.0, -2.35619, 0.0, 1.5707, 0.785398])
MOVE = np.array([1.2, 0.6, 0.0, 0.6, 0.0, 0.0, -0.6])
SIDES = ("the FMU's derivatives", "finite differences")
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


def models(folder: Path) -> tuple[Path, list[ca.DaeBuilder]]:
    """Build the FMU; return it, and its import with and without directional derivatives."""
    stock = stock_robot("panda")
    options = replace(stock, native=True, control="effort", meshes=False, lock={"*finger*": 0.0}, q_start=tuple(HOME))
    path = twodof.build_fmu(folder / "Panda.fmu", options)
    exact, differences = folder / "exact", folder / "differences"
    fmpy.extract(str(path), str(exact))
    shutil.copytree(exact, differences)
    description = differences / "modelDescription.xml"
    description.write_text(description.read_text("utf-8").replace("providesDirectionalDerivative", "hidden"), "utf-8")
    return path, [ca.DaeBuilder("panda", str(unzipped), {}) for unzipped in (exact, differences)]


def shooting(dae: ca.DaeBuilder, steps: int = 1) -> ca.Function:
    """Return the state after an interval of constant effort, by Runge-Kutta steps."""
    for name in dae.u():
        if not name.startswith("tau_cmd"):
            dae.set_category(name, "c")
    runge_kutta = ca.simpleRK(dae.create("rates", ["x", "u"], ["ode"]), steps, 4)
    x, tau = ca.MX.sym("x", 14), ca.MX.sym("tau", 7)
    return ca.Function("interval", [x, tau], [runge_kutta(x, tau, H)])


def solve(dae: ca.DaeBuilder, hessian: str) -> Solution:
    """Return the plan; the variables of an interval are its first state, and its efforts over their limits."""
    w = ca.MX.sym("w", 21 * INTERVALS + 14)
    states = [w[21 * k : 21 * k + 14] for k in range(INTERVALS + 1)]
    efforts = [w[21 * k + 14 : 21 * k + 21] for k in range(INTERVALS)]
    interval = shooting(dae)
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

    stops = [np.array([dae.start(f"q_{end}[{i}]")[0] for i in range(1, 8)]) for end in ("min", "max")]
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


def errors(fmu: Path, dae: ca.DaeBuilder, plan: Solution) -> tuple[float, float]:
    """Return the largest differences of an angle from the FMU's, rad: of the plan, and of FINE steps an interval."""
    changes = [(k * H, {"tau_cmd": tuple(tau)}) for k, tau in enumerate(plan.efforts)]
    settings = {"rtol": 1e-10, "atol": 1e-10}
    run = twodof.samples(fmu, step=H, stop_time=INTERVALS * H, settings=settings, changes=changes)
    q = np.array([sample.q for sample in run])
    interval, fine = shooting(dae, FINE), [plan.states[0]]
    for tau in plan.efforts:
        fine.append(interval(fine[-1], tau).full().ravel())
    return tuple(float(np.abs(states[:, :7] - q).max()) for states in (plan.states, np.array(fine)))


def main() -> Iterator[Figure]:
    """Measure and print; yield the figures."""
    with tempfile.TemporaryDirectory(prefix="twodof_") as name:
        fmu, daes = models(Path(name))
        rounds = {kind: [[solve(dae, kind) for dae in daes] for _ in range(n)] for kind, n in ROUNDS.items()}
        planned, fine = errors(fmu, daes[0], rounds["Gauss-Newton"][0][0])
    rows = [("Hessian", "side", "time", "iterations", "objective", "status")]
    for hessian, of in rounds.items():
        for side, solutions in zip(SIDES, zip(*of)):
            seconds, last = median(s.seconds for s in solutions), solutions[-1]
            rows.append((hessian, side, f"{seconds:.2f} s", last.iterations, f"{last.objective:.6f}", last.status))
    print_rows(f"A move of a Panda, {INTERVALS} intervals; IPOPT {IPOPT}", *rows)
    ratio = median(b.seconds / a.seconds for a, b in rounds["Gauss-Newton"])
    yield Figure("Gauss-Newton: finite differences / the FMU's derivatives, processor time", f"{ratio:.2f}", ">= 1")
    print(f"largest error of an angle of the plan: {planned:.1e} rad; with {FINE} steps an interval: {fine:.1e} rad")
    yield Figure(f"the first error / the second, over {FINE}^4", f"{planned / fine / FINE**4:.2f}", "0.5 to 2")


if __name__ == "__main__":
    print(machine())
    print_figures(list(main()))
