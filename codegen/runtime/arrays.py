"""Arrays that compiled functions make and clear for themselves.

Each is compiled once for all that call it, and inlined, so that numbers of rows and columns stay constants.
"""

import numpy as np
from numba import njit


@njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def zero_vector(size):
    """A vector of zeros."""
    return np.zeros(size)


@njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def zero_matrix(rows, columns):
    """A matrix of zeros."""
    return np.zeros((rows, columns))


@njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def copy_part(values, first, part):
    """Fill `part` with the values from `first` on.

    A loop that hands slices to functions counts references to them, by locked instructions, in every round.
    """
    for i in range(part.size):
        part[i] = values[first + i]


@njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def clear(matrix):
    """Make all entries of a matrix zero."""
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            matrix[i, j] = 0.0
