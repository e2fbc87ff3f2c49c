"""How far a search goes from a saddle point."""

from __future__ import annotations

import numpy as np
import pytest

from codegen.runtime.search.curvature import escape_steps


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
