"""An interval's element matrix, with the interval's controls eliminated.

The controls' block C of the Hessian is the same on every interval, so it is inverted once. Eliminating the controls
of an interval leaves, in the remaining unknowns of its element, K - B' inverse(C) B, with B the coupling block.
"""

import numpy as np
from numba import njit

from codegen.runtime.condensation import (
    invert_positive_definite,
    scatter,
    subtract_condensed,
)
from codegen.runtime.elements import BLOCK, WIDTH
from codegen.runtime.example import BODIES, CONDENSED, control_hessian


def allocate_condensed(grid):
    """Room for the block C, which is filled in, for its inverse, and for B of all intervals of all bodies."""
    storage = np.zeros(2 * CONDENSED**2 + BODIES * grid.steps * CONDENSED * WIDTH)
    block = storage[: CONDENSED**2].reshape(CONDENSED, CONDENSED)
    control_hessian(grid.h, grid.parameters[0], block)
    for a in range(CONDENSED):
        for b in range(a):
            block[b, a] = block[a, b]
    return storage


@njit(error_model="numpy", inline="always")
def condensed_parts(storage, steps):
    """The block C, its inverse, and B of all intervals of all bodies."""
    size = CONDENSED * CONDENSED
    block, inverse = storage[:size], storage[size : 2 * size]
    return (
        block.reshape((CONDENSED, CONDENSED)),
        inverse.reshape((1, CONDENSED, CONDENSED)),
        storage[2 * size :].reshape((BODIES * steps, CONDENSED, WIDTH)),
    )


@njit(error_model="numpy", inline="always")
def prepare_condensed(weight, diagonal, condensed):
    """Invert the controls' block C, weighted and shifted; False when it is not positive definite."""
    block, inverses, _ = condensed
    shifted = np.empty((CONDENSED, CONDENSED))
    for a in range(CONDENSED):
        for b in range(CONDENSED):
            shifted[a, b] = weight * block[a, b]
        shifted[a, a] += diagonal[BLOCK + a]
    return invert_positive_definite(shifted, inverses[0])


@njit(error_model="numpy", inline="always")
def add_element(hessian, diagonal, gradient, condensed, interval, element):
    """Add K - B' inverse(C) B of an interval to the element matrix, and keep B for the recovery of the controls."""
    _, inverses, couplings = condensed
    scatter(hessian, gradient, element, couplings[interval])
    subtract_condensed(couplings[interval], inverses[0], element)
    return True
