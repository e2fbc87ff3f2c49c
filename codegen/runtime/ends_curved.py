"""What the boundary conditions do to the first and last element matrix where they are curved."""

import numpy as np
from numba import njit

from codegen.runtime.elements import BLOCK, shift_and_pin
from codegen.runtime.example import (
    END_HESSIAN_COLUMNS,
    END_HESSIAN_ROWS,
    IS_MULTIPLIER,
    NODE,
    START_HESSIAN_COLUMNS,
    START_HESSIAN_ROWS,
    end_hessian,
    start_hessian,
)


@njit(error_model="numpy", inline="always")
def close_element(unknowns, k, steps, h, parameters, weight, shift, dual_shift, element):
    """Add the Hessians of the boundary conditions, shift the diagonal of an element matrix and pin what is given."""
    if k == 0:
        entries = np.empty(START_HESSIAN_ROWS.size)
        start_hessian(unknowns[:NODE], 0.0, parameters, entries)
        add_end(entries, START_HESSIAN_ROWS, START_HESSIAN_COLUMNS, 0, weight, element)
    if k == steps - 1:
        entries = np.empty(END_HESSIAN_ROWS.size)
        end_hessian(unknowns[unknowns.size - NODE :], steps * h, parameters, entries)
        add_end(entries, END_HESSIAN_ROWS, END_HESSIAN_COLUMNS, BLOCK, weight, element)
    shift_and_pin(k, steps, shift, dual_shift, element)


@njit(error_model="numpy")
def add_end(entries, rows, columns, first, weight, element):
    """Add the lower triangle `entries` of a node's Hessian, and its mirror image, at row and column `first`."""
    for j in range(entries.size):
        row, column = rows[j], columns[j]
        value = weight * entries[j] if IS_MULTIPLIER[row] == IS_MULTIPLIER[column] else entries[j]
        element[first + row, first + column] += value
        if row != column:
            element[first + column, first + row] += value


def end_entries(grid, unknowns):
    """Entries (rows, columns, values) that the ends add to the lower triangle of the KKT matrix."""
    last = unknowns.size - NODE
    at_start, at_end = np.empty(START_HESSIAN_ROWS.size), np.empty(END_HESSIAN_ROWS.size)
    start_hessian(unknowns[:NODE], 0.0, grid.parameters, at_start)
    end_hessian(unknowns[last:], grid.steps * grid.h, grid.parameters, at_end)
    return (
        np.concatenate([START_HESSIAN_ROWS, last + END_HESSIAN_ROWS]),
        np.concatenate([START_HESSIAN_COLUMNS, last + END_HESSIAN_COLUMNS]),
        np.concatenate([at_start, at_end]),
    )
