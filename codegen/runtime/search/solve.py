"""The solution of a problem with scaling factors of unknowns and equations, so that units do not matter.

Scaled numbers are of ordinary magnitude (see `scaling`). A problem whose factors are all one is solved without scaling.
Linear-quadratic problems take one Newton step, and at most two more that remove rounding errors.

If the start is prescribed and the end is free, an initial guess by straight lines is constant. Such a guess grossly
violates dynamics that grow or decay, such as those of epidemics, cells and reactions. The first steps then lead far
away. The motion under the controls of the guess satisfies the dynamics, but may be a worse guess if the dynamics are
unstable. A search from the motion therefore follows only if the search from the guess takes long or fails.
"""

import numpy as np
from numba import njit

from codegen.runtime.search.bounds import bounds_of, with_slacks
from codegen.runtime.search.cascade import longer_guess, minimise, varied_guess
from codegen.runtime.search.curvature import least_delta_w
from codegen.runtime.search.direction import FLAT
from codegen.runtime.search.grid import NONE, with_pinned_values
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, is_factored, solve_kkt
from codegen.runtime.search.messages import describe
from codegen.runtime.search.optimality import WORTH_MEASURING
from codegen.runtime.search.point import evaluate, fill, lagrangian
from codegen.runtime.search.scaling import slacks
from codegen.runtime.search.shooting import (
    scaled_shooting_grid,
    shooting_grid,
    shooting_unknowns,
    whole_unknowns,
)
from codegen.runtime.search.termination import final_status, is_solved, unscaled_unknowns

# If the factors `forces` of the gradient at a solution exceed those at the guess by a larger ratio, the problem is
# scaled again. The ratios are for equations and for primal unknowns. Factors are powers of a thousand or of a million.
STEEPER, STEEPER_COST = 3e3, 3e6
NEGLIGIBLE = 1e-8  # smaller solutions, relative to their factors at the guess, are errors around zero: no factors
RESCALINGS = 10  # largest number of rescalings, so that two sets of factors cannot alternate for ever
# With bounds, a search continues with the tolerance TIGHT if its own exceeds LOOSE, both relative to the scaled cost.
LOOSE, TIGHT = 1e-7, 1e-9
LARGE_CORRECTION = 1e-3  # a larger correction of the cost, relative to the cost, is not used
FAILED = ("infeasible", "stalled", "rank-deficient", "non-finite", "unbounded", "iteration limit")
SLOW = 150  # iterations after which a search from a motion follows; most searches need 10 to 100
FROM_MOTION = 300  # largest number of iterations of the search from a motion
STEEP = 1e-3  # a larger slope of the Lagrangian, in itself and relative to the cost's slope, belongs to no optimum
VARIED, FROM_OTHER = 5, 500  # largest number of varied guesses after a search has stalled; iterations for each
OTHER_GUESSES = {"stalled": ("stalled", "varied"), "infeasible": ("found no feasible motion", "longer")}
"""For each status after which searches from other guesses follow: what has happened, and the kind of these guesses."""
LONGER = 4, 16  # factors of a free duration, after a search has found no feasible motion
ROUNDED, RUN_AWAY = 1e-8, 1e6  # a larger residual is doubtful if unknowns exceed the guess by this factor

NEWTON_STEPS = 20  # largest number of Newton steps on one interval of a motion
RELATIVE = 1e-10  # largest relative change by the last Newton step
BEYOND = 1e6  # a motion that grows by this factor diverges

CONTRADICTORY = 1e-6  # equations contradict each other if their least violation, relative to the first, exceeds it
ROUNDINGS = 4.0  # residual that one Newton step may leave, in rounding errors of the equations' terms
MOST_MULTIPLIER_STEPS = 10  # largest number of steps with equations that depend on each other
LARGE = 1e6  # a larger step, relative to the unknowns, means that the problem is unbounded


def optimise(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise with scaling factors, unless `scaling` is "none"; return (status, message, point, iterations, scaled).

    `scaled` is the grid with the scaling factors of the guess. Searches from other guesses follow if the first search
    stalls, or if it finds no feasible motion of a free duration, see `other_guesses`. The message names the guess that
    has succeeded, or the guesses that have failed.
    """
    outcome = optimise_from(grid, unknowns, tolerance, max_iterations, warm, scaling, log)
    status, message, point, iterations, scaled = outcome
    if warm or grid.problem.structure.linear_quadratic:
        return outcome
    number, (failure, kind) = 0, OTHER_GUESSES.get(status, ("", ""))
    for guess, name in other_guesses(grid, unknowns, status):
        if iterations >= max_iterations:
            break
        number += 1
        remaining = min(FROM_OTHER, max_iterations - iterations)
        other_status, text, optimum, further, other_grid = optimise_from(
            grid, guess, tolerance, remaining, False, scaling, log
        )
        iterations += further
        if other_status == "solved":
            text += f"; found from {name}, as the search from the first guess {failure}"
            return other_status, text, optimum, iterations, other_grid
        if other_status == "time limit":
            return other_status, text, point, iterations, scaled
    if number:
        message += f"; searches from {number} {kind} guesses did not succeed"
    return status, message, point, iterations, scaled


def other_guesses(grid, unknowns, status):
    """Yield pairs (guess, its name) for searches after a search from the guess `unknowns` (n,) has failed.

    A search may stall, for example from a symmetric guess through the middle of an obstacle: up to VARIED varied
    guesses follow. A duration may be far too short for any motion. The violation may then have a minimum at a duration
    between that of the guess and those of motions, as at a full period of an oscillator. Guesses with a longer duration
    follow.
    """
    if status == "stalled":
        for number in range(1, VARIED + 1):
            yield varied_guess(grid, unknowns, number), f"varied guess {number}"
    if status == "infeasible":
        for factor in LONGER:
            guess = longer_guess(grid, unknowns, factor)
            if (guess != unknowns).any():
                yield guess, f"a guess with {factor} times the duration"


def optimise_from(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise from one guess; return (status, message, point, iterations, scaled) as `optimise` does.

    `scaled` is the grid with the scaling factors of the guess. If equations or cost have much larger factors at the
    guess than at the solution, the tolerance means little. The search then continues from the solution, with the
    factors there. Quantities that vanish at the solution do not count, because they have no size there. Slacks do not
    count, because they have the factors of their equations. After a failure the problem is solved in its own units. If
    that succeeds, `scaled` has no factors.
    For an explicit scheme, the searches have no stages, see `shooting`; `point` and `scaled` have them.
    """
    if scaling not in ("auto", "none"):
        raise ValueError(f"scaling is {scaling!r}, expected 'auto' or 'none'")
    s = grid.problem.structure
    if grid.problem.variable_bounds is not None and not grid.bounds:
        grid = grid._replace(bounds=bounds_of(grid))
    guess = shooting_unknowns(grid, unknowns)
    if s.linear_quadratic:  # without scaling: one Newton step is the same in all units
        searched = shooting_grid(grid)
        status, point, iterations = solve_linear_quadratic(searched, guess, tolerance, log)
        status = final_status(searched, guess, point, status)
        cost = float(lagrangian(searched, point)) if status == "solved" else None
        return *described(grid, grid, unknowns, searched, point, status, cost), iterations, grid
    scaled = scaled_shooting_grid(grid, guess) if scaling == "auto" else grid
    searched = shooting_grid(scaled)
    if s.forward and not warm:
        status, scaled, point, iterations = search_forward(grid, scaled, guess, tolerance, max_iterations, scaling, log)
        searched = shooting_grid(scaled)
    else:
        start = scaled_unknowns(searched, guess)
        status, point, iterations = minimise(searched, start, tolerance, max_iterations, warm, log)
    at_guess = scaled
    for _ in range(RESCALINGS):
        if not searched.sizes.size or status != "solved" or iterations >= max_iterations:
            break
        begin = np.where(searched.is_multiplier, 0.0, unscaled_unknowns(searched, point.unknowns))
        measured = np.where(np.abs(point.unknowns) < NEGLIGIBLE, 0.0, begin)
        finer_scaled = scaled_shooting_grid(grid, measured, is_solution=True)
        finer = shooting_grid(finer_scaled)
        forces = finer.forces if finer.sizes.size else 1.0
        steeper = forces > np.where(searched.is_multiplier, STEEPER, STEEPER_COST) * searched.forces
        if not (steeper & (searched.is_multiplier | (measured != 0.0)) & ~slacks(searched)).any():
            break
        scaled, searched, remaining = finer_scaled, finer, max_iterations - iterations
        status, point, further = minimise(finer, scaled_unknowns(finer, begin), tolerance, remaining, True, log)
        iterations += further
    if s.inequalities and status == "solved" and 0.0 < abs(point.cost) < tolerance / LOOSE:
        tight, remaining = TIGHT * abs(point.cost), max_iterations - iterations
        again, closer, further = minimise(searched, point.unknowns, tight, remaining, True, log)
        if again == "solved":
            point, iterations = closer, iterations + further
    status = corrected_status(searched, guess, point, status)
    if searched.sizes.size and status in FAILED and iterations < max_iterations:
        # The scaling factors at the guess may differ much from those at the solution.
        scaled, searched = grid, shooting_grid(grid)
        status, point, further = minimise(searched, guess, tolerance, max_iterations - iterations, warm, log)
        iterations += further
        status = corrected_status(searched, guess, point, status)
        if status == "solved":
            at_guess = grid
    cost = corrected_cost(searched, point) if status == "solved" else None
    return *described(grid, scaled, unknowns, searched, point, status, cost), iterations, at_guess


def described(grid, scaled, guess, searched, point, status, cost):
    """Return (status, message, point) of a search: the final status, and the Point with stages in the problem's units.

    `grid` has the problem's units and `scaled` the scaling factors; `searched` is the grid of the search. `cost`
    is the cost of an optimum, or None. Stationarity remains the change of the cost if unknowns change by their
    scaling factors.
    """
    if searched is not scaled or searched.sizes.size:
        unknowns, stationarity = point.unknowns, point.stationarity / searched.weight
        if searched.sizes.size:
            unknowns = with_pinned_values(searched, unknowns * searched.sizes)
        point = evaluate(grid, whole_unknowns(grid, unknowns))
        point = point._replace(stationarity=stationarity, error=max(point.residual, stationarity))
    status, message = describe(scaled, guess, point, status)
    return status, message, point if cost is None else point._replace(cost=cost)


def search_forward(grid, scaled, guess, tolerance, max_iterations, scaling, log):
    """Search from a guess, then from a motion if that takes long or fails; return (status, scaled, point, iterations).

    The motion under the controls of the `guess` (n,) is another guess, with its own scaling factors. If the search from
    the motion finds no optimum, and the first search has only reached its limit, the first search is repeated without
    limit. `grid` has the problem's own units, `scaled` the scaling factors of the guess; both have stages, and the
    guess has none, see `optimise_from`.
    """
    searched = shooting_grid(scaled)
    start = scaled_unknowns(searched, guess)
    status, point, total = minimise(searched, start, tolerance, min(max_iterations, SLOW), False, log)
    if status not in FAILED or total >= max_iterations:
        return status, scaled, point, total
    motion = forward_motion(shooting_grid(grid), guess)
    if motion is not None:
        motion_scaled = scaled_shooting_grid(grid, motion) if scaling == "auto" else grid
        motion_searched, remaining = shooting_grid(motion_scaled), max_iterations - total
        if status == "iteration limit":
            remaining = min(remaining, FROM_MOTION)  # the first search may still succeed
        begin = scaled_unknowns(motion_searched, motion)
        motion_status, optimum, iterations = minimise(motion_searched, begin, tolerance, remaining, False, log)
        total += iterations
        if motion_status in ("solved", "time limit"):
            return motion_status, motion_scaled, optimum, total
    if status == "iteration limit" and total < max_iterations:
        status, point, iterations = minimise(searched, start, tolerance, max_iterations - total, False, log)
        total += iterations
    return status, scaled, point, total


def corrected_status(grid, guess, point, status):
    """Return the status of a search on a grid, or a more precise status.

    "solved" becomes "stalled" if multipliers are so huge that any slope looks like a rounding error. It becomes
    "unbounded" if unknowns are so far from the guess that any residual may be a rounding error. The guess (n,) is in
    the problem's own units.
    """
    if status == "solved" and point.stationarity > STEEP:
        without_multipliers = evaluate(grid, np.where(grid.is_multiplier, 0.0, point.unknowns))
        steepest_cost = np.abs(without_multipliers.gradient[~grid.is_multiplier]).max(initial=0.0)
        if point.stationarity > STEEP * steepest_cost:
            status = "stalled"
    status = final_status(grid, scaled_unknowns(grid, guess), point, status)
    is_doubtful = status == "solved" and point.residual > ROUNDED
    if is_doubtful and has_run_away(grid, guess, unscaled_unknowns(grid, point.unknowns)):
        return "unbounded"
    return status


def has_run_away(scaled, guess, unknowns):
    """Return True if unknowns are so far from the guess that any residual may be a rounding error.

    Guess and unknowns are in the problem's own units. They must be far apart both in these units and with the scaling
    factors of the grid `scaled`, because one of both tests alone may mean little.
    """
    is_primal = ~scaled.is_multiplier
    size, guess_size = np.abs(unknowns[is_primal]).max(), np.abs(guess[is_primal]).max()
    if not size > RUN_AWAY * guess_size:
        return False
    guess, unknowns = scaled_unknowns(scaled, guess), scaled_unknowns(scaled, unknowns)
    return np.abs(unknowns[is_primal]).max() > RUN_AWAY * max(1.0, np.abs(guess[is_primal]).max())


def scaled_unknowns(grid, unknowns):
    """Return `unknowns` (n,) divided by the scaling factors of the grid, if it has any."""
    return unknowns / grid.sizes if grid.sizes.size else unknowns


def corrected_cost(grid, point):
    """Return the cost of an optimum in its own units, corrected for residuals and for distances to active bounds.

    The correction is of first order. If equations force unknowns onto their bounds, multipliers have no limit, and the
    correction is large and meaningless. The cost then remains unchanged.
    """
    lower, upper = (NONE, NONE) if grid.problem.variable_bounds is None else bounds_of(grid)
    corrected = point.cost + correction(point.unknowns, point.gradient, grid.is_multiplier, lower, upper)
    if abs(corrected - point.cost) > LARGE_CORRECTION * abs(point.cost):
        corrected = point.cost
    return float(corrected) / grid.weight


@njit(cache=True, error_model="numpy")
def correction(unknowns, gradient, is_multiplier, lower, upper):
    """Return the sum of multipliers times residuals, minus the sum of duals times distances of active bounds.

    The dual of a bound is the slope of the Lagrangian at the bound. `lower` and `upper` are (n,), or empty without
    bounds.
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


def forward_motion(grid, unknowns):
    """Return the unknowns (n,) of the motion under the controls of a guess (n,), without multipliers.

    Return None if the motion diverges, or if Newton's method fails. Controls are moved inside their bounds. Everything
    is in the problem's own units.
    """
    s, (lower, upper) = grid.problem.structure, bounds_of(grid)
    motion = np.minimum(np.maximum(np.where(grid.is_multiplier, 0.0, unknowns), lower), upper)
    limit, linking = BEYOND * max(1.0, np.abs(motion).max()), motion[motion.size - s.root :]
    piece, inside = np.concatenate([motion[: s.element], linking]), s.motion_unknowns[s.motion_unknowns < s.stride]
    # The entries of an interval's Hessian that belong to the motion: number, row and column.
    row, column = ({int(j): i for i, j in enumerate(kind)} for kind in (s.motion_equations, s.motion_unknowns))
    pairs = list(enumerate(zip(s.rows.tolist(), s.columns.tolist(), strict=True)))
    entries = [(k, row[i], column[j]) for k, (i, j) in pairs if i in row and j in column]
    entries += [(k, row[j], column[i]) for k, (i, j) in pairs if j in row and i in column]
    entries = np.array(entries).T
    for k in range(grid.steps):
        first, solved = k * s.stride, piece[inside]
        piece[: s.element] = motion[first : first + s.element]
        piece[s.stride : s.element] = piece[: s.node]
        if k > 0:
            piece[inside] = solved  # the stages of the previous interval are the initial guess
        if not is_solved_for_motion(grid, k, piece, entries) or not np.abs(piece).max() <= limit:
            return None
        motion[first + s.motion_unknowns] = piece[s.motion_unknowns]
    return with_slacks(grid, motion) if s.slacks.size else motion


def is_solved_for_motion(grid, k, piece, entries):
    """Return True if Newton's method finds the state after interval k, and the stages, from the state before it.

    `piece` (element + root,) has the unknowns of the interval and both its nodes, then linking variables. The result is
    stored in `piece`. `entries` are numbers, rows and columns of the entries of the Jacobian.
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


def solve_linear_quadratic(grid, unknowns, tolerance, log, system=None):
    """Solve a linear-quadratic problem; return (status, point, iterations).

    A row (cost, residual, stationarity, 0, step length) is appended to `log` at every iterate. `system` is storage for
    the linear system; without it, new storage is allocated.
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
            optimum, steps = with_redundant_equations(grid, point, system, tolerance)
            if optimum is not None:
                return "solved", optimum, iteration + steps
            return *without_minimum(grid, point, system), iteration
        if (iteration > 0 or point.error <= WORTH_MEASURING) and is_solved(grid, point, tolerance, ROUNDINGS):
            return "solved", point, iteration
        if iteration > 0:
            solve_kkt(grid, system, point.gradient, step)
        point = evaluate(grid, point.unknowns + step)
    return "stalled", point, 3


def with_redundant_equations(grid, point, system, tolerance):
    """Return (point, steps) for the unique optimum of a problem with dependent equations that agree, else (None, 0).

    The KKT matrix has -FLAT on the diagonal of the multipliers, and the steps are those of the method of multipliers.
    An example is a prescribed momentum that is conserved. Source: Friedlander and Orban (2012), A primal-dual
    regularized interior-point method for convex quadratic programs.
    """
    step, diagonal = np.empty_like(point.unknowns), np.where(grid.is_multiplier, -FLAT, 0.0)
    if factor_kkt(grid, point.unknowns, 1.0, diagonal, system, point.gradient, step) != 0:
        return None, 0
    for number in range(1, MOST_MULTIPLIER_STEPS + 1):
        point = evaluate(grid, point.unknowns + step)
        if not point.error < np.inf:
            break
        if is_solved(grid, point, tolerance, ROUNDINGS):
            return point, number
        solve_kkt(grid, system, point.gradient, step)
    return None, 0


def without_minimum(grid, point, system):
    """Return (status, point) for a problem whose KKT matrix is singular, or has not the inertia of a minimum.

    The point is the nearest point where the equations hold, or where their violation is least.
    """
    step, residual = np.empty_like(point.unknowns), point.residual
    least = evaluate(grid, np.where(grid.is_multiplier, 0.0, point.unknowns))
    for _ in range(5):
        gradient = np.where(grid.is_multiplier, least.gradient, 0.0)
        diagonal = np.where(grid.is_multiplier, -FLAT, 1.0)
        if not is_factored(factor_kkt(grid, least.unknowns, 0.0, diagonal, system, gradient, step)):
            break
        step[grid.is_multiplier] = 0.0
        least = evaluate(grid, least.unknowns + step)
    if least.residual > CONTRADICTORY * residual:
        return "infeasible", least
    if least_delta_w(grid, point.unknowns, system) > FLAT:
        return "unbounded", least
    solve_kkt(grid, system, least.gradient, step)
    is_large = np.abs(step[~grid.is_multiplier]).max() > LARGE * max(1.0, np.abs(least.unknowns).max())
    return "unbounded" if is_large else "rank-deficient", least
