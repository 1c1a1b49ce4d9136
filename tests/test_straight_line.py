"""C without loops from recursions, beside the same recursions over numbers and Pinocchio."""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin
import pytest
from native_models import model

from twodof.export.bodies import joint_tree
from twodof.export.recursions import mass_matrix, solve_by_factors, solve_by_recursion
from twodof.export.straight_line import Expression, c_function, operations, varied


def test_what_constants_make_0_or_1_leaves_no_operation():
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
        scope = {**known, "x": arguments[0], "y": arguments[1]}
        for line in re.findall(r"(?:const \w+ )?(\w+ = [^;]*);", body):
            exec(line, scope)
        assert scope["z"] == pytest.approx(f(*arguments), rel=1e-14)
        assert np.imag(scope["z"]) == pytest.approx(np.imag(f(*arguments)), rel=1e-12)


@pytest.mark.parametrize("name", ["ur5", "anymal_c", "tiago"])
def test_both_ways_to_an_acceleration_are_pinocchios(name):
    robot = model(name).robot
    constants, rng, n = joint_tree(robot), np.random.default_rng(5), len(robot.joints)
    q, tau = rng.normal(size=(2, n))
    joint = np.array(
        [
            (x, 0.0) if slides else (np.cos(x), np.sin(x))
            for x, slides in zip(q + constants.c, constants.prismatic)
        ]
    )
    M = mass_matrix(constants, constants.body, joint)
    expected = pin.crba(robot.model, robot.model.createData(), q)
    expected = np.triu(expected) + np.triu(expected, 1).T
    np.testing.assert_allclose(M.astype(float), expected, atol=1e-13 * expected.max())
    for a in (
        solve_by_factors(M, tau),
        solve_by_recursion(constants, constants.body, joint, tau),
    ):
        np.testing.assert_allclose(expected @ a.astype(float), tau, atol=1e-11)
