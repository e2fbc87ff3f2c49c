"""A time grid with its data, and a vector of unknowns together with everything that is measured there."""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example import INNER_TIMES, SCALED
from codegen.runtime.unknowns.lagrangian import lagrangian_gradient
from codegen.runtime.norms import measure


class Grid(NamedTuple):
    """N = `steps` intervals, parameters (BODIES, P + SHARED), and which unknowns are multipliers: (n,).

    Intervals have the mean length h, and `nodes` (N + 1,) are the indices of all nodes in time, in mean lengths.
    `is_uniform` says that all intervals have that length.

    The last columns of `parameters` hold the shared unknowns of each body at the point that was evaluated last.
    Where there are `sizes` (n,), all unknowns are in parts of them, and the cost is multiplied by `weight`; `forces`
    (n,) is then `weight` times `sizes`, by which the gradient is multiplied. `bounds`, least and greatest values (n,),
    if known, are in parts of them too.
    """

    steps: int
    h: float
    nodes: np.ndarray
    is_uniform: bool
    parameters: np.ndarray
    is_multiplier: np.ndarray
    sizes: np.ndarray
    forces: np.ndarray
    weight: float
    bounds: tuple[np.ndarray, ...]
    if INNER_TIMES:  # type: ignore[misc]  # decided when a module is made
        inner: tuple[int, ...] = ()  # the nodes at inner times


class Point(NamedTuple):
    """Unknowns (n,), gradient (n,) of the Lagrangian there, discrete cost, and norms of residual and stationarity.

    `violation` is the sum of all residuals; `error` is the max-norm of all equations of the optimum, and infinite where
    the cost is not finite.
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
    gradient = np.empty(unknowns.size)
    steps, h, nodes, _, parameters, is_multiplier, sizes, _, weight, *_ = grid  # by name it takes four times as long
    measured = measured_gradient(unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, gradient)
    return Point(unknowns, gradient, *measured)


def lagrangian(grid, point):
    """The cost where the equations hold exactly, to first order: what is left of them costs multipliers times residual.

    The error of the Lagrangian's value is of second order.
    """
    return point.cost + np.where(grid.is_multiplier, point.unknowns, 0.0).dot(point.gradient)


@njit(cache=True, error_model="numpy")
def measured_gradient(unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, gradient):
    """Fill the `gradient` (n,) of the Lagrangian; return what a Point holds beside it."""
    if SCALED and sizes.size:
        cost = weight * lagrangian_gradient(unknowns * sizes, steps, h, nodes, parameters, gradient)
        for i in range(gradient.size):
            gradient[i] *= weight * sizes[i]
    else:
        cost = lagrangian_gradient(unknowns, steps, h, nodes, parameters, gradient)
    residual, violation, stationarity = measure(gradient, is_multiplier)
    error = max(residual, stationarity) if abs(cost) < np.inf else np.inf
    return cost, residual, violation, stationarity, error
