"""The compiled search in Python's hands: it is called again until it ends, with restorations in between."""

from codegen.runtime.search import descent
from codegen.runtime.search.descent import CONTINUE, GROSS, RESTORE, ROOM, WITH_ITERATE, WITH_NEIGHBOUR, WORDS
from codegen.runtime.search.iterates import (
    Iterate,
    central_duals,
    load,
    measured_point,
    stored,
    with_least_squares_multipliers,
    with_relaxed_bounds,
)
from codegen.runtime.search.point import evaluate
from codegen.runtime.search.restoration import restore

UNLUCKY = ("infeasible", "stalled", "rank-deficient", "unbounded")
WORK_PER_CALL = 5_000_000  # unknowns times iterations between looks at the clock: a fraction of a second
BETWEEN_MARKS = 300  # iterations after which a search has to have made progress
HALVED, UNCHANGED = 0.5, 1e-3  # part of error or violation that progress leaves at most; least relative change of cost
FIRST = [descent.FIRST_MU, descent.FIRST_COST, descent.FIRST_VIOLATION, descent.FIRST_ERROR]
MARKED = [descent.MU, descent.COST, descent.VIOLATION, descent.ERROR]


def descend(search, start, attempt, tolerance, max_iterations, log, known=None, stage=WITH_ITERATE, is_factored=False):
    """Follow Newton's steps from `start`; return (status, iterate, iterations).

    The start is an iterate; or, by the `stage`, primal unknowns (n,) with zeros for multipliers; or those of a
    neighbour, for whose first step the linear system may be factored. From there, and without bounds, the search ends
    as "gross", without an iteration, where the equations are grossly violated. Multipliers that are all zero are
    estimated. Beside a saddle point whose cost is `known`, the search ends as there once it is clear that it leads no
    lower.
    """
    work = search.work
    reals, integers = work.reals, work.integers
    is_beside = integers[descent.IS_BESIDE] if stage == WITH_ITERATE else 0  # of the start that escapes follow
    reals[:], integers[:], integers[descent.IS_BESIDE] = 0.0, 0, is_beside
    if stage == WITH_ITERATE:
        load(search, start)
    else:
        work.vectors[descent.X] = start
        reals[descent.MU], reals[descent.PUSH] = attempt.weight if search.is_bounded else 0.0, attempt.push
        integers[descent.ON_PATH], integers[descent.LOOKS] = attempt.on_path, 1
    if stage == WITH_NEIGHBOUR:
        problem, data, _, bounds = search.arguments
        reals[descent.LEAST_RELAXATION], integers[descent.IS_FACTORED] = search.least, is_factored
        descent.begin_beside(problem, data, bounds, tolerance, reals, integers, work.vectors, work.barriers)
        stage, is_factored = WITH_ITERATE, integers[descent.IS_FACTORED]
    integers[descent.STAGE] = stage
    reals[descent.SHORTEST], reals[descent.FUNNEL] = attempt.shortest, attempt.funnel
    reals[descent.LEAST_RELAXATION] = search.least
    integers[descent.IS_FACTORED] = is_factored
    integers[descent.IS_COSTLESS] = search.grid.problem.structure.costless
    if known is not None:
        reals[descent.KNOWN], integers[descent.HAS_KNOWN] = known, 1
    marked, until = None, BETWEEN_MARKS
    while True:
        status, watched = run(search, tolerance, max_iterations, log, until)
        iterations = int(integers[descent.ITERATIONS])
        if status == GROSS:
            return "gross", stored(search), 0
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
                before, until = reals[FIRST] if marked is None else marked, iterations + BETWEEN_MARKS
                marked = reals[MARKED]
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
    if status == GROSS:
        return status, ""
    count = int(work.integers[descent.ITERATIONS]) - before
    # The row of an iterate from which the next call goes on is written again by that call.
    is_over = status != CONTINUE or int(work.integers[descent.ITERATIONS]) >= max_iterations
    log.extend(search, work.log[: count + 1 if is_over else count])
    if not log.is_late():
        return status, ""
    if not is_over:
        log.extend(search, work.log[count : count + 1])
    return status, "time limit"


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


def restored(search, iterate, reduction, pairs, log):
    """Return (status, iterate) after the violation has been lowered; the status is "restored" if that was enough.

    The iterate has no multipliers. `pairs` (k, 2) are those of the filter.
    """
    status, found = restore(search, iterate, reduction, pairs, log.is_late)
    if search.is_bounded:
        found = found._replace(mu=iterate.mu, duals=central_duals(iterate.mu, found.distance))
        found = found._replace(point=measured_point(search, found))
    return status, found
