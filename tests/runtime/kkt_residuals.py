"""What a Newton step leaves of its equations, and its refinement, as the compiled search has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from codegen.runtime.search import direction, workspace
from codegen.runtime.search.grid import Grid
from codegen.runtime.search.iterates import arguments_of
from codegen.runtime.search.linear_system import System

Vector = NDArray[np.float64]


def linear_residual(
    grid: Grid, unknowns: Vector, diagonal: Vector, right: Vector, step: Vector, system: System
) -> tuple[Vector, float]:
    """KKT matrix . step + right (n,), and its size relative to the right-hand side and the solution."""
    left, vectors = np.empty(step.size), np.empty((workspace.VECTORS, step.size))
    arguments = *arguments_of(grid, system), unknowns, diagonal, right, step, 1.0, vectors, left
    return left, direction.fill_linear_residual(*arguments)


def refine(
    grid: Grid, unknowns: Vector, diagonal: Vector, system: System, right: Vector, step: Vector
) -> bool:  # fmt: skip
    """Refine a step in place with the factors of its system; whether that lowered the residual."""
    vectors, room = np.empty((workspace.VECTORS, step.size)), np.empty((2 * direction.SOLVED_AGAIN + 2, step.size))
    vectors[workspace.RIGHT], vectors[workspace.DIAGONAL], vectors[workspace.STEP] = right, diagonal, step
    is_lower = direction.refined(*arguments_of(grid, system), unknowns, vectors, room)
    step[:] = vectors[workspace.STEP]
    return bool(is_lower)
