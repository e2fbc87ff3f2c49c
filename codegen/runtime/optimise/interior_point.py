"""Primal-dual interior point method with a filter line search, for problems with bounds on unknowns.

Bounds are replaced by a logarithmic barrier whose weight mu tends to zero; for each weight Newton's method solves the
optimality conditions, with the inertia of the KKT matrix corrected until the step is one of descent, and a filter
decides how far to go. Source: Waechter and Biegler (2006), On the implementation of an interior-point filter
line-search algorithm for large-scale nonlinear programming, whose equation and algorithm numbers are quoted.
"""

from typing import NamedTuple

import numpy as np

from codegen.runtime.kkt.apart import allocate_system
from codegen.runtime.optimise.barrier import add_barrier, finite_bounds
from codegen.runtime.optimise.curvature import FLAT
from codegen.runtime.optimise.exact_bounds import within_bounds
from codegen.runtime.optimise.filter import Filter
from codegen.runtime.unknowns.frame import views
from codegen.runtime.optimise.interior_steps import (
    Doubts,
    Search,
    Watch,
    barrier_error,
    begin,
    damped,
    is_acceptable,
    leaves_much,
    line_search,
    measured_iterate,
    primal_part,
    regularised_step,
    tightened,
    watched,
    with_multipliers,
)
from codegen.runtime.unknowns.layout import free_unknowns, multiplier_unknowns
from codegen.runtime.optimise.limits import bounds_of
from codegen.runtime.optimise.restoration import restore
from codegen.runtime.optimise.rounding import is_solved
from codegen.runtime.optimise.saddles import ESCAPES, LEFT, is_below, is_nearly_stationary, steps_aside
from codegen.runtime.optimise.standstill import is_rounding
from codegen.runtime.kkt.system import factor_kkt

LARGEST = 1e20  # unknowns beyond it are taken for infinite
BOTTOMLESS = 1e10  # a cost so many times as far below zero as the first one, or as one, is taken for infinite
NEARBY = 0.1  # part of the guess's violation that is left where a search begins nearby
UNLUCKY = ("infeasible", "stalled", "rank-deficient", "unbounded")
SHORTENED = 10  # steps in turn that the filter shortens before full ones are tried
LEAST_PART = 0.025  # of the tolerance is the last weight: at a tenth the cost of the crane is off by 2e-9 of it
PATIENCE = 8  # iterations with a weight below the tolerance before scaled multipliers have to do


class Attempt(NamedTuple):
    """First weight of the barrier, how far inside their bounds unknowns begin, and whether nearer to feasibility.

    Steps below the shortest make way for restoration; the violation may grow by the factor `funnel`. The guess is bent
    by a part of its size.
    """

    weight: float
    push: float
    nearby: bool
    shortest: float
    funnel: float
    bend: float = 0.0


WARM, COLD = Attempt(1e-5, 1e-4, False, 1e-12, 1e4), Attempt(0.1, 1e-2, False, 1e-12, 1e4)
OTHERS = Attempt(0.1, 1e-2, True, 1e-3, 2.0), Attempt(10.0, 1e-2, False, 1e-3, 2.0)
BENT = Attempt(0.1, 1e-2, False, 1e-12, 1e4, 0.1)  # where equations depend on each other at the guess alone


def minimise(grid, unknowns, tolerance, max_iterations, warm, log):
    """Find a local minimum; return (status, point, iterations).

    A row (cost, residual, stationarity, Hessian's shift, step length, barrier's weight) is appended to `log` at every
    iterate. With `warm`, the barrier begins with a small weight and leaves unknowns close to their bounds. Where that
    fails, the search begins anew: at a point near the guess that violates the equations less, and then with a weight
    that keeps unknowns away from their bounds for longer, and from a bent guess. If no attempt succeeds, the first one
    is reported. `max_iterations` is for all of them together; steps of the restoration are not counted.
    """
    lower, upper = bounds_of(grid)
    bounds, box = finite_bounds(lower, upper), (lower, upper)
    search = Search(grid, bounds, allocate_system(grid), multiplier_unknowns(grid), box)
    primal, first, total = np.where(grid.is_multiplier, 0.0, unknowns), None, 0
    for attempt in (WARM if warm else COLD, *OTHERS, BENT):
        # Far from a solution duals of one serve better than the central path.
        iterate = begin(search, bent(grid, primal, attempt.bend), attempt, central=attempt is WARM)
        status = "restored"
        if attempt.nearby and iterate.point.error < np.inf:
            status, iterate = restored(search, iterate, attempt.weight, NEARBY, Filter(np.inf), log)
        if status == "restored":
            left = max_iterations - total
            status, iterate, iterations = leave_saddles(search, iterate, attempt, tolerance, left, log)
            total += iterations
            first = first or (status, iterate)
        if status == "solved" or first[0] not in UNLUCKY or total >= max_iterations:
            break
    status, iterate = (status, iterate) if status == "solved" else first
    return status, within_bounds(search, iterate, tolerance), total


def bent(grid, unknowns, part):
    """Unknowns that bulge between the ends by a part of the size that each quantity, or the largest, has."""
    if part == 0.0:
        return unknowns
    bulge, largest = np.zeros_like(unknowns), np.abs(unknowns).max(initial=0.0)
    for own, values in zip(views(grid, bulge), views(grid, np.abs(unknowns)), strict=True):
        sizes = np.maximum(values.max(axis=1, initial=0.0), 0.1 * largest)
        own[:] = part * sizes[:, None] * np.sin(np.pi * np.linspace(0.0, 1.0, own.shape[1]))[:, None]
    return np.where(free_unknowns(grid) & ~grid.is_multiplier, unknowns + bulge, unknowns)


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
    if status == "saddle point" and escapes == ESCAPES and not failed:
        status = "solved" if is_solved(search.grid, saddle.point, tolerance) else "stalled"
    return status, saddle, total


def neighbours(search, saddle, attempt, escapes):
    """Iterates to both sides of a saddle point, along the direction in which the cost curves downwards most."""
    unknowns, bounds = saddle.point.unknowns, search.bounds
    curvature = np.zeros(unknowns.size)
    np.add.at(curvature, bounds.place, saddle.duals / saddle.distance)
    for step in steps_aside(search.grid, unknowns, curvature, escapes):
        yield begin(search, primal_part(search.grid, unknowns + step), attempt)


def descend(search, iterate, attempt, tolerance, max_iterations, log):
    """Lower the barrier's weight and follow the minima; return (status, iterate, iterations).

    The weight ends at a fortieth of the tolerance, so that each complementarity is far below it, as in (5); by
    their sum the cost of an optimum is corrected. Where rounding does not allow the tolerance, the optimality
    conditions are relative to the multipliers.
    """
    grid, mu = search.grid, attempt.weight
    first, first_cost = max(1.0, iterate.point.violation), abs(iterate.point.cost)
    small_violation, filtered = 1e-4 * first, Filter(attempt.funnel * first)
    shift, last_shift, length, damping = 0.0, 0.0, 0.0, 0.0
    low, shortened, watch, doubts = 0, 0, None, Doubts()
    for iteration in range(max_iterations + 1):
        iterate, measured = measured_iterate(search, iterate)
        point = iterate.point
        log.append(grid, point, shift, length, mu)
        sure = iteration > 0 and shift == 0.0
        status = conclusion(search, iterate, measured, tolerance, first_cost, low > PATIENCE, sure)
        if not status and log.is_late():
            status = "time limit"
        if status or iteration == max_iterations:
            return status or "iteration limit", iterate, iteration
        before, mu = mu, lowered(point, measured, mu, LEAST_PART * tolerance)
        if mu < before:
            filtered.empty()
            iterate, shortened, watch = tightened(search, iterate, before, mu), 0, None
        low += mu <= LEAST_PART * tolerance
        trial, step = None, regularised_step(search, iterate, mu, last_shift, damping, doubts.are_enough())
        if step is not None:
            shift, last_shift = step.shift, step.shift or last_shift
            watch = Watch(iterate, step) if shortened == SHORTENED else watch
            if watch is not None:
                iterate, length, watch = watched(search, iterate, step, mu, watch, small_violation, filtered)
                shortened = 0
                continue
            trial, length = line_search(search, iterate, step, mu, attempt.shortest, small_violation, filtered)
            doubts.note(step, trial is not None and leaves_much(point, step, length, trial.point))
            shortened = shortened + 1 if trial is None or length < step.longest else 0
            damping = damped(damping, step, length, shortened) if trial is not None else 0.0
        if trial is None:
            convex = step is None or shift == 0.0 or is_minimum(search, iterate, tolerance)
            if low and convex and is_acceptable(grid, point, measured, tolerance):
                return "solved", iterate, iteration
            if step is None:
                return "rank-deficient", iterate, iteration
            if not convex and is_nearly_stationary(point):
                return "saddle point", iterate, iteration
            if is_rounding(grid, point):
                # Rounding has the last word; a gap of one tolerance for every bound is then as good as it gets.
                closed = measured[1] <= tolerance * search.bounds.place.size
                return ("solved" if closed else "stalled"), iterate, iteration
            filtered.add(point.violation, point.cost - mu * iterate.logarithms)
            status, trial = restored(search, iterate, mu, 0.9, filtered, log)
            if status != "restored":
                return status, trial if status == "infeasible" else iterate, iteration
        iterate = trial
    return "iteration limit", iterate, max_iterations


def conclusion(search, iterate, measured, tolerance, first_cost, acceptable_will_do, sure):
    """The status with which the descent ends at an iterate, or an empty word where it goes on.

    Newton's steps went downhill; a start that is stationary, or a shifted Hessian, leave room for doubt.
    """
    grid, point = search.grid, iterate.point
    if not point.error < np.inf:
        return "non-finite"
    closed = measured[3] <= tolerance and is_solved(grid, point, tolerance)
    if closed or (acceptable_will_do and is_acceptable(grid, point, measured, tolerance)):
        return "solved" if sure or is_minimum(search, iterate, tolerance) else "saddle point"
    return "unbounded" if is_boundless(point, measured[6], first_cost) else ""


def lowered(point, measured, mu, least):
    """The weight for the next step: lower where the barrier problem is solved well enough (7).

    The power is 1.5 to the end, as in (7): a leap to the last weight costs up to twice the iterations where bounds are
    hardly active, as on singular arcs.
    """
    while mu > least and barrier_error(point, measured, mu) <= 10.0 * mu:
        mu = max(least, min(0.2 * mu, mu**1.5))
    return mu


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


def is_boundless(point, largest, first_cost):
    """Whether the cost, along nearly feasible points, or an unknown has left all reasonable limits."""
    return largest > LARGEST or (point.residual <= 1e-6 and point.cost < -BOTTOMLESS * max(1.0, first_cost))


def restored(search, iterate, mu, reduction, filtered, log):
    """(status, iterate) after the violation has been lowered; the status is "restored" when that was enough."""

    def lets_pass(point, logarithms):
        return filtered.lets_pass(point.violation, point.cost - mu * logarithms)

    status, unknowns, distance = restore(search, iterate, reduction, lets_pass, log.is_late)
    unknowns = primal_part(search.grid, unknowns)
    return status, with_multipliers(search, unknowns, distance, np.minimum(mu / distance, 1e3))
