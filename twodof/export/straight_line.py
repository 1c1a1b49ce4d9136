"""Generate C code without loops or branches from calculations on expressions.

Constants 0 and 1 of a robot are folded, and common subexpressions are computed once. Frigerio, Buchli, Caldwell &
Semini, "RobCoGen", J. Softw. Eng. Robot. 7(1), 2016, describe the benefit for a robot's dynamics.
"""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count

WIDTH = 100  # longest line, in characters
LONG, BLOCK = 1500, 50
"""Number of statements from which on a function has branches, and of statements between two branches.

LLVM's scheduler and register allocator take time quadratic in a basic block; branches make short functions slower.
"""
STRUCTS = {"turn": "JointPosition"}  # result types of C functions that return a struct


@dataclass(frozen=True, eq=False, slots=True)
class Expression:
    """A value in C: a variable, or an operation on expressions and numbers."""

    operation: str
    operands: tuple[Value, ...] = ()
    serial: int = field(default_factory=count().__next__, init=False)  # the position in the order of creation

    def __neg__(self) -> Value:
        return self.operands[0] if self.operation == "neg" else Expression("neg", (self,))

    def __add__(self, other: Value) -> Value:
        if isinstance(other, Expression) and other.operation == "neg":
            return self - other.operands[0]
        if self.operation == "neg" and other != 0.0:
            return other - self.operands[0]
        return self if other == 0.0 else Expression("+", (self, other))

    def __sub__(self, other: Value) -> Value:
        if isinstance(other, Expression) and other.operation == "neg":
            return self + other.operands[0]
        return self if other == 0.0 else Expression("-", (self, other))

    def __rsub__(self, other: float) -> Value:
        return -self if other == 0.0 else Expression("-", (other, self))

    def __mul__(self, other: Value) -> Value:
        if isinstance(other, Expression):
            if "neg" in (self.operation, other.operation):
                a = self.operands[0] if self.operation == "neg" else self
                b = other.operands[0] if other.operation == "neg" else other
                return a * b if self.operation == other.operation else -(a * b)
            return Expression("*", (self, other))
        if other == 0.0:
            return 0.0
        if other < 0.0:
            return -(self * -other)
        if self.operation == "neg":
            return -(self.operands[0] * other)
        return self if other == 1.0 else Expression("*", (self, other))

    def __truediv__(self, other: Value) -> Value:
        return Expression("/", (self, other))

    def __rtruediv__(self, other: float) -> Value:
        return Expression("/", (other, self)) if other else 0.0

    def __abs__(self) -> Value:
        return Expression("fabs", (self,))

    def sqrt(self) -> Value:
        """Return the square root; NumPy calls it."""
        return Expression("sqrt", (self,))

    __radd__ = __add__
    __rmul__ = __mul__


Value = Expression | float


def operations(results: Iterable[Value]) -> int:
    """Count the operations of a calculation."""
    nodes, _ = _ordered(results)
    return sum(1 for _, operands in nodes if operands)


Varied = tuple[Value, Value]  # a value and its variation


def varied(
    results: Iterable[Value], parts: Mapping[str, Varied] | None = None, held: Sequence[str] = ()
) -> list[Varied]:
    """Return the real parts of values, and their derivatives by the rules of differentiation.

    Complex numbers are x + i h dx with h² = 0, so that real parts are computed in real numbers. ``parts`` has value and
    variation of some variables by name. Other variables have their real and imaginary parts; those whose names begin
    with one of ``held`` have no variation.
    """
    nodes, indices = _ordered(results)
    pairs: list[Varied] = []
    for operation, operands in nodes:
        (a, da), (b, db) = ([pairs[operand] for operand in operands] + [(0.0, 0.0)] * 2)[:2]
        if operation == "+":
            pair = a + b, da + db
        elif operation == "-":
            pair = a - b, da - db
        elif operation == "*":
            pair = a * b, a * db + da * b
        elif operation == "/":
            quotient = a / b
            pair = quotient, (da - quotient * db) / b
        elif operation == "neg":
            pair = -a, -da
        elif operation[0] in "-.0123456789":  # a number
            pair = float(operation), 0.0
        elif parts and operation in parts:
            pair = parts[operation]
        elif operation.startswith(tuple(held)):
            pair = Expression(f"creal({operation})"), 0.0
        else:
            pair = Expression(f"creal({operation})"), Expression(f"cimag({operation})")
        pairs.append(pair)
    return [pairs[index] for index in indices]


def c_function(head: str, results: Mapping[str, Value], complexes: Iterable[Varied] | None = None) -> str:
    """Return a void function that assigns each result to its lvalue, on which no result may depend.

    ``complexes`` has the real part and the variation of each result, for compilation with complex numbers.
    """
    body = _statements(results, "double")
    if complexes is not None:
        separate: dict[str, Value] = {}
        for value, variation in complexes:
            separate[f"const Real re{len(separate)}"] = value
            separate[f"const Real im{len(separate)}"] = variation
        combined = "".join(f"\n    assign(&{target}, re{2 * i}, im{2 * i + 1});" for i, target in enumerate(results))
        body = f"#ifdef IS_COMPLEX\n{_statements(separate, 'Real')}{combined}\n#else\n{body}\n#endif"
    parameters = re.findall(r"(\w+)(?:\[\w+\])?[,)]", head)
    unused = [name for name in parameters if not re.search(rf"\b{name}\b", body)]
    ignored = "".join(f"    (void){name};\n" for name in unused)
    head = textwrap.fill(head, WIDTH, subsequent_indent="    ", break_on_hyphens=False)
    return f"{head}\n{{\n{ignored}{body}\n}}\n"


def _statements(results: Mapping[str, Value], kind: str) -> str:
    nodes, indices = _ordered(results.values())
    uses = Counter(indices) + Counter(operand for _, operands in nodes for operand in operands)
    texts: list[str] = []
    lines: list[str] = []
    for index, (operation, operands) in enumerate(nodes):
        text = _c(operation, [texts[operand] for operand in operands])
        if operands and (uses[index] > 1 or len(text) > WIDTH - 40):
            own = STRUCTS.get(operation, kind)
            lines.append(f"    const {own} t{index} = {_bare(text)};")
            text = f"t{index}"
        texts.append(text)
    lines += [f"    {target} = {_bare(texts[index])};" for target, index in zip(results, indices, strict=True)]
    size = BLOCK if len(lines) > LONG else LONG
    blocks = ("\n".join(lines[i : i + size]) for i in range(0, len(lines), size))
    return "\n    if (never())\n        return;\n".join(blocks)


def _ordered(results: Iterable[Value]) -> tuple[list[tuple[str, tuple[int, ...]]], list[int]]:
    """Return the distinct operations in the order of their creation, and the indices of the results.

    The recursions create the operations of a body together. Code in this order needs fewer loads and stores than code
    that computes one result after another: hybrid dynamics of 101 joints take 12 % less time.
    """
    wanted = list(results)
    pending, reached = [*wanted], dict[int, Expression]()
    while pending:
        value = pending.pop()
        if isinstance(value, Expression) and value.serial not in reached:
            reached[value.serial] = value
            pending += value.operands
    indices: dict[tuple[str, tuple[int, ...]], int] = {}
    index_of: dict[int, int] = {}

    def index(value: Value) -> int:
        if isinstance(value, Expression):
            return index_of[value.serial]
        return indices.setdefault((repr(float(value)), ()), len(indices))

    for serial, expression in sorted(reached.items()):
        operands = tuple(map(index, expression.operands))
        if expression.operation in "+*":
            operands = tuple(sorted(operands))
        index_of[serial] = indices.setdefault((expression.operation, operands), len(indices))
    last = [index(result) for result in wanted]
    return [*indices], last


def _c(operation: str, operands: list[str]) -> str:
    if not operands:
        return operation
    if operation == "neg":
        return f"(-{operands[0]})"
    if len(operands) == 1:
        return f"{operation}({_bare(operands[0])})"
    return f"({operands[0]} {operation} {operands[1]})"


def _bare(text: str) -> str:
    """Remove the parentheses around a whole expression."""
    return text[1:-1] if text.startswith("(") else text
