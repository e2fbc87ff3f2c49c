"""The problem as other optimisers want it: cost, constraints and their derivatives in the free unknowns.

Free primal unknowns and free multipliers are picked out of the vector of all unknowns by index arrays; what is pinned
by a boundary condition appears in neither. Matrices are returned as (rows, columns, values).
"""

import numpy as np
from numba import njit

from codegen.runtime.unknowns.coupling import coupling_entries
from codegen.runtime.kkt.ends_linear import end_entries
from codegen.runtime.stand_ins.example import (
    BODIES,
    COUPLINGS,
    ELEMENT,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    NODE,
    ROOT,
    SHARED,
    STRIDE,
    TIED,
    interval_hessian,
)
from codegen.runtime.unknowns.layout import multiplier_unknowns, primal_unknowns
from codegen.runtime.unknowns.point import evaluate
from codegen.runtime.unknowns.shared import read_shared, root_index
from codegen.runtime.unknowns.tied_ends import shared_representatives


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
    values = np.empty((BODIES * grid.steps, HESSIAN_ROWS.size))
    interval_hessians(unknowns, grid.steps, grid.h, grid.parameters, values)
    chain = grid.steps * STRIDE + NODE
    offsets = (chain * np.arange(BODIES)[:, None] + STRIDE * np.arange(grid.steps)).reshape(-1, 1)
    row, column, value = offsets + HESSIAN_ROWS, offsets + HESSIAN_COLUMNS, values
    if SHARED:
        shared = unknowns.size - ROOT + np.array([[root_index(b, j) for j in range(SHARED)] for b in range(BODIES)])
        shared = np.repeat(shared, grid.steps, axis=0)
        row[:, HESSIAN_ROWS >= ELEMENT] = shared[:, HESSIAN_ROWS[HESSIAN_ROWS >= ELEMENT] - ELEMENT]
        column[:, HESSIAN_COLUMNS >= ELEMENT] = shared[:, HESSIAN_COLUMNS[HESSIAN_COLUMNS >= ELEMENT] - ELEMENT]
    entries = [(row.ravel(), column.ravel(), value.ravel()), end_entries(grid, unknowns)]
    if COUPLINGS:
        entries.append(coupling_entries(grid, unknowns))
    row, column, value = (np.concatenate(part) for part in zip(*entries, strict=True))
    wanted = (grid.is_multiplier[row] == grid.is_multiplier[column]) == is_curvature
    row, column, value = row[wanted], column[wanted], value[wanted]
    off_diagonal = row != column
    row, column = np.concatenate([row, column[off_diagonal]]), np.concatenate([column, row[off_diagonal]])
    value = np.concatenate([value, value[off_diagonal]])
    new_row, new_column = np.full(unknowns.size, -1), np.full(unknowns.size, -1)
    new_row[rows], new_column[columns] = np.arange(rows.size), np.arange(columns.size)
    if TIED:
        representative = shared_representatives(grid, unknowns.size)
        row, column = representative[row], representative[column]
    inside = (new_row[row] >= 0) & (new_column[column] >= 0)
    return new_row[row[inside]], new_column[column[inside]], value[inside]


@njit(cache=True, error_model="numpy")
def interval_hessians(unknowns, steps, h, parameters, values):
    """Fill a row of `values` with the entries of the Hessian of each interval of each body."""
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        for k in range(steps):
            first = body * (steps * STRIDE + NODE) + k * STRIDE
            here = unknowns[first : first + ELEMENT]
            interval_hessian(here, k * h, h, parameters[body], values[body * steps + k])
