"""The inverse of the small block of what is eliminated inside an interval."""

import numpy as np
from numba import njit


@njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def invert_positive_definite(block, size):
    """Invert a symmetric `block` (size, size) in place by Gauss-Jordan; False when it is not positive definite."""
    for k in range(size):
        pivot = block[k, k]
        if not 0.0 < pivot < np.inf:
            return False
        block[k, k] = 1.0
        for j in range(size):
            block[k, j] /= pivot
        for i in range(size):
            if i != k:
                factor = block[i, k]
                block[i, k] = 0.0
                for j in range(size):
                    block[i, j] -= factor * block[k, j]
    return True
