"""The globalisation cascade: searches for a local minimum that begin in other ways where those before them failed.

Saddle points of the cost on the set where the equations hold: directions of negative curvature and escape steps.

The end of an interior-point method: bounds, which were relaxed on the way, hold exactly.

An unknown that is outside its bound, by the relaxation, is moved onto it. Where equations are steep or multipliers
large, even a move of 1e-12 costs digits of the optimality conditions. Newton's steps of the barrier problem without
relaxation then lead back to its optimum.
"""

import numpy as np
from numba import njit

from codegen.runtime.search import descent
from codegen.runtime.search.descent import (
    FLAT,
    FROM_AFAR,
    IS_BESIDE,
    LEAST_RELAXATION,
    WITH_NEIGHBOUR,
    WITH_UNKNOWNS,
    X,
    begin_beside,
)
from codegen.runtime.search.grid import free_unknowns, views
from codegen.runtime.search.iterates import (
    CASCADE,
    CASCADE_WITH_BOUNDS,
    FROM_GUESS,
    FROM_NEIGHBOUR,
    NEARBY,
    barrier_curvature,
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
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, solve_kkt
from codegen.runtime.search.newton import UNLUCKY, descend, restored
from codegen.runtime.search.point import Point, evaluate
from codegen.runtime.search.restoration import NONE_HELD, least_violation
from codegen.runtime.search.termination import VIOLATED, is_at_rounding_level, is_solved

INVERSE_ITERATIONS = 4
ESCAPES = 3  # how often a saddle point is left
LEFT = ("solved", "saddle point", "unbounded")  # ends of a descent beside a saddle point that tell about it


def least_delta_w(grid, unknowns, system, curvature=0.0):
    """Return a delta_w that makes the Hessian on the equations' null space positive definite, and factor with it.

    `curvature` is added to the diagonal first. The result is at most ten times as much as is needed, and infinite where
    none is enough.
    """
    delta_w = FLAT
    while delta_w < 1e20:
        diagonal = np.where(grid.is_multiplier, -FLAT, delta_w + curvature)
        if factor_kkt(grid, unknowns, 1.0, diagonal, system) == 0:
            return delta_w
        delta_w *= 10.0
    return np.inf


def negative_curvature_direction(grid, unknowns, curvature=0.0):
    """Return the direction (n,) of most negative curvature while the equations hold to first order.

    By inverse iteration with the shifted KKT matrix from a fixed random vector; zero where no shift helps. `curvature`
    is what a barrier adds to the Hessian's diagonal.
    """
    system = allocate_system(grid)
    direction = np.random.default_rng(1).uniform(0.5, 1.0, unknowns.size)
    if least_delta_w(grid, unknowns, system, curvature) == np.inf:
        return np.zeros(unknowns.size)
    free = free_unknowns(grid) & ~grid.is_multiplier
    for _ in range(INVERSE_ITERATIONS):
        right = np.where(free, direction / np.abs(direction[free]).max(initial=1e-300), 0.0)
        direction = np.empty(unknowns.size)
        solve_kkt(grid, system, right, direction)
    return np.where(free, direction, 0.0)


def is_below(cost, saddle_cost):
    """Return True if a cost is lower than at a saddle point, by more than rounding."""
    return cost < saddle_cost - 1e-9 * max(1.0, abs(saddle_cost))


def escape_steps(grid, unknowns, curvature, escapes):
    """Return steps along the falling direction to both sides; the more escapes there were, the longer.

    The first change each quantity by a tenth of its greatest value at most, or of one where that is smaller: a large
    one says nothing about how far the others may go.
    """
    direction, sizes = negative_curvature_direction(grid, unknowns, curvature), np.maximum(1.0, np.abs(unknowns))
    for own in views(grid, sizes):
        own[:] = own.max(axis=1, initial=1.0)[:, None]
    direction *= 0.1 * 3.0**escapes / max((np.abs(direction) / sizes).max(initial=0.0), 1e-300)
    return direction, -direction


LAST_STEPS = 3
WORSE = 2.0  # largest growth of an error above the tolerance


def within_bounds(search, iterate, tolerance):
    """Return the point of an iterate inside its bounds, with its errors, or as it is if that costs accuracy."""
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
    best = min(inside, clipped, key=lambda found: found.error)
    return best if best.residual <= max(tolerance, WORSE * point.residual) else point


def on_bounds(search, iterate):
    """Return the point with unknowns beyond a bound moved onto it, and its stationarity with the duals of bounds."""
    unknowns, gradient = iterate.point.unknowns.copy(), iterate.point.gradient.copy()
    problem, data, _, bounds = search.arguments
    measures = clip(
        problem, data, bounds, iterate.point[2:], iterate.distance, iterate.duals, search.work.vectors, unknowns,
        gradient,
    )  # fmt: skip
    return Point(unknowns, gradient, *measures)


@njit(cache=True, error_model="numpy")
def clip(problem, grid, bounds, known, distance, duals, vectors, unknowns, gradient):
    """Move those of `unknowns` (n,) that are beyond a bound onto it, and evaluate; return the measures of a point.

    `known` are those of a point at the unknowns with this `gradient` (n,).
    """
    indices, lower, upper, moves, measures = bounds[0], bounds[4], bounds[5], False, known
    for i in indices:
        clipped = min(max(unknowns[i], lower[i]), upper[i])
        moves = moves or clipped != unknowns[i]
        unknowns[i] = clipped
    if moves:
        descent.tie(grid, unknowns)
        measures, _ = descent.evaluated(problem, grid, bounds, unknowns, gradient, distance, duals, vectors)
    else:
        measures, _ = descent.measured_again(bounds, grid[4], known, unknowns, gradient, distance, duals, vectors)
    return measures


def last_step(search, iterate):
    """Return the iterate after a Newton step of the barrier problem with unrelaxed bounds; None if there is no step.

    An unknown that is no farther from its bound than by the relaxation keeps its distance, and is moved instead, so
    that complementarities stay as they are.
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


BULGE = 0.1  # part of its size by which a guess is bent
WAVES, AMPLITUDE = 3, 0.5  # of a varied guess: sines in a curve, their standard deviation in units of a quantity's size
WITHOUT_WAY = ("stalled", "infeasible", "rank-deficient")  # after these the violation itself is minimised

NEARBY_ITERATIONS = 100  # largest number for a search from a point near such a guess
FROM_ANYWHERE = np.array([[np.inf, -np.inf]])  # the pairs of a filter that accepts everything


def minimise(grid, unknowns, tolerance, max_iterations, warm, log, search=None, is_factored=False):
    """Find a local minimum; return (status, point, iterations).

    Where the search from the guess fails, a globalisation cascade follows: searches that begin in other ways. If none
    succeeds, the end of the first one is reported. With `warm`, unknowns are the solution of a neighbour: the first
    search keeps its multipliers, without bounds only where it is near, and the next, without them, begins with a
    small weight of the barrier and leaves unknowns close to their bounds. A row (cost, residual, stationarity,
    Hessian's shift, step length) is appended to `log` at every iterate, and the barrier's weight where there is
    one. `max_iterations` is for all searches together; steps of the restoration are not counted. `search` is what
    `search_on` gave for a grid with as many bounds, if there was one: its storage serves again. `is_factored`:
    `factor_nearby` has factored its linear system for unknowns beside these, and the first step takes its factors.
    """
    is_passing = search is None
    search = search_on(grid) if is_passing else on_grid(search, grid)
    if (search.bounds.lower > search.bounds.upper).any():
        return "infeasible", evaluate(grid, unknowns), 0
    found = minimise_on(search, unknowns, tolerance, max_iterations, warm, log, is_factored)
    if is_passing:
        keep_storage(search)
    return found


def minimise_on(search, unknowns, tolerance, max_iterations, warm, log, is_factored=False):
    """Find a local minimum, as `minimise` does, of a search whose bounds do not contradict each other."""
    grid, cascade = search.grid, CASCADE_WITH_BOUNDS if search.is_bounded else CASCADE
    guess, first, stage = np.where(grid.is_multiplier, 0.0, unknowns), FROM_GUESS, WITH_UNKNOWNS
    start = guess
    if warm:
        start, first, stage = unknowns, FROM_NEIGHBOUR, WITH_NEIGHBOUR
    status, iterate, total = leave_saddles(
        search, start, first, tolerance, max_iterations, log, stage=stage, is_factored=is_factored
    )
    if warm and search.work.integers[IS_BESIDE]:
        cascade = FROM_NEIGHBOUR, *cascade
    if status == "gross":
        begun = iterate
        status, iterate, total = from_nearby(search, begun, tolerance, max_iterations, log)
        if status not in ("solved", "time limit"):
            left = max_iterations - total
            status, iterate, iterations = leave_saddles(search, begun, first, tolerance, left, log)
            total += iterations
    if status == "solved":
        return status, within_bounds(search, iterate, tolerance), total
    ended = status, iterate
    for attempt in cascade:
        if ended[0] not in UNLUCKY or total >= max_iterations:
            break
        beside = begin(search, bulged_guess(grid, guess, attempt.bulge), attempt)
        status, iterate = "restored", beside
        if attempt.nearby < 1.0 and beside.point.error < np.inf:
            status, iterate = restored(search, beside, attempt.nearby, FROM_ANYWHERE, log)
        if status == "restored":
            left = max_iterations - total
            status, iterate, iterations = leave_saddles(search, iterate, attempt, tolerance, left, log)
            total += iterations
        if ended[0] == "rank-deficient" and status == "infeasible" and iterate.point.residual > tolerance:
            ended = status, iterate  # equations that contradict each other are dependent as well
        if status == "solved":
            break
    if status != "solved":
        status, iterate = ended
    if status in WITHOUT_WAY and iterate.point.residual > VIOLATED and total < max_iterations:
        left = max_iterations - total
        start = (begin_nearby(search, unknowns, tolerance) if warm else None) or begin(search, guess, first)
        status, iterate, iterations = from_least_violation(search, iterate, start, status, tolerance, left, log)
        total += iterations
    return status, within_bounds(search, iterate, tolerance), total


def from_least_violation(search, iterate, guess, status, tolerance, max_iterations, log):
    """Minimise the violation near an iterate and the guess; return (status, iterate, iterations).

    If the least violation is zero, a last search begins there: earlier ones may have lowered the cost, as a duration,
    below that of all feasible motions. Otherwise the equations hold nowhere near the iterate, and the status is
    "infeasible".
    """
    ended, total = None, 0
    for start, held in violating_starts(search, iterate, guess):
        found, least = least_violation(search, start, tolerance, log.is_late, held)
        if found == "restored":
            if search.is_bounded:
                weight = CASCADE[0].weight  # that of the restoration is tiny in the end
                least = least._replace(mu=weight, duals=central_duals(weight, least.distance))
                least = least._replace(point=measured_point(search, least))
            left = max_iterations - total
            tried, last, iterations = leave_saddles(search, least, CASCADE[0], tolerance, left, log)
            total += iterations
            if tried == "solved":
                return tried, last, total
            ended = "stalled" if status == "infeasible" else status, iterate  # something does obey them
        elif found == "infeasible" and ended is None and status != "rank-deficient":
            ended = found, least
    return *(ended or (status, iterate)), total


def violating_starts(search, iterate, guess):
    """Yield iterates near which the equations may hold, with the unknowns that are to stay as they are.

    Shared ones, as a duration, may fall to where no motion obeys while the motion itself has hardly begun to. A guess
    that is symmetric may be stationary and no minimum, so that the last one is bent.
    """
    grid = search.grid
    yield iterate, NONE_HELD
    yield guess, NONE_HELD
    if grid.problem.structure.root:
        yield guess, slice(grid.is_multiplier.size - grid.problem.structure.root, None)
    bent = bulged_guess(grid, np.where(grid.is_multiplier, 0.0, guess.point.unknowns), BULGE)
    yield begin(search, bent, CASCADE[0]), NONE_HELD


def from_nearby(search, guess, tolerance, max_iterations, log):
    """Return (status, iterate, iterations) of a search from a point near the guess that nearly obeys the equations.

    A full Newton step, which knows of no distance, would leave for another optimum.
    """
    status, iterate = restored(search, guess, NEARBY.nearby, FROM_ANYWHERE, log)
    if status != "restored":
        return status, iterate, 0
    limit = min(max_iterations // 2, NEARBY_ITERATIONS)
    return leave_saddles(search, iterate, NEARBY, tolerance, limit, log)


def bulged_guess(grid, unknowns, part):
    """Return unknowns that bulge between the ends by a part of the size of each quantity, or of the largest one.

    Where all are zero, there is nothing to tell sizes from, and one will do.
    """
    if part == 0.0:
        return unknowns
    bulge, largest = np.zeros_like(unknowns), np.abs(unknowns).max(initial=0.0) or 1.0
    for own, values in zip(views(grid, bulge), views(grid, np.abs(unknowns)), strict=True):
        sizes = np.maximum(values.max(axis=1, initial=0.0), 0.1 * largest)
        own[:] = part * sizes[:, None] * np.sin(np.pi * np.linspace(0.0, 1.0, own.shape[1]))[:, None]
    return np.where(free_unknowns(grid) & ~grid.is_multiplier, unknowns + bulge, unknowns)


def varied_guess(grid, unknowns, seed):
    """Return a guess (n,) with a random smooth curve added to every quantity: a sum of a few sines, zero at both ends.

    What is given stays, and so do multipliers and linking variables, such as a free duration. A guess that is zero all
    over has no size, and curves of the size of one are added to it.
    """
    rng, root, is_changed = np.random.default_rng(seed), grid.problem.structure.root, ~grid.is_multiplier
    is_changed[unknowns.size - root :] = False
    is_changed &= free_unknowns(grid)
    least = 0.3 * np.abs(unknowns[is_changed]).max(initial=0.0) or 1.0
    change, waves = np.zeros_like(unknowns), np.arange(1, WAVES + 1)
    for own, curves in zip(views(grid, unknowns), views(grid, change), strict=True):
        sines = np.sin(np.pi * waves[:, None] * np.linspace(0.0, 1.0, own.shape[1]))
        for body in range(own.shape[0]):
            for index in range(own.shape[2]):
                size = max(np.abs(own[body, :, index]).max(), least)
                curves[body, :, index] = AMPLITUDE * size * ((rng.standard_normal(WAVES) / waves) @ sines)
    return np.where(is_changed, unknowns + change, unknowns)


def leave_saddles(search, start, attempt, tolerance, max_iterations, log, **how):
    """Descend; where that ends in a saddle point go on beside it, to either side, and ever farther away from it.

    Where there is no way down it was none: multipliers that are not unique may belong to an indefinite Hessian.
    """
    status, saddle, total = descend(search, start, attempt, tolerance, max_iterations, log, **how)
    failed, escapes = False, 0
    while status == "saddle point" and escapes < ESCAPES and total < max_iterations:
        known = predicted_cost(search, saddle)
        for beside in escaping_iterates(search, saddle, attempt, escapes):
            ended, other, iterations = descend(search, beside, attempt, tolerance, max_iterations - total, log, known)
            total += iterations
            if ended in LEFT and is_below(predicted_cost(search, other), known):
                status, saddle = ended, other
                break
            failed = failed or ended not in LEFT
        escapes += 1
    if status == "saddle point" and escapes == ESCAPES and not failed:
        grid, point = search.grid, saddle.point
        is_over = is_solved(grid, point, tolerance) or is_at_rounding_level(grid, point)
        status = "solved" if is_over else "stalled"
    return status, saddle, total


def escaping_iterates(search, saddle, attempt, escapes):
    """Yield iterates to both sides of a saddle point, along the direction of most negative curvature."""
    grid, unknowns = search.grid, saddle.point.unknowns
    curvature = barrier_curvature(search, saddle)
    for step in escape_steps(grid, unknowns, curvature, escapes):
        yield begin(search, np.where(grid.is_multiplier, 0.0, unknowns + step), attempt)


def begin_nearby(search, unknowns, tolerance):
    """Return the warm start at a neighbour's unknowns, with its multipliers, or None; see `descent.begin_beside`."""
    work, (problem, data, _, bounds) = search.work, search.arguments
    work.vectors[X], work.reals[LEAST_RELAXATION] = unknowns, search.least
    begin_beside(problem, data, bounds, tolerance, work.reals, work.integers, work.vectors, work.barriers)
    return stored(search) if work.integers[IS_BESIDE] else None


def factor_nearby(grid, unknowns, tolerance, search):
    """Factor the linear system of the first step from a neighbour's unknowns, or from others beside them, beforehand.

    `search` is what `search_on` gave for a grid with the same bounds; it has the factors. Return True if such a step
    can take them: the reduced Hessian is positive definite as it is.
    """
    search = on_grid(search, grid)
    iterate = begin_nearby(search, unknowns, tolerance)
    if iterate is None or iterate.mu == FROM_AFAR[0]:
        return False
    _, diagonal = newton_system(search, iterate, iterate.point.gradient, 0.0, 0.0)
    return factor_kkt(grid, iterate.point.unknowns, 1.0, diagonal, search.system) == 0
