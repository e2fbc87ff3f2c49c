"""Without a cost any motion that obeys the conditions will do: multipliers tend to zero, and have no size."""

from __future__ import annotations

import math

import pytest
from interpreted import of_problem
from scipy.special import ellipk
from sympy import pi, sin

from codegen import Control, control, free_parameter, states


def half_period(steps: int) -> Control:
    """A pendulum from its turning point to the other one, in a time that has a lower bound."""
    x, v = states("x v")
    duration = free_parameter("T", 3.3, lower=0.5)
    ends = {"start": {x: 1, v: 0}, "end": {v: 0}}
    dynamics = {x: v, v: -sin(x)}
    return Control(dynamics=dynamics, duration=duration, guess={x: 0, v: -1}, steps=steps, **ends)


def swing_up(torque: float) -> Control:
    """A pendulum that is to reach its upper rest in time, with a torque that is limited by its square."""
    q, v = states("q v")
    u = control("u")
    ends = {"start": {q: 0, v: 0}, "end": {q: pi, v: 0}}
    return Control(dynamics={q: v, v: u - sin(q)}, duration=12, path=[u**2 <= torque**2], steps=60, **ends)


def test_as_many_equations_as_unknowns():
    """The half period in closed form: 2 K(sin^2(1/2)), with the error of the midpoint rule at second order."""
    exact = 2 * ellipk(math.sin(0.5) ** 2)
    errors = []
    for steps in (20, 40):
        result = of_problem(half_period(steps)).solve()
        assert result.status == "solved"
        assert result.iterations <= 20
        errors.append(result.t[-1] - exact)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


def test_a_motion_that_obeys_is_found_at_once():
    module = of_problem(swing_up(0.7))
    result = module.solve()
    assert result.status == "solved"
    assert result.cost == 0.0
    assert result.iterations <= 30  # it was 2069
    assert abs(result.u).max() <= 0.7 + 1e-9
    assert abs(result.q[-1, 0] - float(pi)) <= 1e-9


def test_a_motion_that_is_impossible_is_none():
    """On few intervals: with 60 the search takes seven times as long until it ends in the same way."""
    assert of_problem(swing_up(0.05)).solve(12).status in ("infeasible", "stalled")
