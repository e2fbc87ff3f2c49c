"""Angles of trigonometric functions, and zeros among functions of them."""

from __future__ import annotations

import pytest
import sympy
from sympy import cos, sin

from codegen.evidence.analysis.function_ring import FunctionRing, angles_that_span


def test_hidden_zero_is_found_by_numbers():
    (x,) = sympy.symbols("x,", real=True)
    ring = FunctionRing((x,), ())
    element = ring.function(sympy.tan(x), x, ring.symbol(x))
    assert ring.vanishes(element * ring.function(cos(x), x, ring.symbol(x)) - ring.function(sin(x), x, ring.symbol(x)))
    assert not ring.vanishes(element - ring.function(sin(x), x, ring.symbol(x)))


@pytest.mark.parametrize(
    ("angles", "basis"),
    [
        (["q", "2*q"], ["q"]),
        (["a - b", "a", "b", "2*a - 2*b"], ["a - b", "a"]),
        (["a - b", "a + b", "a"], []),  # a is half a sum of the others
        (["q/2", "3*q/2"], ["q/2"]),
    ],
)
def test_angles_are_integer_combinations_of_some(angles, basis):
    assert angles_that_span([sympy.sympify(x) for x in angles]) == tuple(sympy.sympify(x) for x in basis)
