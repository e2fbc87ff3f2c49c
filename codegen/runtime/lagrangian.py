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
    """Discrete cost, and gradient of the Lagrangian by all unknowns, zero where they are pinned."""
    gradient, last = np.empty_like(unknowns), unknowns.size - NODE
    cost = interval_gradients(unknowns, steps, h, parameters, np.empty((1, ELEMENT)), gradient)
    start_gradient(unknowns[:NODE], 0.0, parameters, gradient[:NODE])
    end_gradient(unknowns[last:], steps * h, parameters, gradient[last:])
    for i in START_PINNED:
        gradient[i] = 0.0
    for i in END_PINNED:
        gradient[last + i] = 0.0
    return cost, gradient


@njit(cache=True, error_model="numpy")
def interval_gradients(unknowns, steps, h, parameters, parts, gradient):
    """Fill `gradient` with the sum of the gradients of all intervals and return the discrete cost.

    Row k of `parts` takes the gradient of interval k if there are that many rows; a single row is overwritten.
    """
    for i in range(gradient.size):
        gradient[i] = 0.0
    cost = 0.0
    for k in range(steps):
        first = k * STRIDE
        part = parts[min(k, parts.shape[0] - 1)]
        cost += interval_gradient(unknowns[first : first + ELEMENT], k * h, h, parameters, part)
        for i in range(ELEMENT):
            gradient[first + i] += part[i]
    return cost
