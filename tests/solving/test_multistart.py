"""Several first guesses: what is varied, what is kept, and which solution counts."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import of_problem
from sympy import cos, sin

from codegen import Control, control, coordinates, states
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
