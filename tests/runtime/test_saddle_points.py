"""How far a search goes from a saddle point, and a minimum with a null direction, which is no saddle point."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import of_problem
from sympy import cos, pi

from codegen import Control, control, coordinate
from codegen.runtime.search.curvature import escape_steps
from codegen.solving import api


@pytest.mark.parametrize("name", ["bryson_denham", "cart_pole"])
def test_each_quantity_moves_by_a_part_of_its_own_size(interpreted, name):
    """However large another one is, which before made all steps long."""
    module = interpreted(name)
    grid = module.make_grid(10)
    unknowns = np.where(grid.is_multiplier, 0.0, module.initial_guess(grid))
    nodes, _ = module.views(grid, unknowns)
    nodes[:, :, 0] = 1000.0
    for escapes in range(3):
        step, back = escape_steps(grid, unknowns, np.zeros(unknowns.size), escapes)
        assert np.array_equal(step, -back)
        parts = [
            np.abs(moved).max(axis=1) / np.maximum(1.0, np.abs(own).max(axis=1))
            for moved, own in zip(module.views(grid, step), module.views(grid, unknowns), strict=True)
        ]
        assert max(part.max() for part in parts) == pytest.approx(0.1 * 3.0**escapes)


def test_a_periodic_motion_that_may_begin_at_any_time_is_a_minimum():
    """The optimum moves along itself in time at no cost; the reference is scipy's solve_bvp at 1e-8."""
    theta, dtheta = coordinate("theta")
    u = control("u")
    problem = Control(
        lagrangian=dtheta**2 / 2 + 4 * cos(theta),
        force={theta: u - dtheta / 5},
        cost=u**2,
        duration=2,
        periodic={theta: 2 * pi, dtheta: 0},
        bounds={u: (-3, 3), theta: (-10, 10)},
        steps=320,
    )
    result = api.solve(of_problem(problem))
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(0.8489304819, rel=1e-5)
    assert result.iterations <= 15  # 50 if curvatures are measured with regularised equations alone
