"""Lagrange's polynomials through values at any nodes, beside motions that are polynomials themselves."""

from __future__ import annotations

import pytest
import sympy
from sympy import Rational, S, Symbol

from codegen.discretise.interval import PolynomialMotion, between

STEP, C = Symbol("h", positive=True), Symbol("c", real=True)
GRIDS = {
    2: (S.Zero, S.One),
    3: (S.Zero, Rational(1, 2), S.One),
    4: (S.Zero, Rational(1, 3), Rational(3, 4), S.One),
}


@pytest.fixture(params=GRIDS)
def motion(request) -> PolynomialMotion:
    """The motion of two coordinates."""
    nodes = GRIDS[request.param]
    values = tuple(sympy.symbols(f"x_{i} y_{i}", real=True) for i in range(len(nodes)))
    return PolynomialMotion(STEP, nodes, values)


def test_it_is_the_motion_where_that_is_a_polynomial(motion):
    """x(t) = 3 - t^n and y(t) = 2 t, in time from the interval's start, with n as high as the nodes allow."""
    degree = len(motion.nodes) - 1
    time = C * STEP
    exact = (3 - time**degree, 2 * time)
    given = {
        q: value.subs(C, node)
        for node, values in zip(motion.nodes, motion.values, strict=True)
        for q, value in zip(values, exact, strict=True)
    }
    for found, value in zip(motion.position(C), exact, strict=True):
        assert sympy.expand(found.subs(given) - value) == 0
    for found, value in zip(motion.velocity(C), exact, strict=True):
        assert sympy.expand(found.subs(given) - sympy.diff(value, C) / STEP) == 0


def test_shares_are_one_at_their_own_node_and_sum_to_one(motion):
    for i, node in enumerate(motion.nodes):
        assert motion.shares(node) == [S.One if i == j else S.Zero for j in range(len(motion.nodes))]
    assert sympy.expand(sum(motion.shares(C))) == 1
    assert sympy.expand(sum(motion.rates(C))) == 0
    for share, rate in zip(motion.shares(C), motion.rates(C), strict=True):
        assert sympy.expand(sympy.diff(share, C) - rate) == 0


def test_a_motion_at_rest_has_no_velocity(motion):
    """To the last digit, whatever the value."""
    still = dict.fromkeys((q for values in motion.values for q in values), Rational(7, 3))
    for c in (S.Zero, Rational(1, 5), S.One):
        assert [v.subs(still) for v in motion.velocity(c)] == [0, 0]
        assert [q.subs(still) for q in motion.position(c)] == [Rational(7, 3)] * 2


def test_points_between_two_values():
    a, b = sympy.symbols("a b", real=True)
    assert between(a, a, C) == a
    for c in (S.Zero, Rational(1, 2), Rational(3, 4), S.One):
        assert sympy.expand(between(a, b, c) - (a + c * (b - a))) == 0
