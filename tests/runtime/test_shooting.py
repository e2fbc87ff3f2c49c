"""Direct multiple shooting: the search without stages of explicit schemes, against the problem with stages."""

from __future__ import annotations

import numpy as np
import pytest
from control_variants import VARIANTS, dense_kkt, trial_point

from codegen.runtime.search import point
from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.shooting import kept_unknowns, shooting_grid, whole_unknowns

EXPLICIT = [variant for variant in VARIANTS if variant[2].get("scheme") == "rk4"]


def searched(module, seed=2):
    """Return a grid of the problem, and the grid and random unknowns without stages."""
    grid = module.make_grid(6)
    kept = kept_unknowns(module.problem.structure, grid.steps)
    return grid, shooting_grid(grid), trial_point(module, grid, seed, 0.1)[kept], kept


@pytest.mark.parametrize(("name", "text", "choices"), VARIANTS)
def test_only_explicit_schemes_have_no_stages_in_a_search(interpreted, name, text, choices):
    problem = interpreted(name, text, **choices).problem
    assert (problem.searched is not problem) == (choices.get("scheme") == "rk4")
    assert problem.searched.structure.shape.stages == (0 if problem.shooting else problem.structure.stages)


@pytest.mark.parametrize(("name", "text", "choices"), EXPLICIT)
def test_stages_and_their_multipliers_satisfy_their_equations(interpreted, name, text, choices):
    module = interpreted(name, text, **choices)
    grid, smaller, unknowns, kept = searched(module)
    whole = whole_unknowns(grid, unknowns)
    np.testing.assert_array_equal(whole[kept], unknowns)
    found, expected = point.evaluate(smaller, unknowns), point.evaluate(grid, whole)
    size = np.abs(expected.gradient).max()
    np.testing.assert_allclose(np.delete(expected.gradient, kept), 0.0, atol=1e-12 * size)
    np.testing.assert_allclose(found.gradient, expected.gradient[kept], rtol=1e-11, atol=1e-12 * size)
    assert found.cost == pytest.approx(expected.cost, rel=1e-12)


@pytest.mark.parametrize(("name", "text", "choices"), EXPLICIT)
def test_the_reduced_hessian_is_a_schur_complement(interpreted, name, text, choices):
    module = interpreted(name, text, **choices)
    grid, smaller, unknowns, kept = searched(module)
    whole, free = dense_kkt(module, grid, whole_unknowns(grid, unknowns)), free_unknowns(smaller)
    stages = np.setdiff1d(np.arange(whole.shape[0]), kept)
    across = whole[np.ix_(kept, stages)]
    expected = whole[np.ix_(kept, kept)] - across @ np.linalg.solve(whole[np.ix_(stages, stages)], across.T)
    found = np.zeros_like(expected)
    primal, multipliers = (np.flatnonzero(free & (smaller.is_multiplier == kind)) for kind in (False, True))
    rows, columns, values = point.hessian(smaller, unknowns)
    np.add.at(found, (primal[rows], primal[columns]), values)
    rows, columns, values = point.jacobian(smaller, unknowns)
    np.add.at(found, (multipliers[rows], primal[columns]), values)
    np.add.at(found, (primal[columns], multipliers[rows]), values)
    chosen = np.ix_(free, free)
    np.testing.assert_allclose(found[chosen], expected[chosen], atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize(("name", "text", "choices"), EXPLICIT)
def test_a_search_ends_where_all_equations_with_stages_hold(interpreted, name, text, choices):
    module = interpreted(name, text, **choices)
    solution = module.solve(6, max_iterations=60)
    assert solution.status == "solved", solution.message
    grid = module.make_grid(6)
    found = point.evaluate(grid, solution.unknowns)
    kept = kept_unknowns(module.problem.structure, grid.steps)
    slopes = np.delete(np.abs(found.gradient), kept)
    assert found.residual < 1e-10
    assert slopes.max() < 1e-11 * max(1.0, np.abs(solution.unknowns).max())
    again = module.solve(6, guess=solution.unknowns, warm=True)
    assert (again.status, again.iterations) == ("solved", 0) or again.iterations <= 1
