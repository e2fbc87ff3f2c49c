"""Momenta of a discrete motion by the forced discrete Legendre transforms."""

import numpy as np
from numba import njit

from codegen.runtime.example import ELEMENT, IS_MULTIPLIER, NODE, STRIDE, interval_gradient

EQUATIONS = np.flatnonzero(IS_MULTIPLIER[:NODE])  # places of the multipliers of the equations of motion in a node


@njit(cache=True, error_model="numpy")
def discrete_momenta(unknowns, steps, h, parameters):
    """Momenta (N + 1, n): p_k = -(D1 Ld + f-) of the interval after a node, D2 Ld + f+ of the last one.

    Both are what the multipliers of the equations of motion multiply in an interval's l.
    """
    momenta = np.empty((steps + 1, EQUATIONS.size))
    gradient = np.empty(ELEMENT)
    for k in range(steps):
        interval_gradient(unknowns[k * STRIDE : k * STRIDE + ELEMENT], k * h, h, parameters, gradient)
        for i in range(EQUATIONS.size):
            momenta[k, i] = -gradient[EQUATIONS[i]]
    for i in range(EQUATIONS.size):
        momenta[steps, i] = gradient[STRIDE + EQUATIONS[i]]
    return momenta
