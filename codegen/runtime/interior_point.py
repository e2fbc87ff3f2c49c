"""Primal-dual interior point method with a filter line search, for problems with bounds on unknowns.

Bounds are replaced by a logarithmic barrier whose weight mu tends to zero; for each weight Newton's method solves the
optimality conditions, with the inertia of the KKT matrix corrected until the step is one of descent, and a filter
decides how far to go. Source: Waechter and Biegler (2006), On the implementation of an interior-point filter
line-search algorithm for large-scale nonlinear programming, whose equation and algorithm numbers are quoted.
"""

from typing import NamedTuple

import numpy as np

from codegen.runtime.apart import allocate_system
from codegen.runtime.system import factor_kkt, solve_kkt
from codegen.runtime.barrier import (
    add_barrier,
    finite_bounds,
    measure_optimality,
    measure_step,
    move,
    move_duals,
    push_inside,
    relaxation,
)
from codegen.runtime.curvature import ESCAPES, FLAT, LEFT, is_below, steps_aside
from codegen.runtime.example import TIED
from codegen.runtime.filter import accept, acceptable, envelope
from codegen.runtime.layout import multiplier_unknowns
from codegen.runtime.limits import bounds_of, with_tied_values
from codegen.runtime.point import evaluate
from codegen.runtime.restoration import restore
from codegen.runtime.rounding import is_solved
from codegen.runtime.standstill import is_rounding

LARGEST = 1e20  # unknowns or costs beyond it are taken for infinite
NEARBY = 0.1  # part of the guess's violation that is left where a search begins nearby
UNLUCKY = ("infeasible", "stalled", "rank-deficient")
CORRECTIONS = 4  # second-order corrections that are tried at one iterate
SHORT_TURN = 3
SHORT = 0.25  # a step that is shortened to less makes the next ones shorter beforehand
SHORTENED = 10  # steps in turn that the filter shortens before full ones are tried
FULL_STEPS = 4  # how many of them may pass before one has to be better than the iterate where they began
PATIENCE = 8  # iterations with the least weight of the barrier before a larger one has to do


class Attempt(NamedTuple):
    """First weight of the barrier, how far inside their bounds unknowns begin, and whether nearer to feasibility.

    Steps below the shortest make way for restoration; the violation may grow by the factor `funnel`.
    """

    weight: float
    push: float
    nearby: bool
    shortest: float
    funnel: float


WARM, COLD = Attempt(1e-5, 1e-4, False, 1e-12, 1e4), Attempt(0.1, 1e-2, False, 1e-12, 1e4)
OTHERS = Attempt(0.1, 1e-2, True, 1e-3, 2.0), Attempt(10.0, 1e-2, False, 1e-3, 2.0)


class Iterate(NamedTuple):
    """A point, the distances of its unknowns to their bounds with the sum of their logarithms, and bound duals."""

    point: NamedTuple
    distance: np.ndarray
    logarithms: float
    duals: np.ndarray


class Search(NamedTuple):
    """What stays the same during a solve: grid, bounds, storage of the linear system, places of multipliers.

    `box` holds the least and the greatest values of all unknowns, infinite where there is no bound.
    """

    grid: NamedTuple
    bounds: NamedTuple
    system: tuple[NamedTuple, int]
    equations: np.ndarray
    box: tuple[np.ndarray, np.ndarray]


class Watch(NamedTuple):
    """Where full steps began: the iterate, its Newton step, and how many may still follow."""

    iterate: NamedTuple
    step: NamedTuple
    left: int


class Step(NamedTuple):
    """A Newton step: its barrier gradient, slope, longest primal and dual lengths, and the Hessian's shift."""

    primal: np.ndarray
    dual: np.ndarray
    gradient: np.ndarray
    slope: float
    longest: float
    dual_length: float
    shift: float


def minimise(grid, unknowns, tolerance, max_iterations, warm, log):
    """Find a local minimum; return (status, point, iterations).

    A row (cost, residual, stationarity, Hessian's shift, step length, barrier's weight) is appended to `log` at every
    iterate. With `warm`, the barrier begins with a small weight and leaves unknowns close to their bounds. Where that
    fails, the search begins anew: at a point near the guess that violates the equations less, and then with a weight
    that keeps unknowns away from their bounds for longer. If no attempt succeeds, the first one is reported.
    `max_iterations` is for all of them together; steps of the restoration are not counted.
    """
    lower, upper = bounds_of(grid)
    bounds, box = finite_bounds(lower, upper), (lower, upper)
    search = Search(grid, bounds, allocate_system(grid), multiplier_unknowns(grid), box)
    primal, first, total = np.where(grid.is_multiplier, 0.0, unknowns), None, 0
    for attempt in (WARM if warm else COLD, *OTHERS):
        # Far from a solution duals of one serve better than the central path.
        iterate = begin(search, primal, attempt, central=attempt is WARM)
        status = "restored"
        if attempt.nearby and iterate.point.error < np.inf:
            status, iterate = restored(search, iterate, attempt.weight, NEARBY, [])
        point = iterate.point
        if status == "restored":
            status, point, iterations = leave_saddles(search, iterate, attempt, tolerance, max_iterations - total, log)
            total += iterations
            first = first or (status, point)
        if status == "solved" or first[0] not in UNLUCKY or total >= max_iterations:
            break
    status, point = (status, point) if status == "solved" else first
    return status, within_bounds(search, point, tolerance), total


def within_bounds(search, point, tolerance):
    """The point with what lies beyond a bound, by its relaxation, on the bound, unless equations then fail to hold."""
    grid, (lower, upper) = search.grid, search.box
    unknowns = np.minimum(np.maximum(point.unknowns, lower), upper)
    if TIED:
        unknowns = with_tied_values(grid, unknowns)
    if not point.error < np.inf or (unknowns == point.unknowns).all():
        return point
    inside, stationarity = evaluate(grid, unknowns), point.stationarity  # with the duals of bounds
    if not inside.residual <= max(tolerance, 2.0 * point.residual):
        return point
    return inside._replace(stationarity=stationarity, error=max(inside.residual, stationarity))


def leave_saddles(search, iterate, attempt, tolerance, max_iterations, log):
    """Descend; where that ends in a saddle point go on beside it, to either side, and ever farther away from it.

    Where there is no way down it was none: multipliers that are not unique may belong to an indefinite Hessian.
    """
    status, saddle, total = descend(search, iterate, attempt, tolerance, max_iterations, log)
    failed, escapes = False, 0
    while status == "saddle point" and escapes < ESCAPES and total < max_iterations:
        for beside in neighbours(search, saddle, attempt, escapes):
            ended, other, iterations = descend(search, beside, attempt, tolerance, max_iterations - total, log)
            total += iterations
            if ended in LEFT and is_below(other.point, saddle.point):
                status, saddle = ended, other
                break
            failed = failed or ended not in LEFT
        escapes += 1
    return "solved" if status == "saddle point" and escapes == ESCAPES and not failed else status, saddle.point, total


def neighbours(search, saddle, attempt, escapes):
    """Iterates to both sides of a saddle point, along the direction in which the cost curves downwards most."""
    unknowns, bounds = saddle.point.unknowns, search.bounds
    curvature = np.zeros(unknowns.size)
    np.add.at(curvature, bounds.place, saddle.duals / saddle.distance)
    for step in steps_aside(search.grid, unknowns, curvature, escapes):
        yield begin(search, primal_part(search.grid, unknowns + step), attempt)


def primal_part(grid, unknowns):
    """Unknowns without their multipliers, which are zero."""
    return np.where(grid.is_multiplier, 0.0, unknowns)


def descend(search, iterate, attempt, tolerance, max_iterations, log):
    """Lower the barrier's weight and follow the minima; return (status, iterate, iterations).

    The cost is off by the sum of all complementarities, for which the weight ends so low that it is below the
    tolerance. Where rounding does not allow that, the tolerance holds for each of them, as it does in (5), and the
    optimality conditions are relative to the multipliers.
    """
    grid, mu = search.grid, attempt.weight
    sound, least = tolerance / 10.0, tolerance / max(10.0, 2.0 * search.bounds.place.size)
    first = max(1.0, iterate.point.violation)
    small_violation, filtered = 1e-4 * first, [(attempt.funnel * first, -np.inf)]
    shift, last_shift, length, at_least, fallback = 0.0, 0.0, 0.0, 0, None
    shortened, watch, damping = 0, None, 0.0
    for iteration in range(max_iterations + 1):
        iterate, measured = measured_iterate(search, iterate)
        point = iterate.point
        log.append((point.cost, point.residual, point.stationarity, shift, length, mu))
        if not point.error < np.inf:
            return "non-finite", iterate, iteration
        closed = measured[1] <= tolerance and is_solved(grid, point, tolerance)
        if closed or (at_least > PATIENCE and is_acceptable(grid, point, measured, tolerance)):
            # Newton's steps went downhill; a start that is stationary, or a shifted Hessian, leaves room for doubt.
            doubtful = iteration == 0 or shift > 0.0
            minimum = not doubtful or is_minimum(search, iterate, tolerance)
            return ("solved" if minimum else "saddle point"), iterate, iteration
        if is_boundless(point, measured[6]):
            return "unbounded", iterate, iteration
        if log.is_late():
            return "time limit", iterate, iteration
        if iteration == max_iterations:
            break
        before = mu
        while mu > least and at_least <= PATIENCE and barrier_error(point, measured, mu) <= 10.0 * mu:
            # Newton's steps converge quadratically once the barrier is weak, and its weight may tend to zero as fast.
            mu = max(least, min(0.2 * mu, mu**1.5 if mu > 1e-3 else mu**2))
        if mu < before:
            filtered, fallback = filtered[:1], (iterate, before)
            iterate, shortened, watch = tightened(search, iterate, before, mu), 0, None
        step = regularised_step(search, iterate, mu, last_shift, damping)
        trial, at_least = None, at_least + (mu == least)
        if step is not None:
            shift, last_shift = step.shift, step.shift or last_shift
            if shortened == SHORTENED:
                watch = Watch(iterate, step, FULL_STEPS)
            if watch is not None:
                trial, length, watch = watched(search, iterate, step, mu, watch, small_violation, filtered)
                shortened = 0
                iterate = iterate if trial is None else trial
                continue
            trial, length = line_search(search, iterate, step, mu, attempt.shortest, small_violation, filtered)
            shortened = shortened + 1 if trial is None or length < step.longest else 0
            damping = damped(damping, step, length, shortened) if trial is not None else 0.0
        if fallback is not None and mu <= sound and (trial is None or at_least == PATIENCE):
            if is_acceptable(grid, point, measured, tolerance):
                return "solved", iterate, iteration
            # So low a weight is beyond rounding: the tolerance for each complementarity is what can be had.
            iterate, before = fallback
            iterate, mu = tightened(search, iterate, before, sound), sound
            fallback, at_least, filtered = None, PATIENCE + 1, filtered[:1]
            continue
        if step is None:
            return "rank-deficient", iterate, iteration
        if trial is None:
            if is_rounding(grid, point):
                # Rounding has the last word; a gap of one tolerance for every bound is then as good as it gets.
                closed = measured[1] <= tolerance * search.bounds.place.size
                return ("solved" if closed else "stalled"), iterate, iteration
            filtered.append(envelope(point.violation, point.cost - mu * iterate.logarithms))
            status, trial = restored(search, iterate, mu, 0.9, filtered)
            if status != "restored":
                return status, trial if status == "infeasible" else iterate, iteration
        iterate = trial
    return "iteration limit", iterate, max_iterations


def measured_iterate(search, iterate):
    """The iterate with the duals of bounds taking part in its stationarity, and what measure_optimality says."""
    point, bounds, is_multiplier = iterate.point, search.bounds, search.grid.is_multiplier
    measured = measure_optimality(
        point.gradient, point.unknowns, is_multiplier, bounds.place, bounds.side, iterate.distance, iterate.duals
    )
    error = max(point.residual, measured[0]) if point.error < np.inf else np.inf
    return iterate._replace(point=point._replace(stationarity=measured[0], error=error)), measured


def is_acceptable(grid, point, measured, tolerance):
    """Whether a point is optimal to the tolerance, with complementarities one by one and scaled multipliers (5)."""
    _, _, _, highest, mean, mean_dual, _ = measured
    scaled = point.stationarity / (max(100.0, mean) / 100.0)
    if highest / (max(100.0, mean_dual) / 100.0) > tolerance:
        return False
    return is_solved(grid, point._replace(stationarity=scaled, error=max(point.residual, scaled)), tolerance)


def tightened(search, iterate, before, mu):
    """The iterate with its bounds relaxed as it belongs to a lower weight; what is then outside moves inside."""
    bounds = search.bounds
    relaxed = relaxation(bounds, mu)
    distance = iterate.distance - (relaxation(bounds, before) - relaxed)
    outside = np.flatnonzero(distance < 0.1 * relaxed)
    if not outside.size:
        return iterate._replace(distance=distance, logarithms=np.log(distance).sum())
    unknowns = iterate.point.unknowns.copy()
    unknowns[bounds.place[outside]] += bounds.side[outside] * (0.1 * relaxed - distance)[outside]
    distance[outside] = 0.1 * relaxed[outside]
    if TIED:
        unknowns = with_tied_values(search.grid, unknowns)
    return iterate._replace(point=evaluate(search.grid, unknowns), distance=distance, logarithms=np.log(distance).sum())


def is_minimum(search, iterate, tolerance):
    """Whether a stationary point is a minimum to second order, with the barrier to stand for bounds.

    Multipliers are known to the tolerance, and so are curvatures, up to a factor.
    """
    grid, bounds, system, *_ = search
    shift = max(FLAT, 100.0 * tolerance)
    point, (diagonal, unused) = iterate.point, np.empty((2, iterate.point.unknowns.size))
    barrier = grid.is_multiplier, bounds.place, bounds.side, iterate.distance, iterate.duals, 0.0
    add_barrier(point.gradient, *barrier, shift, FLAT, unused, diagonal)
    return factor_kkt(grid, point.unknowns, 1.0, diagonal, system) == 0


def begin(search, unknowns, attempt, central=False):
    """An iterate at primal unknowns that are pushed inside their bounds, with duals of one, or on the central path."""
    bounds, mu = search.bounds, attempt.weight
    unknowns = push_inside(*search.box, unknowns, attempt.push)
    if TIED:
        unknowns = with_tied_values(search.grid, unknowns)  # nodes move with the shared unknowns that they equal
    distance = bounds.side * (unknowns[bounds.place] - bounds.value) + relaxation(bounds, mu)
    return with_multipliers(search, unknowns, distance, np.minimum(mu / distance, 1e3) if central else None)


def with_multipliers(search, unknowns, distance, duals=None):
    """An iterate at primal unknowns and their distances, with multipliers by least squares, and duals, or ones."""
    duals = np.ones(distance.size) if duals is None else duals
    unknowns = guess_multipliers(search, unknowns, duals)
    return Iterate(evaluate(search.grid, unknowns), distance, np.log(distance).sum(), duals)


def guess_multipliers(search, unknowns, duals):
    """Unknowns whose multipliers solve stationarity by least squares (36), or vanish where that is huge or singular."""
    grid, bounds, system, *_ = search
    unknowns = np.where(grid.is_multiplier, 0.0, unknowns)
    gradient = np.where(grid.is_multiplier, 0.0, evaluate(grid, unknowns).gradient)
    np.subtract.at(gradient, bounds.place, bounds.side * duals)
    if factor_kkt(grid, unknowns, 0.0, np.where(grid.is_multiplier, -1e-12, 1.0), system, gradient) is None:
        return unknowns
    step = np.empty_like(unknowns)
    solve_kkt(grid, system, gradient, step, carried=True)
    multipliers = np.where(grid.is_multiplier, step, 0.0)
    return unknowns + multipliers if np.abs(multipliers).max(initial=0.0) <= 1e3 else unknowns


def is_boundless(point, largest):
    """Whether the cost, along nearly feasible points, or an unknown has left all reasonable limits."""
    return largest > LARGEST or (point.residual <= 1e-6 and point.cost < -LARGEST)


def barrier_error(point, measured, mu):
    """Error of the optimality conditions of the barrier problem, scaled where multipliers are large (5)."""
    stationarity, _, lowest, highest, mean, mean_dual, _ = measured
    off_centre = max(highest - mu, mu - lowest)
    scale, dual_scale = max(100.0, mean) / 100.0, max(100.0, mean_dual) / 100.0
    return max(stationarity / scale, point.residual, off_centre / dual_scale)


def regularised_step(search, iterate, mu, last_shift, damping):
    """Newton step of the barrier problem, the Hessian shifted until its inertia is right (algorithm IC), or None."""
    grid, bounds, system, *_ = search
    point, size = iterate.point, iterate.point.unknowns.size
    diagonal, gradient, primal = np.empty(size), np.empty(size), np.empty(size)
    dual = np.empty(bounds.place.size)
    barrier = grid.is_multiplier, bounds.place, bounds.side, iterate.distance, iterate.duals, mu
    shift, dual_shift = damping, 0.0
    while shift < 1e20:
        add_barrier(point.gradient, *barrier, shift, dual_shift, gradient, diagonal)
        excess = factor_kkt(grid, point.unknowns, 1.0, diagonal, system, gradient)
        if excess == 0:
            solve_kkt(grid, system, gradient, primal, carried=True)
            measured = measure_step(point.unknowns, gradient, primal, *barrier, max(0.99, 1.0 - mu), dual)
            if abs(measured[0]) < np.inf:
                return Step(primal, dual, gradient, *measured, shift)
        elif dual_shift == 0.0 and (excess is None or excess < 0):
            dual_shift = 1e-8 * mu**0.25  # the equations may be dependent
            continue
        if shift == 0.0:
            shift = 1e-4 if last_shift == 0.0 else max(1e-20, last_shift / 3.0)
        else:
            shift *= 100.0 if last_shift == 0.0 else 8.0
    return None


def damped(damping, step, length, shortened):
    """The least shift of the Hessian for the next step: more where this one had to be shortened much, else less.

    A Hessian that is barely positive definite sends steps far beyond where it means something.
    """
    if length <= SHORT * step.longest and shortened >= SHORT_TURN:
        return 4.0 * max(step.shift, damping, 1e-5)
    if length < step.longest:
        return damping
    return damping / 2.0 if damping > 1e-5 else 0.0


def line_search(search, iterate, step, mu, shortest, small_violation, filtered):
    """Shorten the step until the filter accepts it; return the next iterate, or None, and the length."""

    def accepted(trial, length):
        return is_better(trial, iterate, step, length, mu, small_violation, filtered)

    length = step.longest
    while length > shortest:
        trial = moved(search, iterate, step.primal, length)
        if not accepted(trial, length):
            worse = length == step.longest and trial[0].violation >= iterate.point.violation
            trial = corrected(search, iterate, step, mu, trial, accepted) if worse else None
        if trial is not None:
            return with_duals(trial, iterate, step, mu), length
        length *= 0.5
    return None, length


def watched(search, iterate, step, mu, watch, small_violation, filtered):
    """(next iterate, length, watch) after a full step that is taken untested, in the hope that one soon is better.

    The watchdog technique: where the equations' curvature makes the filter shorten step after step, full ones may be
    better after all. If none is, all goes on from where they began. Source: Waechter and Biegler (2006), section 3.2.
    """
    trial = moved(search, iterate, step.primal, step.longest)
    if is_better(trial, watch.iterate, watch.step, watch.step.longest, mu, small_violation, filtered):
        return with_duals(trial, iterate, step, mu), step.longest, None
    if watch.left == 1 or not trial[0].error < np.inf:
        return watch.iterate, 0.0, None
    return with_duals(trial, iterate, step, mu), step.longest, watch._replace(left=watch.left - 1)


def is_better(trial, iterate, step, length, mu, small_violation, filtered):
    """Whether a trial may follow an iterate, from which a step of some length was to lead to it."""
    point, _, logarithms = trial
    violation, cost = iterate.point.violation, iterate.point.cost - mu * iterate.logarithms
    trial_cost = point.cost - mu * logarithms
    return point.error < np.inf and accept(
        violation, cost, point.violation, trial_cost, step.slope, length, small_violation, filtered
    )


def with_duals(trial, iterate, step, mu):
    """The iterate at a trial point, with duals after the step's dual part."""
    duals = np.empty_like(iterate.duals)
    move_duals(iterate.duals, step.dual, step.dual_length, trial[1], mu, duals)
    return Iterate(*trial, duals)


def moved(search, iterate, step, length):
    """Point, distances and sum of their logarithms after a step of some length."""
    unknowns, bounds = iterate.point.unknowns, search.bounds
    trial, distance = np.empty_like(unknowns), np.empty_like(iterate.distance)
    logarithms = move(unknowns, step, length, bounds.place, bounds.side, iterate.distance, trial, distance)
    return evaluate(search.grid, trial), distance, logarithms


def corrected(search, iterate, step, mu, trial, accepted):
    """A trial after second-order corrections (27) of the full step, or None: the equations' curvature may be wrong."""
    grid, bounds, system, *_ = search
    right, correction, unused = step.gradient.copy(), np.empty_like(step.primal), np.empty_like(step.dual)
    barrier = grid.is_multiplier, bounds.place, bounds.side, iterate.distance, iterate.duals, mu
    residual, length, last = iterate.point.gradient[grid.is_multiplier], step.longest, trial[0].violation
    for _ in range(CORRECTIONS):
        residual = length * residual + trial[0].gradient[grid.is_multiplier]
        right[grid.is_multiplier] = residual
        solve_kkt(grid, system, right, correction)
        if not np.isfinite(correction).all():
            return None
        _, length, _ = measure_step(iterate.point.unknowns, right, correction, *barrier, max(0.99, 1.0 - mu), unused)
        trial = moved(search, iterate, correction, length)
        if accepted(trial, step.longest):
            return trial
        if not trial[0].violation < 0.99 * last:
            return None
        last = trial[0].violation
    return None


def restored(search, iterate, mu, reduction, filtered):
    """(status, iterate) after the violation has been lowered; the status is "restored" when that was enough."""

    def is_acceptable(point, logarithms):
        return acceptable(point.violation, point.cost - mu * logarithms, filtered)

    status, unknowns, distance = restore(search, iterate, reduction, is_acceptable)
    unknowns = primal_part(search.grid, unknowns)
    return status, with_multipliers(search, unknowns, distance, np.minimum(mu / distance, 1e3))
