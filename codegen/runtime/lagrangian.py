"""Value and gradient of the Lagrangian of the optimisation problem: a sum over intervals and both ends.

Unknowns lie in one vector: node 0, interval 0, node 1, interval 1, ..., node N. The gradient by the multipliers is
the residual of the discrete equations, the gradient by the other unknowns is the stationarity of the optimum.
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


def lagrangian_gradient(unknowns, steps, h, parameters):
    """Discrete cost, gradient of the Lagrangian by all unknowns (zero where pinned), and gradients of all intervals."""
    gradient, parts = np.empty_like(unknowns), np.empty((steps, ELEMENT))
    cost = interval_gradients(unknowns, steps, h, parameters, parts, gradient)
    last = unknowns.size - NODE
    start_gradient(unknowns[:NODE], 0.0, parameters, gradient[:NODE])
    end_gradient(unknowns[last:], steps * h, parameters, gradient[last:])
    for i in START_PINNED:
        gradient[i] = 0.0
    for i in END_PINNED:
        gradient[last + i] = 0.0
    return cost, gradient, parts


@njit(cache=True, error_model="numpy")
def interval_gradients(unknowns, steps, h, parameters, parts, gradient):
    """Fill row k of `parts` with the gradient of interval k, and `gradient` with their sum; return the discrete cost."""
    for i in range(gradient.size):
        gradient[i] = 0.0
    cost = 0.0
    for k in range(steps):
        first = k * STRIDE
        cost += interval_gradient(unknowns[first : first + ELEMENT], k * h, h, parameters, parts[k])
        for i in range(ELEMENT):
            gradient[first + i] += parts[k, i]
    return cost
