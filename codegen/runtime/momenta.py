"""Momenta of a discrete motion by the forced discrete Legendre transforms."""

import numpy as np
from numba import njit

from codegen.runtime.example import BODIES, ELEMENT, EQUATIONS, NODE, SHARED, STRIDE, interval_gradient
from codegen.runtime.shared import read_shared


def discrete_momenta(grid, unknowns):
    """Momenta (bodies, N + 1, n): p_k = -(D1 Ld + f-) of the interval after a node, D2 Ld + f+ of the last one.

    Both are what the multipliers of the equations of motion multiply in an interval's l.
    """
    parts = np.empty((BODIES, grid.steps, ELEMENT + SHARED))
    interval_parts(unknowns, grid.steps, grid.h, grid.parameters, parts)
    return np.concatenate([-parts[:, :, EQUATIONS], parts[:, -1:, STRIDE + EQUATIONS]], axis=1)


@njit(cache=True, error_model="numpy")
def interval_parts(unknowns, steps, h, parameters, parts):
    """Fill `parts` with the gradient of every interval's l."""
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        for k in range(steps):
            first = body * (steps * STRIDE + NODE) + k * STRIDE
            interval_gradient(unknowns[first : first + ELEMENT], k * h, h, parameters[body], parts[body, k])
