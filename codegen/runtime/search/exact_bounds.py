"""The end of an interior-point method: bounds, which were relaxed on the way, hold exactly.

An unknown that is outside its bound, by the relaxation, is moved onto it. Where equations are steep or multipliers
large, even a move of 1e-12 costs digits of the optimality conditions. Newton's steps of the barrier problem without
relaxation then lead back to its optimum.
"""

import numpy as np
from numba import njit

from codegen.runtime.search import descent
from codegen.runtime.search.iterates import moved, newton_step, with_tied_values
from codegen.runtime.search.point import Point, evaluate

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
