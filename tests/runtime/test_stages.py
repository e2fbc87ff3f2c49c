"""Stages eliminated by their equations, against the dense KKT matrix."""

from __future__ import annotations

import numpy as np
import pytest
from control_variants import VARIANTS, dense_kkt, trial_point

from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, is_factored, solve_kkt

STAGED = [variant for variant in VARIANTS if variant[2].get("scheme") not in (None, "trapezoidal", "stormer-verlet")]


@pytest.mark.parametrize(("name", "text", "choices"), STAGED)
def test_schemes_with_stages_have_them_eliminated(interpreted, name, text, choices):
    structure = interpreted(name, text, **choices).problem.structure
    first, count = structure.node, structure.stages
    assert count > 0
    assert not structure.is_multiplier[first : first + count].any()
    assert structure.is_multiplier[first + count : first + 2 * count].all()


@pytest.mark.parametrize("dual", [0.0, 1e-3, 1.0])
@pytest.mark.parametrize(("name", "text", "choices"), STAGED)
def test_steps_are_those_of_the_dense_matrix(interpreted, name, text, choices, dual):
    """Also where multipliers have diagonals of their own, as in feasibility restoration."""
    module = interpreted(name, text, **choices)
    grid = module.make_grid(6)
    unknowns, free = trial_point(module, grid, 2, 0.1), np.flatnonzero(free_unknowns(grid))
    rng = np.random.default_rng(3)
    right = np.where(free_unknowns(grid), rng.normal(size=unknowns.size), 0.0)
    diagonal = np.where(grid.is_multiplier, -dual, 100.0 + rng.uniform(size=unknowns.size))
    diagonal[~free_unknowns(grid)] = 0.0
    system, carried, again = allocate_system(grid), np.zeros(unknowns.size), np.zeros(unknowns.size)
    assert is_factored(factor_kkt(grid, unknowns, 1.0, diagonal, system, right, carried))
    solve_kkt(grid, system, right, again)
    matrix = (dense_kkt(module, grid, unknowns) + np.diag(diagonal))[np.ix_(free, free)]
    expected = np.linalg.solve(matrix, -right[free])
    for step in (carried, again):
        np.testing.assert_allclose(step[free], expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
