"""Calls of the compiled search until the search ends, with feasibility restorations between the calls."""

import numpy as np

from codegen.runtime.search import descent, direction, first_iterate, workspace
from codegen.runtime.search.curvature import step_aside
from codegen.runtime.search.iterates import (
    Iterate,
    central_duals,
    load,
    measured_point,
    stored,
    with_least_squares_multipliers,
    with_relaxation,
)
from codegen.runtime.search.point import evaluate
from codegen.runtime.search.restoration import restore
from codegen.runtime.search.workspace import (
    CONTINUE,
    CURVED,
    GROSS,
    RESTORE,
    ROOM,
    WEIGHT,
    WITH_ITERATE,
    WITH_NEIGHBOUR,
    WORDS,
)  # fmt: skip

UNLUCKY = ("infeasible", "stalled", "rank-deficient", "unbounded")  # statuses after which another start may succeed
WORK_PER_CALL = 5_000_000  # unknowns times iterations between two readings of the clock: a fraction of a second
ASIDE_AT_MOST = 3  # largest number of steps along directions of negative curvature
NEVER = -(1 << 40)  # a count that does not reach any limit
BETWEEN_MARKS = 300  # iterations between two tests of progress; a search without progress is stalled
# Progress is an error or a violation below HALVED times its value at the last test, or a larger relative change of the
# cost than UNCHANGED.
HALVED, UNCHANGED = 0.5, 1e-3
FIRST = [workspace.FIRST_MU, workspace.FIRST_COST, workspace.FIRST_VIOLATION, workspace.FIRST_ERROR]
MARKED = [workspace.MU, workspace.COST, workspace.VIOLATION, workspace.ERROR]


def descend(
    search, start, attempt, tolerance, max_iterations, log, saddle_cost=None, stage=WITH_ITERATE, is_factored=False
):
    """Follow Newton's steps from `start`; return (status, iterate, iterations).

    The `stage` says what the start is: an iterate, primal unknowns (n,) with zeros for multipliers, or the solution of
    a similar problem. `attempt` has the settings of the start. `is_factored` is True if the linear system of a warm
    start's first step is factored already. Multipliers that are all zero are estimated. Without bounds, a search from
    unknowns that grossly violate the equations ends as "gross" without an iteration. `saddle_cost` is the cost at the
    saddle point next to which the search starts. The search then ends as "saddle point" as soon as it clearly reaches
    no lower cost.
    """
    work = search.work
    reals, integers = work.reals, work.integers
    # Escapes from a saddle point keep the flag of the search that has led there.
    is_beside = integers[workspace.IS_BESIDE] if stage == WITH_ITERATE else 0
    reals[:], integers[:], integers[workspace.IS_BESIDE] = 0.0, 0, is_beside
    integers[workspace.FOLLOWED] = search.relaxation is not None
    if stage == WITH_ITERATE:
        load(search, start)
    else:
        work.vectors[workspace.X] = start
        reals[workspace.MU], reals[workspace.PUSH] = attempt.weight if search.is_bounded else 0.0, attempt.push
        integers[workspace.ON_PATH], integers[workspace.LOOKS] = attempt.on_path, 1
        if search.relaxation is not None:
            search.relaxation.follow(0.0 if stage == WITH_NEIGHBOUR else attempt.weight, tolerance)
    if stage == WITH_NEIGHBOUR:
        problem, data, _, bounds = search.arguments
        reals[workspace.LEAST_RELAXATION], integers[workspace.IS_FACTORED] = search.least, is_factored
        first_iterate.begin_beside(problem, data, bounds, tolerance, reals, integers, work.vectors, work.barriers)
        stage, is_factored = WITH_ITERATE, integers[workspace.IS_FACTORED]
    if stage == WITH_ITERATE and search.relaxation is not None:
        load(search, with_relaxation(search, tolerance))
    integers[workspace.STAGE] = stage
    reals[workspace.SHORTEST], reals[workspace.FUNNEL] = attempt.shortest, attempt.funnel
    reals[workspace.LEAST_RELAXATION] = search.least
    integers[workspace.IS_FACTORED] = is_factored
    integers[workspace.IS_COSTLESS] = search.grid.problem.structure.costless
    if saddle_cost is not None:
        reals[workspace.KNOWN], integers[workspace.HAS_KNOWN] = saddle_cost, 1
    marked, until, aside = None, BETWEEN_MARKS, 0
    while True:
        status, is_late = run(search, tolerance, max_iterations, log, until)
        iterations = int(integers[workspace.ITERATIONS])
        if status == GROSS:
            return "gross", stored(search), 0
        if status == WEIGHT:
            load(search, with_relaxation(search, tolerance))
            continue
        if status == CURVED:
            iterate, aside = step_aside(search, stored(search)), aside + 1
            if iterate.point.error < np.inf:
                load(search, iterate)
            integers[[workspace.REFUSED, workspace.IN_TURN, workspace.SHORTENED, workspace.WATCHING]] = 0
            integers[workspace.PAIRS], integers[workspace.SHIFTED] = 1, 0 if aside < ASIDE_AT_MOST else NEVER
            continue
        if status == RESTORE:
            iterate = stored(search)
            outcome, feasible = restored(search, iterate, 0.9, work.pairs[: integers[workspace.PAIRS]], log)
            if outcome in UNLUCKY and integers[workspace.HAS_LOOSE] == 1 and search.relaxation is None:
                # If equations force unknowns onto their bounds and all multipliers are huge, only the relaxation gives
                # the feasible set an interior. Continue, as IPOPT does, with bounds as relaxed as at the beginning.
                # Contact laws have an interior, and may be no more relaxed than the bounds.
                search = search._replace(least=direction.RELAXED)
                reals[workspace.LEAST_RELAXATION], integers[workspace.HAS_LOOSE] = search.least, 2
                barriers = work.barriers[workspace.LOOSE_DISTANCE], work.barriers[workspace.LOOSE_DUALS]
                point = evaluate(search.grid, work.vectors[workspace.LOOSE_X].copy())
                load(search, Iterate(point, reals[workspace.LOOSE_MU], *barriers))
                integers[workspace.PAIRS] = 1
                integers[[workspace.REFUSED, workspace.IN_TURN, workspace.SHORTENED, workspace.WATCHING]] = 0
                continue
            if outcome != "restored":
                return outcome, feasible if outcome == "infeasible" else iterate, iterations
            load(search, with_least_squares_multipliers(search, feasible))
            integers[workspace.ITERATIONS] += 1
            if integers[workspace.ITERATIONS] > max_iterations:
                return "iteration limit", stored(search), max_iterations
            continue
        if status == CONTINUE and iterations < max_iterations:
            if is_late:
                return "time limit", stored(search), iterations
            if iterations >= until:
                before, until = reals[FIRST] if marked is None else marked, iterations + BETWEEN_MARKS
                marked = reals[MARKED]
                (mu, cost, violation, error), (new_mu, new_cost, new_violation, new_error) = before, marked
                is_same = new_mu == mu and abs(new_cost - cost) <= UNCHANGED * max(1.0, abs(cost))
                least_violation = min(HALVED * violation, descent.ROUNDED)
                if is_same and new_error > HALVED * error and new_violation > least_violation:
                    return "stalled", stored(search), iterations
            continue
        return WORDS[status], stored(search), iterations


def run(search, tolerance, max_iterations, log, until):
    """Call the compiled search once, until the total of iterations is at most `until`, and log its iterates.

    Return the status as a number of `descent`, and True if the time limit has passed.
    """
    grid, work = search.grid, search.work
    before, affordable = int(work.integers[workspace.ITERATIONS]), WORK_PER_CALL // max(1, grid.is_multiplier.size)
    most = log.iterations_per_call(before, work.log.shape[0] - 1, max(1, min(affordable, until - before)))
    while True:
        status = descent.descend(
            *search.arguments, tolerance, max_iterations, most, work.reals, work.integers, work.vectors, work.barriers,
            work.pairs, work.room, work.log,
        )  # fmt: skip
        if status != ROOM:
            break
        work.room_for_refinement()
        # The next call writes its rows from the first row on.
        count = int(work.integers[workspace.ITERATIONS]) - before
        log.extend(search, work.log[:count])
        before, most = before + count, max(1, most - count)
    if status == GROSS:
        return status, False
    count = int(work.integers[workspace.ITERATIONS]) - before
    # The next call writes the log row of the last iterate again, because it continues from there.
    is_over = status not in (CONTINUE, WEIGHT, CURVED) or int(work.integers[workspace.ITERATIONS]) >= max_iterations
    log.extend(search, work.log[: count + 1 if is_over else count])
    is_late = log.is_late()
    if is_late and not is_over:
        log.extend(search, work.log[count : count + 1])
    return status, is_late


def restored(search, iterate, reduction, pairs, log, is_optional=False):
    """Lower the constraint violation from an iterate; return (status, iterate) with the status "restored" on success.

    The iterate has no multipliers, and its duals are on the central path. The violation falls to at most `reduction`
    times its first value. `pairs` (k, 2) are the pairs (violation, objective) of the filter. See `restore` for
    `is_optional`.
    """
    status, feasible = restore(search, iterate, reduction, pairs, log.is_late, is_optional)
    if search.is_bounded:
        feasible = feasible._replace(mu=iterate.mu, duals=central_duals(iterate.mu, feasible.distance))
        feasible = feasible._replace(point=measured_point(search, feasible))
    return status, feasible
