"""Efforts that a control law commanded, for bags without efforts and at changes of held targets."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..bag.provenance import KNOWN_UNTIL
from ..bag.recorded_commands import has_joint_commands, joint_commands
from ..bag.recording import Recording, Steps
from ..errors import BagError, InputError
from ..export.fmu_options import FmuOptions
from ..export.package import build_fmu
from ..plant.plant import DiscardError, Plant
from ..plant.robot import load_robot
from ..plant.urdf import RobotError
from ..plant.variables import Value, Variable, variable_table
from .stretches import Array

Values = Mapping[str, object]
LAWS = {"quat_des[1]": "pose", "x_des[1]": "task", "q_des[1]": "joint", "tau_cmd[1]": "effort"}
"""Control law by an input that only it and those after it have."""
SAME = 1e-6  # largest difference of recorded efforts from those of the law, as part of the largest effort


def with_efforts(recording: Recording, options: FmuOptions) -> Recording:
    """Return a recording with efforts in the middle of each change of inputs.

    A run records the effort before a change, but the positions around it are due to the efforts before and after it.
    Therefore the mean of both, by the control law, replaces a recorded effort of the law or a missing one.

    Args:
        options: robot and gains of the controller, for a bag with commands and without run.json.

    Raises:
        InputError: the bag does not determine the efforts.
        BagError: the run.json does not fit the samples.
    """
    if recording.tau.shape != recording.q.shape:
        if not recording.provenance:
            return _of_commands(recording, options)
        return replace(recording, tau=np.mean(commanded_efforts(recording), axis=0))
    try:
        before, after = commanded_efforts(recording)
    except (InputError, BagError):  # no law of this project made the efforts, or a sampled one
        return recording
    same = np.abs(before - recording.tau).max() <= SAME * np.abs(recording.tau).max()
    return replace(recording, tau=0.5 * (before + after)) if same else recording


def commanded_efforts(recording: Recording) -> Array:
    """Return the efforts that the control law of a run commanded before and after each sample, N·m or N, 2 × N × n.

    The run.json of the bag has the law's robot, gains and targets.

    Raises:
        InputError: the bag does not determine the efforts.
        BagError: the run.json does not fit the samples.
    """
    run, name = recording.provenance, recording.path
    if not run or KNOWN_UNTIL in run:
        raise InputError(
            f"'{name}' has no efforts, and no complete run.json with the control law, its gains and targets: record"
            " the effort of each JointState, or a run with `effort`"
        )
    first = recording.schedule[0][1]
    if first.get("control_period"):
        raise InputError(
            f"'{name}' has no efforts, and its controller is sampled, so that its efforts are not known at each time:"
            " repeat the run with `effort`"
        )
    return _efforts(recording, (str(run["urdf"]), run["frame"], run["axes"]), recording.steps, recording.schedule)


def _of_commands(recording: Recording, options: FmuOptions) -> Recording:
    """Return the part of a recording between its commands, with the efforts of joint control, or the commanded ones."""
    name = recording.path
    with TemporaryDirectory() as folder:
        try:
            robot, schedule = joint_commands(build_fmu(Path(folder) / "Robot.fmu", options), recording)
        except InputError as error:
            if options.control != "effort" or not has_joint_commands(recording):
                raise
            raise InputError(
                f"'{name}' has no efforts, and its commands are no efforts: give the gains of joint control with"
                f" `settings`, such as Kp=100 and Kd=20 ({error})"
            ) from error
    t = recording.t
    used = (t > schedule[0][0]) & (t <= schedule[-1][0]) if schedule else np.zeros(len(t), bool)
    if used.sum() < 2:
        raise InputError(f"'{name}' has no efforts, and no commands of all joints while their states were recorded")
    parts = {key: getattr(recording, key)[used] for key in ("stamps", "q", "v") if len(getattr(recording, key))}
    recording = replace(recording, **parts)
    tau = _efforts(recording, robot, t[used], schedule)
    return replace(recording, tau=np.mean(tau, axis=0))


def _efforts(
    recording: Recording, model: tuple[str, str, str], at: Array | Steps, schedule: Sequence[tuple[float, Values]]
) -> Array:
    """Return the efforts before and after each sample, 2 × N × n.

    Args:
        model: text of the URDF, frame and axes.
        at: times of the samples, in the unit of the schedule, N.
        schedule: values of inputs and parameters with the times from which on they apply.

    Raises:
        InputError: the values do not determine the efforts.
    """
    name, first = recording.path, schedule[0][1]
    control = next((law for key, law in LAWS.items() if key in first), "")
    if not control or (recording.v.shape != recording.q.shape and control != "effort"):
        raise InputError(f"'{name}' has neither efforts nor what its control law needs: velocities and targets")
    try:
        robot = load_robot(*model)
        none = (0.0,) * max(4, len(robot.joints))
        table = variable_table(robot, dict.fromkeys(("q_start", "x_des", "quat_des"), none), control)
        plant = Plant(robot, table, control)
        given = [v for v in table if v.causality in ("input", "parameter")]
        begins = [k for k, _ in schedule]
        order = [recording.joints.index(joint) for joint in robot.joints]
        before, after = (np.maximum(np.searchsorted(begins, at, s) - 1, 0) for s in ("left", "right"))
        q, tau = recording.q[:, order], np.zeros((2, *recording.q.shape))
        v = recording.v[:, order] if recording.v.shape == recording.q.shape else np.zeros_like(q)
        last = -1
        for side, places, rows in ((0, before, range(len(q))), (1, after, np.flatnonzero(before != after).tolist())):
            tau[1] = tau[0]
            for k in rows:
                if places[k] != last:
                    last = places[k]
                    _set(plant, given, schedule[last][1])
                tau[side, k, order] = plant.commanded_effort(q[k], v[k])
    except (KeyError, TypeError, ValueError, DiscardError, RobotError) as error:
        raise InputError(
            f"'{name}' has no efforts, and the run.json or commands do not determine them: {error}"
        ) from error
    return tau


def _set(plant: Plant, variables: Sequence[Variable], values: Mapping[str, Value]) -> None:
    """Set inputs and parameters of a plant."""
    for variable in variables:
        if variable.index is None:
            setattr(plant, variable.group, values[variable.name])
        else:
            getattr(plant, variable.group)[variable.index] = values[variable.name]
    plant.prepare()
