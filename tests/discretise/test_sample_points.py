"""Whether an expression has a value is asked where the author expects the motion, not only near one."""

import pytest
from sympy import exp, sqrt

from codegen import Control, Phases, control, free_parameter, states
from codegen.discretise.model.from_problem import normalise
from codegen.errors import ExpressionError

EARTH = 6378145.0


def climb(r, v, u, **changes):
    """A rocket above the earth: its air has no finite density one metre from the centre."""
    return Control(dynamics={r: v, v: u - v * exp(-(r - EARTH) / 7200)}, cost=u**2, duration=10, **changes)


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("guess", EARTH),
        ("end", EARTH + 1000),
        ("bounds", (EARTH, EARTH + 10000)),
    ],
)
def test_states_without_a_start_are_tried_where_the_author_expects_them(argument, value):
    (r, v), u = states("r v"), control("u")
    assert normalise(climb(r, v, u, **{argument: {r: value}})).controls


def test_phases_are_tried_where_those_before_them_end():
    (r, v), u = states("r v"), control("u")
    first = climb(r, v, u, start={r: EARTH, v: 0}, guess={v: 1})
    assert len(normalise(Phases(first, climb(r, v, u), jumps=[{v: v / 2}])).phases) == 2


def test_what_has_no_value_anywhere_is_refused():
    x = states("x y")[0]
    T = free_parameter("T", 1)
    problem = Control(dynamics={x: sqrt(-1 - x**2)}, terminal_cost=T, duration=T, start={x: 0}, guess={x: 1})
    with pytest.raises(ExpressionError, match="no finite real value"):
        normalise(problem)
