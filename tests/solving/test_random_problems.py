"""Structured Newton steps of random combinations of features against dense linear algebra."""

import numpy as np
import pytest
from control_variants import dense_kkt, eliminated_blocks_are_positive, shifts, trial_point
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from interpreted import of_problem
from random_problems import phase_problems, single_problems

from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, solve_kkt


@pytest.mark.parametrize("problems", [single_problems(), phase_problems()], ids=["single", "phases"])
@settings(
    max_examples=8, phases=[Phase.explicit, Phase.reuse, Phase.generate]
)  # to make a failure smaller takes minutes
@given(data=st.data(), seed=st.integers(0, 1000))
def test_newton_steps_of_random_problems(problems, data, seed):
    problem, choices = data.draw(problems)
    module = of_problem(problem, **choices)
    grid = module.make_grid(3)
    unknowns = trial_point(module, grid, seed, 0.2)
    gradient = module.evaluate(grid, unknowns).gradient
    assert np.isfinite(gradient).all()
    free = free_unknowns(grid)
    system, excess, shift = allocate_system(grid), 1, 0.3
    step, carried = np.empty_like(unknowns), np.empty_like(unknowns)
    while excess is not None and excess > 0:
        diagonal = shifts(module, grid, shift, 1e-3)
        excess = factor_kkt(grid, unknowns, 1.0, diagonal, system, gradient, carried)
        shift *= 10.0
    hessian = dense_kkt(module, grid, unknowns)
    matrix = hessian + np.diag(diagonal)
    inner = matrix[np.ix_(free, free)]
    if excess is None:
        assert np.linalg.cond(inner) > 1e8 or not eliminated_blocks_are_positive(module, grid, matrix)
        return
    assert np.count_nonzero(np.linalg.eigvalsh(inner) < 0.0) == module.multiplier_unknowns(grid).size
    solve_kkt(grid, system, gradient, step)
    for found in (carried, step):
        scale = np.abs(matrix).max() * np.abs(found).max() + np.abs(gradient).max()
        assert np.abs((matrix @ found + gradient)[free]).max() <= 1e-8 * scale
        moved = module.with_pinned_values(grid, unknowns + found)
        np.testing.assert_allclose(moved, unknowns + found, rtol=0.0, atol=1e-12 * (1.0 + np.abs(found).max()))
    # The matrix is the derivative of the gradient.
    ahead, behind = (module.with_pinned_values(grid, unknowns + sign * 1e-6 * step) for sign in (1, -1))
    change = (module.evaluate(grid, ahead).gradient - module.evaluate(grid, behind).gradient) / 2e-6
    np.testing.assert_allclose((hessian @ step)[free], change[free], rtol=1e-5, atol=1e-5 * np.abs(change).max())
