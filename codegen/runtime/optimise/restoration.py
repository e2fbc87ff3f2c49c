"""Feasibility restoration: lower the violation of the equations when the line search finds no way on.

Minimises half the sum of squares of the residuals c inside the bounds, by Levenberg and Marquardt's method with a
barrier: with A the Jacobian of the equations and the bounds' duals as in `barrier`, the step d solves
(A'A + damping + z/d) d = -(A'c - nu s / d), which is the KKT matrix without cost, with -1 on the multipliers' diagonal.
Source: Nocedal and Wright (2006), section 10.3; Waechter and Biegler (2006), section 3.3, for the purpose.
"""

import numpy as np

from codegen.runtime.kkt.system import factor_kkt, solve_kkt
from codegen.runtime.optimise.barrier import add_barrier, measure_step, move, move_duals
from codegen.runtime.unknowns.point import evaluate

RESTORATION_STEPS = 200
FIRST_DAMPING = 1e-2  # part of the squared slope of the residuals, along the way down, that damps the first step


def restore(search, iterate, reduction, is_acceptable, is_late):
    """("restored", unknowns, distances) that the filter accepts, or (what went wrong, and the last ones).

    When restored, the violation is at most `reduction` times the first. `is_late` tells when the time is up.
    """
    grid, bounds, *_ = search
    unknowns, distance = np.where(grid.is_multiplier, 0.0, iterate.point.unknowns), iterate.distance
    logarithms, point = iterate.logarithms, evaluate(grid, unknowns)
    first, nu, damping = point.violation, max(1e-12, 1e-2 * iterate.point.residual**2), 0.0
    duals = np.minimum(nu / distance, 1e3)
    for _ in range(RESTORATION_STEPS):
        if is_late():
            return "time limit", point.unknowns, distance
        pull = attraction(grid, point)
        damping = damping or first_damping(grid, point, pull)
        error = restoration_error(grid, bounds, pull, distance, duals)
        if error <= 1e-8 * point.residual:
            return "infeasible", point.unknowns, distance
        while nu > 1e-14 and max(error, 0.0) <= 10.0 * nu:
            nu = max(1e-14, min(0.2 * nu, nu**1.5))
        taken = damped_step(search, point, pull, distance, logarithms, duals, nu, damping)
        if taken is None:
            return ("infeasible" if error <= 1e-3 * point.residual else "stalled"), point.unknowns, distance
        (point, distance, logarithms), duals, damping = taken
        if point.violation <= reduction * first and is_acceptable(point, logarithms):
            return "restored", point.unknowns, distance
    return "stalled", point.unknowns, distance


def attraction(grid, point):
    """A' c, the gradient of half the squared residuals by primal unknowns, by the linearity of the Lagrangian."""
    with_residuals = np.where(grid.is_multiplier, point.gradient, point.unknowns)
    pull = evaluate(grid, with_residuals).gradient - point.gradient
    return np.where(grid.is_multiplier, 0.0, pull)


def first_damping(grid, point, pull):
    """Enough to keep the first step short where residuals hardly change, whatever the units.

    Without it the step would go far along directions that are hardly determined, away from the iterate for which the
    cost was lowered.
    """
    squares = 2.0 * sum_of_squares(grid, point)
    return max(1e-12, FIRST_DAMPING * (pull @ pull) / squares) if squares > 0.0 else 1e-4


def restoration_error(grid, bounds, pull, distance, duals):
    """Error of the optimality conditions of the least violation."""
    stationary = pull.copy()
    np.subtract.at(stationary, bounds.place, bounds.side * duals)
    return max(np.abs(stationary).max(), np.max(duals * distance, initial=0.0))


def damped_step(search, point, pull, distance, logarithms, duals, nu, damping):
    """((point, distance, logarithms), duals, damping) after a step that lowers the sum of squares, or None."""
    grid, bounds, system, equations, _ = search
    size = point.unknowns.size
    diagonal, step, slopes = np.empty(size), np.empty(size), np.empty(size)
    dual_step, new_duals = np.empty_like(duals), np.empty_like(duals)
    barrier = grid.is_multiplier, bounds.place, bounds.side, distance, duals, nu
    merit = sum_of_squares(grid, point) - nu * logarithms
    while damping < 1e12:
        add_barrier(pull, *barrier, damping, 0.0, slopes, diagonal)
        diagonal[equations] = -1.0  # not where a node has no such equation, and the matrix a one in its place
        right = np.where(grid.is_multiplier, point.gradient, slopes - pull)
        if factor_kkt(grid, point.unknowns, 0.0, diagonal, system, right) is not None:
            solve_kkt(grid, system, right, step, carried=True)
            step[grid.is_multiplier] = 0.0
            _, length, dual_length = measure_step(point.unknowns, slopes, step, *barrier, 0.99, dual_step)
            unknowns, new_distance = np.empty(size), np.empty_like(distance)
            new_logarithms = move(point.unknowns, step, length, *bounds[::2], distance, unknowns, new_distance)
            trial = evaluate(grid, unknowns)
            lowered = sum_of_squares(grid, trial) - nu * new_logarithms
            if trial.error < np.inf and lowered <= merit + 1e-4 * length * min(0.0, slopes @ step):
                move_duals(duals, dual_step, dual_length, new_distance, nu, new_duals)
                return (trial, new_distance, new_logarithms), new_duals, max(damping / 5.0, 1e-12)
        damping = max(8.0 * damping, 1e-8)
    return None


def sum_of_squares(grid, point):
    """Half the sum of the squares of all residuals."""
    residual = point.gradient[grid.is_multiplier]
    return 0.5 * (residual @ residual)
