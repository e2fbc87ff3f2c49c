"""Solve in multiples of scaling factors of unknowns and equations, which a change of units changes with them.

The same problem is solved in other units, those in which its numbers are of ordinary size (see `scaling`); where they
are that already, it is solved as it is.

The motion that follows from the given start under the controls of a guess, interval by interval.

Where all states are given at the start and none at the end, a guess by straight lines is constant, and grossly violates
dynamics that grow or decay: of epidemics, cells and reactions the first steps then go far astray. A motion obeys them,
but may be no better a start where the dynamics are unstable, so that searches begin there only after others have taken
long, or failed.

Solve a linear-quadratic problem: one Newton step, and at most two more that remove rounding errors.
"""

import numpy as np
from numba import njit

from codegen.runtime.search.bounds import bounds_of, with_slacks
from codegen.runtime.search.cascade import least_delta_w, minimise, varied_guess
from codegen.runtime.search.descent import FLAT, WORTH_MEASURING
from codegen.runtime.search.grid import NONE, plain_grid, with_pinned_values
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, is_factored, solve_kkt
from codegen.runtime.search.messages import describe
from codegen.runtime.search.point import evaluate, fill, lagrangian
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.termination import final_status, is_solved, unscaled_unknowns

NEWTON_STEPS = 20  # on one interval
RELATIVE = 1e-10  # part of what is solved for that the last of them may be
BEYOND = 1e6  # a motion that grows by it runs away


def motion_entries(s):
    """Return the entries of an interval's Hessian that belong to the motion: (3, m), with number, row and column."""
    row, column = ({int(j): i for i, j in enumerate(kind)} for kind in (s.motion_equations, s.motion_unknowns))
    pairs = list(enumerate(zip(s.rows.tolist(), s.columns.tolist(), strict=True)))
    found = [(k, row[i], column[j]) for k, (i, j) in pairs if i in row and j in column]
    found += [(k, row[j], column[i]) for k, (i, j) in pairs if j in row and i in column]
    return np.array(found).T


def forward_motion(grid, unknowns):
    """Return the unknowns (n,) of the motion under the controls of a guess (n,), without multipliers, or None.

    Controls are moved inside their bounds. Everything is in the problem's own units.
    """
    s, (lower, upper) = grid.problem.structure, bounds_of(grid)
    own = np.minimum(np.maximum(np.where(grid.is_multiplier, 0.0, unknowns), lower), upper)
    limit, common = BEYOND * max(1.0, np.abs(own).max()), own[own.size - s.root :]
    piece, inside = np.concatenate([own[: s.element], common]), s.motion_unknowns[s.motion_unknowns < s.stride]
    entries = motion_entries(s)
    for k in range(grid.steps):
        first, solved = k * s.stride, piece[inside]
        piece[: s.element] = own[first : first + s.element]
        piece[s.stride : s.element] = piece[: s.node]
        if k > 0:
            piece[inside] = solved  # stages begin as those of the interval before
        if not is_solved_for_motion(grid, k, piece, entries) or not np.abs(piece).max() <= limit:
            return None
        own[first + s.motion_unknowns] = piece[s.motion_unknowns]
    if s.slacks.size:
        own = with_slacks(grid, own)
    return own


def is_solved_for_motion(grid, k, piece, entries):
    """Return True if Newton's method finds the state after interval k, and its stages, from the state before it.

    `piece` (element + root,) has the unknowns of the interval and both nodes, and those that no node owns.
    """
    s, (entry, row, column) = grid.problem.structure, entries
    times, gradient, values = grid.nodes[k : k + 2].copy(), np.empty(piece.size), np.empty(s.entry_count(1))
    data = 1, grid.h, times, grid.parameters
    matrix = np.zeros((s.motion_equations.size, s.motion_unknowns.size))
    for _ in range(NEWTON_STEPS):
        fill(grid.problem.gradient.address, piece, *data, gradient)
        fill(grid.problem.hessians.address, piece, *data, values)
        matrix[row, column] = values[entry]
        if not np.isfinite(matrix).all():
            return False
        try:
            step = np.linalg.solve(matrix, gradient[s.motion_equations])
        except np.linalg.LinAlgError:
            return False
        piece[s.motion_unknowns] -= step
        if not np.abs(step).max() < np.inf:
            return False
        if (np.abs(step) <= RELATIVE * np.maximum(1.0, np.abs(piece[s.motion_unknowns]))).all():
            return True
    return False


CONTRADICTORY = 1e-6  # least violation of contradictory equations, relative to the first residual
ROUNDINGS = 4.0  # rounding errors of their terms that one Newton step leaves in the equations
LARGE = 1e6  # a larger step, relative to the unknowns, means that the problem is unbounded


def solve_linear_quadratic(grid, unknowns, tolerance, log, system=None):
    """Find the minimum; return (status, point, iterations).

    A row (cost, residual, stationarity, Hessian's shift, step length) is
    appended to `log` at every iterate. `system` is the storage of the linear system, if there is one.
    """
    system = system or allocate_system(grid)
    none, step = np.zeros(unknowns.size), np.empty(unknowns.size)
    point = evaluate(grid, unknowns)
    excess = factor_kkt(grid, unknowns, 1.0, none, system, point.gradient, step)
    for iteration in range(4):
        log.add(point, float(iteration > 0))
        if not point.error < np.inf:
            return "non-finite", point, iteration
        if excess != 0:
            return *without_minimum(grid, point, system), iteration
        if (iteration > 0 or point.error <= WORTH_MEASURING) and is_solved(grid, point, tolerance, ROUNDINGS):
            return "solved", point, iteration
        if iteration > 0:
            solve_kkt(grid, system, point.gradient, step)
        point = evaluate(grid, point.unknowns + step)
    return "stalled", point, 3


def without_minimum(grid, point, system):
    """Return (status, point) if the KKT matrix is singular, or has another inertia than at a minimum."""
    least = nearest_feasible_point(grid, point, system)
    if least.residual > CONTRADICTORY * point.residual:
        return "infeasible", least
    if least_delta_w(grid, point.unknowns, system) > FLAT:
        return "unbounded", least
    step = np.empty_like(point.unknowns)
    solve_kkt(grid, system, least.gradient, step)
    large = np.abs(step[~grid.is_multiplier]).max() > LARGE * max(1.0, np.abs(least.unknowns).max())
    return "unbounded" if large else "rank-deficient", least


def nearest_feasible_point(grid, point, system):
    """Return the point nearest to a given one where the equations hold, or where they are violated least."""
    step = np.empty_like(point.unknowns)
    point = evaluate(grid, np.where(grid.is_multiplier, 0.0, point.unknowns))
    for _ in range(5):
        gradient = np.where(grid.is_multiplier, point.gradient, 0.0)
        diagonal = np.where(grid.is_multiplier, -FLAT, 1.0)
        if not is_factored(factor_kkt(grid, point.unknowns, 0.0, diagonal, system, gradient, step)):
            return point
        step[grid.is_multiplier] = 0.0
        point = evaluate(grid, point.unknowns + step)
    return point


# How much steeper equations and cost may be at a solution than at the guess, to powers of a thousand and a million.
STEEPER, STEEPER_COST = 3e3, 3e6
RESCALINGS = 10  # how often a search goes on at most, as two sets of factors may each be coarse beside the other
LARGE_CORRECTION = 1e-3  # part of the cost
FAILED = ("infeasible", "stalled", "rank-deficient", "non-finite", "unbounded", "iteration limit")
SLOW = 150  # iterations after which a search makes way for one that begins at a motion; most need 10 to 100
FROM_MOTION = 300  # for that one
STEEP = 1e-3  # slopes of the Lagrangian above it, relative to the cost's or to one, belong to no optimum
VARIED, FROM_VARIED = 5, 500  # guesses that are tried after a search has stalled, and iterations for each of them
ROUNDED, RUN_AWAY = 1e-8, 1e6  # residuals above it are none that hold, where an unknown is so many times as large


def optimise(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise with scaling factors, unless `scaling` is "none"; return (status, message, point, iterations, scaled).

    `scaled` is the grid with the scaling factors of the guess. Where the search stalls, as from a symmetric guess that
    leads through the middle of an obstacle, searches from up to VARIED varied guesses follow. The message names the
    guess that succeeded, or the number of guesses tried.
    """
    ended = optimise_from(grid, unknowns, tolerance, max_iterations, warm, scaling, log)
    status, message, point, iterations, scaled = ended
    is_linear = grid.problem.structure.linear_quadratic
    if status != "stalled" or warm or is_linear or iterations >= max_iterations:
        return ended
    number = 0
    while number < VARIED and iterations < max_iterations:
        number += 1
        left, guess = min(FROM_VARIED, max_iterations - iterations), varied_guess(grid, unknowns, number)
        ended, text, found, further, its_grid = optimise_from(grid, guess, tolerance, left, False, scaling, log)
        iterations += further
        if ended == "solved":
            text += f"; found from varied guess {number}, as the search from the first guess stalled"
            return ended, text, found, iterations, its_grid
        if ended == "time limit":
            return ended, text, point, iterations, scaled
    return status, f"{message}; searches from {number} varied guesses did not succeed", point, iterations, scaled


def optimise_from(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise from one guess; return (status, message, point, iterations, scaled) as `optimise` does.

    `scaled` is the grid with the scaling factors of the guess. Equations or a cost with far larger factors at the guess
    than at the solution make the tolerance mean little. The search then goes on from the solution, with the factors
    there. After a failure the problem is solved in its own units.
    """
    if scaling not in ("auto", "none"):
        raise ValueError(f"scaling is {scaling!r}, expected 'auto' or 'none'")
    if grid.problem.structure.linear_quadratic:
        return optimise_linear(grid, unknowns, tolerance, log)
    if grid.problem.variable_bounds is not None and not grid.bounds:
        grid = grid._replace(bounds=bounds_of(grid))
    if scaling == "auto":
        grid = scaled_grid(grid, unknowns)
    if grid.problem.structure.forward and not warm:
        found = search_forward(grid, unknowns, tolerance, max_iterations, scaling, log)
        status, grid, point, iterations = found
    else:
        start = scaled_unknowns(grid, unknowns)
        status, point, iterations = minimise(grid, start, tolerance, max_iterations, warm, log)
    scaled = grid
    for _ in range(RESCALINGS):
        if not grid.sizes.size or status != "solved" or iterations >= max_iterations:
            break
        begin = np.where(grid.is_multiplier, 0.0, unscaled_unknowns(grid, point.unknowns))
        finer = scaled_grid(plain_grid(grid), begin, is_solution=True)
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


def optimise_linear(grid, unknowns, tolerance, log):
    """Minimise a linear-quadratic problem, which needs no scaling: one Newton step is the same in all units."""
    status, point, iterations = solve_linear_quadratic(grid, unknowns, tolerance, log)
    status = final_status(grid, unknowns, point, status)
    status, message = describe(grid, unknowns, point, status)
    if status == "solved":
        point = point._replace(cost=float(lagrangian(grid, point)))
    return status, message, point, iterations, grid


def search_forward(grid, unknowns, tolerance, max_iterations, scaling, log):
    """Search, and begin anew at a motion if that takes long or fails; return (status, grid, point, iterations).

    The motion is the one under the controls of the guess `unknowns` (n,). It is another guess, with scaling factors of
    its own. If no optimum is found from there either, the first search goes on, from its beginning.
    """
    start = scaled_unknowns(grid, unknowns)
    status, point, total = minimise(grid, start, tolerance, min(max_iterations, SLOW), False, log)
    if status not in FAILED or total >= max_iterations:
        return status, grid, point, total
    plain = plain_grid(grid)
    motion = forward_motion(plain, unknowns)
    if motion is not None:
        there = scaled_grid(plain, motion) if scaling == "auto" else plain
        begin, left = scaled_unknowns(there, motion), max_iterations - total
        if status == "iteration limit":
            left = min(left, FROM_MOTION)  # the first search may still get there
        ended, found, iterations = minimise(there, begin, tolerance, left, False, log)
        total += iterations
        if ended in ("solved", "time limit"):
            return ended, there, found, total
    if status == "iteration limit" and total < max_iterations:
        left = max_iterations - total
        status, point, iterations = minimise(grid, start, tolerance, left, False, log)
        total += iterations
    return status, grid, point, total


def verdict(grid, guess, point, status):
    """Return the status that a search on a grid gave, or a better one, as `final_status` and `has_run_away` see it.

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
    """Return the largest slope of the cost."""
    bare = evaluate(grid, np.where(grid.is_multiplier, 0.0, point.unknowns))
    return np.abs(bare.gradient[~grid.is_multiplier]).max(initial=0.0)


def has_run_away(scaled, guess, unknowns):
    """Return True if unknowns are far beyond the guess, where any residual is rounding.

    Guess and unknowns are in the problem's own units, and have to be far apart in these and with the scaling factors of
    the guess, which may mean little.
    """
    if not is_beyond(scaled, guess, unknowns, 0.0):
        return False
    guess, unknowns = scaled_unknowns(scaled, guess), scaled_unknowns(scaled, unknowns)
    return is_beyond(scaled, guess, unknowns, 1.0)


def is_beyond(grid, guess, unknowns, least):
    """Return True if the largest unknown is far larger than the largest of the guess, and than `least`."""
    is_primal = ~grid.is_multiplier
    return np.abs(unknowns[is_primal]).max() > RUN_AWAY * max(least, np.abs(guess[is_primal]).max())


def is_steeper(finer, grid):
    """Return True if equations or cost are far steeper with the factors of `finer`, or none, than those of `grid`."""
    forces = finer.forces if finer.sizes.size else 1.0
    return (forces > np.where(grid.is_multiplier, STEEPER, STEEPER_COST) * grid.forces).any()


def scaled_unknowns(grid, unknowns):
    """Return unknowns in multiples of their scaling factors where the grid has them."""
    return unknowns / grid.sizes if grid.sizes.size else unknowns


def corrected_cost(grid, point):
    """Return the cost of an optimum in its own units, corrected for residuals and distances to active bounds.

    That is so to first order. A large correction belongs to multipliers without limit, as where equations force
    unknowns onto their bounds, and says nothing: the cost stays as it is.
    """
    lower, upper = (NONE, NONE) if grid.problem.variable_bounds is None else bounds_of(grid)
    corrected = point.cost + correction(point.unknowns, point.gradient, grid.is_multiplier, lower, upper)
    if abs(corrected - point.cost) > LARGE_CORRECTION * abs(point.cost):
        corrected = point.cost
    return float(corrected) / grid.weight


@njit(cache=True, error_model="numpy")
def correction(unknowns, gradient, is_multiplier, lower, upper):
    """Return the sum of multipliers times residuals, less that of duals times distances of active bounds.

    The dual of a bound is the Lagrangian's slope there. `lower` and `upper` are (n,), or empty.
    """
    total = 0.0
    for i in range(unknowns.size):
        slope = gradient[i]
        if is_multiplier[i]:
            total += unknowns[i] * slope
        if lower.size and slope != 0.0:
            distance = unknowns[i] - lower[i] if slope > 0.0 else upper[i] - unknowns[i]
            if distance < np.inf:
                dual = abs(slope)
                total -= dual * distance * (dual / (dual + abs(distance)))
    return total


def unscaled_point(grid, point):
    """Return a point in the problem's own units; its stationarity is the change of the cost by scaling factors."""
    if not grid.sizes.size:
        return point
    stationarity = point.stationarity / grid.weight
    sizes, grid = grid.sizes, plain_grid(grid)
    point = evaluate(grid, with_pinned_values(grid, point.unknowns * sizes))
    return point._replace(stationarity=stationarity, error=max(point.residual, stationarity))
