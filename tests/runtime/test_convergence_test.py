"""How large the terms of the equations are, which decides when rounding ends a solution."""

from __future__ import annotations

import numpy as np
from control_variants import trial_point

from codegen.runtime.search.termination import sizes_of_terms


def test_sizes_are_those_of_the_point_that_is_asked_for(interpreted):
    """Kernels read a free duration behind the parameters, where another point may have left its own."""
    module = interpreted("goddard_rocket")
    grid = module.make_grid(5)
    here, elsewhere = (trial_point(module, grid, seed, 0.1) for seed in (1, 2))

    def sizes(unknowns):
        return sizes_of_terms(grid, unknowns)

    module.evaluate(grid, here)
    expected = sizes(here)
    module.evaluate(grid, elsewhere)
    np.testing.assert_array_equal(sizes(here), expected)
    assert not np.allclose(sizes(elsewhere), expected)
