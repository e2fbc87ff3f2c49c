"""Element matrices of the KKT system: one small symmetric matrix for each interval, closed at both ends.

An element's unknowns are those of its left node, of the interval and of its right node, without those that are
eliminated inside the interval; then the shared unknowns.
"""

import numpy as np
from numba import njit

from codegen.runtime.example import (
    CONDENSED,
    END_PINNED,
    END_SHARED,
    END_SHARED_PLACES,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    IS_MULTIPLIER,
    NODE,
    PHASES,
    SHARED,
    SHARED_IS_MULTIPLIER,
    START_PINNED,
    START_SHARED,
    START_SHARED_PLACES,
    STRIDE,
)
from codegen.runtime.shared import release_rows

BLOCK = STRIDE - CONDENSED  # unknowns of a node and its interval
SIZE = BLOCK + NODE  # unknowns of an element, shared ones aside
LOCAL_IS_MULTIPLIER = np.concatenate([IS_MULTIPLIER, IS_MULTIPLIER[:NODE], np.zeros(SHARED, bool)])
if PHASES:
    LOCAL_IS_MULTIPLIER[STRIDE + NODE :] = SHARED_IS_MULTIPLIER
IS_CURVATURE = LOCAL_IS_MULTIPLIER[HESSIAN_ROWS] == LOCAL_IS_MULTIPLIER[HESSIAN_COLUMNS]
if PHASES:
    IS_CURVATURE &= ~LOCAL_IS_MULTIPLIER[HESSIAN_ROWS]  # multipliers that an interval lacks must not become singular


@njit(error_model="numpy", inline="always")
def add_diagonal_and_pin(k, steps, diagonal, element):
    """Add a body's share of `diagonal`, and pin what is given at the ends.

    A node's diagonal is added in the element on its right, the last node's in the last element. The row and column
    of an unknown that a boundary condition gives are those of the unit matrix.
    """
    for i in range(BLOCK):
        element[i, i] += diagonal[k * STRIDE + i]
    if k == steps - 1:
        for i in range(NODE):
            element[BLOCK + i, BLOCK + i] += diagonal[(k + 1) * STRIDE + i]
    if k == 0:
        if SHARED:
            release_rows(START_SHARED_PLACES, START_SHARED, 0, SIZE, element)
        for i in START_PINNED:
            pin(i, element)
    if k == steps - 1:
        if SHARED:
            release_rows(END_SHARED_PLACES, END_SHARED, BLOCK, SIZE, element)
        for i in END_PINNED:
            pin(BLOCK + i, element)


@njit(error_model="numpy")
def pin(place, element):
    """Make one row and column of an element matrix that of the unit matrix."""
    for i in range(element.shape[0]):
        element[place, i] = 0.0
        element[i, place] = 0.0
    element[place, place] = 1.0
