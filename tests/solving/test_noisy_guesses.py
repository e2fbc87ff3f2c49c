"""Searches that begin at guesses which violate the equations grossly: they find the optimum that is near."""

from __future__ import annotations

import numpy as np
import pytest

from codegen.runtime.search import cascade
from codegen.runtime.search.grid import free_unknowns, shared_views
from codegen.runtime.search.iterates import FROM_GUESS, begin, search_on
from codegen.runtime.search.newton import descend
from codegen.runtime.search.restoration import restore
from codegen.runtime.search.solution import Log
from codegen.runtime.search.workspace import WITH_UNKNOWNS


@pytest.fixture(scope="module")
def hovercraft(interpreted):
    return interpreted("hovercraft")


def noisy(module, grid, seed: int):
    """The problem's guess with noise of a tenth on everything that is not given."""
    guess = module.initial_guess(grid)
    indices = free_unknowns(grid) & ~np.asarray(grid.is_multiplier)
    size = np.abs(guess[indices])
    guess[indices] += 0.1 * np.random.default_rng(seed).standard_normal(size.size) * (size + 0.1 * size.max())
    return module.with_pinned_values(grid, guess)


def at(module, grid, unknowns):
    return module.evaluate(grid, np.where(grid.is_multiplier, 0.0, unknowns))


@pytest.mark.parametrize("seed", range(8))
def test_noise_does_not_lead_to_another_optimum(hovercraft, seed):
    """Newton's steps from these guesses would find the cost 1171.0 for every other one."""
    grid = hovercraft.make_grid(20)
    solution = hovercraft.solve(20, guess=noisy(hovercraft, grid, seed))
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(1053.518828, rel=1e-8)


def test_noise_is_a_gross_violation_and_the_guess_is_not(hovercraft):
    for steps in (10, 20, 200):  # on coarser grids straight lines are gross, too
        grid = hovercraft.make_grid(steps)
        search = search_on(grid)
        for guess, is_gross in ((hovercraft.initial_guess(grid), False), (noisy(hovercraft, grid, 0), True)):
            ended, _, iterations = descend(search, guess, FROM_GUESS, 1e-8, 1, Log(), stage=WITH_UNKNOWNS)
            assert (ended == "gross") == is_gross
            assert iterations == 1 - is_gross


def test_what_fails_nearby_begins_anew_at_the_guess(hovercraft, monkeypatch):
    """All iterations together are no more than allowed, and the reported end is that of the second search."""
    starts = []

    def counted(search, start, attempt, tolerance, max_iterations, log, **how):
        if how:  # the first search, which is to look at the guess
            return descend(search, start, attempt, tolerance, max_iterations, log, **how)
        starts.append((start.point.unknowns, max_iterations))
        return "iteration limit", start, 7

    monkeypatch.setattr(cascade, "descend", counted)
    grid = hovercraft.make_grid(20)
    guess = noisy(hovercraft, grid, 0)
    status, point, iterations = cascade.minimise(grid, guess, 1e-8, 100, False, Log())
    (near, first), (again, rest) = starts
    assert (status, iterations, first, rest) == ("iteration limit", 14, 50, 93)
    np.testing.assert_array_equal(again, np.where(grid.is_multiplier, 0.0, guess))
    assert at(hovercraft, grid, near).violation <= 1e-2 * at(hovercraft, grid, guess).violation
    np.testing.assert_array_equal(point.unknowns, at(hovercraft, grid, guess).unknowns)


def test_restoration_gets_past_neighbours_that_almost_meet(hovercraft):
    """There the slope of their distance all but vanishes, and the shortest step that removes the residual is huge."""
    grid = hovercraft.make_grid(20)
    guess = hovercraft.initial_guess(grid)
    own, _ = shared_views(grid, guess)
    own[1] = own[0] + 1e-6
    search = search_on(grid)
    start = begin(search, hovercraft.with_pinned_values(grid, guess), cascade.FROM_GUESS)
    point = start.point
    status, restored = restore(search, start, 1e-6, cascade.FROM_ANYWHERE, lambda: False)
    assert status == "restored"
    assert restored.point.violation <= 1e-6 * point.violation
    assert np.abs(restored.point.unknowns - point.unknowns).max() < 100.0
