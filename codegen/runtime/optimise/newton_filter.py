"""Newton's method on the KKT system, made dependable by a filter line search and by shifts of the Hessian.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm, whose
equation numbers are quoted. The inertia of the KKT matrix, by which the shifts are chosen, comes from its factors.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from codegen.runtime.kkt.apart import allocate_system
from codegen.runtime.kkt.system import factor_kkt, is_factored, solve_kkt
from codegen.runtime.optimise.curvature import FLAT
from codegen.runtime.optimise.descent import slope_of
from codegen.runtime.optimise.filter import Filter
from codegen.runtime.unknowns.layout import layout
from codegen.runtime.unknowns.point import evaluate
from codegen.runtime.optimise.rounding import is_solved, sizes_of_terms
from codegen.runtime.optimise.saddles import ESCAPES, LEFT, is_below, is_nearly_stationary, steps_aside
from codegen.runtime.optimise.standstill import is_rounding

SHORTEST_STEP = 1e-10
RESTORATION_STEPS = 50
GROSS = 0.03  # residuals above this part of the equations' terms are a gross violation
NEARBY = 1e-2  # part of the guess's violation that is left where a search begins nearby
NEARBY_ITERATIONS = 100  # for that search, and half of what is allowed at most
SMALL_SHIFT = 1e-2  # below it, the Hessian is first tried as it is


class Shift(NamedTuple):
    """The Hessian's shift at an iterate, the last one that was not zero, and how many times in turn it was lowered.

    `singular` once the matrix has been singular or had too few negative eigenvalues, as dependent equations make it.
    """

    value: float = 0.0
    last: float = 0.0
    lowered: int = 0
    singular: bool = False


def minimise(grid, unknowns, tolerance, max_iterations, warm, log):
    """Find a local minimum; return (status, point, iterations).

    Where the guess violates the equations grossly, the search begins at a point near it that nearly obeys them: a full
    Newton step, which knows of no distance, would leave for another optimum. If so many iterations do not solve
    the problem from there, the search begins at the guess itself, and how that ends is reported. `warm` has no
    effect: Newton's method needs no telling. A row (cost, residual, stationarity, Hessian's shift, step length) is
    appended to `log` at every iterate; steps of the restoration are not counted.
    """
    system, total = allocate_system(grid), 0
    guess = without_multipliers(grid, unknowns)
    if guess.error < np.inf and is_gross(grid, guess):
        near = restore(grid, guess, NEARBY, Filter(np.inf), system, log)
        if near is not None:
            limit = min(max_iterations // 2, NEARBY_ITERATIONS)
            status, point, total = leave_saddles(grid, near, tolerance, limit, log, system)
            if status in ("solved", "time limit"):
                return status, point, total
    status, point, iterations = leave_saddles(grid, guess, tolerance, max_iterations - total, log, system)
    return status, point, total + iterations


def leave_saddles(grid, guess, tolerance, max_iterations, log, system):
    """Descend; where that ends in a saddle point go on beside it, to either side, and ever farther away from it.

    Where there is no way down it was none: multipliers that are not unique may belong to an indefinite Hessian.
    """
    status, saddle, total = descend(grid, guess, tolerance, max_iterations, log, system)
    failed, escapes = False, 0
    while status == "saddle point" and escapes < ESCAPES and total < max_iterations:
        for step in steps_aside(grid, saddle.unknowns, 0.0, escapes):
            beside = without_multipliers(grid, saddle.unknowns + step)
            ended, point, iterations = descend(grid, beside, tolerance, max_iterations - total, log, system)
            total += iterations
            if ended in LEFT and is_below(point, saddle):
                status, saddle = ended, point
                break
            failed = failed or ended not in LEFT
        escapes += 1
    if status == "saddle point" and escapes == ESCAPES and not failed:
        status = "solved" if is_solved(grid, saddle, tolerance) else "stalled"
    return status, saddle, total


def is_gross(grid, point):
    """Whether the residual is more than a small part of the equations' largest terms."""
    terms, _ = sizes_of_terms(grid, point.unknowns)
    return point.residual > GROSS * terms


def descend(grid, guess, tolerance, max_iterations, log, system):
    """Follow Newton's steps from a point whose multipliers are zero; return (status, point, iterations)."""
    point = with_multipliers(grid, guess, system)
    small_violation = 1e-4 * max(1.0, point.violation)
    filtered = Filter(1e8 * small_violation)
    shift, length, step = Shift(), 0.0, np.empty_like(guess.unknowns)
    for iteration in range(max_iterations + 1):
        log.append(grid, point, shift.value, length)
        if not point.error < np.inf:
            return "non-finite", point, iteration
        if is_solved(grid, point, tolerance):
            # Newton's steps went downhill; a start that is stationary, or a shifted Hessian, leaves room for doubt.
            doubtful = iteration == 0 or shift.value > 0.0
            return ("saddle point" if doubtful and not is_minimum(grid, point, system) else "solved"), point, iteration
        if log.is_late():
            return "time limit", point, iteration
        if iteration == max_iterations:
            break
        slope, shift = regularised_step(grid, point, shift, system, step)
        if slope is None:
            return "rank-deficient", point, iteration
        trial, length = search(grid, point, step, slope, small_violation, filtered, system)
        if trial is None:
            if shift.value > 0.0 and is_nearly_stationary(point) and not is_minimum(grid, point, system):
                return "saddle point", point, iteration
            if is_rounding(grid, point):
                return "stalled", point, iteration
            filtered.add(point.violation, point.cost)
            trial = restore(grid, point, 0.9, filtered, system, log)
            if trial is None:
                return "time limit" if log.is_late() else "infeasible", point, iteration
            trial = with_multipliers(grid, without_multipliers(grid, trial.unknowns), system)
        point = trial
    return "iteration limit", point, max_iterations


def is_minimum(grid, point, system):
    """Whether a stationary point is a minimum to second order: the reduced Hessian is positive, up to rounding."""
    return factor_kkt(grid, point.unknowns, 1.0, shifts(grid, FLAT, FLAT), system) == 0


def without_multipliers(grid, unknowns):
    """The point at the same primal unknowns with all multipliers zero."""
    return evaluate(grid, np.where(grid.is_multiplier, 0.0, unknowns))


def with_multipliers(grid, point, system):
    """The point with multipliers that solve stationarity by least squares (36), as it is where they are huge or none.

    All multipliers of `point` are zero.
    """
    if point.stationarity == 0.0:
        return point
    gradient, step = np.where(grid.is_multiplier, 0.0, point.gradient), np.empty_like(point.unknowns)
    if not is_factored(factor_kkt(grid, point.unknowns, 0.0, shifts(grid, 1.0, 1e-12), system, gradient)):
        return point
    solve_kkt(grid, system, gradient, step, carried=True)
    multipliers = np.where(grid.is_multiplier, step, 0.0)
    return evaluate(grid, point.unknowns + multipliers) if np.abs(multipliers).max() <= 1e3 else point


def regularised_step(grid, point, before, system, step):
    """Fill a Newton step; return the slope of the cost along it, and the shift of the Hessian that makes it a descent.

    This is algorithm IC with two changes that save factorisations. Where the iterate `before` needed a shift for its
    curvatures, a lower one is tried at once, and none only when that has become small; and the more often in turn a
    lower shift was enough, the lower the next one is. The slope is None when the system stays singular.
    """
    lower = max(1e-20, before.last / 3.0 ** min(1 + before.lowered, 40)) if before.last > 0.0 else 1e-4
    at_once = before.value > 0.0 and lower > SMALL_SHIFT and not before.singular
    shift, dual_shift, singular = lower if at_once else 0.0, 0.0, before.singular
    while shift < 1e20:
        excess = factor_kkt(grid, point.unknowns, 1.0, shifts(grid, shift, dual_shift), system, point.gradient)
        if excess == 0:
            solve_kkt(grid, system, point.gradient, step, carried=True)
            lowered = before.lowered + 1 if shift == lower and not singular else 0
            found = Shift(shift, shift or before.last, lowered, singular)
            return slope_of(point.unknowns, point.gradient, step, grid.is_multiplier), found
        if excess is None or excess < 0:
            singular = True
            dual_shift = 1e-8 if shift > 0.0 else 0.0  # the equations are dependent
        if shift == 0.0:
            shift = lower
        else:
            shift *= 100.0 if before.last == 0.0 else 8.0
    return None, before


def shifts(grid, shift, dual_shift):
    """Diagonal that shifts the Hessian by primal unknowns up, and that by multipliers down."""
    if dual_shift == 0.0:
        return shift * primal_ones(grid.steps)
    return np.where(grid.is_multiplier, -dual_shift, shift)


@lru_cache(maxsize=4)
def primal_ones(steps):
    """Ones for primal unknowns and zeros for multipliers, kept for the next solve."""
    return np.where(layout(steps).is_multiplier, 0.0, 1.0)


def search(grid, point, step, slope, small_violation, filtered, system):
    """Shorten the step until the filter accepts it; return the new point (None when there is none) and the length."""
    length, limits = 1.0, (slope, small_violation, filtered)
    while length > SHORTEST_STEP:
        trial = evaluate(grid, point.unknowns + step)
        if is_better(trial, point, length, *limits):
            return trial, length
        if length == 1.0 and trial.violation >= point.violation:
            # The curvature of the equations, not the direction, may be what is wrong: second-order correction (27).
            correction = np.empty_like(step)
            solve_kkt(grid, system, point.gradient + np.where(grid.is_multiplier, trial.gradient, 0.0), correction)
            trial = evaluate(grid, point.unknowns + correction)
            if is_better(trial, point, length, *limits):
                return trial, length
        length, step = 0.5 * length, 0.5 * step
    return None, length


def is_better(trial, point, length, slope, small_violation, filtered):
    """Whether a trial may follow a point, from which a step of some length was to lead to it."""
    return trial.error < np.inf and filtered.accept(
        point.violation, point.cost, trial.violation, trial.cost, slope, length, small_violation
    )


def restore(grid, point, reduction, filtered, system, log):
    """Reduce the violation to a part `reduction` that the filter accepts; None when that fails, or the time is up.

    Levenberg and Marquardt's method: with A the equations' Jacobian and c their residuals, the step d minimises
    |A d + c|^2 + damping |d|^2, which is the KKT matrix with -damping for the multipliers and a one for the others.
    Source: Nocedal and Wright (2006), section 10.3.
    """
    step, first, damping = np.empty_like(point.gradient), point.violation, 1e-4
    for _ in range(RESTORATION_STEPS):
        gradient, trial = np.where(grid.is_multiplier, point.gradient, 0.0), None
        while trial is None:
            if damping > 1e12 or log.is_late():
                return None
            if is_factored(factor_kkt(grid, point.unknowns, 0.0, shifts(grid, 1.0, damping), system, gradient)):
                solve_kkt(grid, system, gradient, step, carried=True)
                trial = evaluate(grid, point.unknowns + np.where(grid.is_multiplier, 0.0, step))
                lowered = sum_of_squares(grid, trial) < (1.0 - 1e-8) * sum_of_squares(grid, point)
                trial = trial if lowered and trial.error < np.inf else None
            damping = damping * 8.0 if trial is None else max(damping / 5.0, 1e-12)
        point = trial
        if point.violation <= reduction * first and filtered.lets_pass(point.violation, point.cost):
            return point
    return None


def sum_of_squares(grid, point):
    """The sum of the squares of all residuals."""
    residual = point.gradient[grid.is_multiplier]
    return residual @ residual
