"""Newton's method with a filter line search; where unknowns have bounds, a primal-dual interior point method.

Bounds are replaced by a logarithmic barrier whose weight mu tends to zero; for each weight Newton's method solves the
optimality conditions, with the inertia of the KKT matrix corrected until the step is one of descent, and a filter
decides how far to go. Source: Waechter and Biegler (2006), On the implementation of an interior-point filter
line-search algorithm for large-scale nonlinear programming, whose equation and algorithm numbers are quoted.
"""

import numpy as np

from codegen.runtime.kkt.system import factor_kkt
from codegen.runtime.optimise.bounded import (
    barrier_objective,
    central_duals,
    decreased_mu,
    falling_relaxation,
    is_acceptable,
    is_closed,
    is_optimal,
    measured_iterate,
    newton_system,
    predicted_cost,
    with_barrier_parameter,
    with_least_squares_multipliers,
    with_relaxed_bounds,
)
from codegen.runtime.optimise.convergence_test import is_solved, sizes_of_terms
from codegen.runtime.optimise.line_search import Globalisation
from codegen.runtime.optimise.negative_curvature import FLAT
from codegen.runtime.optimise.restoration import restore
from codegen.runtime.optimise.saddle_points import is_below, is_nearly_stationary
from codegen.runtime.optimise.stagnation import is_at_rounding_level
from codegen.runtime.optimise.warm_start import has_multipliers
from codegen.runtime.stand_ins.example import INEQUALITIES

UNBOUNDED_BELOW = 1e10  # a cost so many times as far below zero as the first one, or as one, is taken for infinite
NEARLY_FEASIBLE = 1e-6  # residuals up to it, or to ten times that part of the equations' terms, are those of a motion
PROGRESS = 0.5  # part of the error that a step leaves at most, of those that are worth more
UNLUCKY = ("infeasible", "stalled", "rank-deficient", "unbounded")
if INEQUALITIES:
    LARGEST = 1e20  # unknowns beyond it are taken for infinite
    LEAST_PART = 0.025  # of the tolerance is the last weight: at a tenth the cost of the crane is off by 2e-9 of it
    PATIENCE = 8  # iterations with a weight below the tolerance before scaled multipliers have to do


def descend(search, iterate, attempt, tolerance, max_iterations, log, known=None):
    """Follow Newton's steps from an iterate; return (status, iterate, iterations).

    Multipliers that are all zero are estimated; others are those of a neighbour.

    With bounds, the barrier's weight is lowered where its minimum is reached. The weight ends at a fortieth of the
    tolerance, so that each complementarity is far below it, as in (5); by their sum the cost of an optimum is
    corrected. Where rounding does not allow the tolerance, the optimality conditions are relative to the multipliers.
    Beside a saddle point whose cost is `known`, the search ends as there once it is clear that it leads no lower.
    """
    grid, is_warm, error = search.grid, has_multipliers(search.grid, iterate.point.unknowns), np.inf
    if not is_warm:
        iterate = with_least_squares_multipliers(search, iterate)
    course, first_cost = Globalisation(attempt, iterate.point.violation), abs(iterate.point.cost)
    late = 0  # iterations with the last weight
    if INEQUALITIES:
        loose = None  # the iterate before bounds were relaxed less
    for iteration in range(max_iterations + 1):
        if INEQUALITIES:
            iterate = measured_iterate(search, iterate)
            log.append(grid, iterate.point, course.inertia.delta_w, course.length, iterate.mu)
            converged = is_optimal(search, iterate, tolerance, late > PATIENCE)
        else:
            log.append(grid, iterate.point, course.inertia.delta_w, course.length)
            converged = is_solved(grid, iterate.point, tolerance)
        if is_warm:
            converged = converged or is_at_rest(search, iterate, error, tolerance)
            error = iterate.point.error
        # Newton's steps went downhill; a start that is stationary, or a shifted Hessian, leaves room for doubt.
        doubtful = converged and (iteration == 0 or course.inertia.delta_w > 0.0)
        status = status_of(search, iterate, tolerance, converged, doubtful, first_cost)
        if not status and log.is_late():
            status = "time limit"
        elif not status and known is not None and is_in_vain(search, iterate, known):
            status = "saddle point"
        elif not status and course.is_contradicted(iterate.point):
            status = "infeasible"  # a search that begins elsewhere may find a way
        if status or iteration == max_iterations:
            return status or "iteration limit", iterate, iteration
        if INEQUALITIES:
            mu = decreased_mu(iterate, LEAST_PART * tolerance)
            if mu < iterate.mu:
                course.forget()
                by = falling_relaxation(search, iterate, mu)
                if loose is None and by > 0.0:
                    loose = iterate
                iterate = with_barrier_parameter(search, iterate, mu, by)
            late += mu <= LEAST_PART * tolerance
        step, trial = course.next_iterate(search, iterate)
        if trial is None:
            status = status_without_step(search, iterate, step, tolerance, late > 0)
            if status:
                return status, iterate, iteration
            course.filtered.add(iterate.point.violation, barrier_objective(iterate))
            status, trial = restored(search, iterate, 0.9, course.filtered, log)
            if INEQUALITIES and loose is not None and status in UNLUCKY:
                search, iterate, loose = with_relaxed_bounds(search), loose, None
                course.forget()
                continue
            if status != "restored":
                return status, trial if status == "infeasible" else iterate, iteration
            trial = with_least_squares_multipliers(search, trial)
        iterate = trial
    return "iteration limit", iterate, max_iterations


def status_of(search, iterate, tolerance, converged, doubtful, first_cost):
    """The status with which a search ends at an iterate, or nothing where it goes on.

    Where it is `doubtful` that a point which has converged is a minimum, the curvature there decides.
    """
    if not iterate.point.error < np.inf:
        return "non-finite"
    if converged:
        return "saddle point" if doubtful and not is_minimum(search, iterate, tolerance) else "solved"
    return "unbounded" if is_unbounded_below(search.grid, iterate, first_cost) else ""


def is_at_rest(search, iterate, error, tolerance):
    """Whether no more than rounding is left at an iterate, and the step to it, from an `error`, made little progress.

    A search that begins near a solution may be there at once, and would go on until no step is accepted. A bound that
    has only just been left is not known to be so while its complementarity is above the tolerance.
    """
    if iterate.point.error <= PROGRESS * error or not is_at_rounding_level(search.grid, iterate.point):
        return False
    if INEQUALITIES:
        return iterate.measured.highest <= tolerance
    else:
        return True


def status_without_step(search, iterate, step, tolerance, is_last_weight):
    """The status with which a search ends at an iterate that no step improves, or nothing where restoration may help.

    `step` is None where the Newton system stays singular.
    """
    point = iterate.point
    convex = step is None or step.inertia.delta_w == 0.0 or is_minimum(search, iterate, tolerance)
    if INEQUALITIES and is_last_weight and convex and is_acceptable(search.grid, iterate, tolerance):
        return "solved"
    if step is None:
        return "rank-deficient"
    if not convex and is_nearly_stationary(point):
        return "saddle point"
    if not is_at_rounding_level(search.grid, point):
        return ""
    if INEQUALITIES and not is_closed(search, iterate, tolerance):
        return "stalled"
    return "solved" if convex else "saddle point"  # rounding has the last word


def is_minimum(search, iterate, tolerance):
    """Whether a stationary point is a minimum to second order, with the barrier to stand for bounds.

    Multipliers are known to the tolerance, and so are curvatures, up to a factor.
    """
    unknowns, delta_w = iterate.point.unknowns, max(FLAT, 100.0 * tolerance)
    if INEQUALITIES:
        iterate = iterate._replace(mu=0.0)
    _, diagonal = newton_system(search, iterate, iterate.point.gradient, delta_w, FLAT)
    return factor_kkt(search.grid, unknowns, 1.0, diagonal, search.system) == 0


def is_in_vain(search, iterate, known):
    """Whether the optimum nearby costs no less than what is `known`, as far as an iterate close to it tells."""
    return is_nearly_stationary(iterate.point) and not is_below(predicted_cost(search, iterate), known)


def is_unbounded_below(grid, iterate, first_cost):
    """Whether the cost, along nearly feasible points, or an unknown has left all reasonable limits."""
    if INEQUALITIES and iterate.measured.largest > LARGEST:
        return True
    point = iterate.point
    if not point.cost < -UNBOUNDED_BELOW * max(1.0, first_cost):
        return False
    # Where unknowns are huge, so is the residual of a motion that all but obeys the equations.
    terms, _ = sizes_of_terms(grid, point.unknowns)
    return point.residual <= NEARLY_FEASIBLE * max(1.0, 10.0 * terms)


def restored(search, iterate, reduction, filtered, log):
    """(status, iterate) after the violation has been lowered; the status is "restored" when that was enough.

    The iterate has no multipliers.
    """
    status, found = restore(search, iterate, reduction, filtered, log.is_late)
    if INEQUALITIES:
        found = found._replace(mu=iterate.mu, duals=central_duals(iterate.mu, found.distance), measured=None)
    return status, found
