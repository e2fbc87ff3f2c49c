"""The word for how a solution ended: what has grown has not always run away."""

from __future__ import annotations

import numpy as np
import pytest

from codegen.runtime.search import termination
from codegen.runtime.search.grid import free_unknowns


@pytest.mark.parametrize(
    ("residual", "cost", "has_run_away"),
    [(1e-9, -1e6, True), (1.0, -1e6, False), (1e-9, 9.9, False)],
    ids=["the-cost-falls-for-ever", "equations-do-not-hold", "the-cost-is-much-the-same"],
)
def test_what_grows_from_a_guess_of_zero(interpreted, monkeypatch, residual, cost, has_run_away):
    """A range in metres begins at zero and may end at a thousand kilometres."""
    module = interpreted("goddard_rocket")
    grid = module.make_grid(5)
    guess = module.initial_guess(grid)
    index = int(np.flatnonzero(free_unknowns(grid) & ~grid.is_multiplier)[0])
    first = module.evaluate(grid, guess)
    monkeypatch.setattr(termination, "evaluate", lambda grid, unknowns: first._replace(cost=10.0))
    unknowns, gradient = guess.copy(), np.zeros(guess.size)
    unknowns[index], gradient[index] = 1e5, -2.0 * abs(cost)
    point = first._replace(unknowns=unknowns, gradient=gradient, residual=residual, cost=cost)
    monkeypatch.setattr(termination, "at_bounds", lambda grid, unknowns: np.zeros(unknowns.size, bool))
    grown = termination.diverging_unknowns(grid, guess, point, False)
    assert grown.any() == has_run_away
    assert not grown[np.arange(grown.size) != index].any()
