"""Solve with scaling factors, which a change of units changes with the numbers of the problem.

The same problem is solved in other units, in which its numbers are ordinary (see `scaling`). A problem in ordinary
numbers is solved as it is.
"""

from functools import lru_cache

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example import (
    BODIES,
    COUPLINGS,
    FORWARD,
    INEQUALITIES,
    NODE,
    OWN,
    SHARED,
    STRIDE,
    TIED,
    variable_bounds,
    with_pinned_values,
)
from codegen.runtime.unknowns.time_grid import NONE, plain_grid
from codegen.runtime.optimise.messages import describe
from codegen.runtime.optimise.cascade import minimise
from codegen.runtime.optimise.active_bounds import bounds_of
from codegen.runtime.unknowns.point import evaluate, lagrangian
from codegen.runtime.unknowns.tied import with_tied_values
from codegen.runtime.optimise.forward_motion import forward_motion
from codegen.runtime.optimise.scaling import IS_SLACK, KIND, fill_scaling_factors
from codegen.runtime.optimise.termination import final_status, unscaled_unknowns

# How much steeper equations and cost may be at a solution than at the guess, to powers of a thousand and a million.
STEEPER, STEEPER_COST = 3e3, 3e6
RESCALINGS = 10  # how often a search goes on at most, as two sets of factors may each be coarse beside the other
LARGE_CORRECTION = 1e-3  # part of the cost
FAILED = ("infeasible", "stalled", "rank-deficient", "non-finite", "unbounded", "iteration limit")
if FORWARD:
    SLOW = 150  # iterations after which a search makes way for one that begins at a motion; most need 10 to 100
    FROM_MOTION = 300  # for that one
STEEP = 1e-3  # slopes of the Lagrangian above it, in parts of the cost's or of one, belong to no optimum
ROUNDED, RUN_AWAY = 1e-8, 1e6  # residuals above it are none that hold, where an unknown is so many times as large


def optimise(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise with scaling factors, unless `scaling` is "none"; return (status, message, point, iterations, scaled).

    `scaled` is the grid with the scaling factors of the guess. Equations or a cost with far larger factors at the guess
    than at the solution make the tolerance mean little. The search then goes on from the solution, with the factors
    there. After a failure the problem is solved in its own units.
    """
    if scaling not in ("auto", "none"):
        raise ValueError(f"scaling is {scaling!r}, expected 'auto' or 'none'")
    known = evaluate(grid, np.where(grid.is_multiplier, 0.0, unknowns))
    if scaling == "auto":
        grid = with_scaling_factors(grid, known)
    if grid.sizes.size:
        known = None
    if FORWARD and not warm:
        found = search_forward(grid, unknowns, tolerance, max_iterations, scaling, log, known)
        status, grid, point, iterations = found
    else:
        start = scaled_unknowns(grid, unknowns)
        status, point, iterations = minimise(grid, start, tolerance, max_iterations, warm, log, known)
    scaled = grid
    for _ in range(RESCALINGS):
        if not grid.sizes.size or status != "solved" or iterations >= max_iterations:
            break
        begin = np.where(grid.is_multiplier, 0.0, unscaled_unknowns(grid, point.unknowns))
        there = evaluate(plain_grid(grid), begin)
        there = there._replace(gradient=np.where(grid.is_multiplier, 0.0, there.gradient))  # residuals are rounding
        finer = with_scaling_factors(plain_grid(grid), there)
        if not is_steeper(finer, grid):
            break
        start, left, grid = scaled_unknowns(finer, begin), max_iterations - iterations, finer
        status, point, further = minimise(grid, start, tolerance, left, True, log)
        iterations += further
    status = verdict(grid, unknowns, point, status)
    if grid.sizes.size and status in FAILED and iterations < max_iterations:
        # Factors come from the guess, and may be far from those of the solution.
        grid = plain_grid(grid)
        status, point, further = minimise(grid, unknowns, tolerance, max_iterations - iterations, warm, log)
        iterations += further
        status = verdict(grid, unknowns, point, status)
    own = unscaled_point(grid, point)
    status, message = describe(grid, unknowns, own, status)
    cost = corrected_cost(grid, point) if status == "solved" else own.cost
    return status, message, own._replace(cost=cost), iterations, scaled


if FORWARD:

    def search_forward(grid, unknowns, tolerance, max_iterations, scaling, log, known):
        """(status, grid, point, iterations) of a search that begins anew at a motion if it takes long or fails.

        The motion is the one under the controls of the guess `unknowns` (n,). It is another guess, with scaling factors
        of its own. If no optimum is found from there either, the first search goes on, from its beginning.
        """
        start = scaled_unknowns(grid, unknowns)
        status, point, total = minimise(grid, start, tolerance, min(max_iterations, SLOW), False, log, known)
        if status not in FAILED or total >= max_iterations:
            return status, grid, point, total
        plain = plain_grid(grid)
        motion = forward_motion(plain, unknowns)
        if motion is not None:
            there = with_scaling_factors(plain, evaluate(plain, motion)) if scaling == "auto" else plain
            begin, left = scaled_unknowns(there, motion), max_iterations - total
            if status == "iteration limit":
                left = min(left, FROM_MOTION)  # the first search may still get there
            ended, found, iterations = minimise(there, begin, tolerance, left, False, log)
            total += iterations
            if ended in ("solved", "time limit"):
                return ended, there, found, total
        if status == "iteration limit" and total < max_iterations:
            left = max_iterations - total
            status, point, iterations = minimise(grid, start, tolerance, left, False, log, known)
            total += iterations
        return status, grid, point, total


def verdict(grid, guess, point, status):
    """The status that a search on a grid gave, or a better one, as `final_status` and `has_run_away` see it.

    Multipliers without limit would make any slope one of rounding. The guess (n,) is in the problem's own units.
    """
    if status == "solved" and point.stationarity > STEEP and point.stationarity > STEEP * steepest_cost(grid, point):
        status = "stalled"
    status = final_status(grid, scaled_unknowns(grid, guess), point, status)
    is_doubtful = status == "solved" and point.residual > ROUNDED
    if is_doubtful and has_run_away(grid, guess, unscaled_unknowns(grid, point.unknowns)):
        return "unbounded"
    return status


def steepest_cost(grid, point):
    """The largest slope of the cost."""
    bare = evaluate(grid, np.where(grid.is_multiplier, 0.0, point.unknowns))
    return np.abs(bare.gradient[~grid.is_multiplier]).max(initial=0.0)


def has_run_away(scaled, guess, unknowns):
    """Whether unknowns are beyond anything the guess spoke of, where any residual is rounding.

    Guess and unknowns are in the problem's own units, and have to be far apart in these and with the scaling factors of
    the guess, which may mean little.
    """
    if not is_beyond(scaled, guess, unknowns, 0.0):
        return False
    guess, unknowns = scaled_unknowns(scaled, guess), scaled_unknowns(scaled, unknowns)
    return is_beyond(scaled, guess, unknowns, 1.0)


def is_beyond(grid, guess, unknowns, least):
    """Whether the largest unknown is far larger than the largest of the guess, and than `least`."""
    is_primal = ~grid.is_multiplier
    return np.abs(unknowns[is_primal]).max() > RUN_AWAY * max(least, np.abs(guess[is_primal]).max())


def is_steeper(finer, grid):
    """Whether equations or cost are far steeper by a grid's factors, or without any, than by those of another."""
    forces = finer.forces if finer.sizes.size else 1.0
    return (forces > np.where(grid.is_multiplier, STEEPER, STEEPER_COST) * grid.forces).any()


def scaled_unknowns(grid, unknowns):
    """Unknowns in parts of sizes where the grid has them."""
    return unknowns / grid.sizes if grid.sizes.size else unknowns


def scaled_grid(grid, unknowns):
    """The same grid with scaling factors; unknowns (n,) are a guess."""
    return with_scaling_factors(grid, evaluate(grid, np.where(grid.is_multiplier, 0.0, unknowns)))


def with_scaling_factors(grid, point):
    """The same grid with scaling factors of unknowns and cost, or without if all are one.

    The point is that of a guess without its multipliers. Of derivatives at a guess outside its bounds and on them, the
    smaller ones count: outside a model may mean nothing, and the bounds may be far from where a solution is.
    """
    sizes, bounds, kinds = np.empty(point.unknowns.size), (NONE, NONE), kinds_of(grid.steps)
    inside = primal = point.unknowns
    if INEQUALITIES:
        bounds = variable_bounds(grid)
        inside = np.minimum(np.maximum(primal, bounds[0]), bounds[1])  # in a third of the time of np.clip
        if TIED:
            inside = with_tied_values(grid, inside)  # ends without bounds of their own move along
    slopes = np.abs(point.gradient)
    if INEQUALITIES and (inside != primal).any():
        slopes = np.fmin(slopes, np.abs(evaluate(grid, inside).gradient))
    weight, is_scaled = fill_scaling_factors(
        primal, inside, slopes, *bounds, kinds, grid.steps, grid.h, grid.nodes, grid.parameters, sizes
    )
    if not is_scaled:
        if INEQUALITIES:
            grid = grid._replace(bounds=bounds)
        return grid
    if INEQUALITIES:
        # Bounds of slacks below zero, by rounding or where equations determine them, are numbers without a unit.
        units = np.where(IS_SLACK[kinds], 1.0, sizes)
        bounds = bounds[0] / units, bounds[1] / units
    return grid._replace(sizes=sizes, forces=weight * sizes, weight=weight, bounds=bounds)


def corrected_cost(grid, point):
    """The cost of an optimum, in its own units, less what residuals and distances to active bounds are worth.

    That is so to first order. A large correction belongs to multipliers without limit, as where equations force
    unknowns onto their bounds, and says nothing: the cost stays as it is.
    """
    corrected = lagrangian(grid, point)
    if INEQUALITIES:
        corrected -= remaining_gap(point.unknowns, point.gradient, *bounds_of(grid))
    if abs(corrected - point.cost) > LARGE_CORRECTION * abs(point.cost):
        corrected = point.cost
    return float(corrected) / grid.weight


if INEQUALITIES:

    @njit(cache=True, error_model="numpy")
    def remaining_gap(unknowns, gradient, lower, upper):
        """The sum of duals times distances of active bounds; the dual of a bound is what the Lagrangian falls to it."""
        total = 0.0
        for i in range(unknowns.size):
            if gradient[i] > 0.0 and lower[i] > -np.inf:
                dual, distance = gradient[i], unknowns[i] - lower[i]
            elif gradient[i] < 0.0 and upper[i] < np.inf:
                dual, distance = -gradient[i], upper[i] - unknowns[i]
            else:
                continue
            total += dual * distance * (dual / (dual + abs(distance) + 1e-300))
        return total


@lru_cache(maxsize=4)
def kinds_of(steps):
    """The quantity (n,) of every unknown, as a number."""
    chain = np.tile(np.arange(steps * STRIDE + NODE) % STRIDE, BODIES)
    if SHARED:
        own, common = np.tile(np.arange(OWN), BODIES), np.arange(OWN, SHARED + COUPLINGS)
        chain = np.concatenate([chain, STRIDE + own, STRIDE + common])
    return KIND[chain]


def unscaled_point(grid, point):
    """A point in the problem's own units; its stationarity is the change of the cost with parts of sizes."""
    if not grid.sizes.size:
        return point
    stationarity = point.stationarity / grid.weight
    sizes, grid = grid.sizes, plain_grid(grid)
    point = evaluate(grid, with_pinned_values(grid, point.unknowns * sizes))
    return point._replace(stationarity=stationarity, error=max(point.residual, stationarity))
