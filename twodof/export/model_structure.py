"""Dependencies of an FMU's unknowns, the element ModelStructure of modelDescription.xml.

Sources: FMI 2.0.4, section 2.2.8; FMI 3.0.2, section 2.4.8.
"""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence

from ..plant.robot import Robot
from ..plant.variables import DISTURBANCES, OF_LINKS, Control, Variable
from .native import INDICATORS

UNKNOWNS_3 = {"Outputs": "Output", "Derivatives": "ContinuousStateDerivative", "InitialUnknowns": "InitialUnknown"}
"""Element names of ModelStructure in FMI 3.0, by those of FMI 2.0."""
STATES = ("q", "v")
START = ("q_start", "q_min", "q_max")  # variables on which the start value of q depends
KNOWN = ("payload", "payload_com", "armature")
INERTIAL = (*KNOWN, *OF_LINKS)
"""Parameters on which the mass matrix depends; KNOWN are those on which the control law's model may depend."""
IMPACT = (*START, "v_start", *INERTIAL, "rigid_stops")
"""Variables on which the start value of v depends, because a velocity into a stop is removed."""
OWN, FRAME, EVERY = "that joint's", "those of joints that move the frame", "all"
Dependencies = tuple[Sequence[str], str] | tuple[Sequence[str], str, Sequence[str]]
"""Groups on which a variable depends, their elements, and groups of which it depends on its own element only."""
SENSORS = ("q_resolution", "q_noise", "v_noise", "seed", "v_from_q")  # variables on which the first sample depends


def _dependencies(control: Control, free: Collection[str]) -> tuple[dict[str, Dependencies], dict[str, Dependencies]]:
    """Return the groups and elements on which each computed group depends, during a run and at its start."""
    inputs = (*control.inputs, *DISTURBANCES, *free)
    law = ("gravity", *control.parameters, "limit_effort", *SENSORS, "control_delay")

    def within(groups: Sequence[str]) -> list[str]:
        return [group for group in groups if group in free]

    during: dict[str, Dependencies] = {
        "q": (("q",), OWN),
        "v": (("v",), OWN),
        "der_q": (("v",), OWN),
        "x": (("q",), FRAME),
        "quat": (("q",), FRAME),
        "xd": (STATES, FRAME),
        "omega": (STATES, FRAME),
        "M": (("q", *within(INERTIAL)), EVERY),
        "h": ((*STATES, *within((*INERTIAL, "gravity"))), EVERY),
        "J": (("q",), FRAME),
        "drift": (STATES, FRAME),
        "tau": ((*STATES, *control.inputs, *within((*KNOWN, "gravity"))), EVERY),
        "q_meas": (("q",), OWN),
        "v_meas": (STATES, OWN),
        "der_v": ((*STATES, *inputs), EVERY),
    }
    at_the_start: dict[str, Dependencies] = {
        "q": (START, OWN),
        "x": (START, FRAME),
        "quat": (START, FRAME),
        "J": (START, FRAME),
        "M": ((*START, *INERTIAL), EVERY),
        "h": ((*IMPACT, "gravity"), EVERY),
        **dict.fromkeys(("v", "xd", "omega", "drift", "der_q"), (IMPACT, EVERY)),
        "tau": ((*IMPACT, *law, *control.inputs, *STATES), EVERY),
        "q_meas": ((*START, "q", "q_resolution", "q_noise", "seed"), OWN),
        "v_meas": (IMPACT, EVERY, ("v", "v_noise", "seed", "v_from_q")),
        "der_v": ((*IMPACT, "friction", "damping", *law, "control_period", *inputs), EVERY),
    }
    if control.commands == "effort":
        during["tau"] = (control.inputs, OWN)
        at_the_start["tau"] = (("limit_effort", "control_delay", *control.inputs), OWN)
    return during, at_the_start


def add_structure(
    root: ET.Element, robot: Robot, table: Sequence[Variable], references: Sequence[str], control: Control, fmi: int
) -> None:
    """Add ModelStructure: the unknowns, with the references of the variables on which each depends."""
    moves = robot.moves_frame()
    during, at_the_start = _dependencies(control, {v.group for v in table if v.is_free})

    def known(unknown: Variable, groups: Sequence[str], whose: str, own: Sequence[str] = ()) -> dict[str, None]:
        """Return the sorted references of the variables on which an unknown depends."""
        return {
            reference: None
            for variable, reference in zip(table, references)
            if (variable.group in (*groups, *own))
            and ((whose != OWN and variable.group not in own) or variable.index in (unknown.index, None))
            and (whose != FRAME or (variable.index is not None and moves[variable.index]))
        }

    computed = {reference for variable, reference in zip(table, references) if variable.causality == "output"}
    unknowns: dict[str, dict[str, dict[str, None]]] = {part: {} for part in UNKNOWNS_3}
    for variable, reference in zip(table, references):
        if variable.group in during and variable.causality != "input":
            kind = "Outputs" if variable.causality == "output" else "Derivatives"
            for part, rule in ((kind, during), ("InitialUnknowns", at_the_start)):
                dependencies = known(variable, *rule[variable.group])
                if rule is at_the_start:  # where q and v are outputs, they follow from parameters
                    dependencies = {key: None for key in dependencies if key not in computed}
                unknowns[part].setdefault(reference, {}).update(dependencies)
    structure = ET.SubElement(root, "ModelStructure")
    for part, name in UNKNOWNS_3.items():
        if not unknowns[part]:
            continue
        parent = ET.SubElement(structure, part) if fmi == 2 else structure
        tag, key = ("Unknown", "index") if fmi == 2 else (name, "valueReference")
        for reference, dependencies in unknowns[part].items():
            ET.SubElement(parent, tag, {key: reference, "dependencies": " ".join(dependencies)})
    indicators = (r for v, r in zip(table, references) if v.group == INDICATORS)
    for reference in dict.fromkeys(indicators):
        ET.SubElement(structure, "EventIndicator", valueReference=reference)
