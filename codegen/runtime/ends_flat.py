"""What the boundary conditions do to the first and last element matrix where they are not curved: pin what is given."""

import numpy as np
from numba import njit

from codegen.runtime.elements import add_diagonal_and_pin


@njit(error_model="numpy", inline="always")
def close_element(unknowns, k, steps, h, parameters, weight, diagonal, element):
    """Add the diagonal of an element matrix and pin what is given."""
    add_diagonal_and_pin(k, steps, diagonal, element)


def end_entries(grid, unknowns):
    """Entries (rows, columns, values) that the ends add to the lower triangle of the KKT matrix: none."""
    return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
