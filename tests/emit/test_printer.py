"""Printed expressions have the value of what was written, also where a denominator vanishes."""

import math

import pytest
from numba import njit
from sympy import Pow, Rational, sqrt, symbols

from codegen.emit.lower.printer import scalar_code

x, y = symbols("x y")
QUOTIENTS = [
    x**-2,
    -(x**-3),
    y + x**-2,
    (1 + x**-2) ** -2,
    x ** Rational(-1, 2),
    y * x ** Rational(-3, 2),
    Pow(x**-2, y, evaluate=False),
    sqrt(x**2 + y**2) ** -1,
]


@pytest.mark.parametrize("expression", QUOTIENTS, ids=str)
def test_negative_powers_keep_their_value(expression):
    value = eval(scalar_code(expression), {"math": math}, {"x": 0.7, "y": 1.3})
    assert value == pytest.approx(float(expression.subs({x: 0.7, y: 1.3})), rel=1e-14)


def test_negative_powers_of_zero_are_infinite_in_machine_code():
    """A motion may pass through a pole, and a guess may lie on one: numba raises ZeroDivisionError at 0.0**(-2)."""
    scope = {"math": math}
    body = ", ".join(scalar_code(power) for power in (x**-2, x ** Rational(-3, 2), x ** Rational(-1, 2)))
    exec(f"def powers(x):\n    return {body}", scope)
    assert njit(error_model="numpy")(scope["powers"])(0.0) == (math.inf, math.inf, math.inf)
