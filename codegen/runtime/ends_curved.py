"""The two ends of the KKT band matrix, where an end adds curvature of its own or unknowns that exist only there."""

import numpy as np
from numba import njit

from codegen.runtime.example import (
    BANDWIDTH,
    END_EXTRA,
    END_HESSIAN_COLUMNS,
    END_HESSIAN_ROWS,
    END_IS_MULTIPLIER,
    END_PINNED,
    NODE,
    START_EXTRA,
    START_HESSIAN_COLUMNS,
    START_HESSIAN_ROWS,
    START_IS_MULTIPLIER,
    START_PINNED,
    end_hessian,
    start_hessian,
)
from codegen.runtime.pins import pin


@njit(cache=True, error_model="numpy")
def close_ends(unknowns, duration, parameters, weight, shift, dual_shift, band):
    """Add the Hessians of both ends, shift the unknowns that exist only there, and pin what is fixed."""
    last = band.shape[0] - END_EXTRA - NODE
    entries = np.empty(START_HESSIAN_ROWS.size)
    start_hessian(unknowns[: START_EXTRA + NODE], 0.0, parameters, entries)
    add_end(entries, START_HESSIAN_ROWS, START_HESSIAN_COLUMNS, START_IS_MULTIPLIER, weight, 0, band)
    entries = np.empty(END_HESSIAN_ROWS.size)
    end_hessian(unknowns[unknowns.size - END_EXTRA - NODE :], duration, parameters, entries)
    add_end(entries, END_HESSIAN_ROWS, END_HESSIAN_COLUMNS, END_IS_MULTIPLIER, weight, last, band)
    for i in range(START_EXTRA):
        band[i, BANDWIDTH] += -dual_shift if START_IS_MULTIPLIER[i] else shift
    for i in range(END_EXTRA):
        band[last + NODE + i, BANDWIDTH] += -dual_shift if END_IS_MULTIPLIER[NODE + i] else shift
    for i in START_PINNED:
        pin(i, band)
    for i in END_PINNED:
        pin(last + i, band)


@njit(cache=True, error_model="numpy")
def add_end(entries, rows, columns, is_multiplier, weight, first, band):
    """Add the lower triangle `entries` and its mirror image to the band matrix, from row `first` on."""
    for j in range(entries.size):
        row, column = rows[j], columns[j]
        value = weight * entries[j] if is_multiplier[row] == is_multiplier[column] else entries[j]
        band[first + row, BANDWIDTH + column - row] += value
        if row != column:
            band[first + column, BANDWIDTH + row - column] += value
