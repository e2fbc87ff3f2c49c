"""An interval's element matrix, with the interval's controls eliminated.

The controls' block C of the Hessian depends on parameters and on the length of an interval alone, so it is inverted
once where all are equally long, and else before all other work. Eliminating the controls of an interval leaves, in the
remaining unknowns of its element, K - B' inverse(C) B, with B the coupling block.
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_matrix
from codegen.runtime.kkt.static_condensation import scatter, subtract_schur_complement
from codegen.runtime.kkt.elements import BLOCK, WIDTH
from codegen.runtime.stand_ins.example import BODIES, CONDENSED, STRIDE, control_hessian
from codegen.runtime.kkt.inverse import invert_positive_definite
from codegen.runtime.unknowns.times import span


def allocate_condensed(grid):
    """`inverses` (BODIES, 2, CONDENSED, CONDENSED) of C at 1, and `couplings` (BODIES, N, CONDENSED, WIDTH).

    Where intervals differ in length there are N + 1 inverses, that of interval k at k + 1.
    """
    count = 2 if grid.is_uniform else grid.steps + 1
    return np.zeros((BODIES, count, CONDENSED, CONDENSED)), np.zeros((BODIES, grid.steps, CONDENSED, WIDTH))


@njit(error_model="numpy")
def prepare_condensed(h, nodes, parameters, weight, parts, diagonal, inverses):
    """Invert the blocks C of a body, by `parts` (ELEMENT,), `weight` and `diagonal`; False if not positive definite."""
    block = zero_matrix(CONDENSED, CONDENSED)
    for k in range(inverses.shape[0] - 1):
        inverse = inverses[k + 1]
        control_hessian(span(nodes, k, h)[1], parameters, block)
        for a in range(CONDENSED):
            for b in range(CONDENSED):
                factor = weight * parts[BLOCK + a] * parts[BLOCK + b]
                inverse[a, b] = factor * block[max(a, b), min(a, b)]
            inverse[a, a] += diagonal[k * STRIDE + BLOCK + a]
        if not invert_positive_definite(inverse, CONDENSED):
            return False
    return True


@njit(error_model="numpy", inline="always")
def add_element(hessian, diagonal, gradient, inverses, couplings, k, element):
    """Add K - B' inverse(C) B of interval k, from `hessian`, to `element` (ROWS, WIDTH); `couplings` keeps B."""
    scatter(hessian, gradient, k, element, couplings[k])
    subtract_schur_complement(couplings[k], inverses[min(k + 1, inverses.shape[0] - 1)], element)
    return True
