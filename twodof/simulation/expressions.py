"""Expressions of metrics, for example a cost or a condition, evaluated without running code.

Numbers, names, + − * / **, comparisons, and abs, min and max of two values.
"""

import ast
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, nearest

LONGEST = 500  # characters
Numbers = NDArray[np.float64 | np.bool_]
OPERATORS: dict[object, Callable[..., Numbers]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ("abs", 1): np.abs,
    ("min", 2): np.minimum,
    ("max", 2): np.maximum,
}
"""Operators, and functions by name and number of arguments."""
Values = Mapping[str, ArrayLike]


class Expression(NamedTuple):
    """A checked expression: its names, and a function that evaluates it for numbers or equal-sized arrays by name."""

    text: str
    names: tuple[str, ...]
    value: Callable[[Values], Numbers]


def full_name(name: str, known: Iterable[str]) -> str:
    """Return the known name that equals, begins with, or is "final_" + a name; "" for none or several."""
    names = [*known]
    for candidate in (name, f"final_{name}"):
        if candidate in names:
            return candidate
    begun = [each for each in names if each.startswith(name)]
    return begun[0] if len(begun) == 1 else ""


def expression(text: str, known: Iterable[str], *, condition: bool) -> Expression:
    """Read an expression of known names: a condition such as "error > 1e-3", or a value such as "settling + overshoot".

    Raises:
        InputError: the text is not such an expression, or has an unknown name.
    """
    known = tuple(known)
    try:
        if len(text) > LONGEST:
            raise ValueError
        names: list[str] = []
        value = _compiled(ast.parse(text.strip(), mode="eval").body, names, condition)
    except (ValueError, SyntaxError, OverflowError, RecursionError, MemoryError):
        like = "a comparison, as 'error > 1e-3'" if condition else "a value, as 'settling + 0.1*peak_effort'"
        if re.search(r"\b(and|or)\b|,|&", text):
            remedy = "; give each condition separately" if condition else ""
        else:
            remedy = "; leave units out" if re.search(r"\d\s*(%|(?!e[-+]?\d)[^\W\d])", text) else ""
        raise InputError(f"'{text:.100}' is not {like}{remedy}") from None
    if not names:
        raise InputError(f"'{text:.100}' names no metric; there are: {', '.join(known)}")
    for name in names:
        if not full_name(name, known):
            near = " or ".join(each for each in known if each.startswith(name)) or nearest(name, known, 0.4)
            hint = f"did you mean {near}?" if near else f"there are: {', '.join(known)}"
            raise InputError(f"'{text:.100}': there is no metric '{name:.50}'; {hint}")
    full = {name: full_name(name, known) for name in names}

    def evaluate(values: Values) -> Numbers:
        with np.errstate(all="ignore"):
            return value({name: np.asarray(values[own], dtype=np.float64) for name, own in full.items()})

    return Expression(text.strip(), tuple(full[name] for name in names), evaluate)


def _compiled(node: ast.expr, names: list[str], condition: bool = False) -> Callable[[Mapping[str, Numbers]], Numbers]:
    """Return an expression as a function and collect its names; raise ValueError for any other syntax."""
    if isinstance(node, ast.Compare) != condition:
        raise ValueError
    parts: list[ast.expr] = []
    kind: object = None
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        number = np.float64(node.value)  # type: ignore[arg-type]
        return lambda values: number
    if isinstance(node, ast.Name):
        name = node.id
        names.append(name)
        return lambda values: values[name]
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        kind, parts = type(node.ops[0]), [node.left, *node.comparators]
    elif isinstance(node, ast.UnaryOp):
        kind, parts = type(node.op), [node.operand]
    elif isinstance(node, ast.BinOp):
        kind, parts = type(node.op), [node.left, node.right]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        kind, parts = (node.func.id, len(node.args)), node.args
    if kind not in OPERATORS:
        raise ValueError
    function, inner = OPERATORS[kind], [_compiled(part, names) for part in parts]
    return lambda values: function(*(part(values) for part in inner))
