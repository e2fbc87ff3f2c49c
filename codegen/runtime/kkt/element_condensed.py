"""An interval's element matrix, with the interval's controls eliminated.

The controls' block C of the Hessian is the same on every interval, so it is inverted once. Eliminating the controls
of an interval leaves, in the remaining unknowns of its element, K - B' inverse(C) B, with B the coupling block.
"""

import numpy as np
from numba import njit

from codegen.runtime.kkt.static_condensation import scatter, subtract_schur_complement
from codegen.runtime.kkt.elements import BLOCK, WIDTH
from codegen.runtime.stand_ins.example import BODIES, CONDENSED, control_hessian
from codegen.runtime.kkt.inverse import invert_positive_definite


def allocate_condensed(grid):
    """`inverses` (BODIES, 2, CONDENSED, CONDENSED) of C and its inverse, `couplings` (BODIES, N, CONDENSED, WIDTH)."""
    inverses, block = np.zeros((BODIES, 2, CONDENSED, CONDENSED)), np.zeros((CONDENSED, CONDENSED))
    control_hessian(grid.h, grid.parameters[0], block)
    for a in range(CONDENSED):
        for b in range(a):
            block[b, a] = block[a, b]
    inverses[:, 0] = block
    return inverses, np.zeros((BODIES, grid.steps, CONDENSED, WIDTH))


@njit(error_model="numpy", inline="always")
def prepare_condensed(weight, parts, diagonal, inverses):
    """Invert the block C of a body, by `parts` (ELEMENT,), `weight` and `diagonal`; False if not positive definite."""
    block, inverse = inverses[0], inverses[1]
    for a in range(CONDENSED):
        for b in range(CONDENSED):
            inverse[a, b] = weight * parts[BLOCK + a] * parts[BLOCK + b] * block[a, b]
        inverse[a, a] += diagonal[BLOCK + a]
    return invert_positive_definite(inverse, CONDENSED)


@njit(error_model="numpy", inline="always")
def add_element(hessian, diagonal, gradient, inverses, couplings, k, element):
    """Add K - B' inverse(C) B of interval k, from `hessian`, to `element` (ROWS, WIDTH); `couplings` keeps B."""
    scatter(hessian, gradient, k, element, couplings[k])
    subtract_schur_complement(couplings[k], inverses[1], element)
    return True
