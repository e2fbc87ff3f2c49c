"""Newton's method with a filter line search; where unknowns have bounds, a primal-dual interior point method.

Bounds are replaced by a logarithmic barrier whose weight mu tends to zero; for each weight Newton's method solves the
optimality conditions, with the inertia of the KKT matrix corrected until the step is one of descent, and a filter
decides how far to go. Source: Waechter and Biegler (2006), On the implementation of an interior-point filter
line-search algorithm for large-scale nonlinear programming, whose equation and algorithm numbers are quoted.
"""

import numpy as np

from codegen.runtime.kkt.system import factor_kkt
from codegen.runtime.optimise.bounded import (
    FROM_GUESS,
    CASCADE,
    WARM,
    InertiaCorrection,
    barrier_curvature,
    begin,
    central_duals,
    falling_relaxation,
    is_acceptable,
    is_closed,
    is_optimal,
    decreased_mu,
    measured_iterate,
    barrier_objective,
    newton_system,
    search_on,
    with_barrier_parameter,
    with_least_squares_multipliers,
    with_relaxed_bounds,
)
from codegen.runtime.optimise.negative_curvature import FLAT
from codegen.runtime.optimise.exact_bounds import within_bounds
from codegen.runtime.optimise.filter import Filter
from codegen.runtime.optimise.newton_steps import (
    AccuracyMonitor,
    Watchdog,
    damped,
    barely_reduces_residual,
    is_inaccurate,
    line_search,
    regularised_step,
    watchdog_step,
)
from codegen.runtime.optimise.restoration import restore
from codegen.runtime.optimise.convergence_test import is_solved, sizes_of_terms
from codegen.runtime.optimise.saddle_points import ESCAPES, LEFT, is_below, is_nearly_stationary, escape_steps
from codegen.runtime.optimise.stagnation import is_at_rounding_level
from codegen.runtime.optimise.unbounded import NEARBY
from codegen.runtime.stand_ins.example import INEQUALITIES, UNBOUNDED
from codegen.runtime.unknowns.time_grid import views
from codegen.runtime.unknowns.layout import free_unknowns

UNBOUNDED_BELOW = 1e10  # a cost so many times as far below zero as the first one, or as one, is taken for infinite
UNLUCKY = ("infeasible", "stalled", "rank-deficient", "unbounded")
SHORTENED = 10  # steps in turn that the filter shortens before full ones are tried
if UNBOUNDED:
    GROSS = 0.03  # residuals above this part of the equations' terms are a gross violation
    NEARBY_ITERATIONS = 100  # for a search that begins near a guess that violates them so, and half of what is allowed
if INEQUALITIES:
    LARGEST = 1e20  # unknowns beyond it are taken for infinite
    LEAST_PART = 0.025  # of the tolerance is the last weight: at a tenth the cost of the crane is off by 2e-9 of it
    PATIENCE = 8  # iterations with a weight below the tolerance before scaled multipliers have to do


def minimise(grid, unknowns, tolerance, max_iterations, warm, log):
    """Find a local minimum; return (status, point, iterations).

    Where the search from the guess fails, a globalisation cascade follows: searches that begin in other ways. If none
    succeeds, the end of the first one is reported. With `warm`, the barrier of bounds begins with a small weight and
    leaves unknowns close to them. A row (cost, residual, stationarity, Hessian's shift, step length) is appended to
    `log` at every iterate, and the barrier's weight where there is one. `max_iterations` is for all searches together;
    steps of the restoration are not counted.
    """
    search, first, total = search_on(grid), None, 0
    primal, cascade = np.where(grid.is_multiplier, 0.0, unknowns), (WARM if warm else FROM_GUESS, *CASCADE)
    guess = begin(search, primal, cascade[0])
    if UNBOUNDED and guess.point.error < np.inf and is_gross(grid, guess.point):
        status, iterate, total = from_nearby(search, guess, tolerance, max_iterations, log)
        if status in ("solved", "time limit"):
            return status, iterate.point, total
    for attempt in cascade:
        iterate = begin(search, bulged_guess(grid, primal, attempt.bulge), attempt) if first else guess
        status = "restored"
        if attempt.nearby < 1.0 and iterate.point.error < np.inf:
            status, iterate = restored(search, iterate, attempt.nearby, Filter(np.inf), log)
        if status == "restored":
            left = max_iterations - total
            status, iterate, iterations = leave_saddles(search, iterate, attempt, tolerance, left, log)
            total += iterations
            first = first or (status, iterate)
        if first and first[0] == "rank-deficient" and status == "infeasible" and iterate.point.residual > tolerance:
            first = status, iterate  # equations that contradict each other are dependent as well
        if status == "solved" or first[0] not in UNLUCKY or total >= max_iterations:
            break
    status, iterate = (status, iterate) if status == "solved" else first
    if INEQUALITIES:
        return status, within_bounds(search, iterate, tolerance), total
    else:
        return status, iterate.point, total


if UNBOUNDED:

    def is_gross(grid, point):
        """Whether the residual is more than a small part of the equations' largest terms."""
        terms, _ = sizes_of_terms(grid, point.unknowns)
        return point.residual > GROSS * terms

    def from_nearby(search, guess, tolerance, max_iterations, log):
        """(status, iterate, iterations) of a search from a point near the guess that nearly obeys the equations.

        A full Newton step, which knows of no distance, would leave for another optimum.
        """
        status, iterate = restored(search, guess, NEARBY.nearby, Filter(np.inf), log)
        if status != "restored":
            return status, iterate, 0
        limit = min(max_iterations // 2, NEARBY_ITERATIONS)
        return leave_saddles(search, iterate, NEARBY, tolerance, limit, log)


def bulged_guess(grid, unknowns, part):
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
        for beside in escaping_iterates(search, saddle, attempt, escapes):
            ended, other, iterations = descend(search, beside, attempt, tolerance, max_iterations - total, log)
            total += iterations
            if ended in LEFT and is_below(other.point, saddle.point):
                status, saddle = ended, other
                break
            failed = failed or ended not in LEFT
        escapes += 1
    if status == "saddle point" and escapes == ESCAPES and not failed:
        is_over = is_solved(search.grid, saddle.point, tolerance) or is_at_rounding_level(search.grid, saddle.point)
        status = "solved" if is_over else "stalled"
    return status, saddle, total


def escaping_iterates(search, saddle, attempt, escapes):
    """Iterates to both sides of a saddle point, along the direction in which the cost curves downwards most."""
    grid, unknowns = search.grid, saddle.point.unknowns
    curvature = barrier_curvature(search, saddle)
    for step in escape_steps(grid, unknowns, curvature, escapes):
        yield begin(search, np.where(grid.is_multiplier, 0.0, unknowns + step), attempt)


def descend(search, iterate, attempt, tolerance, max_iterations, log):
    """Follow Newton's steps from an iterate without multipliers; return (status, iterate, iterations).

    With bounds, the barrier's weight is lowered where its minimum is reached. The weight ends at a fortieth of the
    tolerance, so that each complementarity is far below it, as in (5); by their sum the cost of an optimum is
    corrected. Where rounding does not allow the tolerance, the optimality conditions are relative to the multipliers.
    """
    grid, iterate = search.grid, with_least_squares_multipliers(search, iterate)
    first, first_cost = max(1.0, iterate.point.violation), abs(iterate.point.cost)
    small_violation, filtered = 1e-4 * first, Filter(attempt.funnel * first)
    inertia, length, damping, shortened, watchdog, monitor = InertiaCorrection(), 0.0, 0.0, 0, None, AccuracyMonitor()
    if INEQUALITIES:
        low, loose = 0, None  # iterations with the last weight; the iterate before bounds were relaxed less
    for iteration in range(max_iterations + 1):
        if INEQUALITIES:
            iterate = measured_iterate(search, iterate)
            log.append(grid, iterate.point, inertia.delta_w, length, iterate.mu)
            converged = is_optimal(search, iterate, tolerance, low > PATIENCE)
        else:
            log.append(grid, iterate.point, inertia.delta_w, length)
            converged = is_solved(grid, iterate.point, tolerance)
        point, status = iterate.point, ""
        if not point.error < np.inf:
            status = "non-finite"
        elif converged:
            # Newton's steps went downhill; a start that is stationary, or a shifted Hessian, leaves room for doubt.
            doubtful = iteration == 0 or inertia.delta_w > 0.0
            status = "saddle point" if doubtful and not is_minimum(search, iterate, tolerance) else "solved"
        elif is_unbounded_below(iterate, first_cost):
            status = "unbounded"
        elif log.is_late():
            status = "time limit"
        if status or iteration == max_iterations:
            return status or "iteration limit", iterate, iteration
        if INEQUALITIES:
            mu = decreased_mu(iterate, LEAST_PART * tolerance)
            if mu < iterate.mu:
                filtered.empty()
                if loose is None and falling_relaxation(search, iterate, mu) > 0.0:
                    loose = iterate
                iterate, shortened, watchdog = with_barrier_parameter(search, iterate, mu), 0, None
            low += mu <= LEAST_PART * tolerance
        careful, before = monitor.is_due(), inertia
        trial, step = None, regularised_step(search, iterate, inertia, damping, careful)
        if step is not None:
            inertia = step.inertia
            if careful:
                monitor.record(step.refined)
            watchdog = Watchdog(iterate, step) if shortened == SHORTENED else watchdog
            if watchdog is not None:
                iterate, length, watchdog = watchdog_step(search, iterate, step, watchdog, small_violation, filtered)
                shortened = 0
                continue
            trial, length = line_search(search, iterate, step, attempt.shortest, small_violation, filtered)
            if trial is not None and not careful and barely_reduces_residual(point, step, length, trial.point):
                monitor.add()
                if monitor.is_due() and is_inaccurate(search, iterate, step):
                    step = regularised_step(search, iterate, before, damping, True) or step
                    inertia = step.inertia
                    trial, length = line_search(search, iterate, step, attempt.shortest, small_violation, filtered)
                if monitor.is_due():
                    monitor.record(step.refined)
            shortened = shortened + 1 if trial is None or length < step.longest else 0
            if shortened or damping > 0.0:
                damping = damped(damping, step, length, shortened) if trial is not None else 0.0
        if trial is None:
            convex = step is None or inertia.delta_w == 0.0 or is_minimum(search, iterate, tolerance)
            if INEQUALITIES and low and convex and is_acceptable(grid, iterate, tolerance):
                return "solved", iterate, iteration
            if step is None:
                return "rank-deficient", iterate, iteration
            if not convex and is_nearly_stationary(point):
                return "saddle point", iterate, iteration
            if is_at_rounding_level(grid, point):
                if INEQUALITIES and not is_closed(search, iterate, tolerance):
                    return "stalled", iterate, iteration
                return "solved" if convex else "saddle point", iterate, iteration  # rounding has the last word
            filtered.add(point.violation, barrier_objective(iterate))
            status, trial = restored(search, iterate, 0.9, filtered, log)
            if INEQUALITIES and loose is not None and status in UNLUCKY:
                search, iterate, loose, shortened, watchdog = with_relaxed_bounds(search), loose, None, 0, None
                filtered.empty()
                continue
            if status != "restored":
                return status, trial if status == "infeasible" else iterate, iteration
            trial = with_least_squares_multipliers(search, trial)
        iterate = trial
    return "iteration limit", iterate, max_iterations


def is_minimum(search, iterate, tolerance):
    """Whether a stationary point is a minimum to second order, with the barrier to stand for bounds.

    Multipliers are known to the tolerance, and so are curvatures, up to a factor.
    """
    unknowns, delta_w = iterate.point.unknowns, max(FLAT, 100.0 * tolerance)
    if INEQUALITIES:
        iterate = iterate._replace(mu=0.0)
    _, diagonal = newton_system(search, iterate, iterate.point.gradient, delta_w, FLAT)
    return factor_kkt(search.grid, unknowns, 1.0, diagonal, search.system) == 0


def is_unbounded_below(iterate, first_cost):
    """Whether the cost, along nearly feasible points, or an unknown has left all reasonable limits."""
    if INEQUALITIES and iterate.measured.largest > LARGEST:
        return True
    return iterate.point.residual <= 1e-6 and iterate.point.cost < -UNBOUNDED_BELOW * max(1.0, first_cost)


def restored(search, iterate, reduction, filtered, log):
    """(status, iterate) after the violation has been lowered; the status is "restored" when that was enough.

    The iterate has no multipliers.
    """
    status, found = restore(search, iterate, reduction, filtered, log.is_late)
    if INEQUALITIES:
        found = found._replace(mu=iterate.mu, duals=central_duals(iterate.mu, found.distance))
    return status, found
