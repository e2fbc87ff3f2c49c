"""How large the terms of the equations are, which decides when rounding ends a solution."""

from __future__ import annotations

import numpy as np
from control_variants import trial_point


def test_sizes_are_those_of_the_point_that_is_asked_for(interpreted):
    """Kernels read a free duration behind the parameters, where another point may have left its own."""
    module = interpreted("goddard_rocket")
    grid = module.make_grid(5)
    here, elsewhere = (trial_point(module, grid, seed, 0.1) for seed in (1, 2))

    def sizes(unknowns):
        return module.sizes_of_terms(grid, unknowns)

    module.evaluate(grid, here)
    expected = sizes(here)
    module.evaluate(grid, elsewhere)
    np.testing.assert_array_equal(sizes(here), expected)
    assert not np.allclose(sizes(elsewhere), expected)


def test_sums_are_not_completed_beyond_what_is_enough(interpreted):
    """Where both reach it, a part of the terms decides as all do; where one cannot, all are looked at."""
    module = interpreted("goddard_rocket")
    grid = module.make_grid(5)
    unknowns = trial_point(module, grid, 1, 0.1)
    whole = np.array(module.sizes_of_terms(grid, unknowns))
    parts = np.array([module.sizes_of_terms(grid, unknowns, *(part * whole)) for part in (1e-6, 0.5, 1.0)])
    assert (parts <= whole).all()
    assert (parts >= np.outer([1e-6, 0.5, 1.0], whole)).all()
    assert (parts[0] < whole).any()
    np.testing.assert_array_equal(module.sizes_of_terms(grid, unknowns, 0.0, 2.0 * whole[1]), whole)


def test_a_step_ends_where_a_line_search_would_go_first(interpreted):
    """What is found in one call with the step is what following it for its longest lengths gives."""
    module = interpreted("goddard_rocket")
    grid = module.make_grid(5)
    search = module.search_on(grid)
    primal = np.where(grid.is_multiplier, 0.0, module.initial_guess(grid))
    iterate = module.begin(search, primal, module.FROM_GUESS)
    step = module.regularised_step(search, iterate, module.InertiaCorrection(), 0.0, False)
    followed = module.moved(search, iterate, step._replace(end=None), step.longest)
    for at_once, later in zip((*step.end.point, *step.end[1:]), (*followed.point, *followed[1:]), strict=True):
        np.testing.assert_array_equal(at_once, later)
    assert (step.end.distance > 0.0).all()
    assert (step.end.duals > 0.0).all()
