"""Element matrices of the KKT system: one small symmetric matrix for each interval, closed at both ends.

An element's unknowns are those of its left node, of the interval and of its right node, the controls that are
eliminated inside the interval aside.
"""

from numba import njit

from codegen.runtime.example import (
    CONTROLS,
    END_PINNED,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    IS_MULTIPLIER,
    NODE,
    START_PINNED,
    STRIDE,
)

BLOCK = STRIDE - CONTROLS  # unknowns of a node and its interval
SIZE = BLOCK + NODE  # unknowns of an element
IS_CURVATURE = IS_MULTIPLIER[HESSIAN_ROWS % STRIDE] == IS_MULTIPLIER[HESSIAN_COLUMNS % STRIDE]


@njit(error_model="numpy", inline="always")
def shift_and_pin(k, steps, shift, dual_shift, element):
    """Add `shift` to the diagonal of primal unknowns, -`dual_shift` to that of multipliers, and pin what is given.

    A node's diagonal is shifted in the element on its right, the last node's in the last element. The row and column
    of an unknown that a boundary condition gives are those of the unit matrix.
    """
    for i in range(BLOCK if k < steps - 1 else SIZE):
        element[i, i] += -dual_shift if IS_MULTIPLIER[i % BLOCK] else shift
    if k == 0:
        for i in START_PINNED:
            pin(i, element)
    if k == steps - 1:
        for i in END_PINNED:
            pin(BLOCK + i, element)


@njit(error_model="numpy")
def pin(place, element):
    """Make one row and column of an element matrix that of the unit matrix."""
    for i in range(SIZE):
        element[place, i] = 0.0
        element[i, place] = 0.0
    element[place, place] = 1.0
