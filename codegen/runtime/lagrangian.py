"""Value and gradient of the Lagrangian of the optimisation problem: a sum over intervals and both ends.

Unknowns lie in one vector: node 0, interval 0, node 1, interval 1, ..., node N. The gradient by the multipliers is the residual of the discrete equations, the
gradient by the other unknowns is the stationarity of the optimum.
"""

import numpy as np
from numba import njit

from codegen.runtime.example import (
    ELEMENT,
    END_PINNED,
    NODE,
    START_PINNED,
    STRIDE,
    end_gradient,
    interval_gradient,
    start_gradient,
)


@njit(cache=True, error_model="numpy")
def lagrangian_gradient(unknowns, steps, h, parameters, gradient):
    """Fill the gradient of the Lagrangian by all unknowns and return the discrete cost; pinned entries are zero."""
    local = np.empty(ELEMENT)
    for i in range(gradient.size):
        gradient[i] = 0.0
    cost = 0.0
    for k in range(steps):
        first = k * STRIDE
        cost += interval_gradient(unknowns[first : first + ELEMENT], k * h, h, parameters, local)
        for i in range(ELEMENT):
            gradient[first + i] += local[i]
    add_end_gradients(unknowns, steps * h, parameters, gradient)
    return cost


@njit(cache=True, error_model="numpy")
def add_end_gradients(unknowns, duration, parameters, gradient):
    """Add the shares of both ends to the gradient and clear the entries of pinned unknowns."""
    last = unknowns.size - NODE
    start_gradient(unknowns[:NODE], 0.0, parameters, gradient[:NODE])
    end_gradient(unknowns[last:], duration, parameters, gradient[last:])
    for i in START_PINNED:
        gradient[i] = 0.0
    for i in END_PINNED:
        gradient[last + i] = 0.0
