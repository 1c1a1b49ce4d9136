"""Values of variables of each type of FMI 2.0 and 3.0, checked against the type and the variable's own range."""

import sys
from collections.abc import Mapping
from contextlib import suppress
from math import inf, isfinite
from typing import NamedTuple

from ..errors import InputError
from ..plant.numerals import whole_number
from ..plant.variables import Value

WHOLE = {f"Int{bits}": range(-(2 ** (bits - 1)), 2 ** (bits - 1)) for bits in (8, 16, 32, 64)}
WHOLE |= {f"UInt{bits}": range(2**bits) for bits in (8, 16, 32, 64)}
WHOLE |= {"Integer": WHOLE["Int32"], "Enumeration": WHOLE["Int64"]}
"""Ranges of the integer types."""
DISCRETE = {"Boolean", "String", *WHOLE}
"""Types of variables that are no real numbers."""
LARGEST = {"Real": sys.float_info.max, "Float32": 3.4028234663852886e38}
"""Largest magnitude of each type of real numbers."""
IN_FMI_2 = {**{kind: kind for kind in ("Real", "Integer", "Boolean", "String")}, "Enumeration": "Integer"}
IN_FMI_3 = {kind: kind for kind in ("Float32", "Boolean", "String", *WHOLE)}
IN_FMI_3 |= {"Real": "Float64", "Integer": "Int32", "Enumeration": "Int64"}
"""Names in calls of FMI 2.0 and 3.0 for each type."""


class Type(NamedTuple):
    """Type of a variable: its name in FMI, or "Real", "Integer"; its range; items of an enumeration by name."""

    name: str
    low: float = -inf
    high: float = inf
    items: Mapping[str, int] = {}

    def value(self, given: object, name: str) -> Value | str:
        """Return a value of this type for the variable ``name``; an item of an enumeration may be given by its name."""
        if self.name == "Boolean":
            if not isinstance(given, bool):
                raise InputError(f"{name} = {given!r:.50}: expected true or false")
            return given
        if self.name == "String":
            if not isinstance(given, str) or "\0" in given:
                raise InputError(f"{name} = {given!r:.50}: expected a text")
            return given
        if self.name == "Enumeration":
            return self._item(given, name)
        if self.name not in (*LARGEST, *WHOLE):
            raise InputError(f"{name} is of type {self.name} and cannot be set; numbers, Booleans and Strings can")
        return self._number(given, name)

    def _number(self, given: object, name: str) -> float:
        if isinstance(given, bool) or not isinstance(given, int | float):
            raise InputError(f"{name} = {given!r:.50}: expected a number")
        try:
            number = float(given)
        except OverflowError:  # an integer too large for a float
            number = inf if given > 0 else -inf
        if not isfinite(number):
            raise InputError(f"{name} = {number} is not finite")
        whole, low, high = WHOLE.get(self.name), f"{self.low:.12g}", f"{self.high:.12g}"
        text = f"{given}" if isinstance(given, int) else f"{given:.17g}"
        within = self.low <= number <= self.high
        if whole is not None:
            if not number.is_integer():
                raise InputError(f"{name} = {text} must be a whole number")
            number, least, most = int(given), max(self.low, whole[0]), min(self.high, whole[-1])
            low, high, within = f"{least}", f"{most}", least <= number <= most
        elif abs(number) > LARGEST[self.name]:
            raise InputError(f"{name} = {text} is too large for its type {self.name}")
        if not within:
            raise InputError(f"{name} = {text} must be in [{low}, {high}]")
        return number

    def _item(self, given: object, name: str) -> int:
        number = self.items.get(given) if isinstance(given, str) else given
        if number is None:
            with suppress(ValueError):
                number = whole_number(str(given))
        if isinstance(number, bool) or number not in self.items.values():
            there = ", ".join(f"{item} ({value})" for item, value in self.items.items())
            raise InputError(f"{name} = {given!r:.50} is not in its enumeration; there are: {there:.500}")
        return next(value for value in self.items.values() if value == number)
