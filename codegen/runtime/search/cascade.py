"""The globalisation cascade: searches for a local minimum from several starts, and escapes from saddle points.

A search may end at a saddle point of the cost on the set where the equations hold. Two searches then start on both
sides of the saddle point, along the direction of most negative curvature.

An interior-point method relaxes bounds. At its end, unknowns outside their bounds are moved onto the bounds. With steep
equations or large multipliers, even a move of 1e-12 makes the optimality conditions less accurate. Newton's steps of
the barrier problem without relaxation then restore the accuracy.
"""

import numpy as np
from numba import njit

from codegen.runtime.search import first_iterate, optimality
from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.curvature import barrier_curvature, escape_steps
from codegen.runtime.search.first_iterate import FROM_AFAR, begin_beside
from codegen.runtime.search.grid import free_unknowns, views
from codegen.runtime.search.iterates import (
    CASCADE,
    CASCADE_WITH_BOUNDS,
    FROM_GUESS,
    FROM_NEIGHBOUR,
    NEARBY,
    begin,
    central_duals,
    keep_storage,
    measured_point,
    moved,
    newton_step,
    newton_system,
    on_grid,
    predicted_cost,
    search_on,
    stored,
    with_tied_values,
)
from codegen.runtime.search.linear_system import factor_kkt
from codegen.runtime.search.newton import UNLUCKY, descend, restored
from codegen.runtime.search.point import Point, evaluate
from codegen.runtime.search.restoration import NONE_HELD, least_violation
from codegen.runtime.search.termination import VIOLATED, is_at_rounding_level, is_solved
from codegen.runtime.search.workspace import IS_BESIDE, LEAST_RELAXATION, WITH_NEIGHBOUR, WITH_UNKNOWNS, X

BULGE = 0.1  # height of the curve that bends a guess, relative to the magnitude of each quantity
WAVES, AMPLITUDE = 3, 0.5  # number of sines in a varied guess; their standard deviation, relative to a quantity's size
WITHOUT_WAY = ("stalled", "infeasible", "rank-deficient")  # statuses after which the constraint violation is minimised
NEARBY_ITERATIONS = 100  # largest number of iterations from a feasible point near a grossly infeasible guess
FROM_ANYWHERE = np.array([[np.inf, -np.inf]])  # the pairs of a filter that accepts all points
ESCAPES = 3  # largest number of escapes from a saddle point
LEFT = ("solved", "saddle point", "unbounded")  # conclusive statuses of a search that starts next to a saddle point
LAST_STEPS = 3  # largest number of Newton steps without relaxation of bounds
WORSE = 2.0  # largest factor by which the move onto bounds may increase an error above the tolerance


def minimise(grid, unknowns, tolerance, max_iterations, warm, log, search=None, is_factored=False):
    """Find a local minimum; return (status, point, iterations).

    If the search from the guess fails, searches from other starts follow. If none succeeds, the outcome of the first
    search is returned.

    With `warm`, `unknowns` are the solution of a neighbour, a similar problem. The first search then keeps the
    neighbour's multipliers; without bounds it does so only if the residual is small. The next search drops the
    multipliers, begins with a small barrier weight and leaves unknowns close to their bounds.

    A row is appended to `log` at every iterate: cost, residual, stationarity, shift of the Hessian, step length, and
    with bounds the barrier's weight. `max_iterations` is the limit for all searches together, without the steps of
    restorations. `search` is the result of `search_on` for a grid with as many bounds, whose storage is used again.
    `is_factored` is True if `factor_nearby` has factored the linear system of the first step.
    """
    keeps_storage = search is None
    search = search_on(grid) if search is None else on_grid(search, grid)
    if (search.bounds.lower > search.bounds.upper).any():
        return "infeasible", evaluate(grid, unknowns), 0
    status, iterate, total = minimise_on(search, unknowns, tolerance, max_iterations, warm, log, is_factored)
    point = within_bounds(search, iterate, tolerance)
    if keeps_storage:
        keep_storage(search)
    return status, point, total


def minimise_on(search, unknowns, tolerance, max_iterations, warm, log, is_factored):
    """Return (status, iterate, iterations) like `minimise`, for a search whose bounds do not contradict each other."""
    grid, cascade = search.grid, CASCADE_WITH_BOUNDS if search.is_bounded else CASCADE
    guess = np.where(grid.is_multiplier, 0.0, unknowns)
    start, first, stage = guess, FROM_GUESS, WITH_UNKNOWNS
    if warm:
        start, first, stage = unknowns, FROM_NEIGHBOUR, WITH_NEIGHBOUR
    status, iterate, total = leave_saddles(
        search, start, first, tolerance, max_iterations, log, stage=stage, is_factored=is_factored
    )
    if warm and search.work.integers[IS_BESIDE]:
        cascade = FROM_NEIGHBOUR, *cascade
    if status == "gross":
        # A full Newton step to satisfy the equations could lead to a distant optimum. Begin at a nearly feasible point.
        begun = iterate
        status, iterate = restored(search, begun, NEARBY.nearby, FROM_ANYWHERE, log, is_optional=True)
        if status == "restored":
            limit = min(max_iterations // 2, NEARBY_ITERATIONS)
            status, iterate, total = leave_saddles(search, iterate, NEARBY, tolerance, limit, log)
        if status not in ("solved", "time limit"):
            remaining = max_iterations - total
            status, iterate, iterations = leave_saddles(search, begun, first, tolerance, remaining, log)
            total += iterations
    if status == "solved":
        return status, iterate, total
    outcome = status, iterate
    for attempt in cascade:
        if outcome[0] not in UNLUCKY or total >= max_iterations:
            break
        begun = begin(search, bulged_guess(grid, guess, attempt.bulge), attempt)
        status, iterate = "restored", begun
        if attempt.nearby < 1.0 and begun.point.error < np.inf:
            status, iterate = restored(search, begun, attempt.nearby, FROM_ANYWHERE, log)
        if status == "restored":
            remaining = max_iterations - total
            status, iterate, iterations = leave_saddles(search, iterate, attempt, tolerance, remaining, log)
            total += iterations
        if outcome[0] == "rank-deficient" and status == "infeasible" and iterate.point.residual > tolerance:
            outcome = status, iterate  # "infeasible" says more: contradictory equations are also rank-deficient
        if status == "solved":
            break
    if status != "solved":
        status, iterate = outcome
    if status in WITHOUT_WAY and iterate.point.residual > VIOLATED and total < max_iterations:
        start = (begin_nearby(search, unknowns, tolerance) if warm else None) or begin(search, guess, first)
        remaining = max_iterations - total
        status, iterate, iterations = from_least_violation(search, iterate, start, status, tolerance, remaining, log)
        total += iterations
    return status, iterate, total


def from_least_violation(search, iterate, guess, status, tolerance, max_iterations, log):
    """Minimise the violation near an iterate and near the guess; return (status, iterate, iterations).

    If the least violation is zero, a last search begins there. This helps if earlier searches have lowered the cost,
    such as a duration, below the cost of all feasible motions. If the least violation is not zero, the equations hold
    nowhere near the iterate, and the status is "infeasible". `status` is the status of the earlier searches.
    """
    outcome, total = None, 0
    for start, held in violating_starts(search, iterate, guess):
        result, least = least_violation(search, start, tolerance, log.is_late, held)
        if result == "restored":
            if search.is_bounded:
                weight = CASCADE[0].weight  # the weight of the restoration is tiny at its end
                least = least._replace(mu=weight, duals=central_duals(weight, least.distance))
                least = least._replace(point=measured_point(search, least))
            remaining = max_iterations - total
            last_status, last, iterations = leave_saddles(search, least, CASCADE[0], tolerance, remaining, log)
            total += iterations
            if last_status == "solved":
                return last_status, last, total
            outcome = "stalled" if status == "infeasible" else status, iterate  # there is a feasible point
        elif result == "infeasible" and outcome is None and status != "rank-deficient":
            outcome = result, least
    return *(outcome or (status, iterate)), total


def violating_starts(search, iterate, guess):
    """Yield pairs (iterate, slice of unknowns that stay fixed) from which the constraint violation is minimised.

    Linking variables, such as a duration, may fall to values without a feasible motion before the motion itself changes
    much. One start therefore keeps the linking variables fixed. At a symmetric guess, the violation may be stationary
    but not minimal. The last start is therefore bent.
    """
    grid = search.grid
    yield iterate, NONE_HELD
    yield guess, NONE_HELD
    if grid.problem.structure.root:
        yield guess, slice(grid.is_multiplier.size - grid.problem.structure.root, None)
    bent = bulged_guess(grid, np.where(grid.is_multiplier, 0.0, guess.point.unknowns), BULGE)
    yield begin(search, bent, CASCADE[0]), NONE_HELD


def bulged_guess(grid, unknowns, part):
    """Return `unknowns` (n,) with a half sine wave added to each quantity between the ends.

    The height is the fraction `part` of the magnitude of the quantity, or of a tenth of the largest magnitude if that
    is more. If all unknowns are zero, the largest magnitude counts as one.
    """
    if part == 0.0:
        return unknowns
    bulge, largest = np.zeros_like(unknowns), np.abs(unknowns).max(initial=0.0) or 1.0
    for changes, values in zip(views(grid, bulge), views(grid, np.abs(unknowns)), strict=True):
        sizes = np.maximum(values.max(axis=1, initial=0.0), 0.1 * largest)
        changes[:] = part * sizes[:, None] * np.sin(np.pi * np.linspace(0.0, 1.0, changes.shape[1]))[:, None]
    return np.where(free_unknowns(grid) & ~grid.is_multiplier, unknowns + bulge, unknowns)


def varied_guess(grid, unknowns, seed):
    """Return a guess (n,) with a random smooth curve added to every quantity: a sum of a few sines, zero at both ends.

    Prescribed values, multipliers and linking variables, such as a free duration, stay the same. If the guess is zero
    everywhere, the curves have a magnitude of one.
    """
    rng, root, is_changed = np.random.default_rng(seed), grid.problem.structure.root, ~grid.is_multiplier
    is_changed[unknowns.size - root :] = False
    is_changed &= free_unknowns(grid)
    least = 0.3 * np.abs(unknowns[is_changed]).max(initial=0.0) or 1.0
    change, waves = np.zeros_like(unknowns), np.arange(1, WAVES + 1)
    for values, curves in zip(views(grid, unknowns), views(grid, change), strict=True):
        sines = np.sin(np.pi * waves[:, None] * np.linspace(0.0, 1.0, values.shape[1]))
        for body in range(values.shape[0]):
            for index in range(values.shape[2]):
                size = max(np.abs(values[body, :, index]).max(), least)
                curves[body, :, index] = AMPLITUDE * size * ((rng.standard_normal(WAVES) / waves) @ sines)
    return np.where(is_changed, unknowns + change, unknowns)


def longer_guess(grid, unknowns, factor):
    """Return a guess (n,) with each free duration multiplied by `factor`, or up to its bound.

    These are the linking variables that make the motion, or a phase, longer. The motion keeps its shape.
    """
    durations, longer = grid.problem.phase_durations or grid.problem.duration_of, unknowns.copy()
    _, upper = bounds_of(grid)
    for i in range(unknowns.size - grid.problem.structure.root, unknowns.size):
        changed = unknowns.copy()
        changed[i] *= factor
        if not grid.is_multiplier[i] and np.max(durations(grid, changed) - durations(grid, unknowns)) > 0.0:
            longer[i] = min(changed[i], max(unknowns[i], upper[i]))
    return longer


def leave_saddles(search, start, attempt, tolerance, max_iterations, log, **how):
    """Search for a minimum; from a saddle point, search again on both sides, each time farther away.

    Arguments and result are the same as for `newton.descend`. If no search leads to a lower cost, the point does not
    count as a saddle point. The reason may be multipliers that are not unique: the Hessian at a minimum may then be
    indefinite.
    """
    status, saddle, total = descend(search, start, attempt, tolerance, max_iterations, log, **how)
    grid, has_failed, escapes = search.grid, False, 0
    while status == "saddle point" and escapes < ESCAPES and total < max_iterations:
        saddle_cost, unknowns = predicted_cost(search, saddle), saddle.point.unknowns
        for step in escape_steps(grid, unknowns, barrier_curvature(search, saddle), escapes):
            beside = begin(search, np.where(grid.is_multiplier, 0.0, unknowns + step), attempt)
            remaining = max_iterations - total
            outcome, other, iterations = descend(search, beside, attempt, tolerance, remaining, log, saddle_cost)
            total += iterations
            if outcome in LEFT and is_below(predicted_cost(search, other), saddle_cost):
                status, saddle = outcome, other
                break
            has_failed = has_failed or outcome not in LEFT
        escapes += 1
    if status == "saddle point" and escapes == ESCAPES and not has_failed:
        is_optimal = is_solved(grid, saddle.point, tolerance) or is_at_rounding_level(grid, saddle.point)
        status = "solved" if is_optimal else "stalled"
    return status, saddle, total


def is_below(cost, saddle_cost):
    """Return True if `cost` is lower than the cost at a saddle point by more than rounding errors."""
    return cost < saddle_cost - 1e-9 * max(1.0, abs(saddle_cost))


def begin_nearby(search, unknowns, tolerance):
    """Return the warm start at `unknowns` (n,), the solution of a similar problem; see `first_iterate.begin_beside`.

    Return None if the multipliers of that solution are unusable.
    """
    work, (problem, data, _, bounds) = search.work, search.arguments
    work.vectors[X], work.reals[LEAST_RELAXATION] = unknowns, search.least
    begin_beside(problem, data, bounds, tolerance, work.reals, work.integers, work.vectors, work.barriers)
    return stored(search) if work.integers[IS_BESIDE] else None


def factor_nearby(grid, unknowns, tolerance, search):
    """Factor the linear system of the first step from the solution of a similar problem, before the search begins.

    `unknowns` (n,) is this solution. `search` is the result of `search_on` for a grid with as many bounds; its storage
    takes the factors. Return True if a first step from these or from similar unknowns can use the factors, because the
    reduced Hessian is positive definite.
    """
    search = on_grid(search, grid)
    iterate = begin_nearby(search, unknowns, tolerance)
    if iterate is None or iterate.mu == FROM_AFAR[0]:
        return False
    _, diagonal = newton_system(search, iterate, iterate.point.gradient, 0.0, 0.0)
    return factor_kkt(grid, iterate.point.unknowns, 1.0, diagonal, search.system) == 0


def within_bounds(search, iterate, tolerance):
    """Return the point of an iterate with unknowns moved inside their bounds, and with its errors.

    The point remains unchanged if the move makes it less accurate.
    """
    point = iterate.point
    if not (search.is_bounded and point.error < np.inf):
        return point
    clipped = inside = on_bounds(search, iterate)
    for _ in range(LAST_STEPS):
        if inside.error <= max(tolerance, WORSE * point.error):
            return inside
        iterate = last_step(search, iterate)
        if iterate is None:
            break
        inside = on_bounds(search, iterate)
    best = min(inside, clipped, key=lambda candidate: candidate.error)
    return best if best.residual <= max(tolerance, WORSE * point.residual) else point


def on_bounds(search, iterate):
    """Return the point of an iterate with unknowns beyond a bound moved onto the bound.

    Its stationarity includes the duals of bounds.
    """
    unknowns, gradient = iterate.point.unknowns.copy(), iterate.point.gradient.copy()
    problem, data, _, bounds = search.arguments
    measures = clip(
        problem, data, bounds, iterate.point[2:], iterate.distance, iterate.duals, search.work.vectors, unknowns,
        gradient,
    )  # fmt: skip
    return Point(unknowns, gradient, *measures)


@njit(cache=True, error_model="numpy")
def clip(problem, grid, bounds, known, distance, duals, vectors, unknowns, gradient):
    """Move `unknowns` (n,) that are beyond a bound onto the bound, and evaluate again.

    Return (cost, residual, violation, stationarity, error). `known` are these numbers, and `gradient` (n,) the
    gradient, before the move.
    """
    indices, lower, upper, moves, measures = bounds[0], bounds[4], bounds[5], False, known
    first_iterate.add_linking(grid, -1.0, unknowns)
    for i in indices:
        clipped = min(max(unknowns[i], lower[i]), upper[i])
        moves = moves or clipped != unknowns[i]
        unknowns[i] = clipped
    first_iterate.add_linking(grid, 1.0, unknowns)
    if moves:
        measures, _ = optimality.evaluated(problem, grid, bounds, unknowns, gradient, distance, duals, vectors)
    else:
        measures, _ = optimality.measured_again(bounds, grid[4], known, unknowns, gradient, distance, duals, vectors)
    return measures


def last_step(search, iterate):
    """Return the iterate after a Newton step of the barrier problem with unrelaxed bounds; None if there is no step.

    An unknown that is closer to its bound than the relaxation keeps its distance and is moved instead. Its
    complementarity then does not change.
    """
    grid, bounds, unknowns = search.grid, search.bounds, iterate.point.unknowns.copy()
    distance = bounds.side * (unknowns[bounds.indices] - bounds.value)
    relaxed = iterate.distance - distance
    close = np.flatnonzero(distance < relaxed)
    unknowns[bounds.indices[close]] += (bounds.side * relaxed)[close]
    distance[close] = iterate.distance[close]
    unknowns = with_tied_values(grid, unknowns)
    mu = iterate.duals @ distance / max(1, distance.size)
    iterate = iterate._replace(point=evaluate(grid, unknowns), mu=mu, distance=distance)
    step = newton_step(search, iterate)
    return None if step is None else moved(search, iterate, step, step.longest)
