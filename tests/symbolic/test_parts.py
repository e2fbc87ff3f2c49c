"""Walks over the distinct parts of expressions, against sympy and against closed forms for repeated parts."""

from hypothesis import given
from hypothesis import strategies as st
from sympy import Abs, E, Expr, Float, Integer, Rational, cos, exp, pi, sin, symbols

from codegen.symbolic.parts import operations, replaced, symbols_of

X, Y, Z = symbols("x y z", real=True)
LEAVES = [X, Y, Z, pi, E, Integer(1), Integer(2), Integer(-1), Rational(1, 2), Rational(-3, 4), Float(0.3)]


def combined(parts: st.SearchStrategy[Expr]) -> st.SearchStrategy[Expr]:
    pairs = st.tuples(parts, parts)
    return st.one_of(
        pairs.map(lambda pair: pair[0] + pair[1]),
        pairs.map(lambda pair: pair[0] - pair[1]),
        pairs.map(lambda pair: pair[0] * pair[1]),
        pairs.map(lambda pair: pair[0] / (1 + pair[1] ** 2)),
        st.tuples(parts, st.sampled_from([sin, cos, exp, Abs])).map(lambda pair: pair[1](pair[0])),
        parts.map(lambda part: (1 + part**2) ** Rational(-1, 2)),
    )


@given(st.recursive(st.sampled_from(LEAVES), combined, max_leaves=12))
def test_walks_agree_with_those_of_sympy(expression):
    assert operations(expression) == expression.count_ops()
    assert symbols_of(expression) == expression.free_symbols
    values = {X: Y + Z, Y: 2 * X}
    assert replaced(expression, values) == expression.xreplace(values)


def test_a_part_that_is_repeated_a_trillion_times_is_visited_once():
    """n repetitions of e -> sin(e) cos(e) have 3 (2^n - 1) operations."""
    expression, in_y = X, Y
    for _ in range(40):
        expression, in_y = sin(expression) * cos(expression), sin(in_y) * cos(in_y)
    assert operations(expression) == 3 * (2**40 - 1)
    assert symbols_of(expression) == {X}
    assert replaced(expression, {X: Y}) == in_y
