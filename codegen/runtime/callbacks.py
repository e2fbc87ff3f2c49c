"""The problem as other optimisers want it: cost, constraints and their derivatives in the free unknowns.

Free primal unknowns and free multipliers are picked out of the vector of all unknowns by index arrays; what is pinned
by a boundary condition appears in neither. Matrices are returned as (rows, columns, values).
"""

import numpy as np
from numba import njit

from codegen.runtime.example import (
    ELEMENT,
    END_PINNED,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    NODE,
    ONLY_AT_ENDS,
    START_PINNED,
    STRIDE,
    interval_hessian,
)
from codegen.runtime.ends_flat import end_entries
from codegen.runtime.elements import IS_CURVATURE
from codegen.runtime.point import evaluate


def free_unknowns(grid):
    """Boolean mask of the unknowns that no boundary condition fixes and that mean something."""
    free = np.ones(grid.is_multiplier.size, dtype=bool)
    for i in ONLY_AT_ENDS:
        free[i + STRIDE : -NODE : STRIDE] = False
    free[list(START_PINNED)] = False
    free[[free.size - NODE + i for i in END_PINNED]] = False
    return free


def primal_unknowns(grid):
    """Indices of the free primal unknowns."""
    return np.flatnonzero(free_unknowns(grid) & ~grid.is_multiplier)


def multiplier_unknowns(grid):
    """Indices of the multipliers whose equations are imposed."""
    return np.flatnonzero(free_unknowns(grid) & grid.is_multiplier)


def cost(grid, unknowns):
    """Discrete cost."""
    return evaluate(grid, unknowns).cost


def cost_gradient(grid, unknowns):
    """Gradient of the discrete cost by the free primal unknowns."""
    without_multipliers = np.where(grid.is_multiplier, 0.0, unknowns)
    return evaluate(grid, without_multipliers).gradient[primal_unknowns(grid)]


def constraints(grid, unknowns):
    """Residuals of all discrete equations."""
    return evaluate(grid, unknowns).gradient[multiplier_unknowns(grid)]


def stationarity(grid, unknowns):
    """Gradient of the Lagrangian by the free primal unknowns, at the multipliers contained in `unknowns`."""
    return evaluate(grid, unknowns).gradient[primal_unknowns(grid)]


def jacobian(grid, unknowns):
    """Jacobian of the residuals by the free primal unknowns, as (rows, columns, values)."""
    return submatrix(grid, unknowns, multiplier_unknowns(grid), primal_unknowns(grid), False)


def hessian(grid, unknowns):
    """Hessian of the Lagrangian by the free primal unknowns, both triangles, as (rows, columns, values)."""
    return submatrix(grid, unknowns, primal_unknowns(grid), primal_unknowns(grid), True)


def submatrix(grid, unknowns, rows, columns, is_curvature):
    """Entries of the KKT matrix in the given rows and columns, renumbered; duplicates are to be added."""
    values = np.empty((grid.steps, HESSIAN_ROWS.size))
    interval_hessians(unknowns, grid.steps, grid.h, grid.parameters, values)
    offsets = STRIDE * np.arange(grid.steps)[:, None]
    row = (offsets + HESSIAN_ROWS)[:, is_curvature == IS_CURVATURE].ravel()
    column = (offsets + HESSIAN_COLUMNS)[:, is_curvature == IS_CURVATURE].ravel()
    value = values[:, is_curvature == IS_CURVATURE].ravel()
    end_row, end_column, end_value = end_entries(grid, unknowns)
    row, column = np.concatenate([row, end_row]), np.concatenate([column, end_column])
    value = np.concatenate([value, end_value])
    off_diagonal = row != column
    row, column = np.concatenate([row, column[off_diagonal]]), np.concatenate([column, row[off_diagonal]])
    value = np.concatenate([value, value[off_diagonal]])
    new_row, new_column = np.full(unknowns.size, -1), np.full(unknowns.size, -1)
    new_row[rows], new_column[columns] = np.arange(rows.size), np.arange(columns.size)
    inside = (new_row[row] >= 0) & (new_column[column] >= 0)
    return new_row[row[inside]], new_column[column[inside]], value[inside]


@njit(cache=True, error_model="numpy")
def interval_hessians(unknowns, steps, h, parameters, values):
    """Fill row k of `values` with the entries of the Hessian of interval k."""
    gradient = np.empty(ELEMENT)
    for k in range(steps):
        first = k * STRIDE
        interval_hessian(unknowns[first : first + ELEMENT], k * h, h, parameters, gradient, values[k])
