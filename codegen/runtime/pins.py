"""Unknowns that a boundary condition fixes: their rows of the KKT matrix are those of the unit matrix."""

from numba import njit

from codegen.runtime.example import BANDWIDTH, END_EXTRA, END_PINNED, NODE, START_PINNED


@njit(cache=True, error_model="numpy")
def pin(row, band):
    """Make one row and column of the band matrix that of the unit matrix."""
    for column in range(band.shape[1]):
        band[row, column] = 0.0
    band[row, BANDWIDTH] = 1.0
    for other in range(max(0, row - BANDWIDTH), min(band.shape[0], row + BANDWIDTH + 1)):
        if other != row:
            band[other, BANDWIDTH + row - other] = 0.0


@njit(cache=True, error_model="numpy")
def clear_pinned(right_hand_side):
    """Zero the entries of pinned unknowns."""
    last = right_hand_side.size - END_EXTRA - NODE
    for i in START_PINNED:
        right_hand_side[i] = 0.0
    for i in END_PINNED:
        right_hand_side[last + i] = 0.0
