"""Newton's method on the KKT system, made dependable by a filter line search and by shifts of the Hessian.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm, whose
equation numbers are quoted. The inertia of the KKT matrix, by which the shifts are chosen, comes from its factors.
"""

from typing import NamedTuple

import numpy as np

from codegen.runtime.apart import allocate_system
from codegen.runtime.system import factor_kkt, is_factored, solve_kkt
from codegen.runtime.curvature import FLAT
from codegen.runtime.descent import slope_of
from codegen.runtime.filter import accept, acceptable, envelope
from codegen.runtime.point import evaluate
from codegen.runtime.rounding import is_rounding, is_solved

SHORTEST_STEP = 1e-10
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

    `warm` has no effect: Newton's method needs no telling. A row (cost, residual, stationarity, Hessian's shift, step
    length) is appended to `log` at every iterate.
    """
    system = allocate_system(grid)
    point = evaluate(grid, guess_multipliers(grid, unknowns, system))
    small_violation = 1e-4 * max(1.0, point.violation)
    filtered = [(1e8 * small_violation, -np.inf)]
    shift, length = Shift(), 0.0
    for iteration in range(max_iterations + 1):
        log.append((point.cost, point.residual, point.stationarity, shift.value, length))
        if not point.error < np.inf:
            return "non-finite", point, iteration
        if is_solved(grid, point, tolerance):
            # Newton's steps went downhill; a start that is stationary, or a shifted Hessian, leaves room for doubt.
            doubtful = iteration == 0 or shift.value > 0.0
            return ("saddle point" if doubtful and not is_minimum(grid, point, system) else "solved"), point, iteration
        if iteration == max_iterations:
            break
        step, slope, shift = regularised_step(grid, point, shift, system)
        if step is None:
            return "rank-deficient", point, iteration
        trial, length = search(grid, point, step, slope, small_violation, filtered, system)
        if trial is None:
            if is_rounding(grid, point):
                return "stalled", point, iteration
            filtered.append(envelope(point.violation, point.cost))
            trial = restore(grid, point, filtered, system)
            if trial is None:
                return "infeasible", point, iteration
            trial = evaluate(grid, guess_multipliers(grid, trial.unknowns, system))
        point = trial
    return "iteration limit", point, max_iterations


def is_minimum(grid, point, system):
    """Whether a stationary point is a minimum to second order: the reduced Hessian is positive, up to rounding."""
    return factor_kkt(grid, point.unknowns, 1.0, shifts(grid, FLAT, FLAT), system) == 0


def guess_multipliers(grid, unknowns, system):
    """Unknowns whose multipliers solve stationarity by least squares (36), or vanish where that is huge or singular."""
    point = evaluate(grid, np.where(grid.is_multiplier, 0.0, unknowns))
    if point.stationarity == 0.0:
        return point.unknowns
    gradient, step = np.where(grid.is_multiplier, 0.0, point.gradient), np.empty_like(unknowns)
    if not is_factored(factor_kkt(grid, point.unknowns, 0.0, shifts(grid, 1.0, 1e-12), system, gradient)):
        return point.unknowns
    solve_kkt(grid, system, gradient, step, carried=True)
    multipliers = np.where(grid.is_multiplier, step, 0.0)
    return point.unknowns + multipliers if np.abs(multipliers).max() <= 1e3 else point.unknowns


def regularised_step(grid, point, before, system):
    """Newton step, slope of the cost along it, and the shift of the Hessian that makes it a descent.

    This is algorithm IC with two changes that save factorisations. Where the iterate `before` needed a shift for its
    curvatures, a lower one is tried at once, and none only when that has become small; and the more often in turn a
    lower shift was enough, the lower the next one is. The step is None when the system stays singular.
    """
    step = np.empty_like(point.unknowns)
    lower = max(1e-20, before.last / 3.0 ** min(1 + before.lowered, 40)) if before.last > 0.0 else 1e-4
    at_once = before.value > 0.0 and lower > SMALL_SHIFT and not before.singular
    shift, dual_shift, singular = lower if at_once else 0.0, 0.0, before.singular
    while shift < 1e20:
        excess = factor_kkt(grid, point.unknowns, 1.0, shifts(grid, shift, dual_shift), system, point.gradient)
        if excess == 0:
            solve_kkt(grid, system, point.gradient, step, carried=True)
            lowered = before.lowered + 1 if shift == lower and not singular else 0
            found = Shift(shift, shift or before.last, lowered, singular)
            return step, slope_of(point.unknowns, point.gradient, step, grid.is_multiplier), found
        if excess is None or excess < 0:
            singular = True
            dual_shift = 1e-8 if shift > 0.0 else 0.0  # the equations are dependent
        if shift == 0.0:
            shift = lower
        else:
            shift *= 100.0 if before.last == 0.0 else 8.0
    return None, 0.0, before


def shifts(grid, shift, dual_shift):
    """Diagonal that shifts the Hessian by primal unknowns up, and that by multipliers down."""
    if shift == dual_shift == 0.0:
        return np.zeros(grid.is_multiplier.size)
    return np.where(grid.is_multiplier, -dual_shift, shift)


def search(grid, point, step, slope, small_violation, filtered, system):
    """Shorten the step until the filter accepts it; return the new point (None when there is none) and the length."""

    def is_better(trial, length):
        violation, cost = point.violation, point.cost
        if not trial.error < np.inf:
            return False
        return accept(violation, cost, trial.violation, trial.cost, slope, length, small_violation, filtered)

    length = 1.0
    while length > SHORTEST_STEP:
        trial = evaluate(grid, point.unknowns + step)
        accepted = is_better(trial, length)
        if not accepted and length == 1.0 and trial.violation >= point.violation:
            # The curvature of the equations, not the direction, may be what is wrong: second-order correction (27).
            correction = np.empty_like(step)
            solve_kkt(grid, system, point.gradient + np.where(grid.is_multiplier, trial.gradient, 0.0), correction)
            trial = evaluate(grid, point.unknowns + correction)
            accepted = is_better(trial, length)
        if accepted:
            return trial, length
        length, step = 0.5 * length, 0.5 * step
    return None, length


def restore(grid, point, filtered, system):
    """Reduce the violation by shortest steps until the filter accepts; None when it cannot be reduced by a tenth."""
    step, first = np.empty_like(point.gradient), point.violation
    for _ in range(50):
        gradient = np.where(grid.is_multiplier, point.gradient, 0.0)
        if not is_factored(factor_kkt(grid, point.unknowns, 0.0, shifts(grid, 1.0, 1e-12), system, gradient)):
            return None
        solve_kkt(grid, system, gradient, step, carried=True)
        step[grid.is_multiplier] = 0.0
        length = 1.0
        trial = evaluate(grid, point.unknowns + step)
        while not trial.violation < (1.0 - 1e-4 * length) * point.violation:
            length *= 0.5
            if length < SHORTEST_STEP:
                return None
            trial = evaluate(grid, point.unknowns + length * step)
        point = trial
        if point.violation <= 0.9 * first and acceptable(point.violation, point.cost, filtered):
            return point
    return None
