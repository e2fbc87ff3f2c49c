"""Inequalities on one unknown of an end are bounds: the same optima as by other conditions, with fewer unknowns.

Each problem is solved twice: with a condition x <= a, and with exp(x) <= exp(a), which says the same but is no bound.
"""

import pytest
from interpreted import of_problem
from sympy import Eq, cos, exp

from codegen import Control, Phases, control, coordinate, states

SIDES = (lambda x, limit: x <= limit, lambda x, limit: exp(x) <= exp(limit))


def first_order(says) -> Control:
    """The end is to be reached at a speed of 1/2 at most; freely it would be 3/2."""
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={x: v, v: u}, cost=u**2 / 2, duration=1, start={x: 0, v: 0}, end={x: 1},
        end_conditions=[says(v, 0.5)], steps=10,
    )  # fmt: skip


def within_bounds(says) -> Control:
    """A quantity with bounds everywhere is held below a tighter one at its start."""
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={x: v, v: u}, cost=u**2 / 2 - x, duration=1, end={x: 0, v: 0}, bounds={x: (-2, 2), v: (-3, 3)},
        start_conditions=[says(x, 0.25), says(-v, 0.5)], steps=10,
    )  # fmt: skip


def mechanical(says) -> Control:
    """A pendulum that is to end slowly: its velocity is an unknown of the end alone."""
    q, dq = coordinate("q")
    u = control("u")
    return Control(
        lagrangian=dq**2 / 2 + cos(q), force={q: u}, cost=u**2 / 2, duration=2, start={q: 0, dq: 0}, end={q: 1.5},
        end_conditions=[says(dq, 0.25), says(-dq, 0.1)], steps=10,
    )  # fmt: skip


def phases(says) -> Phases:
    """The last of two phases has the condition."""
    x, v = states("x v")
    u = control("u")
    common = {"dynamics": {x: v, v: u}, "cost": u**2 / 2, "duration": 0.5, "steps": 10}
    parts = (Control(**common, start={x: 0, v: 0}), Control(**common, end={x: 1}, end_conditions=[says(v, 0.5)]))
    return Phases(*parts)


def returning(says) -> Control:
    """A periodic quantity is a shared unknown, whose copy at an end has no bounds of its own."""
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={x: v, v: u - x}, cost=(u - 1) ** 2 / 2, duration=1, periodic=[x, v],
        end_conditions=[says(x, 0.25)], steps=10,
    )  # fmt: skip


def with_an_equation(says) -> Control:
    """An equation may decide what is bounded, and then there is nothing to bound."""
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={x: v, v: u}, cost=u**2 / 2, duration=1, start={x: 0, v: 0},
        end_conditions=[Eq(x + v, 1), says(v, 0.1)], steps=10,
    )  # fmt: skip


CASES = [
    (first_order, {}, 2), (first_order, {"scheme": "gauss-4"}, 2), (within_bounds, {}, 4), (mechanical, {}, 4),
    (mechanical, {"method": "hamiltonian"}, 4), (phases, {}, 2), (returning, {}, 0), (with_an_equation, {}, 0),
]  # fmt: skip


@pytest.mark.parametrize(("problem", "choices", "saved"), CASES)
def test_a_bound_is_the_same_as_a_condition(problem, choices, saved):
    """Each condition that is a bound saves a multiplier and a slack in every node."""
    bound, condition = (of_problem(problem(says), **choices) for says in SIDES)
    fewer = condition.NODE - bound.NODE
    assert fewer == saved
    one, other = bound.solve(), condition.solve()
    assert one.status == other.status == "solved", (one.message, other.message)
    assert one.cost == pytest.approx(other.cost, rel=1e-8)
    assert one.q == pytest.approx(other.q, abs=1e-7)
