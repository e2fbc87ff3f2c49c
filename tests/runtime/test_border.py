"""Newton's steps against the dense KKT matrix, with a border that ends before the last node, and with states first."""

from __future__ import annotations

import numpy as np
import pytest
from control_variants import VARIANTS, assert_steps_are_dense, shifts, trial_point

from codegen.runtime.search.shooting import shooting_grid, shooting_unknowns

STEPS = 17
PUSHED = '''"""A pendulum is pushed to rest at another angle."""
from sympy import sin
from codegen import Control, control, states
def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={x: v, v: u - sin(x)}, cost=u**2, duration=3, start={x: 0, v: 0}, end={x: 1, v: 0}, steps=20)
'''


def last_bordered(grid, system):
    """Return the number of the last block with a border of the first body, 0 if the border stays to the end."""
    s = grid.problem.structure
    return system.orders[grid.steps * (s.stride - s.condensed - 2 * s.stages) + s.node + s.border.size]


@pytest.mark.parametrize(("name", "text", "choices"), VARIANTS)
def test_steps_are_those_of_the_dense_matrix(interpreted, name, text, choices):
    module = interpreted(name, text, **choices)
    grid = module.make_grid(STEPS)
    assert_steps_are_dense(module, grid, shifts(module, grid, 100.0, 0.0), trial_point(module, grid, 2, 1e-3))


@pytest.mark.parametrize("scheme", ["rk4", "gauss-4"])
def test_a_border_ends_once_the_controls_reach_every_end(interpreted, scheme):
    module = interpreted("pushed_to_rest", PUSHED, scheme=scheme)
    grid = module.make_grid(STEPS)
    smaller, unknowns = shooting_grid(grid), shooting_unknowns(grid, trial_point(module, grid, 2, 0.1))
    s = smaller.problem.structure
    assert (s.shape.states, s.shape.bordered) == (2, 1)
    system = assert_steps_are_dense(module, smaller, shifts(module, smaller, 1.0, 0.0), unknowns)
    assert 0 < last_bordered(smaller, system) < STEPS - 1
    block = s.stride - s.condensed - 2 * s.stages
    for first in range(block, STEPS * block, block):  # each state, then its equation
        np.testing.assert_array_equal(system.orders[first : first + 4], [0, 2, 1, 3])


def test_equations_with_diagonals_or_large_curvatures_keep_the_search_for_pivots(interpreted):
    module = interpreted("pushed_to_rest", PUSHED, scheme="rk4")
    grid = module.make_grid(STEPS)
    smaller, unknowns = shooting_grid(grid), shooting_unknowns(grid, trial_point(module, grid, 2, 0.1))
    for diagonal in (shifts(module, smaller, 1.0, 1e-2), shifts(module, smaller, 1e12, 0.0)):
        assert_steps_are_dense(module, smaller, diagonal, unknowns)


def test_a_null_direction_of_the_hessian_does_not_stall_a_search(interpreted):
    """Nodal controls have a mode that costs nothing; the optimal cost is that of controls on intervals."""
    nodal, constant = (interpreted("linear_pendulum", controls=controls) for controls in ("nodal", "interval"))
    for steps in range(190, 211, 2):
        solution = nodal.solve(steps)
        assert solution.status == "solved"
        assert solution.cost == pytest.approx(constant.solve(steps).cost, rel=1e-9)
