"""Steps at rounding level, of which the cost tells nothing, and that lead closer to an optimum all the same."""

from __future__ import annotations

import pytest
from dense_problem import solve, variables
from known_optima import nlp, x1, x2
from sympy import exp


@pytest.mark.parametrize("bounds", [{}, {x1: (-1, 3), x2: (-1, 3)}])
def test_steps_that_a_large_cost_does_not_show_are_taken(bounds):
    """Beside 1e10 a fall of the cost below 1e-6 is rounding: seen by the cost, x1 would be known to 1e-3."""
    grid = nlp((1.5, 0.5), 1e10 + exp(x1) - x1 + (x2 - x1) ** 2, bounds=bounds)
    status, point, iterations = solve(grid)
    assert status == "solved"
    assert variables(grid, point) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert iterations <= 16  # with bounds, five of them do not change anything
