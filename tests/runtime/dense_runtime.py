"""The runtime with the dense linear algebra of `dense_problem` in place of a generated module's, and searches by it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import dense_problem
import numpy as np
import pytest
from dense_problem import INFINITY, Dense, Point

from codegen.runtime.kkt import refinement
from codegen.runtime.optimise import (
    barrier,
    bounded,
    cascade,
    exact_bounds,
    line_search,
    negative_curvature,
    newton,
    newton_steps,
    restoration,
    saddle_points,
    unbounded,
    warm_start,
)
from codegen.runtime.optimise.iteration_log import Log

LINEAR_ALGEBRA = {
    "allocate_system", "evaluate", "factor_kkt", "free_unknowns", "is_at_rounding_level", "is_solved", "bounds_of",
    "linear_residual", "multiplier_unknowns", "sizes_of_terms", "solve_kkt", "views", "with_tied_values",
}  # fmt: skip


@contextmanager
def dense_linear_algebra() -> Iterator[None]:
    """Give the runtime the functions of `dense_problem` where a generated module has its own."""
    with pytest.MonkeyPatch.context() as patch:
        loop = cascade, newton, newton_steps, line_search, restoration, warm_start
        others = barrier, bounded, unbounded, negative_curvature, exact_bounds, refinement, saddle_points
        for module in (*loop, *others):
            for name in set(vars(module)) & LINEAR_ALGEBRA:
                patch.setattr(module, name, getattr(dense_problem, name))
        patch.setattr(unbounded, "regularisation", lambda grid, up, down: np.where(grid.is_multiplier, -down, up))
        for module in (line_search, restoration, exact_bounds):
            patch.setattr(module, "moved", dense_problem.moved)
        for module in (line_search, restoration, newton_steps):
            patch.setattr(module, "step_along", dense_problem.step_along)
        for module in loop:
            patch.setattr(module, "INEQUALITIES", 1)
        for module in (cascade, newton_steps):
            patch.setattr(module, "UNBOUNDED", 0)
        yield


def leave_out_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the loop that which a module has where no unknown is bounded."""
    for module in (cascade, newton, newton_steps, line_search, restoration, warm_start):
        monkeypatch.setattr(module, "INEQUALITIES", 0)
        monkeypatch.setattr(module, "UNBOUNDED", 0, raising=False)  # no search from nearby, which the barrier has not
        for name in set(vars(module)) & set(vars(unbounded)) - LINEAR_ALGEBRA - {"np"}:
            monkeypatch.setattr(module, name, getattr(unbounded, name))


def solve(grid: Dense, limit: int = 300, warm: bool = False, guess: Any = None) -> tuple[str, Point, int]:
    unknowns = grid.guess.copy() if guess is None else guess
    status, point, iterations = cascade.minimise(grid, unknowns, 1e-10, limit, warm, Log())
    assert iterations <= limit + restoration.RESTORATION_STEPS
    return status, point, iterations


def assert_optimal(grid: Dense, point: Point) -> None:
    """First-order conditions from the definition: equations, bounds, and signs of the Lagrangian's own gradient."""
    unknowns = point.unknowns
    assert (unknowns >= grid.lower).all()
    assert (unknowns <= grid.upper).all()
    gradient = dense_problem.evaluate(grid, unknowns).gradient
    assert np.abs(gradient[grid.is_multiplier]).max(initial=0.0) <= 1e-10
    for i in np.flatnonzero(~grid.is_multiplier & grid.free):
        room = max(0.0, gradient[i]) * (unknowns[i] - grid.lower[i] if grid.lower[i] > -INFINITY else 1.0)
        room += max(0.0, -gradient[i]) * (grid.upper[i] - unknowns[i] if grid.upper[i] < INFINITY else 1.0)
        assert room <= 2e-10 * max(1.0, np.abs(unknowns).max())
