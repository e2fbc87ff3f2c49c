"""Stages eliminated by their equations, against the dense KKT matrix."""

from __future__ import annotations

import numpy as np
import pytest
from control_variants import VARIANTS, assert_steps_are_dense, trial_point

from codegen.runtime.search.grid import free_unknowns

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
    unknowns, free = trial_point(module, grid, 2, 0.1), free_unknowns(grid)
    curvature = 100.0 + np.random.default_rng(4).uniform(size=unknowns.size)
    assert_steps_are_dense(module, grid, np.where(free, np.where(grid.is_multiplier, -dual, curvature), 0.0), unknowns)
