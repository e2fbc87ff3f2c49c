"""Solve a linear-quadratic problem: one Newton step, and at most two more that remove rounding errors."""

import numpy as np

from codegen.runtime.assembly_condensed import allocate_system, assemble_kkt, factor_kkt, solve_kkt
from codegen.runtime.norms import measure_step
from codegen.runtime.point import evaluate
from codegen.runtime.rounding import rounding_level


def minimise(grid, unknowns, tolerance, max_iterations, log):
    """Find the minimum; return (status, unknowns, iterations).

    A row (cost, residual, stationarity, Hessian's shift, step length) is appended to `log` at every iterate.
    """
    gradient, step = np.empty_like(unknowns), np.empty_like(unknowns)
    system = allocate_system(grid)
    cost, positive = assemble_kkt(grid, unknowns, 1.0, 0.0, 0.0, gradient, system)
    if not np.isfinite(cost + gradient.sum()):
        return "non-finite", unknowns, 0
    if not positive:
        return "unbounded", unknowns, 0
    if factor_kkt(system) >= 0:
        return "rank-deficient", unknowns, 0
    for iteration in range(4):
        point = evaluate(grid, unknowns)
        log.append((point.cost, point.residual, point.stationarity, 0.0, float(iteration > 0)))
        rounding = rounding_level(unknowns, grid.steps, grid.h, grid.parameters) if iteration else 0.0
        if point.error <= max(tolerance, rounding):
            return "solved", unknowns, iteration
        solve_kkt(system, point.gradient, step)
        if iteration == 0 and measure_step(unknowns, point.gradient, step, grid.is_multiplier)[0] < 0.0:
            return "unbounded", unknowns, 0
        unknowns = unknowns + step
    return "stalled", unknowns, 3
