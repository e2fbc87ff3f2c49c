"""Newton's method with a filter line search; for bounded unknowns, a primal-dual interior-point method.

The compiled function `descend` is the same for all problems. Its arguments are vectors, the addresses of the loops and
of the linear system of a problem, and work space. It allocates nothing, raises nothing, and releases the lock of the
Python interpreter. It returns after a given number of iterations, or when Python has to act. Its state stays in the
work space for the next call.

A logarithmic barrier with a weight mu replaces bounds; mu tends to zero. For each weight, Newton's method solves the
optimality conditions. The inertia of the KKT matrix is corrected until the step is a descent step, and a filter decides
on the step length. Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search
algorithm for large-scale nonlinear programming. Numbers of equations and sections in this file refer to this article.

Every finite bound b is an entry of flat arrays: the index of its unknown x in `indices`, its `side` s, and its
`magnitude` max(1, |b|). The side is 1 for a lower and -1 for an upper bound. With distance d = s (x - b) and dual z,
the perturbed optimality conditions are gradient - s z = 0 and z d = mu. Each step updates the distances like the
unknowns: a distance that is computed from x and b close to a bound would be a rounding error. Bounds are relaxed a
little, so that equations may force unknowns onto them. The relaxation falls to rounding level with mu.

Several functions share arguments. `problem`, `grid`, `system` and `bounds` are tuples, see `descend`. `x` and `g` (n,)
are the unknowns and the gradient of the Lagrangian. `distance` and `duals` (m,) belong to all bounds.
"""

import numpy as np
from numba import njit

from codegen.runtime.search.direction import (
    ACCURATE,
    PER_WEIGHT,
    RELAXED,
    approach,
    fill_linear_residual,
    fill_newton_system,
    is_minimum,
    lower_barrier,
    measure_step,
    move,
    regularise,
    relaxation,
    sum_of_logarithms,
)
from codegen.runtime.search.first_iterate import begin, copy, enter
from codegen.runtime.search.linear_system import solve_at
from codegen.runtime.search.optimality import (
    evaluated,
    is_acceptable,
    is_at_rounding_level,
    is_gross,
    is_solved,
    log_row,
    measured_again,
    terms,
)
from codegen.runtime.search.workspace import (
    AT_REST,
    CONTINUE,
    COST,
    CURVED,
    DAMPING,
    DELTA_W,
    DIAGONAL,
    DISTANCE,
    DOUBTFUL,
    DUAL_STEP,
    DUAL_STEP2,
    DUALS,
    EMPTIED,
    ENOUGH,
    FIRST_COST,
    FOLLOWED,
    GO_ON,
    GROSS,
    HAS_KNOWN,
    HAS_LOOSE,
    IN_TURN,
    IN_VAIN,
    INFEASIBLE,
    IS_COSTLESS,
    IS_FACTORED,
    IS_WARM,
    ITERATIONS,
    KNOWN,
    LAST_COST,
    LAST_DELTA_W,
    LAST_ERROR,
    LATE,
    LEAST_RELAXATION,
    LENGTH,
    LOOKS,
    LOOSE_DISTANCE,
    LOOSE_DUALS,
    LOOSE_MU,
    LOOSE_X,
    LOWERED,
    MOVED,
    MU,
    NON_FINITE,
    PAIRS,
    PUSHED,
    RANK_DEFICIENT,
    REFUSED,
    RESTORE,
    RIGHT,
    RIGHT2,
    ROOM,
    SADDLE,
    SEEN,
    SHIFTED,
    SHIFTED_COST,
    SHORTENED,
    SHORTEST,
    SMALL_VIOLATION,
    SOLVED,
    STAGE,
    STALLED,
    STEP,
    STEP2,
    TRIAL,
    TRIAL_G,
    UNBOUNDED,
    WAS_SINGULAR,
    WATCH_DISTANCE,
    WATCH_DUALS,
    WATCH_LONGEST,
    WATCH_OBJECTIVE,
    WATCH_SLOPE,
    WATCH_VIOLATION,
    WATCH_X,
    WATCHING,
    WEIGHT,
    WITH_UNKNOWNS,
    G,
    X,
)

# The end of a search.
PROGRESS = 0.5  # a warm search ends at rounding level if a step reduces the error by a smaller factor
# Largest relative change of an error that counts as unchanged; number of unchanged iterates in turn that end a search.
UNCHANGED, REST = 1e-3, 5
UNBOUNDED_BELOW = 1e10  # a cost below minus this number times max(1, |first cost|) counts as minus infinity
LARGEST = 1e20  # a problem with bounds counts as unbounded if an unknown exceeds it
PATIENCE = 8  # iterations with the last weight after which the convergence test scales multipliers
VAIN = 20  # full steps in turn without effect on the violation, after which equations count as contradictory
ROUNDED = 1e-12  # residuals below it are rounding errors, which no step reduces
NEARLY = 1e-6  # largest error of an iterate that may be a saddle point
NEARLY_FEASIBLE = 1e-6  # largest residual of an unbounded problem's iterate, relative to max(1, ten times the terms)

# The barrier.
MOST_RELAXING = RELAXED / PER_WEIGHT  # weights above it have the largest relaxation
FOLLOWED_DECREASE = 0.4  # smallest ratio of two weights if the equations depend on the weight
LEAST_PART = 0.025  # the last weight, relative to the tolerance; with 0.1, the cost of a crane problem is off by 2e-9

# Line search.
CORRECTIONS = 4  # largest number of second-order corrections at one iterate
SHORT = 0.25  # largest relative length of a much shortened step
SHORT_IN_TURN = 6  # much shortened steps in turn after which the Hessian is damped
SHORTENED_IN_TURN = 10  # shortened steps in turn after which the watchdog begins
FULL_STEPS = 4  # full steps that the watchdog takes without a test
LEAST_DAMPING = 1e-5  # least damping of the Hessian after several much shortened steps
LITTLE = 0.01  # largest relative length of a step of which the line search leaves little
UNSOLVED = 0.1  # if a full step leaves a larger part of the residual, its linear system may be solved inaccurately
TINY, CLOSER = 1e-13, 0.9  # a step up to TINY max(1, |x|) changes nothing; largest ratio of errors of a closer trial
MISLED = 5  # steps in turn, shortened by the filter alone, after which the filter is emptied
EMPTIED_AT_MOST = 5  # largest number of times that the filter is emptied, so that a search cannot cycle

# If the Hessian is indefinite at many iterates in turn that nearly satisfy the equations, and the cost changes by a
# small part of itself, see `curvature`.
NEAR_EQUATIONS, SHIFTED_IN_TURN, SLOW_COST = 1e-2, 30, 1e-2


@njit(error_model="numpy")
def lets_pass(pairs, count, violation, objective):
    """Return True if none of the first `count` pairs of the filter is better in both measures (18).

    The two measures are the constraint violation and the objective.
    """
    passes = True
    for j in range(count):
        passes = passes and (violation < pairs[j, 0] or objective < pairs[j, 1])
    return passes


@njit(error_model="numpy")
def add_pair(pairs, count, violation, objective):
    """Add a pair (violation, objective), slightly lowered, to the filter; return the new number of pairs.

    Pairs that the new pair dominates are removed, except for the first pair.
    """
    violation, objective = (1.0 - 1e-5) * violation, objective - 1e-8 * violation
    kept = 1
    for j in range(1, count):
        if not (violation <= pairs[j, 0] and objective <= pairs[j, 1]):
            pairs[kept, 0], pairs[kept, 1] = pairs[j, 0], pairs[j, 1]
            kept += 1
    if kept < pairs.shape[0]:
        pairs[kept, 0], pairs[kept, 1] = violation, objective
        kept += 1
    return kept


@njit(error_model="numpy")
def accepts(pairs, integers, violation, objective, trial_violation, trial_objective, slope, length, small):
    """Return True if the filter line search accepts a trial (19, 20), and update the filter.

    The objective is the barrier function. `slope` is its derivative along the step, and `small` is the largest
    violation for which the objective must fall as the slope predicts. The filter grows unless the objective falls as
    predicted. Old pairs with a small violation and a low objective may block progress for many iterations. Therefore
    all pairs except the first are removed if the filter alone has refused trials of MISLED iterates in turn. IPOPT does
    the same (option filter_reset_trigger).
    """
    rounding = 2e-15 * abs(objective)
    promising = slope < 0.0 and length * (-slope) ** 2.3 > violation**1.1
    fell = promising and trial_objective <= objective + 1e-8 * length * slope + rounding
    if promising and violation <= small:
        better = fell
    else:
        is_closer = trial_violation <= (1.0 - 1e-5) * violation
        better = is_closer or trial_objective <= objective - 1e-8 * violation + rounding
    if not better or not lets_pass(pairs, integers[PAIRS], trial_violation, trial_objective):
        integers[REFUSED] = better
        return False
    integers[IN_TURN] = integers[IN_TURN] + 1 if integers[REFUSED] else 0
    integers[REFUSED] = 0
    if integers[IN_TURN] == MISLED and integers[EMPTIED] < EMPTIED_AT_MOST:
        integers[PAIRS], integers[IN_TURN] = 1, 0
        integers[EMPTIED] += 1
    if not fell:
        integers[PAIRS] = add_pair(pairs, integers[PAIRS], violation, objective)
    return True


@njit(cache=True, error_model="numpy", nogil=True)
def descend(
    problem, grid, system, bounds, tolerance, limit, most, reals, integers, vectors, barriers, pairs, room, log
):
    """Follow Newton's steps; return the reason for the return, a number such as SOLVED.

    A search begins, according to its STAGE, at the iterate or at the primal unknowns in the work space. A search
    without bounds and with LOOKS ends at once, as GROSS, if the equations are grossly violated.

    Parameters
    ----------
    problem : tuple of int
        Addresses of the loops for the gradient and for the second derivatives, and of the linear system.
    grid : tuple
        steps, h, nodes, parameters, is_multiplier, sizes, forces, weight, ties, is_free, fillings, durations; see
        `iterates.arguments_of`.
    system : tuple
        Storage of the linear system: tables, factors, orders, entries, scaled, costless, inverses, counts, equations,
        rows, columns; see `linear_system.System`.
    bounds : tuple
        indices, side, magnitude, value (m,) of all finite bounds; least and greatest values (n,), or empty arrays
        without bounds.
    tolerance : float
        Tolerance of residual and stationarity, see `is_solved`.
    limit, most : int
        Largest number of iterations of the whole search, and of this call.
    reals, integers : (REALS,), (INTEGERS,)
        The state; cost, residual, violation, stationarity and error of the iterate begin at COST.
    vectors, barriers : (VECTORS, n), (BARRIERS, m)
        Work space; the iterate is in the rows X, G, DISTANCE and DUALS.
    pairs : (.., 2)
        The pairs (violation, objective) of the filter.
    room : (2 SOLVED_AGAIN + 2, n) or (0, n)
        Work space for refinement. If it is empty but needed, the function returns ROOM.
    log : (most + 1, 6)
        Rows of all iterates: cost, residual, stationarity, shift of the Hessian, step length, mu.
    """
    indices, side, magnitude = bounds[0], bounds[1], bounds[2]
    n, m, is_multiplier = vectors.shape[1], indices.size, grid[4]
    x, g, trial, tg = vectors[X], vectors[G], vectors[TRIAL], vectors[TRIAL_G]
    distance, duals, moved, pushed = barriers[DISTANCE], barriers[DUALS], barriers[MOVED], barriers[PUSHED]
    right, step, right2, step2 = vectors[RIGHT], vectors[STEP], vectors[RIGHT2], vectors[STEP2]
    dual_step, dual_step2 = barriers[DUAL_STEP], barriers[DUAL_STEP2]
    is_costless, least_mu, done, status = integers[IS_COSTLESS], LEAST_PART * tolerance, 0, CONTINUE
    if integers[STAGE] == WITH_UNKNOWNS:
        begin(problem, grid, bounds, reals, integers, vectors, barriers)
    if integers[STAGE] != GO_ON:
        if m == 0 and integers[LOOKS] and is_gross(problem, grid, system, reals, vectors):
            return GROSS
        enter(problem, grid, system, bounds, reals, integers, vectors, barriers, pairs)
    measures, measured = measured_again(bounds, is_multiplier, reals[COST : COST + 5], x, g, distance, duals, vectors)
    logarithms = sum_of_logarithms(distance)
    t_measures, t_measured, t_logarithms = measures, measured, logarithms
    while True:
        cost, residual, violation, stationarity, error = measures
        _, gap, lowest, highest, mean, mean_dual, largest = measured
        mu, iteration = reals[MU], integers[ITERATIONS]
        log_row(grid, g, cost, residual, stationarity, log[done])
        log[done, 3], log[done, 4], log[done, 5] = reals[DELTA_W], reals[LENGTH], mu
        # Convergence test.
        converged = False
        if error < np.inf and (m == 0 or highest <= tolerance):
            converged = is_solved(
                problem, grid, system, x, residual, stationarity, tolerance, is_costless, vectors
            )  # fmt: skip
        if not converged and m > 0 and integers[LATE] > PATIENCE:
            converged = is_acceptable(
                problem, grid, system, x, measures, measured, tolerance, is_costless, vectors
            )  # fmt: skip
        if integers[SEEN] <= iteration:  # not the iterate that the previous call has tested already
            integers[SEEN] = iteration + 1
            is_closed = m == 0 or highest <= tolerance
            if not converged and integers[IS_WARM] and PROGRESS * reals[LAST_ERROR] < error < np.inf:
                # A search that begins near a solution may reach it at once, up to rounding errors.
                converged = is_closed and is_at_rounding_level(
                    problem, grid, system, x, residual, stationarity, is_costless, vectors
                )
            # Terms that cancel in the first derivatives, as in exp(x) - 1, do not appear in the second derivatives.
            # Their rounding errors exceed the estimate of `terms`: steps then change neither cost nor error any more.
            is_unchanged = cost == reals[LAST_COST] and abs(error - reals[LAST_ERROR]) <= UNCHANGED * error
            integers[AT_REST] = integers[AT_REST] + 1 if is_unchanged and is_closed and error <= tolerance else 0
            converged = converged or integers[AT_REST] >= REST
            reals[LAST_ERROR], reals[LAST_COST] = error, cost
        if not error < np.inf:
            status = NON_FINITE
        elif converged:
            status = SOLVED
            # After descent steps with an unshifted Hessian, a stationary point is a minimum. Otherwise test it.
            if (iteration == 0 or reals[DELTA_W] > 0.0) and not is_minimum(
                problem, grid, system, bounds, x, g, distance, duals, tolerance, integers, vectors
            ):
                status = SADDLE
        elif m > 0 and largest > LARGEST:
            status = UNBOUNDED
        elif cost < -UNBOUNDED_BELOW * max(1.0, abs(reals[FIRST_COST])):
            # Huge unknowns have huge residuals, even if the motion nearly satisfies the equations.
            of_equations, _ = terms(problem, grid, system, x, is_costless, vectors)
            if residual <= NEARLY_FEASIBLE * max(1.0, 10.0 * of_equations):
                status = UNBOUNDED
        if status == CONTINUE and integers[HAS_KNOWN] and max(residual, stationarity) <= NEARLY:
            # The search that starts next to a saddle point leads to no lower cost.
            predicted = cost - gap
            for i in range(n):
                if is_multiplier[i]:
                    predicted += x[i] * g[i]
            if not predicted < reals[KNOWN] - 1e-9 * max(1.0, abs(reals[KNOWN])):
                status = SADDLE
        if status == CONTINUE and integers[IN_VAIN] >= VAIN and residual > reals[SMALL_VIOLATION]:
            status = INFEASIBLE
        if status != CONTINUE or iteration >= limit or done >= most:
            break
        if integers[SHIFTED] >= SHIFTED_IN_TURN:
            if abs(cost - reals[SHIFTED_COST]) <= SLOW_COST * abs(cost):
                status = CURVED
                break
            integers[SHIFTED] = 0
        if integers[SHIFTED] == 0:
            reals[SHIFTED_COST] = cost
        # Update of the barrier's weight, and of the relaxation of bounds.
        if m > 0:
            scaled = max(stationarity / max(1.0, mean / 100.0), residual)
            new = lower_barrier(mu, least_mu, scaled, max(1.0, mean_dual / 100.0), lowest, highest)
            if integers[FOLLOWED]:
                new = max(new, FOLLOWED_DECREASE * mu)
            if new < mu:
                integers[PAIRS], integers[REFUSED], integers[IN_TURN] = 1, 0, 0
                integers[SHORTENED], integers[WATCHING] = 0, 0
                by = 0.0
                if new < MOST_RELAXING:
                    by = relaxation(mu, reals[LEAST_RELAXATION]) - relaxation(new, reals[LEAST_RELAXATION])
                if by > 0.0:
                    if not integers[HAS_LOOSE]:
                        copy(x, vectors[LOOSE_X])
                        copy(distance, barriers[LOOSE_DISTANCE])
                        copy(duals, barriers[LOOSE_DUALS])
                        reals[LOOSE_MU], integers[HAS_LOOSE] = mu, 1
                    least = 0.1 * relaxation(new, reals[LEAST_RELAXATION])
                    copy(x, trial)
                    logarithms, moves = approach(x, indices, side, magnitude, by, least, distance, moved)
                    copy(moved, distance)
                    if moves:
                        for j in range(grid[8].shape[0]):  # unknowns that equal a linking variable move along
                            x[grid[8][j, 0]] += x[grid[8][j, 1]] - trial[grid[8][j, 1]]
                        measures, measured = evaluated(problem, grid, bounds, x, g, distance, duals, vectors)
                        cost, residual, violation, stationarity, error = measures
                        _, gap, lowest, highest, mean, mean_dual, largest = measured
                reals[MU] = mu = new
                if integers[FOLLOWED]:
                    status = WEIGHT
                    break
            if mu <= least_mu:
                integers[LATE] += 1
        objective, small = cost - mu * logarithms, reals[SMALL_VIOLATION]
        # Newton's step. Attempt 0 uses the factors of the matrix at a nearby point, 1 is a new step, 2 a refined step.
        accepted, has_step, delta_w, longest, slope, dual_length, is_watched = False, False, 0.0, 0.0, 0.0, 0.0, False
        with_factors = integers[IS_FACTORED] == 1
        integers[IS_FACTORED] = 0
        careful = integers[DOUBTFUL] >= integers[ENOUGH] and not with_factors
        if careful and room.shape[0] == 0:
            status = ROOM
            break
        damping_before, delta_before, last_before = reals[DAMPING], reals[DELTA_W], reals[LAST_DELTA_W]
        lowered_before, singular_before = integers[LOWERED], integers[WAS_SINGULAR]
        attempt = 0 if with_factors else 1
        while attempt < 3 and not accepted:
            if attempt == 0:
                fill_newton_system(grid, bounds, g, distance, duals, mu, 0.0, 0.0, right, vectors[DIAGONAL])
                solve_at(
                    problem[2], grid[0], system[0], right, system[8], system[1], system[2], system[6], system[7], step
                )
                slope, _, longest, dual_length = measure_step(
                    grid, bounds, x, right, step, distance, duals, mu, dual_step
                )  # fmt: skip
                has_step, delta_w = True, 0.0
            else:
                has_step, slope, longest, dual_length, delta_w, is_refined = regularise(
                    problem, grid, system, bounds, x, g, distance, duals, mu, damping_before, careful, reals, integers,
                    vectors, barriers, room,
                )  # fmt: skip
                if not has_step:
                    break
                if careful:
                    integers[DOUBTFUL] = 1 if is_refined else 0
                    integers[ENOUGH] = 1 if is_refined else 4 * integers[ENOUGH]
                if attempt == 1 and integers[SHORTENED] == SHORTENED_IN_TURN:
                    # If the curvature of the equations makes the filter shorten step after step, full steps may be
                    # better. If no full step is better, the search continues from this iterate. This is the watchdog
                    # technique, section 3.2.
                    integers[WATCHING] = FULL_STEPS
                    copy(x, vectors[WATCH_X])
                    copy(distance, barriers[WATCH_DISTANCE])
                    copy(duals, barriers[WATCH_DUALS])
                    reals[WATCH_VIOLATION], reals[WATCH_OBJECTIVE] = violation, objective
                    reals[WATCH_SLOPE], reals[WATCH_LONGEST] = slope, longest
                if integers[WATCHING]:
                    is_watched = True
                    break
            # Filter line search.
            length = longest
            while length > reals[SHORTEST] and not accepted:
                reals[LENGTH] = length
                t_logarithms = move(
                    bounds, x, step, length, distance, duals, dual_step, dual_length, mu, trial, moved, pushed
                )
                t_measures, t_measured = evaluated(problem, grid, bounds, trial, tg, moved, pushed, vectors)
                if t_measures[4] < np.inf:
                    accepted = accepts(
                        pairs, integers, violation, objective, t_measures[2], t_measures[0] - mu * t_logarithms, slope,
                        length, small,
                    )  # fmt: skip
                if not accepted and length == longest:
                    is_closer = t_measures[4] < CLOSER * error
                    if m > 0:
                        of_barrier = max(error, highest - mu, mu - lowest)
                        of_trial = max(t_measures[4], t_measured[3] - mu, mu - t_measured[2])
                        is_closer = is_closer or of_trial < CLOSER * of_barrier
                    if is_closer:
                        # At rounding level, cost and violation do not tell if a step is good. IPOPT accepts tiny steps
                        # without a test: section 3.9.
                        rests = True
                        for i in range(n):
                            rests = rests and (is_multiplier[i] or abs(step[i]) <= TINY * max(1.0, abs(x[i])))
                        accepted = rests or is_at_rounding_level(
                            problem, grid, system, trial, t_measures[1], t_measures[3], is_costless, vectors
                        )
                    if not accepted and t_measures[2] >= violation:
                        # Second-order corrections (27) of a full step that the curvature of the equations spoils. Duals
                        # follow the corrected step, since the duals of the refused step belong to other distances.
                        copy(right, right2)
                        soc_length, refused = longest, t_measures[2]
                        for correction in range(CORRECTIONS):
                            for i in range(n):
                                if is_multiplier[i]:
                                    before = g[i] if correction == 0 else right2[i]
                                    right2[i] = soc_length * before + tg[i]
                            solve_at(
                                problem[2], grid[0], system[0], right2, system[8], system[1], system[2], system[6],
                                system[7], step2,
                            )  # fmt: skip
                            _, _, soc_length, soc_dual = measure_step(
                                grid, bounds, x, right2, step2, distance, duals, mu, dual_step2
                            )
                            t_logarithms = move(
                                bounds, x, step2, soc_length, distance, duals, dual_step2, soc_dual, mu, trial, moved,
                                pushed,
                            )  # fmt: skip
                            t_measures, t_measured = evaluated(problem, grid, bounds, trial, tg, moved, pushed, vectors)
                            if t_measures[4] < np.inf:
                                accepted = accepts(
                                    pairs, integers, violation, objective, t_measures[2],
                                    t_measures[0] - mu * t_logarithms, slope, longest, small,
                                )  # fmt: skip
                            if accepted or not t_measures[2] < 0.99 * refused:
                                break
                            refused = t_measures[2]
                if not accepted:
                    length *= 0.5
            if not accepted:
                reals[LENGTH] = length
            if attempt == 0:
                attempt = 1
                continue
            # If the equations were linear, the part 1 - length of each residual would remain. A larger residual comes
            # from curvature, or from an inaccurate step. So may a poor step: one of which the line search leaves little
            # or nothing, although the equations nearly hold.
            expected = max(ROUNDED, (1.0 - reals[LENGTH] + UNSOLVED) * residual)
            is_tested = attempt == 1 and not careful and (m > 0 or delta_w == 0.0)
            is_poor = (not accepted or reals[LENGTH] <= LITTLE * longest) and residual <= NEARLY
            if is_tested and (is_poor or (accepted and t_measures[1] > expected)):
                integers[DOUBTFUL] += 1
                if is_poor or integers[DOUBTFUL] >= integers[ENOUGH]:
                    fill_newton_system(grid, bounds, g, distance, duals, mu, delta_w, 0.0, right, vectors[DIAGONAL])
                    remainder = fill_linear_residual(
                        problem, grid, system, x, vectors[DIAGONAL], right, step, 1.0, vectors, right2
                    )
                    if remainder > ACCURATE:
                        if room.shape[0] == 0:
                            status = ROOM
                            break
                        accepted, careful = False, True
                        reals[DELTA_W], reals[LAST_DELTA_W] = delta_before, last_before
                        integers[LOWERED], integers[WAS_SINGULAR] = lowered_before, singular_before
                        attempt = 2
                        continue
                    if not is_poor:
                        integers[DOUBTFUL], integers[ENOUGH] = 0, 4 * integers[ENOUGH]
            break
        if status == ROOM:
            integers[DOUBTFUL] = integers[ENOUGH]  # the next call repeats the step and refines it
            reals[DELTA_W], reals[LAST_DELTA_W] = delta_before, last_before
            integers[LOWERED], integers[WAS_SINGULAR] = lowered_before, singular_before
            break
        if is_watched:
            integers[SHORTENED] = 0
            reals[LENGTH] = longest
            t_logarithms = move(
                bounds, x, step, longest, distance, duals, dual_step, dual_length, mu, trial, moved, pushed
            )
            t_measures, t_measured = evaluated(problem, grid, bounds, trial, tg, moved, pushed, vectors)
            better = t_measures[4] < np.inf and accepts(
                pairs, integers, reals[WATCH_VIOLATION], reals[WATCH_OBJECTIVE], t_measures[2],
                t_measures[0] - mu * t_logarithms, reals[WATCH_SLOPE], reals[WATCH_LONGEST], small,
            )  # fmt: skip
            accepted = True
            if better:
                integers[WATCHING] = 0
            elif integers[WATCHING] == 1 or not t_measures[4] < np.inf:
                reals[LENGTH], integers[WATCHING] = 0.0, 0
                copy(vectors[WATCH_X], trial)
                copy(barriers[WATCH_DISTANCE], moved)
                copy(barriers[WATCH_DUALS], pushed)
                t_measures, t_measured = evaluated(problem, grid, bounds, trial, tg, moved, pushed, vectors)
                t_logarithms = sum_of_logarithms(moved)
            else:
                integers[WATCHING] -= 1
        elif has_step:
            shorter = not accepted or reals[LENGTH] < longest
            integers[SHORTENED] = integers[SHORTENED] + 1 if shorter else 0
            as_before = not shorter and t_measures[2] >= 0.999 * violation
            integers[IN_VAIN] = integers[IN_VAIN] + 1 if as_before else 0
            if integers[SHORTENED] or reals[DAMPING] > 0.0:
                # A Hessian that is barely positive definite makes steps far too long.
                damping = reals[DAMPING]
                if not accepted:
                    reals[DAMPING] = 0.0
                elif reals[LENGTH] <= SHORT * longest and integers[SHORTENED] >= SHORT_IN_TURN:
                    reals[DAMPING] = 4.0 * max(delta_w, damping, LEAST_DAMPING)
                elif not reals[LENGTH] < longest:
                    reals[DAMPING] = damping / 2.0 if damping > LEAST_DAMPING else 0.0
        if not accepted:
            convex = not has_step or delta_w == 0.0 or is_minimum(
                problem, grid, system, bounds, x, g, distance, duals, tolerance, integers, vectors
            )  # fmt: skip
            if m > 0 and integers[LATE] > 0 and convex and is_acceptable(
                problem, grid, system, x, measures, measured, tolerance, is_costless, vectors
            ):  # fmt: skip
                status = SOLVED
            elif not has_step:
                status = RANK_DEFICIENT
            elif not convex and max(residual, stationarity) <= NEARLY:
                status = SADDLE
            elif not is_at_rounding_level(
                problem, grid, system, x, residual, stationarity, is_costless, vectors
            ):  # fmt: skip
                status = RESTORE
                integers[PAIRS] = add_pair(pairs, integers[PAIRS], violation, objective)
            elif m > 0 and not gap <= tolerance * m:
                status = STALLED
            else:
                status = SOLVED if convex else SADDLE  # only rounding errors remain
            break
        copy(trial, x)
        copy(tg, g)
        copy(moved, distance)
        copy(pushed, duals)
        measures, measured, logarithms = t_measures, t_measured, t_logarithms
        integers[ITERATIONS] += 1
        done += 1
        is_shifted = reals[DELTA_W] > 0.0 and reals[LENGTH] >= SHORT and measures[1] <= NEAR_EQUATIONS
        integers[SHIFTED] = integers[SHIFTED] + 1 if is_shifted else min(integers[SHIFTED], 0)
    for i in range(5):
        reals[COST + i] = measures[i]
    return status
