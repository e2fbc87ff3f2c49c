"""Problems in other units have the same solution, and a reported cost is corrected by what residuals are worth."""

from __future__ import annotations

import numpy as np
import pytest
from gallery_units import GALLERY, UNITS, cost_factor, text_in_units
from interpreted import without_compilation


@pytest.mark.parametrize("name", ["orbital_transfer", "double_integrator", "linear_pendulum"])
def test_other_units_have_the_same_solution(name):
    module, steps = without_compilation(text_in_units(name)), GALLERY[name].steps
    own = module.solve(steps)
    assert own.status == "solved", own.message
    for unit in UNITS:
        for factor in (1e-6, 1e6):
            solution = module.solve(steps, **{unit: factor})
            assert solution.status == "solved", (unit, factor, solution.message)
            assert solution.cost == pytest.approx(own.cost * cost_factor(name, **{unit: factor}), rel=1e-8)
            assert solution.iterations <= 1.5 * own.iterations


def test_cost_is_right_to_second_order_in_the_residual(interpreted):
    """Even with a loose tolerance, which leaves an error in the discrete cost."""
    module = interpreted("orbital_transfer")
    right = 0.0487567009  # by CasADi and IPOPT, N = 50
    rough = module.solve(50, tolerance=1e-2)
    grid = module.make_grid(50)
    assert rough.cost == pytest.approx(right, abs=1e-9)
    assert abs(rough.cost - right) < abs(module.cost(grid, rough.unknowns) - right)


def test_what_is_solved_in_wrong_sizes_alone_is_not_solved(interpreted):
    """Where the guess makes all equations vanish, anything solves them; the sizes at the solution tell."""
    module = interpreted("orbital_transfer")
    grid = module.make_grid(10)
    guess, sizes = module.initial_guess(grid), np.ones(grid.is_multiplier.size)
    vanishing = grid._replace(sizes=sizes, forces=1e-40 * sizes, weight=1e-40)
    point = module.evaluate(vanishing, guess)
    assert point.error < 1e-30
    status, *_ = module.refined(vanishing, guess, point, 1e-10, 0, module.Log())
    assert status == "iteration limit"
    status, found, _, point, iterations = module.refined(vanishing, guess, point, 1e-10, 100, module.Log())
    assert status == "solved"
    assert iterations > 0
    assert module.in_units(found, point).residual <= 1e-10
