"""Straight-line C, compared with the same calculation over numbers."""

from __future__ import annotations

import re
from cProfile import Profile
from typing import Any

import numpy as np
import pytest
from recordings import chain_urdf

from twodof.export.mechanism_source import mechanism_source
from twodof.export.straight_line import Expression, c_function, operations, varied
from twodof.plant.robot import load_robot
from twodof.plant.variables import variable_table


def test_factors_that_are_constantly_0_or_1_leave_no_operation():
    x, y = Expression("x"), Expression("y")
    assert 0.0 * x + 1.0 * y is y
    assert x - 0.0 is x and 0.0 / x == 0.0
    assert -(x * -1.0) is x
    assert operations([x + -y, x - y, -1.0 * y + x]) == 1
    assert operations([x * y, y * x]) == 1
    assert operations([(-x) * (-y), x * y]) == 1


def test_text_computes_the_expression_and_how_it_varies():
    x, y = Expression("x"), Expression("y")
    value = (x * 3.0 - y) / (x * y + 2.0) - x * -y * 0.25 + -(x / y)

    def f(x, y):
        return (x * 3 - y) / (x * y + 2) + x * y * 0.25 - x / y

    text = c_function("void f(double x, double y, double *z)", {"z": value}, varied([value]))
    complexes, plain = re.split(r"#else\n", text.split("#ifdef IS_COMPLEX\n")[1])
    complexes = re.sub(r"assign\(&(\w+), (\w+), (\w+)\)", r"\1 = \2 + 1j * \3", complexes)
    known = {"creal": np.real, "cimag": np.imag}
    for body, arguments in ((plain, (0.7, -1.3)), (complexes, (0.7 + 2e-20j, -1.3 + 1e-20j))):
        scope: dict[str, Any] = {**known, "x": arguments[0], "y": arguments[1]}
        for line in re.findall(r"(?:const \w+ )?(\w+ = [^;]*);", body):
            exec(line, scope)
        assert scope["z"] == pytest.approx(f(*arguments), rel=1e-14)
        assert np.imag(scope["z"]) == pytest.approx(np.imag(f(*arguments)), rel=1e-12)


def test_code_has_the_order_in_which_expressions_were_created():
    """Code of one body stays together, whatever the results are that use it."""
    x, y = Expression("x"), Expression("y")
    first, second = x + y, x - y
    text = c_function("void f(double x, double y, double z[2])", {"z[0]": second * second, "z[1]": first * first})
    assert text.index("x + y") < text.index("x - y")


def test_calls_of_the_generator_grow_with_the_joints_alone():
    def calls(joints: int) -> int:
        robot = load_robot(chain_urdf("zy" * (joints // 2)), "tip", "xyz")
        table = variable_table(robot, {"q_start": (0.0,) * joints, "x_des": (0.0,) * 3})
        with Profile(builtins=False) as profile:
            mechanism_source(robot, table)
        return sum(entry.callcount for entry in profile.getstats())

    assert calls(64) < 2**1.25 * calls(32)


def test_blocks_of_long_functions_are_short():
    """Compilers take time quadratic in the block length: 64 joints took 42 s, and take 23 s."""
    for joints, branched in ((7, False), (64, True)):
        robot = load_robot(chain_urdf(("zyx" * joints)[:joints]), "tip", "xyz")
        table = variable_table(robot, {"q_start": (0.0,) * joints, "x_des": (0.0,) * 3})
        text = mechanism_source(robot, table)
        blocks = re.split(r"never\(\)|^}|^#", text, flags=re.MULTILINE)
        assert ("never()" in text) == branched
        assert max(block.count(";") for block in blocks) < 1600
