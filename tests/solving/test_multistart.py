"""Several first guesses: what is varied, what is kept, and which solution counts."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import of_problem
from scipy.optimize import fsolve
from sympy import cos, sin

import codegen
from codegen import Control, control, coordinates, free_parameter, states
from codegen.errors import ArgumentError
from codegen.runtime.search import solve
from codegen.runtime.search.cascade import varied_guess
from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.point import evaluate
from codegen.solving import api
from codegen.solving.warm_start import varied


@pytest.fixture(scope="module")
def hoop():
    """A bead on a hoop that a motor turns: where the hoop rests, a torque does not move the bead, to first order."""
    (theta, phi), (dtheta, dphi) = coordinates("theta phi")
    torque = control("torque")
    rotation = sin(theta) ** 2 / 40 + 0.02
    return of_problem(
        Control(
            lagrangian=dtheta**2 / 80 + rotation / 2 * dphi**2 + cos(theta) / 2,
            force={phi: torque},
            cost=torque**2,
            duration=2,
            start={theta: 0.3, phi: 0, dtheta: 0, dphi: 0},
            end={theta: 2, dtheta: 0},
            steps=6,
        )
    )


def test_best_of_several_guesses(hoop):
    alone = api.solve(hoop)
    result = api.solve(hoop, guesses=6)
    assert result.solved
    assert not alone.solved or result.cost <= alone.cost * (1 + 1e-9)
    assert len(result.attempts) == result.summary["guesses"] == 6
    solved = [line for line in result.attempts if ": solved" in line]
    costs = [float(line.rsplit("cost ", 1)[1]) for line in solved]
    assert result.summary["guesses_solved"] == len(solved) > 0
    assert result.cost == pytest.approx(min(costs), rel=1e-8)
    assert result.summary["guesses_with_this_cost"] == sum(cost < result.cost * (1 + 1e-6) for cost in costs)


def test_where_no_guess_is_solved_the_first_failure_counts(hoop, monkeypatch):
    monkeypatch.setattr(solve, "minimise", lambda grid, unknowns, *rest: ("stalled", hoop.evaluate(grid, unknowns), 0))
    result = api.solve(hoop, guesses=3)
    assert result.status == "stalled"
    assert result.summary["guesses_solved"] == 0
    assert len(result.attempts) == 3


def test_guesses_are_refined_together_with_their_record(hoop):
    result = api.solve(hoop, guesses=6, doublings=1)
    assert result.solved
    assert result.steps == 12
    assert result.summary["guesses"] == len(result.attempts) == 6


@pytest.mark.parametrize("problem", ["hovercraft", "brachistochrone", "bouncing_ball"])
def test_a_variation_keeps_what_is_given_and_is_reproducible(interpreted, problem):
    module = interpreted(problem)
    grid = module.make_grid(6)
    own, other = module.initial_guess(grid), varied(module, 6, 1)
    np.testing.assert_array_equal(other, varied(module, 6, 1))
    assert np.abs(other - varied(module, 6, 2)).max() > 1e-3
    free = free_unknowns(grid) & ~np.asarray(grid.is_multiplier)
    changed = other != own
    assert changed.sum() > 0.5 * free.sum()
    assert not changed[~free].any()


def test_several_guesses_contradict_a_warm_start_and_a_simulation(hoop, pendulum):
    with pytest.raises(ArgumentError, match="warm start"):
        api.solve(hoop, guesses=2, warm=hoop.initial_guess(hoop.make_grid(4)))
    with pytest.raises(ArgumentError, match="optimisation"):
        api.solve(pendulum, guesses=2)


def test_a_guess_of_zeros_is_varied():
    x, v = states("x v")
    u = control("u")
    rest = {x: 0, v: 0}
    module = of_problem(Control(dynamics={x: v, v: u}, cost=u**2, duration=1, start=rest, end=rest, steps=8))
    first, second = varied(module, 8, 1), varied(module, 8, 2)
    assert 0.1 < np.abs(first).max() < 10
    assert np.abs(first - second).max() > 0.1


@pytest.mark.parametrize("count", [1, 3, 6])
def test_a_search_that_stalls_begins_anew_at_varied_guesses(hoop, monkeypatch, count):
    """After `count` searches that stall; the sixth is that from the last varied guess."""
    search, starts = solve.minimise, []

    def minimise(grid, unknowns, *others):
        starts.append(unknowns)
        if len(starts) <= count:
            return "stalled", evaluate(grid, unknowns), 7
        return search(grid, unknowns, *others)

    monkeypatch.setattr(solve, "minimise", minimise)
    grid = hoop.make_grid(6)
    own = hoop.initial_guess(grid)
    found = hoop.solve(6, scaling="none")  # one search from every guess
    for number, start in enumerate(starts[1:], start=1):
        np.testing.assert_array_equal(start, varied_guess(grid, own, number))
    if count == 6:
        assert len(starts) == count
        assert found.status == "stalled"
        assert found.iterations == 7 * count
        assert found.message.endswith("searches from 5 varied guesses did not succeed")
    else:
        assert len(starts) == count + 1
        assert found.status == "solved"
        assert found.residual <= 1e-10
        assert found.message.endswith(f"found from varied guess {count}, as the search from the first guess stalled")


def least_time_of_oscillator(x: int) -> float:
    """Return the least time from an odd x at rest to the origin at rest for q'' + q = u, |u| <= 1.

    In the plane of z = q + i q', arcs of circles about z = u lead from z = x to the origin. The first arc leads to the
    semicircle about x, and (x - 1) / 2 arcs of half a period lead from there to the semicircle about 1 or -1.
    """
    halves = (x - 1) // 2

    def miss(times: np.ndarray) -> list[float]:
        first, last = times
        z, u = complex(x), -1.0
        for length in (first, *[np.pi] * halves, last):
            z, u = u + (z - u) * np.exp(-1j * length), -u
        return [z.real, z.imag]

    first, last = fsolve(miss, [0.2, 1.4], xtol=1e-13)
    np.testing.assert_allclose(miss(np.array([first, last])), 0.0, atol=1e-10)
    assert first > 0.0
    assert last > 0.0
    return float(first + last + np.pi * halves)


def test_a_duration_that_is_far_too_short_is_lengthened():
    """The violation has a minimum near the period 2 pi; IPOPT 3.14 ends there from guesses of 1 to 8."""
    q, v = states("q v")
    u, T = control("u"), free_parameter("T", 1)
    problem = Control(
        dynamics={q: v, v: u - q},
        terminal_cost=T,
        duration=T,
        start={q: 7, v: 0},
        end={q: 0, v: 0},
        bounds={u: (-1, 1)},
        steps=100,
    )
    solution = codegen.solve(problem)
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(least_time_of_oscillator(7), rel=2e-3)
    assert "times the duration, as the search from the first guess found no feasible motion" in solution.message
