"""The problem as other optimisers want it: cost, constraints and their derivatives in the free unknowns.

Free primal unknowns and free multipliers are picked out of the vector of all unknowns by index arrays; what is pinned
by a boundary condition appears in neither. Matrices are returned as (rows, columns, values).
"""

import numpy as np

from codegen.runtime.search.grid import multiplier_unknowns, primal_unknowns
from codegen.runtime.search.linear_system import allocate_system, filled_entries
from codegen.runtime.search.point import evaluate


def cost(grid, unknowns):
    """Return the discrete cost."""
    return evaluate(grid, unknowns).cost


def cost_gradient(grid, unknowns):
    """Return the gradient of the discrete cost by the free primal unknowns."""
    without_multipliers = np.where(grid.is_multiplier, 0.0, unknowns)
    return evaluate(grid, without_multipliers).gradient[primal_unknowns(grid)]


def constraints(grid, unknowns):
    """Return the residuals of all discrete equations."""
    return evaluate(grid, unknowns).gradient[multiplier_unknowns(grid)]


def stationarity(grid, unknowns):
    """Return the gradient of the Lagrangian by the free primal unknowns, at the multipliers in `unknowns`."""
    return evaluate(grid, unknowns).gradient[primal_unknowns(grid)]


def jacobian(grid, unknowns):
    """Return the Jacobian of the residuals by the free primal unknowns, as (rows, columns, values)."""
    return submatrix(grid, unknowns, multiplier_unknowns(grid), primal_unknowns(grid), False)


def hessian(grid, unknowns):
    """Return the Hessian of the Lagrangian by the free primal unknowns, both triangles, as (rows, columns, values)."""
    return submatrix(grid, unknowns, primal_unknowns(grid), primal_unknowns(grid), True)


def submatrix(grid, unknowns, rows, columns, is_curvature):
    """Return entries of the KKT matrix in the given rows and columns, renumbered; duplicates are to be added."""
    row, column = global_entries(grid.problem.structure, grid.steps)
    value = filled_entries(grid, unknowns, allocate_system(grid)).copy()
    wanted = ((grid.is_multiplier[row] == grid.is_multiplier[column]) == is_curvature) & (row >= 0)
    row, column, value = row[wanted], column[wanted], value[wanted]
    off_diagonal = row != column
    row, column = np.concatenate([row, column[off_diagonal]]), np.concatenate([column, row[off_diagonal]])
    value = np.concatenate([value, value[off_diagonal]])
    new_row, new_column = np.full(unknowns.size, -1), np.full(unknowns.size, -1)
    new_row[rows], new_column[columns] = np.arange(rows.size), np.arange(columns.size)
    tied = grid.problem.structure.ties(grid.steps)
    if tied.size:
        representative = np.arange(unknowns.size)
        representative[tied[:, 0]] = tied[:, 1]
        row, column = representative[row], representative[column]
    inside = (new_row[row] >= 0) & (new_column[column] >= 0)
    return new_row[row[inside]], new_column[column[inside]], value[inside]


def global_entries(s, steps):
    """Return rows and columns, among all unknowns, of all second derivatives; of the root matrix the lower triangle.

    Entries of the upper triangle of the root matrix have row and column -1, which is no unknown: they repeat.
    """
    chain, size, n = steps * s.stride + s.node, s.size(steps), s.node
    root = size - s.root
    parts = [[], []]
    of_ends = (
        (0, (s.start_rows, s.start_columns), range(1)),
        (steps * s.stride, (s.end_rows, s.end_columns), range(1)),
    )
    first = (np.arange(s.bodies)[:, None] * chain + s.stride * np.arange(steps)).ravel()
    shared = np.repeat(root + s.root_indices(), steps, axis=0)
    for which, local in enumerate((s.rows, s.columns)):
        indices = first[:, None] + np.minimum(local, s.element - 1)
        linking = local >= s.element
        if linking.any():
            indices[:, linking] = shared[:, local[linking] - s.element]
        parts[which].append(indices.ravel())
    for begin, ends, _ in of_ends:
        for which, local in enumerate(ends):
            for body in range(s.bodies):
                own = body * chain + begin + np.minimum(local, n - 1)
                linking = local >= n
                if linking.any():
                    own[linking] = root + s.root_indices()[body][local[linking] - n]
                parts[which].append(own)
    if s.root:
        i, j = np.divmod(np.arange(s.root**2), s.root)
        parts[0].append(np.where(i >= j, root + i, -1))
        parts[1].append(np.where(i >= j, root + j, -1))
    return tuple(np.concatenate(part).astype(np.int64) for part in parts)
