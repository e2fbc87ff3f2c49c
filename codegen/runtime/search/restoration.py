"""Feasibility restoration: the reduction of the constraint violation when the line search fails.

The method minimises half the sum of squares of the residuals c by the method of Levenberg and Marquardt, with a barrier
of weight nu for bounds. Let A be the Jacobian of the equations, and let r, z and s be the distances, duals and sides of
bounds (see `descent`). The step d solves (A'A + damping + z/r) d = -(A'c - nu s / r). Its matrix is the KKT matrix
without cost, with -1 on the multipliers' diagonal. Sources: Nocedal and Wright (2006), section 10.3; Waechter and
Biegler (2006), section 3.3.
"""

import numpy as np

from codegen.runtime.search.direction import DECREASE, ERROR_FACTOR, POWER
from codegen.runtime.search.iterates import FROM_GUESS, begin, moved, newton_system, step_along
from codegen.runtime.search.linear_system import factor_kkt, is_factored
from codegen.runtime.search.point import evaluate

RESTORATION_STEPS = 200  # largest number of steps of a restoration
BETWEEN_LOOKS = 5  # steps after which the progress of an optional restoration is measured
FIRST_DAMPING = 1e-2  # damping of the first step, relative to the squared slope of the residuals
FEASIBILITY_STEPS = 1000  # largest number of steps of the search for the least violation
STATIONARY, NEARLY_STATIONARY = 1e-6, 1e-3  # largest slope at the least violation, relative to the residual
WEIGHT = 1e-2  # first weight of the barrier, relative to the squared residual
LARGEST_DAMPING = 1e12  # times the barrier's weight if the weight exceeds one: squared residuals have their own units
LARGEST_RESIDUAL = 1e150  # the squares of larger residuals overflow: no step lowers such a violation
HOLDING, NONE_HELD = 1e16, slice(0)  # the curvature that holds unknowns fixed; the empty set of unknowns
LARGEST_DUAL = 0.1  # at the start; with 1e3, not 2 but 15 of 30 searches for the space shuttle from noise fail


def restore(search, iterate, reduction, pairs, is_late, is_optional=False):
    """Lower the constraint violation; return ("restored", iterate) or (another status, the last iterate).

    The filter accepts a restored iterate. Its violation is at most `reduction` times the first violation. `pairs` (k,
    2) are the pairs (violation, objective) of the filter. `is_late` is a function that returns True once the time limit
    has passed. With bounds, the iterate has the duals of the restoration's barrier, and the weight of this barrier if
    it is not restored. If the restoration `is_optional`, it ends as soon as its steps would not suffice at the present
    rate.
    """
    if not iterate.point.residual < LARGEST_RESIDUAL:
        return "stalled", iterate
    grid, damping = search.grid, 0.0
    largest = LARGEST_DAMPING * max(1.0, WEIGHT * iterate.point.residual**2)
    first, current = iterate.point.violation, restoration_start(search, iterate)
    before = first
    for number in range(RESTORATION_STEPS):
        if is_late():
            return "time limit", current
        if is_optional and number and number % BETWEEN_LOOKS == 0:
            now, looks = current.point.violation, (RESTORATION_STEPS - number) / BETWEEN_LOOKS
            if not now * min(1.0, now / before) ** looks <= reduction * first:
                return "stalled", current
            before = now
        point = current.point
        residual_slope = residual_gradient(grid, point)
        damping = damping or first_damping(grid, point, residual_slope)
        error = restoration_error(search, current, residual_slope)
        if error <= 1e-8 * point.residual:
            return "infeasible", current
        if search.is_bounded:
            current = current._replace(mu=lower_weight(current.mu, error))
        taken = damped_step(search, current, residual_slope, damping, largest)
        if taken is None:
            return ("infeasible" if error <= NEARLY_STATIONARY * point.residual else "stalled"), current
        current, damping = taken
        if current.point.violation <= reduction * first:
            accepted = current._replace(mu=iterate.mu)
            is_better = (accepted.point.violation < pairs[:, 0]) | (accepted.objective < pairs[:, 1])
            if is_better.all():
                return "restored", accepted
    return "stalled", current


def least_violation(search, iterate, tolerance, is_late, held):
    """Minimise the constraint violation from an iterate; return (status, the last iterate).

    The status is "restored" if the violation becomes zero to the tolerance. It is "infeasible" if the last iterate is a
    minimum of the violation. No small change of the unknowns then brings the equations closer to zero, as far as first
    derivatives tell. Otherwise the status is "stalled" or "time limit".

    The search begins inside the bounds and takes Newton's steps. If residuals do not vanish, Gauss-Newton steps,
    without the curvature of the equations, converge slowly or not at all. This curvature is the Hessian of a Lagrangian
    whose multipliers are the residuals. Unknowns in the slice `held` stay fixed.
    """
    grid, damping = search.grid, 0.0
    inside = begin(search, np.where(grid.is_multiplier, 0.0, iterate.point.unknowns), FROM_GUESS)
    if not inside.point.residual < LARGEST_RESIDUAL:
        return "stalled", inside
    current = restoration_start(search, inside)
    for _ in range(FEASIBILITY_STEPS):
        if is_late():
            return "time limit", current
        point = current.point
        if point.residual <= tolerance:
            return "restored", current
        residual_slope = residual_gradient(grid, point)
        residual_slope[held] = 0.0
        damping = damping or first_damping(grid, point, residual_slope)
        error = restoration_error(search, current, residual_slope)
        if error <= STATIONARY * point.residual:
            return "infeasible", current
        if search.is_bounded:
            current = current._replace(mu=lower_weight(current.mu, error))
        taken = damped_step(search, current, residual_slope, damping, LARGEST_DAMPING, True, held)
        if taken is None:
            return "stalled", current
        current, damping = taken
    return ("infeasible" if error <= NEARLY_STATIONARY * point.residual else "stalled"), current


def restoration_start(search, iterate):
    """Return the iterate without multipliers; with bounds, it has small duals and a small weight of the barrier."""
    grid, unknowns, start = search.grid, iterate.point.unknowns, iterate
    if unknowns[grid.is_multiplier].any():
        start = iterate._replace(point=evaluate(grid, np.where(grid.is_multiplier, 0.0, unknowns)))
    if search.is_bounded:
        nu = max(1e-12, WEIGHT * iterate.point.residual**2)
        # With nu of 1e8, duals on the central path would hold unknowns close to bounds for many iterations.
        start = start._replace(mu=nu, duals=np.minimum(nu / start.distance, LARGEST_DUAL))
    return start


def residual_gradient(grid, point):
    """Return A'c (n,), the gradient of half the squared residuals with respect to primal unknowns."""
    with_residuals = np.where(grid.is_multiplier, point.gradient, point.unknowns)
    residual_slope = evaluate(grid, with_residuals).gradient - point.gradient
    return np.where(grid.is_multiplier, 0.0, residual_slope)


def first_damping(grid, point, residual_slope):
    """Return a damping that keeps the first step short in directions in which residuals hardly change, in any units.

    Without damping, the step would go far in these directions, away from the iterate with a low cost.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # residuals of a motion that diverges may be huge
        squares = 2.0 * sum_of_squares(grid, point)
        return max(1e-12, FIRST_DAMPING * (residual_slope @ residual_slope) / squares) if squares > 0.0 else 1e-4


def restoration_error(search, current, residual_slope):
    """Return the max-norm of the optimality conditions of the least violation."""
    stationary, bounds = residual_slope.copy(), search.bounds
    np.subtract.at(stationary, bounds.indices, bounds.side * current.duals)
    return max(np.abs(stationary).max(), np.max(current.duals * current.distance, initial=0.0))


def lower_weight(nu, error):
    """Return the barrier parameter of the restoration for the next step, by the rule of `direction.lower_barrier`.

    `error` is the error of the optimality conditions with the parameter `nu`.
    """
    while nu > 1e-14 and max(error, 0.0) <= ERROR_FACTOR * nu:
        nu = max(1e-14, min(DECREASE * nu, nu**POWER))
    return nu


def damped_step(search, current, residual_slope, damping, largest, curved=False, held=NONE_HELD):
    """Return (iterate, damping) after a step that lowers the sum of squares; None if no damping gives such a step.

    The damping grows from `damping` up to `largest`. The step is Newton's if `curved`, else a Gauss-Newton step. For
    Newton's step any decrease suffices, up to rounding errors. Close to bounds, slopes promise more than a step
    achieves, and duals may still have to settle. Unknowns in the slice `held` stay fixed.
    """
    grid, point, step = search.grid, current.point, np.empty_like(current.point.unknowns)
    unknowns = np.where(grid.is_multiplier, point.gradient, point.unknowns) if curved else point.unknowns
    least = restoration_objective(grid, current)
    while damping < largest:
        slopes, diagonal = newton_system(search, current, residual_slope, damping, 0.0)
        diagonal[held] += HOLDING
        diagonal[search.equations] = -1.0  # an equation that a node lacks keeps the one that the matrix has for it
        right = np.where(grid.is_multiplier, point.gradient, slopes - residual_slope)
        if is_factored(factor_kkt(grid, unknowns, 0.0, diagonal, search.system, right, step)):
            step[grid.is_multiplier] = step[held] = 0.0
            taken = step_along(search, current, slopes, step)
            trial = moved(search, current, taken, taken.longest)
            enough = 1e-15 * abs(least) if curved else 1e-4 * taken.longest * min(0.0, slopes @ step)
            if trial.point.error < np.inf and restoration_objective(grid, trial) <= least + enough:
                return trial, max(damping / 5.0, 1e-12)
        damping = max(8.0 * damping, 1e-8)
    return None


def restoration_objective(grid, current):
    """Return half the sum of squared residuals, with the restoration's barrier where there are bounds."""
    return sum_of_squares(grid, current.point) - current.mu * np.log(current.distance).sum()


def sum_of_squares(grid, point):
    """Return half the sum of the squares of all residuals."""
    residual = point.gradient[grid.is_multiplier]
    return 0.5 * (residual @ residual)
