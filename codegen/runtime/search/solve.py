"""Solve in multiples of scaling factors of unknowns and equations, which a change of units changes with them.

The same problem is solved in other units, those in which its numbers are of ordinary size (see `scaling`); where they
are that already, it is solved as it is.
"""

import numpy as np

from codegen.runtime.search import linear
from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.cascade import minimise
from codegen.runtime.search.convergence import is_solved
from codegen.runtime.search.forward_motion import forward_motion
from codegen.runtime.search.grid import plain_grid, with_pinned_values
from codegen.runtime.search.messages import describe
from codegen.runtime.search.point import evaluate, lagrangian
from codegen.runtime.search.scaling import with_sizes
from codegen.runtime.search.termination import VIOLATED, final_status, unscaled_unknowns

# How much steeper equations and cost may be, to powers of a thousand and a million, at the guess than at a solution.
COARSE, COARSE_COST = 3e3, 3e6
REFINEMENTS = 2  # sizes are measured again so often: two sets of them may each be coarse beside the other
WEIGHTY = 100.0  # mean multipliers above it make stationarity a sum of large terms: Waechter and Biegler (2006), (5)
LARGE_CORRECTION = 1e-3  # part of the cost
# In other sizes it may be solved, for which iterations beyond a number are kept.
FAILED = ("infeasible", "stalled", "rank-deficient", "non-finite", "unbounded", "iteration limit")
LONG = 1000
SLOW = 150  # iterations after which a search makes way for one that begins at a motion; most need 10 to 100
FROM_MOTION = 300  # for that one
STEEP = 1e-3  # slopes of the Lagrangian above it, in parts of the cost's or of one, belong to no optimum
ROUNDED, RUN_AWAY = 1e-8, 1e6  # residuals above it are none that hold, where an unknown is so many times as large
NOTHING = 1e-14  # what is below it, in parts of the size that it was given, is zero but for rounding


def optimise(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise in parts of sizes, unless `scaling` is "none"; return (status, message, point, iterations, scaled).

    `scaled` is the grid with the sizes in parts of which the search began.
    """
    if scaling not in ("auto", "none"):
        raise ValueError(f"scaling is {scaling!r}, expected 'auto' or 'none'")
    if grid.problem.structure.linear_quadratic:
        return optimise_linear(grid, unknowns, tolerance, log)
    known = evaluate(grid, np.where(grid.is_multiplier, 0.0, unknowns))
    if scaling == "auto":
        grid = with_sizes(grid, known)
    scaled, start, limit = grid, scaled_unknowns(grid, unknowns), max_iterations
    if grid.sizes.size:
        known, limit = None, min(max_iterations, LONG)
    if grid.problem.structure.forward and not warm:
        found = search_forward(grid, unknowns, tolerance, limit, max_iterations, scaling, log, known)
        status, scaled, start, point, iterations = found
        grid = scaled
    else:
        status, point, iterations = minimise(grid, start, tolerance, limit, warm, log, known)
    if grid.sizes.size and status == "solved":
        status, grid, start, point, further = refined(grid, start, point, tolerance, max_iterations - iterations, log)
        iterations += further
    status = verdict(scaled, grid, unknowns, point, status)
    if grid.sizes.size and status in FAILED and iterations < max_iterations:
        # Sizes come from the guess, and may be far from those of the solution.
        grid = plain_grid(grid)
        status, point, further = minimise(grid, unknowns, tolerance, max_iterations - iterations, warm, log)
        iterations += further
        status = verdict(scaled, grid, unknowns, point, status)
    own = unscaled_point(grid, point)
    status, message = describe(grid, unknowns, own, status)
    cost = corrected_cost(grid, point) if status == "solved" else own.cost
    return status, message, own._replace(cost=cost), iterations, scaled


def optimise_linear(grid, unknowns, tolerance, log):
    """Minimise a linear-quadratic problem, which needs no scaling: one Newton step is the same in all units."""
    status, point, iterations = linear.minimise(grid, unknowns, tolerance, log)
    status = final_status(grid, unknowns, point, status)
    status, message = describe(grid, unknowns, point, status)
    if status == "solved":
        point = point._replace(cost=float(lagrangian(grid, point)))
    return status, message, point, iterations, grid


def search_forward(grid, unknowns, tolerance, limit, max_iterations, scaling, log, known):
    """(status, grid, start, point, iterations) of a search that begins anew at a motion if it takes long or fails.

    That is the one under the controls of the guess `unknowns` (n,), with the sizes that things have there. Where no
    optimum is found from it either, the first search goes on, from its beginning and up to its own `limit`.
    """
    start = scaled_unknowns(grid, unknowns)
    status, point, total = minimise(grid, start, tolerance, min(limit, SLOW), False, log, known)
    if status not in FAILED or total >= max_iterations:
        return status, grid, start, point, total
    plain = plain_grid(grid)
    motion = forward_motion(plain, unknowns)
    if motion is not None:
        there = with_sizes(plain, evaluate(plain, motion)) if scaling == "auto" else plain
        begin, left = scaled_unknowns(there, motion), max_iterations - total
        if status == "iteration limit":
            left = min(left, FROM_MOTION)  # the first search may still get there
        ended, found, iterations = minimise(there, begin, tolerance, left, False, log)
        total += iterations
        if ended in ("solved", "time limit"):
            return ended, there, begin, found, total
    if status == "iteration limit" and total < max_iterations:
        left = min(limit, max_iterations - total)
        status, point, iterations = minimise(grid, start, tolerance, left, False, log, known)
        total += iterations
    return status, grid, start, point, total


def verdict(scaled, grid, guess, point, status):
    """The status that a search on a grid gave, or a better one, as `final_status` and `has_run_away` see it.

    Multipliers without limit would make any slope one of rounding. The guess (n,) is in the problem's own units.
    """
    if status == "solved" and point.stationarity > STEEP and point.stationarity > STEEP * steepest_cost(grid, point):
        status = "stalled"
    status = final_status(grid, scaled_unknowns(grid, guess), point, status)
    holds = grid is scaled and point.residual <= ROUNDED
    if status == "solved" and not holds and has_run_away(scaled, guess, unscaled_unknowns(grid, point.unknowns)):
        return "unbounded"
    return status


def steepest_cost(grid, point):
    """The largest slope of the cost."""
    bare = evaluate(grid, np.where(grid.is_multiplier, 0.0, point.unknowns))
    return np.abs(bare.gradient[~grid.is_multiplier]).max(initial=0.0)


def refined(grid, start, point, tolerance, max_iterations, log):
    """(status, grid, start, point, iterations) after a solution has been measured by the sizes that things have there.

    Where equations or the cost were far less steep at the guess, the tolerance means little, and the search goes on. If
    that fails, what was found is a solution only where all conditions nearly hold in the sizes that they have there.
    """
    total = 0
    for _ in range(REFINEMENTS if grid.sizes.size else 0):
        unknowns = unscaled_unknowns(grid, point.unknowns)
        # A coordinate that a constraint holds at zero has no size there, not that of its rounding.
        finer = scaled_grid(plain_grid(grid), np.where(np.abs(point.unknowns) < NOTHING, 0.0, unknowns))
        if not has_larger_derivatives(finer, grid):
            break
        begin = scaled_unknowns(finer, unknowns)
        same = evaluate(finer, begin)
        slope = slope_beside_bounds(finer, same)
        same = same._replace(stationarity=slope, error=max(same.residual, slope))
        if is_solved(finer, same, tolerance) or same.error <= tolerance:
            return "solved", finer, begin, same, total
        bare = np.where(grid.is_multiplier, 0.0, begin)  # multipliers were found by coarse measures
        status, better, iterations = minimise(finer, bare, tolerance, max_iterations - total, True, log)
        total += iterations
        if status != "solved":
            found = ("solved", grid, start, point) if same.error <= VIOLATED else (status, finer, begin, better)
            return *found, total
        grid, start, point = finer, begin, better
        if not grid.sizes.size:
            break
    return "solved", grid, start, point, total


def has_run_away(scaled, guess, unknowns):
    """Whether equations hold only but for the rounding of unknowns that are beyond anything the guess spoke of.

    Far out any residual is rounding, and a motion that ends there obeys nothing. Guess and unknowns are in the
    problem's own units, and have to be far apart in these and in parts of the sizes that the grid has from the guess,
    which may mean little: by those that they have out there nothing would be seen.
    """
    if not is_beyond(scaled, guess, unknowns, 0.0):
        return False
    guess, unknowns = scaled_unknowns(scaled, guess), scaled_unknowns(scaled, unknowns)
    return is_beyond(scaled, guess, unknowns, 1.0) and evaluate(scaled, unknowns).residual > ROUNDED


def is_beyond(grid, guess, unknowns, least):
    """Whether the largest unknown is far larger than the largest of the guess, and than `least`."""
    is_primal = ~grid.is_multiplier
    return np.abs(unknowns[is_primal]).max() > RUN_AWAY * max(least, np.abs(guess[is_primal]).max())


def slope_beside_bounds(grid, point):
    """The largest slope that no bound holds, beside multipliers: of bounds the duals are missing."""
    slope = np.where(grid.is_multiplier, 0.0, point.gradient)
    if grid.problem.variable_bounds is not None:
        lower, upper = bounds_of(grid)
        slope *= np.clip(np.where(slope > 0.0, point.unknowns - lower, upper - point.unknowns), 0.0, 1.0)
    mean = np.abs(point.unknowns[grid.is_multiplier]).mean()
    return float(np.abs(slope).max() / max(1.0, mean / WEIGHTY))


def has_larger_derivatives(finer, grid):
    """Whether a grid's forces, ones where it has no sizes, are far larger than those of a grid that has sizes."""
    large = finer.forces if finer.sizes.size else 1.0
    return (large > np.where(grid.is_multiplier, COARSE, COARSE_COST) * grid.forces).any()


def scaled_unknowns(grid, unknowns):
    """Unknowns in parts of sizes where the grid has them."""
    return unknowns / grid.sizes if grid.sizes.size else unknowns


def scaled_grid(grid, unknowns):
    """Return the grid with the scaling factors with which a solve from a guess (n,) begins.

    A linear-quadratic problem has none: one Newton step is the same in all units.
    """
    if grid.problem.structure.linear_quadratic:
        return grid
    return with_sizes(grid, evaluate(grid, np.where(grid.is_multiplier, 0.0, unknowns)))


def corrected_cost(grid, point):
    """The cost of an optimum, in its own units, less what residuals and distances to active bounds are worth.

    That is so to first order. A large correction belongs to multipliers without limit, as where equations force
    unknowns onto their bounds, and says nothing: the cost stays as it is.
    """
    corrected = lagrangian(grid, point)
    if grid.problem.variable_bounds is not None:
        corrected -= remaining_gap(point.unknowns, point.gradient, *bounds_of(grid))
    if abs(corrected - point.cost) > LARGE_CORRECTION * abs(point.cost):
        corrected = point.cost
    return float(corrected) / grid.weight


def remaining_gap(unknowns, gradient, lower, upper):
    """Return the sum of duals times distances of active bounds; the dual of a bound is the Lagrangian's slope there."""
    dual = np.abs(gradient)
    distance = np.where(gradient > 0.0, unknowns - lower, np.where(gradient < 0.0, upper - unknowns, np.inf))
    known = np.isfinite(distance)
    dual, distance = dual[known], distance[known]
    return float((dual * distance * (dual / (dual + np.abs(distance) + 1e-300))).sum())


def unscaled_point(grid, point):
    """A point in the problem's own units; its stationarity is the change of the cost with parts of sizes."""
    if not grid.sizes.size:
        return point
    stationarity = point.stationarity / grid.weight
    sizes, grid = grid.sizes, plain_grid(grid)
    point = evaluate(grid, with_pinned_values(grid, point.unknowns * sizes))
    return point._replace(stationarity=stationarity, error=max(point.residual, stationarity))
