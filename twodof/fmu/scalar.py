"""Scalar variables and elements of arrays of an FMU's description."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from math import inf, prod

from fmpy.model_description import ModelVariable

from ..bounds import MAX_NAME
from ..errors import FmuError
from ..export.typed_values import LARGEST, WHOLE, Type
from .validation import NUMBERS


@dataclass(frozen=True)
class Scalar:
    """A scalar variable, or an element of an array of FMI 3.0."""

    name: str  # name; an element's name has 1-based indices, e.g. "q[1]", "der(q[1])"
    causality: str
    # "Real" also for Float64, "Integer" also for Int32, "Boolean", or another type of the description, with brackets
    # for an array of Strings
    type: str
    unit: str | None
    start: str | None  # text of the start value; None without one
    description: str  # description of the scalar, or of the whole array
    reference: int
    variability: str  # as in the description, or its default there
    relative: bool  # whether it is a difference of values, to which the offset of a unit does not apply
    element: int = 0  # 0-based index in the array, row by row
    low: str | None = None  # low, high: texts of the range; None without one
    high: str | None = None
    # numbers of the items of an enumeration by name; scalars of one type share it
    items: Mapping[str, int] = field(default_factory=dict, hash=False)
    exact: bool = False  # whether its value is the start value until the end of initialisation, at least

    @property
    def start_value(self) -> float | bool | None:
        """Start value of a number or Boolean that has one."""
        read = NUMBERS.get(self.type)
        return None if self.start is None or read is None else read(self.start)

    @property
    def initial_value(self) -> float | bool | str:
        """Start value of any type; 0, false or an empty text without one."""
        read = NUMBERS.get(self.type) or (int if self.type in WHOLE else float if self.type in LARGEST else str)
        return read("0" if read is not str else "") if self.start is None else read(self.start)

    @property
    def is_calculated(self) -> bool:
        """True if an importer cannot give it a start value; FMI 2.0.4, section 2.2.7."""
        starts = self.start is not None or self.causality in ("input", "parameter", "structuralParameter")
        return not starts or self.variability == "constant"

    @property
    def value_type(self) -> Type:
        """Type, with the range of whole numbers and of Float32; FMUs refuse other real numbers themselves."""
        if self.type not in WHOLE and self.type != "Float32":
            return Type(self.type)
        read = int if self.type in WHOLE else float
        low, high = (end if text is None else read(text) for text, end in ((self.low, -inf), (self.high, inf)))
        return Type(self.type, low, high, self.items)


def scalars(variable: ModelVariable, items: Mapping[str, int]) -> Iterator[Scalar]:
    """Yield a scalar variable itself, or the elements of an array, with the items of its enumeration."""
    kind = {"Float64": "Real", "Int32": "Integer"}.get(variable.type, variable.type)
    kind += "[]" if kind == "String" and variable.dimensions else ""
    whole = Scalar(
        name=variable.name,
        causality=variable.causality,
        type=kind,
        unit=variable.unit,
        start=variable.start,
        description=(variable.description or "")[:MAX_NAME],
        reference=variable.valueReference,
        variability=variable.variability,
        relative=bool(variable.relativeQuantity),
        low=variable.min,
        high=variable.max,
        items=items,
        exact=variable.initial == "exact" or variable.variability == "constant",
    )
    if not variable.dimensions:
        yield whole
        return
    starts: list[str | None] = [*(variable.start or "").split()] or [None]
    if kind == "Real" and len(starts) not in (1, prod(variable.shape)):
        raise FmuError(f"{variable.name} has {len(starts)} start values; expected one, or one for each element")
    inner = re.fullmatch(r"der\((.*)\)", variable.name)
    for i, indices in enumerate(product(*(range(1, size + 1) for size in variable.shape))):
        index = f"[{','.join(map(str, indices))}]"
        name = f"der({inner[1]}{index})" if inner else variable.name + index
        yield replace(whole, name=name, start=starts[i % len(starts)], element=i)
