"""The first iterate of a search, from a guess or from the solution of a similar problem.

Numbers of equations refer to Waechter and Biegler (2006), and `descent` explains the arguments.
"""

import numpy as np
from numba import njit

from codegen.runtime.kkt.system import SINGULAR
from codegen.runtime.search.direction import factored, relaxation
from codegen.runtime.search.optimality import evaluate_iterate
from codegen.runtime.search.workspace import (
    COST,
    DIAGONAL,
    DISTANCE,
    DUALS,
    ENOUGH,
    ERROR,
    FIRST_COST,
    FIRST_ERROR,
    FIRST_MU,
    FIRST_VIOLATION,
    FUNNEL,
    GO_ON,
    IS_BESIDE,
    IS_FACTORED,
    IS_WARM,
    LAST_ERROR,
    LEAST_RELAXATION,
    MU,
    ON_PATH,
    PAIRS,
    PUSH,
    RESIDUAL,
    RIGHT,
    SMALL_VIOLATION,
    STAGE,
    STATIONARITY,
    STEP,
    TRIAL,
    VIOLATION,
    G,
    X,
)

# The start of a search.
AT_GUESS, BESIDE, FROM_AFAR = (0.1, 1e-2), (1e-5, 1e-4), (0.1, 0.1)
"""The first weight of the barrier, and the push inside the bounds, for a search from a guess (AT_GUESS), for a warm
start without multipliers (BESIDE), and for a warm start with multipliers whose residual exceeds NEAR (FROM_AFAR).
Unknowns close to their bounds would shorten all steps."""
WARM_WEIGHT = 0.1  # the first weight of the barrier of a warm start, relative to the tolerance; 1 takes one more step
CLOSE = 1e-8  # least distance of unknowns to their bounds at a warm start
NEAR = 0.1  # largest residual of a warm start with multipliers; 0.3 takes 50 percent more iterations on one problem
LARGEST_DUAL = 1e3  # largest dual at a start, for a bound that is very close
LARGEST_MULTIPLIER = 1e3  # a larger least-squares multiplier means that equations depend on each other
FILTERED = 1e-4  # largest violation, relative to the first, for which the switching condition requires descent


@njit(error_model="numpy")
def copy(source, target):
    """Copy the vector `source` to `target`."""
    for i in range(source.size):
        target[i] = source[i]


@njit(error_model="numpy")
def has_multipliers(unknowns, is_multiplier):
    """Return True if any multiplier is not zero."""
    has_any = False
    for i in range(unknowns.size):
        has_any = has_any or (is_multiplier[i] and unknowns[i] != 0.0)
    return has_any


@njit(error_model="numpy")
def add_linking(grid, factor, x):
    """Add `factor` times the linking variables to the unknowns of `x` (n,) at ends that follow them.

    An unknown at an end is its linking variable plus a constant, such as a full turn. With the factor -1 only the
    constant remains. Between this call and a call with the factor 1 linking variables may move.
    """
    sizes, ties = grid[5], grid[8]
    for j in range(ties.shape[0]):
        i, other = ties[j, 0], ties[j, 1]
        x[i] += factor * (x[other] * sizes[other] / sizes[i] if sizes.size else x[other])


@njit(cache=True, error_model="numpy")
def push_inside(grid, bounds, push, x):
    """Move the unknowns `x` (n,) inside their bounds, by at least `push` max(1, |bound|) (36).

    Between two bounds, the distance is at most `push` times the distance between the bounds.
    """
    indices, lower, upper = bounds[0], bounds[4], bounds[5]
    add_linking(grid, -1.0, x)
    for i in indices:
        width = push * (upper[i] - lower[i])
        if lower[i] > -np.inf:
            x[i] = max(x[i], lower[i] + min(push * max(1.0, abs(lower[i])), width))
        if upper[i] < np.inf:
            x[i] = min(x[i], upper[i] - min(push * max(1.0, abs(upper[i])), width))
    add_linking(grid, 1.0, x)


@njit(cache=True, error_model="numpy")
def begin(problem, grid, bounds, reals, integers, vectors, barriers):
    """Make the iterate at the primal unknowns X in the work space, pushed inside their bounds.

    The weight MU and the PUSH are in the work space, too. The duals are one, or with ON_PATH on the central path.
    """
    x, distance, duals, mu = vectors[X], barriers[DISTANCE], barriers[DUALS], reals[MU]
    indices, side, magnitude, value = bounds[0], bounds[1], bounds[2], bounds[3]
    if indices.size > 0:
        push_inside(grid, bounds, reals[PUSH], x)
        relaxed = relaxation(mu, reals[LEAST_RELAXATION])
        for j in range(indices.size):
            distance[j] = side[j] * (x[indices[j]] - value[j]) + relaxed * magnitude[j]
            duals[j] = min(mu / distance[j], LARGEST_DUAL) if integers[ON_PATH] else 1.0
    evaluate_iterate(problem, grid, reals, vectors)


@njit(error_model="numpy")
def begin_at(start, problem, grid, bounds, reals, integers, vectors, barriers):
    """Do the same as `begin`, with duals on the central path; `start` is a pair (weight of the barrier, push)."""
    reals[MU] = start[0] if bounds[0].size else 0.0
    reals[PUSH], integers[ON_PATH], integers[IS_FACTORED] = start[1], 1, 0
    begin(problem, grid, bounds, reals, integers, vectors, barriers)


@njit(cache=True, error_model="numpy")
def begin_beside(problem, grid, bounds, tolerance, reals, integers, vectors, barriers):
    """Make the iterate of a warm start at the unknowns X in the work space, the solution of a similar problem.

    IS_BESIDE is set if the iterate has the multipliers of this solution. The multipliers are dropped if all are zero,
    if the iterate is not finite, or, without bounds, if the residual exceeds NEAR. The duals of bounds follow from the
    multipliers. If the Lagrangian decreases towards a bound with a slope larger than the distance to the bound, the
    bound is active. Its dual is then this slope. Other duals are on the central path. The barrier's weight begins at
    its final value, and unknowns may stay close to their bounds.

    If the residual exceeds NEAR, for example after a large disturbance, other bounds become active. The iterate then
    starts farther inside the bounds. Source: Yildirim and Wright (2002), Warm-start strategies in interior-point
    methods for linear programming, SIAM J. Optim. 12: the larger the change of the data, the larger the first weight of
    the barrier.
    """
    x, g, distance, duals, is_multiplier = vectors[X], vectors[G], barriers[DISTANCE], barriers[DUALS], grid[4]
    indices, side, magnitude, value = bounds[0], bounds[1], bounds[2], bounds[3]
    integers[IS_BESIDE] = has_multipliers(x, is_multiplier)
    copy(x, vectors[TRIAL])
    if integers[IS_BESIDE]:
        if indices.size:
            push_inside(grid, bounds, CLOSE, x)
        evaluate_iterate(problem, grid, reals, vectors)
        is_near = reals[RESIDUAL] <= NEAR
        if indices.size and not is_near:
            begin_at(FROM_AFAR, problem, grid, bounds, reals, integers, vectors, barriers)
        else:
            reals[MU] = WARM_WEIGHT * tolerance if indices.size else 0.0
            relaxed = relaxation(reals[MU], reals[LEAST_RELAXATION])
            for j in range(indices.size):
                distance[j] = side[j] * (x[indices[j]] - value[j]) + relaxed * magnitude[j]
                slope = side[j] * g[indices[j]]
                duals[j] = slope if slope > distance[j] else min(reals[MU] / distance[j], LARGEST_DUAL)
        integers[IS_BESIDE] = reals[ERROR] < np.inf and (is_near or indices.size > 0)
    if not integers[IS_BESIDE]:
        for i in range(x.size):
            x[i] = 0.0 if is_multiplier[i] else vectors[TRIAL, i]
        begin_at(BESIDE, problem, grid, bounds, reals, integers, vectors, barriers)


@njit(cache=True, error_model="numpy")
def estimate_multipliers(problem, grid, system, bounds, reals, vectors, barriers):
    """Set the multipliers to the least-squares solution of the stationarity conditions (36).

    The iterate must have zero multipliers. They stay zero if a multiplier would exceed LARGEST_MULTIPLIER, or if the
    linear system is singular.
    """
    is_multiplier, indices, side, duals = grid[4], bounds[0], bounds[1], barriers[DUALS]
    x, g, right, diagonal, step = vectors[X], vectors[G], vectors[RIGHT], vectors[DIAGONAL], vectors[STEP]
    if indices.size == 0 and reals[STATIONARITY] == 0.0:
        return
    for i in range(x.size):
        right[i] = 0.0 if is_multiplier[i] else g[i]
        diagonal[i] = -1e-12 if is_multiplier[i] else 1.0
    for j in range(indices.size):
        right[indices[j]] -= side[j] * duals[j]
    excess = factored(problem, grid, system, x, 0.0, vectors, True)
    if excess == SINGULAR or excess > 0:
        return
    for i in range(x.size):
        if is_multiplier[i] and not abs(step[i]) <= LARGEST_MULTIPLIER:
            return
    for i in range(x.size):
        if is_multiplier[i]:
            x[i] = step[i]
    evaluate_iterate(problem, grid, reals, vectors)


@njit(error_model="numpy")
def enter(problem, grid, system, bounds, reals, integers, vectors, barriers, pairs):
    """Prepare the state of a search that begins with the iterate in the work space.

    Multipliers that are all zero are estimated. Otherwise the start is warm, and its multipliers are kept.
    """
    integers[IS_WARM] = has_multipliers(vectors[X], grid[4])
    if not integers[IS_WARM]:
        estimate_multipliers(problem, grid, system, bounds, reals, vectors, barriers)
    first = max(1.0, reals[VIOLATION])
    reals[SMALL_VIOLATION], reals[FIRST_COST], reals[LAST_ERROR] = FILTERED * first, reals[COST], np.inf
    reals[FIRST_MU], reals[FIRST_VIOLATION], reals[FIRST_ERROR] = reals[MU], reals[VIOLATION], reals[ERROR]
    pairs[0, 0], pairs[0, 1], integers[PAIRS], integers[ENOUGH] = reals[FUNNEL] * first, -np.inf, 1, 2
    integers[STAGE] = GO_ON
