"""The compiled search in Python's hands: it is called again until it ends, with restorations in between."""

import numpy as np

from codegen.runtime.search import descent
from codegen.runtime.search.descent import CONTINUE, RESTORE, ROOM, WORDS
from codegen.runtime.search.iterates import (
    Iterate,
    central_duals,
    has_multipliers,
    measured_point,
    with_least_squares_multipliers,
    with_relaxed_bounds,
)
from codegen.runtime.search.point import Point, evaluate
from codegen.runtime.search.restoration import restore

UNLUCKY = ("infeasible", "stalled", "rank-deficient", "unbounded")
WORK_PER_CALL = 5_000_000  # unknowns times iterations between looks at the clock: a fraction of a second
FILTERED = 1e-4  # part of the first violation up to which the switching condition asks for descent
BETWEEN_MARKS = 300  # iterations after which a search has to have made progress
HALVED, UNCHANGED = 0.5, 1e-3  # part of error or violation that progress leaves at most; least relative change of cost


def descend(search, iterate, attempt, tolerance, max_iterations, log, known=None):
    """Follow Newton's steps from an iterate; return (status, iterate, iterations).

    Multipliers that are all zero are estimated; others are those of a neighbour. Beside a saddle point whose cost is
    `known`, the search ends as there once it is clear that it leads no lower.
    """
    grid, work = search.grid, search.work
    is_warm = has_multipliers(iterate.point.unknowns, grid.is_multiplier)
    if not is_warm:
        iterate = with_least_squares_multipliers(search, iterate)
    reals, integers = work.reals, work.integers
    reals[:], integers[:] = 0.0, 0
    first = max(1.0, iterate.point.violation)
    reals[descent.SHORTEST], reals[descent.SMALL_VIOLATION] = attempt.shortest, FILTERED * first
    reals[descent.FIRST_COST], reals[descent.LAST_ERROR] = abs(iterate.point.cost), np.inf
    reals[descent.LEAST_RELAXATION] = search.least
    integers[descent.IS_WARM], integers[descent.IS_FACTORED] = is_warm, attempt.is_factored
    integers[descent.IS_COSTLESS], integers[descent.ENOUGH] = grid.problem.structure.costless, 2
    if known is not None:
        reals[descent.KNOWN], integers[descent.HAS_KNOWN] = known, 1
    work.pairs[0], integers[descent.PAIRS] = (attempt.funnel * first, -np.inf), 1
    load(search, iterate)
    marked, until = reals[[descent.MU, descent.COST, descent.VIOLATION, descent.ERROR]], BETWEEN_MARKS
    while True:
        status, watched = run(search, tolerance, max_iterations, log, until)
        iterations = int(integers[descent.ITERATIONS])
        if status == RESTORE:
            iterate = stored(search)
            ended, found = restored(search, iterate, 0.9, work.pairs[: integers[descent.PAIRS]], log)
            if ended in UNLUCKY and integers[descent.HAS_LOOSE] == 1:
                search = with_relaxed_bounds(search)
                reals[descent.LEAST_RELAXATION], integers[descent.HAS_LOOSE] = search.least, 2
                load_loose(search)
                forget(integers)
                continue
            if ended != "restored":
                return ended, found if ended == "infeasible" else iterate, iterations
            load(search, with_least_squares_multipliers(search, found))
            integers[descent.ITERATIONS] += 1
            if integers[descent.ITERATIONS] > max_iterations:
                return "iteration limit", stored(search), max_iterations
            continue
        if status == CONTINUE and iterations < max_iterations:
            if watched == "time limit":
                return watched, stored(search), iterations
            if iterations >= until:
                before, until = marked, iterations + BETWEEN_MARKS
                marked = reals[[descent.MU, descent.COST, descent.VIOLATION, descent.ERROR]]
                if is_stagnant(before, marked):
                    return "stalled", stored(search), iterations
            continue
        return WORDS[status], stored(search), iterations


def is_stagnant(before, now):
    """Return True if the barrier's weight, cost, violation and error of an iterate are nearly those of many before."""
    (mu, cost, violation, error), (new_mu, new_cost, new_violation, new_error) = before, now
    is_same = new_mu == mu and abs(new_cost - cost) <= UNCHANGED * max(1.0, abs(cost))
    return is_same and new_error > HALVED * error and new_violation > min(HALVED * violation, descent.ROUNDED)


def run(search, tolerance, max_iterations, log, until):
    """Call the compiled search once, up to so many iterations in all at most, and log its iterates.

    Return the number of its status, and "time limit" if the time is up, else "".
    """
    grid, work = search.grid, search.work
    before, affordable = int(work.integers[descent.ITERATIONS]), WORK_PER_CALL // max(1, grid.is_multiplier.size)
    most = log.iterations_per_call(before, work.log.shape[0] - 1, max(1, min(affordable, until - before)))
    while True:
        status = descent.descend(
            *search.arguments, tolerance, max_iterations, most, work.reals, work.integers, work.vectors, work.barriers,
            work.pairs, work.room, work.log,
        )  # fmt: skip
        if status != ROOM:
            break
        work.room_for_refinement()
    count = int(work.integers[descent.ITERATIONS]) - before
    # The row of an iterate from which the next call goes on is written again by that call.
    is_over = status != CONTINUE or int(work.integers[descent.ITERATIONS]) >= max_iterations
    log.extend(search, work.log[: count + 1 if is_over else count])
    if not log.is_late():
        return status, ""
    if not is_over:
        log.extend(search, work.log[count : count + 1])
    return status, "time limit"


def load(search, iterate):
    """Put an iterate into the work space."""
    work = search.work
    work.vectors[descent.X], work.vectors[descent.G] = iterate.point.unknowns, iterate.point.gradient
    work.barriers[descent.DISTANCE], work.barriers[descent.DUALS] = iterate.distance, iterate.duals
    work.reals[descent.MU], work.reals[descent.COST : descent.COST + 5] = iterate.mu, iterate.point[2:]


def load_loose(search):
    """Put back the iterate before bounds were relaxed less."""
    work = search.work
    barriers = work.barriers[descent.LOOSE_DISTANCE], work.barriers[descent.LOOSE_DUALS]
    point = evaluate(search.grid, work.vectors[descent.LOOSE_X].copy())
    load(search, Iterate(point, work.reals[descent.LOOSE_MU], *barriers))


def forget(integers):
    """Forget what belongs to another barrier problem."""
    integers[descent.PAIRS] = 1
    integers[[descent.REFUSED, descent.IN_TURN, descent.SHORTENED, descent.WATCHING]] = 0


def stored(search):
    """Return the iterate that is in the work space."""
    work, reals = search.work, search.work.reals
    measures = reals[descent.COST : descent.COST + 5].tolist()
    point = Point(work.vectors[descent.X].copy(), work.vectors[descent.G].copy(), *measures)
    barriers = work.barriers[descent.DISTANCE].copy(), work.barriers[descent.DUALS].copy()
    return Iterate(point, float(reals[descent.MU]), *barriers)


def restored(search, iterate, reduction, pairs, log):
    """Return (status, iterate) after the violation has been lowered; the status is "restored" if that was enough.

    The iterate has no multipliers. `pairs` (k, 2) are those of the filter.
    """
    status, found = restore(search, iterate, reduction, pairs, log.is_late)
    if search.is_bounded:
        found = found._replace(mu=iterate.mu, duals=central_duals(iterate.mu, found.distance))
        found = found._replace(point=measured_point(search, found))
    return status, found
