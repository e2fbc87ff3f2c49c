"""The two ends of the KKT band matrix, where no end has a curvature of its own: pin what is fixed there."""

from numba import njit

from codegen.runtime.example import END_EXTRA, END_PINNED, NODE, START_PINNED
from codegen.runtime.pins import pin


@njit(cache=True, error_model="numpy")
def close_ends(unknowns, duration, parameters, weight, shift, dual_shift, band):
    """Make the rows and columns of pinned unknowns those of the unit matrix."""
    last = band.shape[0] - END_EXTRA - NODE
    for i in START_PINNED:
        pin(i, band)
    for i in END_PINNED:
        pin(last + i, band)
