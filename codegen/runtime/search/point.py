"""A vector of unknowns with the cost, the gradient of the Lagrangian and the norms that are measured there."""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.addresses import call_loop


class Point(NamedTuple):
    """Unknowns (n,), gradient (n,) of the Lagrangian there, discrete cost, and norms of residual and stationarity.

    `residual` is the largest residual of an equation and `violation` the sum of all; `error` is the max-norm of all
    optimality conditions, infinite where the cost is not finite.
    """

    unknowns: np.ndarray
    gradient: np.ndarray
    cost: float
    residual: float
    violation: float
    stationarity: float
    error: float


def evaluate(grid, unknowns):
    """Evaluate cost, gradient and norms at `unknowns` (n,)."""
    steps, h, nodes, _, parameters, is_multiplier, sizes, _, weight, _, _, problem = grid
    gradient, scaled = np.empty(unknowns.size), np.empty(sizes.size)
    measured = measured_gradient(
        problem.gradient.address, unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, scaled, gradient
    )
    return Point(unknowns, gradient, *measured)


def lagrangian(grid, point):
    """Return the value of the Lagrangian: the cost where the equations hold exactly, to second order."""
    return point.cost + np.where(grid.is_multiplier, point.unknowns, 0.0).dot(point.gradient)


@njit(cache=True, error_model="numpy")
def measured_gradient(
    loop, unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, scaled, gradient
):  # fmt: skip
    """Fill the `gradient` (n,) of the Lagrangian; return the cost and the norms of a Point.

    `loop` is the address of the loop over intervals, `scaled` (n,) or empty is work space.
    """
    nodes_at, parameters_at, gradient_at = nodes.ctypes.data, parameters.ctypes.data, gradient.ctypes.data
    width = parameters.shape[1]
    if sizes.size:
        for i in range(sizes.size):
            scaled[i] = unknowns[i] * sizes[i]
        cost = call_loop(loop, scaled.ctypes.data, steps, h, nodes_at, parameters_at, width, gradient_at) * weight
        for i in range(gradient.size):
            gradient[i] *= weight * sizes[i]
    else:
        cost = call_loop(loop, unknowns.ctypes.data, steps, h, nodes_at, parameters_at, width, gradient_at)
    residual, violation, stationarity = 0.0, 0.0, 0.0
    for i in range(gradient.size):
        value = abs(gradient[i])
        if not value < np.inf:
            return cost, np.inf, np.inf, np.inf, np.inf
        if is_multiplier[i]:
            violation += value
            residual = max(residual, value)
        else:
            stationarity = max(stationarity, value)
    error = max(residual, stationarity) if abs(cost) < np.inf else np.inf
    return cost, residual, violation, stationarity, error
