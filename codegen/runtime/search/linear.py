"""Solve a linear-quadratic problem: one Newton step, and at most two more that remove rounding errors."""

import numpy as np

from codegen.runtime.search.convergence import is_solved
from codegen.runtime.search.descent import FLAT, WORTH_MEASURING
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, is_factored, solve_kkt
from codegen.runtime.search.point import evaluate
from codegen.runtime.search.saddle_points import least_delta_w

CONTRADICTORY = 1e-6  # least violation of contradictory equations, relative to the first residual
ROUNDINGS = 4.0  # rounding errors of their terms that one Newton step leaves in the equations
LARGE = 1e6  # a larger step, relative to the unknowns, means that the problem is unbounded


def minimise(grid, unknowns, tolerance, log, system=None):
    """Find the minimum; return (status, point, iterations).

    A row (cost, residual, stationarity, Hessian's shift, step length) is
    appended to `log` at every iterate. `system` is the storage of the linear system, if there is one.
    """
    system = system or allocate_system(grid)
    none, step = np.zeros(unknowns.size), np.empty(unknowns.size)
    point = evaluate(grid, unknowns)
    excess = factor_kkt(grid, unknowns, 1.0, none, system, point.gradient, step)
    for iteration in range(4):
        log.add(point, float(iteration > 0))
        if not point.error < np.inf:
            return "non-finite", point, iteration
        if excess != 0:
            return *without_minimum(grid, point, system), iteration
        if (iteration > 0 or point.error <= WORTH_MEASURING) and is_solved(grid, point, tolerance, ROUNDINGS):
            return "solved", point, iteration
        if iteration > 0:
            solve_kkt(grid, system, point.gradient, step)
        point = evaluate(grid, point.unknowns + step)
    return "stalled", point, 3


def without_minimum(grid, point, system):
    """Return (status, point) if the KKT matrix is singular, or has another inertia than at a minimum."""
    least = least_violation(grid, point, system)
    if least.residual > CONTRADICTORY * point.residual:
        return "infeasible", least
    if least_delta_w(grid, point.unknowns, system) > FLAT:
        return "unbounded", least
    step = np.empty_like(point.unknowns)
    solve_kkt(grid, system, least.gradient, step)
    large = np.abs(step[~grid.is_multiplier]).max() > LARGE * max(1.0, np.abs(least.unknowns).max())
    return "unbounded" if large else "rank-deficient", least


def least_violation(grid, point, system):
    """Return the point nearest to a given one where the equations hold, or where they are violated least."""
    step = np.empty_like(point.unknowns)
    point = evaluate(grid, np.where(grid.is_multiplier, 0.0, point.unknowns))
    for _ in range(5):
        gradient = np.where(grid.is_multiplier, point.gradient, 0.0)
        diagonal = np.where(grid.is_multiplier, -FLAT, 1.0)
        if not is_factored(factor_kkt(grid, point.unknowns, 0.0, diagonal, system, gradient, step)):
            return point
        step[grid.is_multiplier] = 0.0
        point = evaluate(grid, point.unknowns + step)
    return point
