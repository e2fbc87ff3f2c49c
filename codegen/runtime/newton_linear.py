"""Solve a linear-quadratic problem: one Newton step, and at most two more that remove rounding errors."""

import numpy as np

from codegen.runtime.frontal import allocate_system, factor_kkt, solve_kkt
from codegen.runtime.point import evaluate
from codegen.runtime.rounding import is_solved


def minimise(grid, unknowns, tolerance, max_iterations, warm, log):
    """Find the minimum; return (status, point, iterations).

    `max_iterations` and `warm` have no effect. A row (cost, residual, stationarity, Hessian's shift, step length) is
    appended to `log` at every iterate.
    """
    system = allocate_system(grid)
    none = np.zeros(unknowns.size)
    excess = factor_kkt(grid, unknowns, 1.0, none, system)
    point = evaluate(grid, unknowns)
    for iteration in range(4):
        log.append((point.cost, point.residual, point.stationarity, 0.0, float(iteration > 0)))
        if not point.error < np.inf:
            return "non-finite", point, iteration
        if excess is None or excess < 0:
            return "rank-deficient", point, iteration
        if excess > 0:
            return "unbounded", point, iteration
        if is_solved(grid, point, tolerance):
            return "solved", point, iteration
        step = np.empty_like(unknowns)
        solve_kkt(grid, system, point.gradient, step)
        point = evaluate(grid, point.unknowns + step)
    return "stalled", point, 3
