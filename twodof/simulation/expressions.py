"""Expressions of metrics, as of a cost or a condition, read without running code.

Numbers, names, + − * / **, comparisons, and abs, min and max of two values.
"""

import ast
import difflib
import operator
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError

LONGEST = 500  # characters
OPERATORS: dict[type, Callable[..., Any]] = {
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
}
FUNCTIONS = {"abs": (np.abs, 1), "min": (np.minimum, 2), "max": (np.maximum, 2)}


class Expression(NamedTuple):
    """A checked expression, and the names that it has."""

    text: str
    tree: ast.expr
    names: tuple[str, ...]
    known: tuple[str, ...]

    @property
    def is_condition(self) -> bool:
        """Return whether the expression compares two values."""
        return isinstance(self.tree, ast.Compare)

    def value(self, values: Mapping[str, Any]) -> Any:
        """Return the value for numbers, or arrays of equal lengths, by name."""
        with np.errstate(all="ignore"):
            return self._value(self.tree, values)

    def _value(self, node: ast.expr, values: Mapping[str, Any]) -> Any:
        if isinstance(node, ast.Constant):
            return np.float64(node.value)  # type: ignore[arg-type]
        if isinstance(node, ast.Name):
            return np.asarray(values[full_name(node.id, self.known)], dtype=np.float64)
        if isinstance(node, ast.UnaryOp):
            return OPERATORS[type(node.op)](self._value(node.operand, values))
        if isinstance(node, ast.BinOp):
            return OPERATORS[type(node.op)](self._value(node.left, values), self._value(node.right, values))
        if isinstance(node, ast.Compare):
            return OPERATORS[type(node.ops[0])](
                self._value(node.left, values), self._value(node.comparators[0], values)
            )
        assert isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        return FUNCTIONS[node.func.id][0](*(self._value(argument, values) for argument in node.args))


def full_name(name: str, known: Iterable[str]) -> str:
    """Return the known name that a name is, begins, or is with "final_" before it; "" if none or several."""
    names = [*known]
    for candidate in (name, f"final_{name}"):
        if candidate in names:
            return candidate
    begun = [each for each in names if each.startswith(name)]
    return begun[0] if len(begun) == 1 else ""


def expression(text: str, known: Iterable[str], *, condition: bool) -> Expression:
    """Read an expression of known names: a condition, as "error > 1e-3", or a value, as "settling + overshoot".

    Raises:
        InputError: it is none, or has a name that is not known.
    """
    names = tuple(known)
    try:
        if len(text) > LONGEST:
            raise ValueError
        tree = ast.parse(text.strip(), mode="eval").body
        found = _check(tree, condition)
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        like = "a comparison, as 'error > 1e-3'" if condition else "a value, as 'settling + 0.1*peak_effort'"
        raise InputError(f"'{text:.100}' is not {like}") from None
    for name in found:
        if not full_name(name, names):
            near = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
            begun = [each for each in names if each.startswith(name)]
            hint = f"did you mean {' or '.join(begun or near)}?" if begun or near else f"there are: {', '.join(names)}"
            raise InputError(f"'{text:.100}': there is no number '{name:.50}'; {hint}")
    return Expression(text.strip(), tree, tuple(full_name(name, names) for name in found), names)


def _check(node: ast.expr, condition: bool = False) -> list[str]:
    """Return the names in an expression; raise ValueError for any other content."""
    if isinstance(node, ast.Compare) == condition:
        if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in OPERATORS:
            return _check(node.left) + _check(node.comparators[0])
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            return []
        if isinstance(node, ast.Name):
            return [node.id]
        if isinstance(node, ast.UnaryOp) and type(node.op) in OPERATORS:
            return _check(node.operand)
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            return _check(node.left) + _check(node.right)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            _, count = FUNCTIONS.get(node.func.id, (None, -1))
            if len(node.args) == count:
                return [name for argument in node.args for name in _check(argument)]
    raise ValueError
