"""Reference trajectories in an FMU, for checks of importers.

There are four experiments of 0.5 s from the start position. In "move", the robot follows targets, or efforts of a
controller. In "push", there are also external efforts, rotors, a payload that a controller knows, velocities at the
start, accelerations of the target, and different gains of the axes. In "sample", the controller takes samples with
noise, and its efforts are late. In "rest", joints have friction, stick, slip, and reach rigid stops. Inputs are
constant over HOLD steps, and references are samples at which neither an input changes nor the controller takes a
sample. Therefore the result does not depend on whether an importer sets inputs before or after it reads outputs, or
interpolates them. Parameters and inputs that keep their start values are not in the files, except inputs of "push".

Each sample is solved twice, by Dormand and Prince's order 8 and by Radau IIA of order 5 (Hairer, Norsett & Wanner,
"Solving ODEs" I and II), with Pinocchio's equations of motion. At an event of friction or stops, which SciPy locates,
both continue by the plant's rules. Where a closed form exists it is the reference, and both solvers must agree with it.
The format is FMI-LS-REF 1.0.0-beta.1 with MA-HS-Experiments and parameter sets of SSP 1.0.
"""

import hashlib
import logging
from collections.abc import Iterable, Mapping, Sequence
from xml.etree import ElementTree as ET

import numpy as np

from ..errors import BuildError
from ..plant.plant import Plant
from ..plant.robot import Robot
from ..plant.variables import OF_LINKS, ON_REQUEST, Variable
from .closed_form import Array, responses
from .event_solver import advanced
from .fmi3_files import xml_text

FOLDER = "extra/org.fmi-standard.fmi-ls-ref"
MANIFEST = "http://fmi-standard.org/fmi-ls-manifest"
SSV = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
STEPS, STEP, HOLD = 50, 0.01, 5  # communication steps, s, steps
PERIOD, DELAY = 3, 1  # of the sampled controller, communication steps
ROWS = [k for k in range(1, STEPS + 1) if k % HOLD]  # samples of the references
SWING, ACCELERATION = 0.05, 0.5  # rad or m of each joint, rad/s² or m/s²
TIGHT = {"rtol": 1e-11, "atol": 1e-13}
SOLVERS = {"DOP853": 1e-13, "Radau": 1e-11}  # SciPy's solvers, with their tolerances
LEAST_TOLERANCE, EVENT_TOLERANCE, MOST_TOLERANCE = 1e-10, 1e-8, 1e-7
"""Tolerances relative to a variable's largest magnitude, or to 1. The first one is for the error of the FMU's
integrator, the second one for that with events. If the solvers differ by more than the third one, there is no
reference.
"""
IDEAL: dict[str, float | bool] = {
    **dict.fromkeys(("friction", "control_period", "control_delay", "q_resolution", "q_noise", "v_noise"), 0.0),
    **{"v_from_q": False, "limit_effort": False, **TIGHT},
}
"""Parameters with which the motion is smooth, by group."""
SAMPLED: dict[str, float] = {"control_period": PERIOD * STEP, "control_delay": DELAY * STEP, "seed": 7} | {
    "q_resolution": 1e-3, "q_noise": 1e-3, "v_noise": 1e-2, "Kp": 25.0, "Kd": 10.0, "Kp_rot": 25.0, "Kd_rot": 10.0
}  # fmt: skip
"""Parameters and inputs of "sample", by group. The loop is stable with these gains."""
GROUPS = ("q", "v", "x", "xd", "quat", "omega", "tau", "q_meas", "v_meas", "der_q", "der_v")
"""Groups with results in all experiments; outputs on request have results in "push" only."""
PART = 0.01  # payload and rotors of "push", relative to the robot's inertia
Columns = dict[str, Array]


LOG = logging.getLogger(__name__)


def references(robot: Robot, table: Sequence[Variable], control: str) -> dict[str, bytes]:
    """Return the files of the folder ``extra``, by their path in the FMU.

    Raises:
        BuildError: the motion from the start position is not smooth, or the solvers do not agree.
    """
    names = {v.name: v for v in table if v.group not in OF_LINKS}  # links keep their exact start values
    files: dict[str, bytes] = {}
    experiments = ET.Element("Experiments", name="references", description="Co-simulation with its reference results")
    for name in ("move", "push", "sample", "rest"):
        try:
            values, stimuli, results, tolerance, exact = _experiment(Plant(robot, table, control), names, name)
        except BuildError as error:
            if name != "rest":
                raise
            reason = str(error).removeprefix("no references: ")  # impacts can make the motion sensitive
            LOG.warning(f"no reference has friction and stops: {reason}")
            continue
        times: Array = STEP * np.arange(STEPS + 1, dtype=np.float64)
        rows = [k for k in ROWS if name != "sample" or k % PERIOD]
        stimuli = {n: column for n, column in stimuli.items() if name == "push" or (column != names[n].start).any()}
        files[f"{name}-in.csv"] = _csv(times, stimuli)
        files[f"{name}-ref.csv"] = _csv(times[rows], {key: column[rows] for key, column in results.items()})
        texts = {
            n: str(value).lower() if isinstance(value, bool) else f"{value:.9g}"
            for n, value in values.items()
            if names[n].causality != "input" and value != names[n].start
        }
        files[f"{name}.ssv"] = parameter_set(name, ((n, names[n].type, value) for n, value in texts.items()))
        text = f"{', '.join(exact)} in closed form, the rest by" if exact else "by"
        described = f"references: {text} two solvers; deviations are of a variable's largest magnitude, or of 1"
        experiment = ET.SubElement(experiments, "Experiment", name=name, description=described)
        experiment.set("tolerance", f"{tolerance:.3g}")
        span = {"startTime": "0", "stopTime": f"{STEPS * STEP:g}", "stepSize": f"{STEP:g}"}
        ET.SubElement(experiment, "TransientSimulation", span)
        for tag, source in (
            ("Parameters", f"{name}.ssv"),
            ("Stimuli", f"{name}-in.csv"),
            ("References", f"{name}-ref.csv"),
        ):
            ET.SubElement(experiment, tag, source=source)
    files["references.exp"] = xml_text(experiments)
    files["fmi-ls-manifest.xml"] = _manifest(files)
    return {f"{FOLDER}/{name}": content for name, content in files.items()}


def _experiment(
    plant: Plant, names: Mapping[str, Variable], name: str
) -> tuple[dict[str, float | bool], Columns, Columns, float, list[str]]:
    """Return an experiment's values, stimuli, results and tolerance, and the names of results in closed form."""
    values = {n: IDEAL[v.group] for n, v in names.items() if v.group in IDEAL}
    values |= {
        n: v.start + 1e3 * (-1) ** (v.group == "q_min") for n, v in names.items() if v.group in ("q_min", "q_max")
    }
    values |= _damping(plant, names, 0.0 if name == "move" else 1.0 / STEP)
    if name == "sample":
        values |= {n: SAMPLED[v.group] for n, v in names.items() if v.group in SAMPLED}
    _apply(plant, names, values)
    if name in ("push", "rest"):
        values |= _load(plant, names) if name == "push" else _rubbing(plant, names)
        _apply(plant, names, values)
    stimuli = _stimuli(plant, names, values, name)
    if name == "rest":
        values |= _narrowed(plant, names, stimuli)
        _apply(plant, names, values)
    compared = (*GROUPS, *ON_REQUEST) if name == "push" else GROUPS
    found = [_solve(plant, names, compared, stimuli, method, tolerance) for method, tolerance in SOLVERS.items()]
    return values, stimuli, found[0], *_tolerance(plant, stimuli, found)


def _apply(plant: Plant, names: Mapping[str, Variable], values: Mapping[str, float | bool]) -> None:
    for name, value in values.items():
        _set(plant, names[name], value)
    plant.initialise()


def _set(plant: Plant, variable: Variable, value: float | bool) -> None:
    if variable.index is None:
        setattr(plant, variable.group, value)
    else:
        getattr(plant, variable.group)[variable.index] = value


def _damping(plant: Plant, names: Mapping[str, Variable], rate: float) -> dict[str, float | bool]:
    """Return the damping of joints, reduced to a largest rate of velocities, 1/s, and then rounded as in the file.

    In the acceleration of a stiff joint, this rate multiplies the integrator's error of the velocity.
    """
    most = rate / np.diag(np.linalg.inv(plant.known.mass_matrix(np.array(plant.q))))
    damped = {n: v for n, v in names.items() if v.group == "damping" and v.start > most[v.index or 0]}
    return {n: float(f"{most[v.index or 0]:.9g}") for n, v in damped.items()}


def _load(plant: Plant, names: Mapping[str, Variable]) -> dict[str, float | bool]:
    """Return a known payload, rotors and velocities at the start, different for each joint, rounded as in the file."""
    n = len(plant.q)
    mass, steps = np.diag(plant.known.mass_matrix(np.array(plant.q))), 1.0 + np.arange(n) / n
    groups = {
        "payload": PART * sum(inertia.mass for inertia in plant.robot.model.inertias) * np.ones(1),
        "payload_com": np.array([0.02, -0.01, 0.03]),
        "armature": PART * mass * steps,
        "v_start": SWING * (-1.0) ** np.arange(n) * steps,
    }
    known = {name: True for name, variable in names.items() if variable.group == "payload_known"}
    return known | {
        name: float(f"{groups[v.group][v.index or 0]:.9g}") for name, v in names.items() if v.group in groups
    }


def _rubbing(plant: Plant, names: Mapping[str, Variable]) -> dict[str, float | bool]:
    """Return the parameters of "rest": rigid stops, friction and rotors, rounded as in the file.

    A joint of strong friction and small inertia would otherwise stop within microseconds, and each impact of another
    joint would let it slip for as short a time. Its state, and the order of such events, would depend on rounding.
    """
    mass = np.diag(plant.known.mass_matrix(np.array(plant.q)))
    starts = [v.start for v in names.values() if v.group == "friction"]
    friction = np.array([F or ACCELERATION * m for F, m in zip(starts, mass)])
    groups = {"friction": friction, "armature": plant.armature + np.maximum(0.0, friction / ACCELERATION - mass)}
    values: dict[str, float | bool] = {n: True for n, v in names.items() if v.group == "rigid_stops"}
    return values | {
        name: float(f"{groups[v.group][v.index or 0]:.9g}") for name, v in names.items() if v.group in groups
    }


def _narrowed(plant: Plant, names: Mapping[str, Variable], stimuli: Columns) -> dict[str, float | bool]:
    """Return joint limits at half of the distance that each joint moves without them, rounded as in the file."""
    ways = _solve(plant, names, ["q"], stimuli, "DOP853", 1e-6)
    ends = {"q_min": np.min, "q_max": np.max}
    return {
        n: float(f"{(column[0] + ends[v.group](column)) / 2.0 + 1e-3 * SWING * (-1) ** (v.group == 'q_min'):.9g}")
        for n, v in names.items()
        if v.group in ends
        for column in [ways[f"q[{(v.index or 0) + 1}]"]]
    }


def _stimuli(plant: Plant, names: Mapping[str, Variable], given: Mapping[str, float | bool], kind: str) -> Columns:
    """Return the inputs at each communication point, STEPS + 1 values each, rounded as in the file."""
    n, q, blocks, push = len(plant.q), np.array(plant.q), STEPS // HOLD, kind == "push"
    size = 0.1 if kind == "rest" else 1.0  # friction holds the joints that only the controller moves
    swing, x = size * SWING * (-1.0) ** np.arange(n), np.array(plant.x)
    plant.q = [*(q + swing)]
    reach = np.array(plant.x) - x
    plant.q = [*q]
    block = np.arange(STEPS + 1)[:, None] // HOLD
    ramp, moves = np.minimum((block + 1.0) / blocks, 0.8), block < blocks // 2
    phase, mass = 2.0 * np.pi * block / blocks + np.arange(n), plant.known.mass_matrix(q)
    inputs = {
        "x_des": x + ramp * reach,
        "xd_des": moves * reach,
        "q_des": q + ramp * swing,
        "v_des": moves * swing,
        "tau_cmd": plant.known.inverse_dynamics(q, 0.0 * q, 0.0 * q) + size * ACCELERATION * np.cos(phase) @ mass,
    }
    if push:
        J = np.array(plant.known.observe(q, 0.0 * q)[1][:3])
        mobility = float(np.linalg.norm(J @ np.linalg.solve(mass, J.T), 2)) or 1.0
        inputs["tau_ext"] = ACCELERATION * np.sin(phase) @ mass
        inputs["f_ext"] = ACCELERATION / mobility * np.cos(phase[:, :1] + np.arange(3))
        inputs["a_des"] = PART * ACCELERATION * np.sin(phase)
        inputs["xdd_des"] = inputs["alpha_des"] = PART * ACCELERATION * np.sin(phase[:, :1] + np.arange(3))
    if kind == "rest":  # forth, free, back, free
        turns = np.array([1.0, 0.0, -1.0, 0.0])[(block + np.arange(n)) // 2 % 4]
        inputs["tau_ext"] = turns * (ACCELERATION * np.diag(mass) + 2.0 * np.array(plant.friction))
    columns = {}
    for name, variable in names.items():
        if variable.causality == "input":
            group = inputs.get(variable.group)
            held = given.get(name, variable.start)  # parameters may be inputs
            values = np.full(STEPS + 1, held, float) if group is None else group[:, variable.index]
            if push and variable.group.startswith(("Kp", "Kd")):
                values *= 1.0 + (variable.index or 0) / 10.0
            columns[name] = np.array([float(f"{value:.9g}") for value in values])
    return columns


def _solve(
    plant: Plant, names: Mapping[str, Variable], groups: Sequence[str], stimuli: Columns, method: str, tolerance: float
) -> Columns:
    """Return groups of outputs at each communication point by one solver, with inputs held over each step."""
    rank, plant.time = -1, 0.0
    plant.initialise()
    outputs = [v for v in names.values() if v.group in groups]
    rows = np.empty((STEPS + 1, len(outputs)))
    for k in range(STEPS + 1):
        plant.time = k * STEP
        vectors = {group: getattr(plant, group) for group in {variable.group for variable in outputs}}
        rows[k] = [vectors[variable.group][variable.index] for variable in outputs]
        for name, column in stimuli.items():
            _set(plant, names[name], float(column[k]))
        if plant.control_period:
            plant.sampling = plant.sampling.settled(plant, plant.time)
        equations = plant.equations_of_motion()
        kept = sum(ratio > equations.rcond for ratio in equations.ratios(np.array(plant.q)))
        if rank not in (-1, kept):
            raise BuildError("no references: the robot passes a singular pose near its start; choose another `q_start`")
        rank = kept
        end = advanced(plant, STEP, method, tolerance)
        plant.q, plant.v = end[: len(plant.q)].tolist(), end[len(plant.q) :].tolist()
    return {variable.name: column for variable, column in zip(outputs, rows.T)}


def _tolerance(plant: Plant, stimuli: Columns, found: Sequence[Columns]) -> tuple[float, list[str]]:
    """Put the closed form into the references; return the tolerance, and the names with a closed form."""
    first, second = found
    exact = _closed_form(plant, stimuli, first)
    first |= exact
    scales = {name: max(1.0, float(np.abs(column).max())) for name, column in first.items()}
    off = {name: np.abs(column - first[name])[ROWS] / scales[name] for name, column in second.items()}
    apart = {name: float(column.max()) for name, column in off.items()}
    worst = max(apart, key=lambda name: apart[name])
    if not apart[worst] <= MOST_TOLERANCE:
        began = STEP * ROWS[int((~(np.array([*off.values()]) <= MOST_TOLERANCE)).any(axis=0).argmax())]
        text = f"solvers and closed form differ by {apart[worst]:.2g} in {worst}, first at {began:g} s"
        raise BuildError(f"no references: {text}; choose another `q_start`")
    least = EVENT_TOLERANCE if any(plant.friction) else LEAST_TOLERANCE
    return max(least, 10.0 * apart[worst]), [*exact]


def _closed_form(plant: Plant, stimuli: Columns, solved: Columns) -> Columns:
    """Return the columns that obey ë + Kd ė + Kp e = 0 between two samples, from the state at the start."""
    group, rate = ("q", "v") if plant.control == "joint" else ("x", "xd")
    names = [name for name in solved if name.startswith(f"{group}[") and name.replace(group, f"{group}_des") in stimuli]
    equations = plant.equations_of_motion()
    rows = len(plant.robot.axes) + 3 * (plant.control == "pose")
    full = rows <= len(plant.q) and min(equations.ratios(np.array(plant.q)), default=1.0) > equations.rcond
    pushed = any(column.any() for name, column in stimuli.items() if name.startswith(("tau_ext", "f_ext")))
    rough = plant.control_period or any(plant.damping) or any(plant.friction)
    if rough or pushed or not (full or group == "q") or (plant.payload and not plant.payload_known):
        return {}
    columns: Columns = {}
    for name in names:
        i = name.removeprefix(group)
        target, speed, push = (
            stimuli.get(f"{g}_des{i}", np.zeros(STEPS + 1)) for g in (group, rate, "a" if group == "q" else "xdd")
        )
        e, v = [solved[name][0]], [solved[f"{rate}{i}"][0]]
        for k in range(STEPS):
            Kp, Kd = stimuli[f"Kp{i}"][k], stimuli[f"Kd{i}"][k]
            phi, psi, gamma, psi_rate = (float(part[0]) for part in responses(np.array([STEP]), Kp, Kd))
            a, off = push[k] + Kd * speed[k], e[-1] - target[k]
            e.append(target[k] + phi * off + psi * v[-1] + gamma * a)
            v.append(-Kp * psi * off + psi_rate * v[-1] + psi * a)
        columns |= {name: np.array(e), f"{rate}{i}": np.array(v)}
    return columns


# --- files ---


def _csv(times: Array, columns: Columns) -> bytes:
    """Return a CSV with twelve digits, which are equal on all machines."""
    rows = [[f"{value:.12g}" for value in row] for row in np.column_stack([times, *columns.values()])]
    names = [f'"{name}"' if "," in name else name for name in columns]
    return "".join(f"{','.join(row)}\n" for row in [["time", *names], *rows]).encode()


def parameter_set(name: str, rows: Iterable[tuple[str, str, str]]) -> bytes:
    """Return the text of a parameter set of SSP 1.0, by name, type and value of each parameter."""
    root = ET.Element("ssv:ParameterSet", {"xmlns:ssv": SSV, "version": "1.0", "name": name})
    parameters = ET.SubElement(root, "ssv:Parameters")
    for own, kind, value in rows:
        ET.SubElement(ET.SubElement(parameters, "ssv:Parameter", name=own), f"ssv:{kind}", value=value)
    return xml_text(root)


def _manifest(files: Mapping[str, bytes]) -> bytes:
    """Return the text of fmi-ls-manifest.xml, with the digests of the files."""
    about = "Layered Standard providing information on related files included in an FMU."
    facts = {"name": "org.fmi-standard.fmi-ls-ref", "version": "1.0.0-beta.1", "description": about}
    root = ET.Element(
        "fmiReferences", {"xmlns:fmi-ls": MANIFEST, **{f"fmi-ls:fmi-ls-{k}": v for k, v in facts.items()}}
    )
    kinds = {
        "exp": ("application/x-ma-hs-experiments", "experiment/smoke-test"),
        "ssv": ("application/x-ssp-parameter-set", "parameter"),
        "csv": ("text/csv", "other"),
    }
    for name, content in sorted(files.items()):
        kind, role = kinds[name.rpartition(".")[2]]
        role = "result" if name.endswith("-ref.csv") else role
        ET.SubElement(
            root, "Related", type=kind, source=name, role=role, checksum=hashlib.sha3_256(content).hexdigest()
        )
    return xml_text(root)
