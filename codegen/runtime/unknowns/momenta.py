"""Momenta of a discrete motion by the forced discrete Legendre transforms."""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.stand_ins.example import BODIES, ELEMENT, EQUATIONS, NODE, SHARED, STRIDE, interval_gradient
from codegen.runtime.unknowns.shared import read_shared
from codegen.runtime.unknowns.times import span


def discrete_momenta(grid, unknowns):
    """Momenta (BODIES, N + 1, m): p_k = -(D1 Ld + f-) of the interval after a node, D2 Ld + f+ of the last one.

    Both are what the multipliers of the equations of motion multiply in an interval's l.
    """
    momenta = np.empty((BODIES, grid.steps + 1, EQUATIONS.size))
    interval_momenta(unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, momenta)
    return momenta


@njit(cache=True, error_model="numpy")
def interval_momenta(unknowns, steps, h, nodes, parameters, momenta):
    """Fill `momenta` (BODIES, N + 1, EQUATIONS.size) from the gradient of every interval's l at `unknowns` (n,)."""
    part = zero_vector(ELEMENT + SHARED)
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        for k in range(steps):
            first = body * (steps * STRIDE + NODE) + k * STRIDE
            t, length = span(nodes, k, h)
            interval_gradient(unknowns[first : first + ELEMENT], t, length, parameters[body], part)
            for i in range(EQUATIONS.size):
                momenta[body, k, i] = -part[EQUATIONS[i]]
        for i in range(EQUATIONS.size):
            momenta[body, steps, i] = part[STRIDE + EQUATIONS[i]]
