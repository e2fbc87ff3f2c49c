"""Without a cost any motion that obeys the conditions will do: multipliers tend to zero, and have no size."""

from __future__ import annotations

import math

import pytest
from interpreted import of_problem
from scipy.special import ellipk
from sympy import cos, pi, sin

from codegen import Control, control, coordinates, free_parameter, states


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


def step_of_a_walker() -> Control:
    """One step of a compass walker on level ground, which may be as fast as it likes: no hip torque is needed.

    Source: Goswami, Espiau and Keramane (1996), Limit cycles and their stability in a passive bipedal gait.
    """
    (a, b), (da, db) = coordinates("a b")
    u, T = control("u"), free_parameter("T", 0.8, lower=0.3, upper=2)
    hip, leg, length, g = 10, 5, 1, 9.81
    stance = (hip + leg + leg / 4) * length**2 * da**2 / 2
    swing = leg * length**2 * db**2 / 8 - leg * length**2 * cos(a - b) * da * db / 2
    potential = (hip + 3 * leg / 2) * length * g * cos(a) - leg * length * g * cos(b) / 2
    return Control(
        lagrangian=stance + swing - potential,
        force={a: -u, b: u},
        cost=u**2,
        duration=T,
        start={a: -0.2, b: 0.2},
        end={a: 0.2, b: -0.2},
        bounds={u: (-50, 50)},
        steps=20,
    )


def test_a_cost_that_vanishes_at_its_optimum_ends_there():
    """All terms of the conditions are 1e-22 there, and none is small beside them: it was called stalled."""
    result = of_problem(step_of_a_walker()).solve()
    assert result.status == "solved", result.message
    assert result.cost <= 1e-20
    assert result.residual <= 1e-12
    assert result.iterations <= 20
