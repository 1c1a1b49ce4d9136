"""Start values by name, checked against the variables of an FMU or of a build."""

import re
from collections.abc import Mapping
from itertools import chain, count, takewhile
from typing import Protocol

from ..errors import InputError, choice, nearest
from ..plant.variables import CONTROLS, Value
from .typed_values import Type

Setting = object
"""A number, Boolean or text, or a sequence or array of these; dicts of mixed values have the type dict[str, object]."""


ALIKE = 0.75  # ratio of difflib from which on a variable may be meant
MEANT = {
    "zeta": "Kd",
    "damping_ratio": "Kd",
    "gain": "Kp",
    "stiffness": "Kp",
    "rpy_des": "quat_des",
    "target": "x_des",
    "goal": "x_des",
    "tau_max": "limit_effort",
    "torque": "tau_ext",
    "force": "f_ext",
    "mass": "payload",
    "load": "payload",
    "dt": "control_period",
    "delay": "control_delay",
    "noise": "q_noise",
}
"""Names that people use for variables."""


class Described(Protocol):
    """A variable of an FMU or of a build."""

    @property
    def causality(self) -> str:
        """The causality, as FMI has it."""


class Variables(Protocol):
    """The variables of an FMU or of a build."""

    @property
    def variables(self) -> Mapping[str, Described]:
        """All variables by name, in order."""

    @property
    def control(self) -> str:
        """The control law; "" if unknown."""

    @property
    def aliases(self) -> Mapping[str, str]:
        """Further names, and the names that they stand for."""

    def type_of(self, name: str) -> Type:
        """Return the type of a variable."""

    def source_of(self, name: str) -> str:
        """Return the output that is connected to a variable; "" without a connection."""


def vector(variables: Mapping[str, object], group: str) -> list[str]:
    """Return the names of a vector's elements in order, or of the scalar; empty if there is none."""
    if group in variables:
        return [group]
    names = (f"{group}[{i}]" for i in count(1))
    return list(takewhile(variables.__contains__, names))


def groups_of(variables: Mapping[str, Described], causality: str) -> dict[str, list[str]]:
    """Return vectors and scalars of one causality by group name."""
    groups: dict[str, list[str]] = {}
    for name, variable in variables.items():
        if variable.causality == causality:
            groups.setdefault(name.partition("[")[0], []).append(name)
    return groups


def resolve(fmu: Variables, settings: Mapping[str, Setting]) -> dict[str, Value]:
    """Return values by variable name; a group's name sets all of its elements.

    Raises:
        InputError: a name is unknown or an output, a variable is given under two names, or a value has a wrong number
            or type, or is not finite.
    """
    values, texts = resolve_all(fmu, settings)
    if texts:
        raise InputError(f"{next(iter(texts))} is of type String, which can only be set before a run")
    return values


def resolve_all(fmu: Variables, settings: Mapping[str, Setting]) -> tuple[dict[str, Value], dict[str, str]]:
    """Return values as ``resolve`` does, and those of variables of type String; errors are the same."""
    if not isinstance(settings, Mapping):
        raise InputError(f"settings are values by name, as {{'Kp': 80}}, not {settings!r:.50}")
    values: dict[str, Value] = {}
    texts: dict[str, str] = {}
    names: dict[str, str] = {}
    for asked, setting in settings.items():
        name = fmu.aliases.get(asked, asked)
        if (other := names.setdefault(name, asked)) != asked:
            raise InputError(f"{name} is given twice, as '{other}' and as '{asked}'; leave one out")
        elements = [name] if name in fmu.variables else vector(fmu.variables, name)
        if not elements:
            raise InputError(no_variable(fmu, name, "input", "parameter"))
        # arrays have their own types of numbers
        plain: object = setting.tolist() if hasattr(setting, "tolist") else setting
        if isinstance(plain, Mapping):
            raise InputError(f"{name} is {plain!r:.50}; give its {len(elements)} values in a list")
        given = list(plain) if isinstance(plain, list | tuple) else [plain] * len(elements)
        if len(given) != len(elements):
            raise InputError(f"{name} has {len(elements)} elements, {len(given)} were given")
        for element, value in zip(elements, given, strict=True):
            checked = _checked(fmu, element, value)
            if isinstance(checked, str):
                texts[element] = checked
            else:
                values[element] = checked
    return values, texts


def _checked(fmu: Variables, name: str, value: object) -> Value | str:
    variable = fmu.variables[name]
    if source := fmu.source_of(name):
        raise InputError(f"{name} cannot be set: a connection drives it from {source}; set that, or an input of it")
    if variable.causality not in ("input", "parameter"):
        start = name.replace(group := name.partition("[")[0], f"{group}_start", 1)
        remedy = f"; set {start}" if start in fmu.variables else ""
        raise InputError(f"{name} is of causality '{variable.causality}' and cannot be set{remedy}")
    return fmu.type_of(name).value(value, name)


def _of_another(fmu: Variables, name: str) -> str:
    """Return a hint: the length of a vector, or the control laws that have a variable; "" without a hint."""
    group = name.partition("[")[0]
    having = [c for c, law in CONTROLS.items() if group in (*law.inputs, *law.parameters)]
    elements = vector(fmu.variables, group)
    if elements and fmu.variables[elements[0]].causality in ("input", "parameter"):
        return f": {group} has {len(elements)} elements"
    if name in (joints := getattr(fmu, "joints", ())):
        return f": it is a joint, number {joints.index(name) + 1} of the elements of a vector"
    if not fmu.control or not having:
        return ""
    quoted = " or ".join(f"control '{control}'" for control in having)
    return f": it belongs to {quoted}; this FMU has control '{fmu.control}'"


def no_variable(fmu: Variables, name: str, *causalities: str) -> str:
    """Return the message for an unknown name, with its control law or the nearest names."""
    groups = {g: names for causality in causalities for g, names in groups_of(fmu.variables, causality).items()}
    indexed = re.sub(r"_?(?<!\d)(\d+)$", r"[\1]", name)  # x_des_1 and x_des1 as x_des[1]
    known = [each for each in dict.fromkeys([*groups, *chain(*groups.values())]) if each != name]
    near = nearest(name, known, 0.85)
    if near is None and "." in name:  # Kp of a system, not controller.Kp
        near = nearest(name.rpartition(".")[2], [each for each in known if "." not in each], 0.6)
    unitless = re.sub(r"\s+[\[(].*$", "", name)  # Kp [1/s2] of a table
    part = re.fullmatch(r"(\w+_des|K[pd])[._]([xyz])", unitless)  # x_des.x of an exported table
    axis = f"{part[1]}[{str(getattr(fmu, 'axes', '')).find(part[2]) + 1}]" if part else ""
    of_components = [each for each in known if each.endswith(f".{name}")]
    elements = [each for each in known if each.startswith(f"{name}[")]  # of a vector whose first one is connected
    meant = (*of_components, *elements, indexed, axis, near, MEANT.get(name), unitless)
    own = [each for each in meant if each in known]
    like = f"; did you mean '{own[0]}'?" if own else choice(name, known, ALIKE)
    if len(of_components) > 1:
        like = choice("", of_components)
    return f"there is no variable '{name:.50}'{_of_another(fmu, name) or like}"
