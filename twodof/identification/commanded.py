"""Efforts that the control law of a run commanded, for bags without efforts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..bag.provenance import KNOWN_UNTIL
from ..bag.recording import Recording
from ..errors import InputError
from ..plant.plant import DiscardError, Plant
from ..plant.robot import load_robot
from ..plant.urdf import RobotError
from ..plant.variables import Value, Variable, variable_table
from .stretches import Array

LAWS = {"quat_des[1]": "pose", "x_des[1]": "task", "q_des[1]": "joint", "tau_cmd[1]": "effort"}
"""Control law by an input that only it and those after it have."""


def commanded_efforts(recording: Recording) -> Array:
    """Return the efforts that the control law commanded at the measured states, N·m or N, N × n.

    The run.json of the bag has the law's robot, gains and targets. At a change of inputs, the effort is the mean of
    those before and after it, because the positions around this sample are due to both.

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
    control = next((law for key, law in LAWS.items() if key in first), "")
    if recording.v.shape != recording.q.shape or not control:
        raise InputError(f"'{name}' has neither efforts nor what its control law needs: velocities and targets")
    try:
        robot = load_robot(str(run["urdf"]), run["frame"], run["axes"])
        none = (0.0,) * max(4, len(robot.joints))
        table = variable_table(robot, dict.fromkeys(("q_start", "x_des", "quat_des"), none), control)
        plant = Plant(robot, table, control)
        given = [v for v in table if v.causality in ("input", "parameter")]
        begins = [k for k, _ in recording.schedule]
        order = [recording.joints.index(joint) for joint in robot.joints]
        before, after = (np.maximum(np.searchsorted(begins, recording.steps, s) - 1, 0) for s in ("left", "right"))
        q, v, tau = recording.q[:, order], recording.v[:, order], np.zeros((2, *recording.q.shape))
        last = -1
        for side, at, rows in ((0, before, range(len(q))), (1, after, np.flatnonzero(before != after).tolist())):
            tau[1] = tau[0]
            for k in rows:
                if at[k] != last:
                    last = at[k]
                    _set(plant, given, recording.schedule[last][1])
                tau[side, k, order] = plant.commanded_effort(q[k], v[k])
    except (KeyError, TypeError, ValueError, DiscardError, RobotError) as error:
        raise InputError(f"'{name}' has no efforts, and its run.json does not determine them: {error}") from error
    mean: Array = 0.5 * (tau[0] + tau[1])
    return mean


def _set(plant: Plant, variables: Sequence[Variable], values: Mapping[str, Value]) -> None:
    """Set inputs and parameters of a plant."""
    for variable in variables:
        if variable.index is None:
            setattr(plant, variable.group, values[variable.name])
        else:
            getattr(plant, variable.group)[variable.index] = values[variable.name]
    plant.prepare()
