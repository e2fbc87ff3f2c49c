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

from codegen.runtime.kkt.system import SINGULAR
from codegen.runtime.search.linear_system import call_hessians, factor_at, global_index, multiply_entries, solve_at
from codegen.runtime.search.point import measured_gradient

# Results of `descend`: the reason why it returns.
(
    CONTINUE, SOLVED, SADDLE, NON_FINITE, UNBOUNDED, INFEASIBLE, RANK_DEFICIENT, STALLED, RESTORE, ROOM, GROSS, WEIGHT,
    CURVED,
) = range(13)  # fmt: skip
WORDS = (
    "iteration limit", "solved", "saddle point", "non-finite", "unbounded", "infeasible", "rank-deficient", "stalled",
)  # fmt: skip
"""The termination status for each of the first eight of these numbers."""

# Rows of the vectors (VECTORS, n) and of the arrays (BARRIERS, m) of the work space.
(
    X, G, TRIAL, TRIAL_G, RIGHT, DIAGONAL, STEP, SCALED, SPARE, RIGHT2, STEP2, WATCH_X, LOOSE_X,
) = range(13)  # fmt: skip
VECTORS = 13
(
    DISTANCE, DUALS, MOVED, PUSHED, DUAL_STEP, DUAL_STEP2, WATCH_DISTANCE, WATCH_DUALS, LOOSE_DISTANCE, LOOSE_DUALS,
) = range(10)  # fmt: skip
BARRIERS = 10

# Indices of the state of a search, between calls: floats, then integers. LOOSE_... is the iterate before bounds are
# relaxed less for the first time, and WATCH_... the iterate to which the watchdog may return. KNOWN is the cost of a
# saddle point. LATE, SHORTENED, IN_VAIN, IN_TURN and AT_REST count iterations in turn. DOUBTFUL counts steps whose
# linear system may be solved inaccurately, and ENOUGH is the number of such steps that calls for a measurement. With
# FOLLOWED, the equations depend on the barrier's weight: the search returns WEIGHT after each change of it. SHIFTED
# counts steps in turn with a shifted Hessian near the equations, and SHIFTED_COST is the cost before them.
(
    MU, LEAST_RELAXATION, SHORTEST, SMALL_VIOLATION, FIRST_COST, DELTA_W, LAST_DELTA_W, DAMPING, LENGTH, LAST_ERROR,
    WATCH_VIOLATION, WATCH_OBJECTIVE, WATCH_SLOPE, WATCH_LONGEST, KNOWN, COST, RESIDUAL, VIOLATION,
    STATIONARITY, ERROR, LOOSE_MU, LAST_COST, PUSH, FUNNEL, FIRST_MU, FIRST_VIOLATION, FIRST_ERROR, SHIFTED_COST,
) = range(28)  # fmt: skip
REALS = 28
(
    PAIRS, REFUSED, IN_TURN, EMPTIED, LATE, SHORTENED, WATCHING, IN_VAIN, DOUBTFUL, ENOUGH, LOWERED, WAS_SINGULAR,
    ITERATIONS, IS_WARM, IS_FACTORED, HAS_KNOWN, IS_COSTLESS, HAS_LOOSE, FACTORISATIONS, AT_REST, SEEN, STAGE, ON_PATH,
    LOOKS, IS_BESIDE, FOLLOWED, SHIFTED,
) = range(27)  # fmt: skip
INTEGERS = 27

# The stage of a search. It continues, or it begins with an iterate, with primal unknowns, or with the unknowns of a
# neighbour. A neighbour is the solution of a similar problem; `begin_beside` makes an iterate of its unknowns.
GO_ON, WITH_ITERATE, WITH_UNKNOWNS, WITH_NEIGHBOUR = range(4)

# The start of a search.
AT_GUESS, BESIDE, FROM_AFAR = (0.1, 1e-2), (1e-5, 1e-4), (0.1, 0.1)
"""The first weight of the barrier, and the push inside the bounds, for a search from a guess (AT_GUESS), for a warm
start without multipliers (BESIDE), and for a warm start with multipliers whose residual exceeds NEAR (FROM_AFAR).
Unknowns close to their bounds would shorten all steps."""
WARM_WEIGHT = 0.1  # the first weight of the barrier of a warm start, relative to the tolerance; 1 takes one more step
CLOSE = 1e-8  # least distance of unknowns to their bounds at a warm start
NEAR = 0.1  # largest residual of a warm start with multipliers; 0.3 takes 50 percent more iterations on one problem
LARGEST_FALL = 0.5  # largest part of a free duration that one step takes away; 0.75 and 0.9 take more iterations
LARGEST_DUAL = 1e3  # largest dual at a start, for a bound that is very close
LARGEST_MULTIPLIER = 1e3  # a larger least-squares multiplier means that equations depend on each other
FILTERED = 1e-4  # largest violation, relative to the first, for which the switching condition requires descent
GROSSLY = 0.03  # larger residuals, relative to the equations' terms, are a gross violation

# Magnitudes of residuals and of the terms of equations.
UNIT_ROUNDOFF = 2.2e-16
VANISHED = 1e-20  # a residual below it counts as zero, since a cost of squares may vanish with all its terms
WORTH_MEASURING = 1e-7  # for larger errors, the magnitudes of terms are not computed
ROUNDED = 1e-12  # residuals below it are rounding errors, which no step reduces
NEARLY = 1e-6  # largest error of an iterate that may be a saddle point
NEARLY_FEASIBLE = 1e-6  # largest residual of an unbounded problem's iterate, relative to max(1, ten times the terms)

# The end of a search.
PROGRESS = 0.5  # a warm search ends at rounding level if a step reduces the error by a smaller factor
# Largest relative change of an error that counts as unchanged; number of unchanged iterates in turn that end a search.
UNCHANGED, REST = 1e-3, 5
FLAT = 1e-8  # curvatures above -FLAT count as positive
UNBOUNDED_BELOW = 1e10  # a cost below minus this number times max(1, |first cost|) counts as minus infinity
LARGEST = 1e20  # a problem with bounds counts as unbounded if an unknown exceeds it
PATIENCE = 8  # iterations with the last weight after which the convergence test scales multipliers
VAIN = 20  # full steps in turn without effect on the violation, after which equations count as contradictory

# The barrier.
ERROR_FACTOR = 10.0  # the barrier parameter mu decreases if the error is below this multiple of mu
DECREASE, POWER = 0.2, 1.5  # the next parameter is the smaller of DECREASE * mu and mu**POWER
FOLLOWED_DECREASE = 0.4  # smallest ratio of two weights if the equations depend on the weight
LEAST_PART = 0.025  # the last weight, relative to the tolerance; with 0.1, the cost of a crane problem is off by 2e-9
RELAXED, LEAST_RELAXED = 1e-8, 1e-12  # largest and least relaxation of a bound, relative to max(1, |bound|)
PER_WEIGHT = 1e-2  # the relaxation between these limits, relative to the barrier's weight
MOST_RELAXING = RELAXED / PER_WEIGHT  # weights above it have the largest relaxation
ROUNDING = 1e-15  # steps ignore residuals up to it: at a distance of 1e-12 these would change the signs of duals

# Inertia correction.
# The shift delta_w is added to the Hessian, delta_c is subtracted from the diagonal of the multipliers.
SINGULAR_STEP = 1e12  # a step that exceeds the right-hand side by this factor is a rounding error
LARGE_SHIFT = 1e8  # above this delta_w, a delta_c is tried: a zero eigenvalue has the sign of its rounding error
SMALL_DELTA_W = 1e-2  # if the next lower shift is below it, the first factorisation has no shift
FAR = 10.0  # a step larger than this multiple of the largest unknown needs a larger first shift
DUAL_SHIFT = 1e-8  # delta_c, for equations that may be dependent
LEAST_DAMPING = 1e-5  # least damping of the Hessian after several much shortened steps

# Refinement.
ACCURATE = 1e-10  # largest residual, relative to right-hand side and solution, of a step that is not refined
NEARLY_ACCURATE = 1e-6  # if two corrections do not halve a smaller residual, it is a rounding error of a large solution
LARGE_STEP = 1e6  # residuals are compared with a solution up to this size, relative to the right-hand side
SOLVED_AGAIN = 10  # largest number of corrections, as in IPOPT
LITTLE = 0.01  # largest relative length of a step of which the line search leaves little
UNSOLVED = 0.1  # if a full step leaves a larger part of the residual, its linear system may be solved inaccurately

# Line search.
CORRECTIONS = 4  # largest number of second-order corrections at one iterate
SHORT = 0.25  # largest relative length of a much shortened step
SHORT_IN_TURN = 6  # much shortened steps in turn after which the Hessian is damped
SHORTENED_IN_TURN = 10  # shortened steps in turn after which the watchdog begins
FULL_STEPS = 4  # full steps that the watchdog takes without a test
TINY, CLOSER = 1e-13, 0.9  # a step up to TINY max(1, |x|) changes nothing; largest ratio of errors of a closer trial
MISLED = 5  # steps in turn, shortened by the filter alone, after which the filter is emptied
EMPTIED_AT_MOST = 5  # largest number of times that the filter is emptied, so that a search cannot cycle

# If the Hessian is indefinite at many iterates in turn that nearly satisfy the equations, and the cost changes by a
# small part of itself, see `curvature`.
NEAR_EQUATIONS, SHIFTED_IN_TURN, SLOW_COST = 1e-2, 30, 1e-2


@njit(error_model="numpy")
def sum_of_logarithms(distance):
    """Return the sum of the logarithms of positive numbers.

    Several numbers are multiplied before a logarithm is taken, because logarithms are slow.
    """
    total, product = 0.0, 1.0
    for j in range(distance.size):
        product *= distance[j]
        if not 1e-150 < product < 1e150:
            total += np.log(product)
            product = 1.0
    return total + np.log(product)


@njit(error_model="numpy")
def lower_barrier(mu, least, error, dual_scale, lowest, highest):
    """Return the next barrier parameter, at least `least`; mu itself if the barrier problem is not solved well enough.

    `error` is the scaled error of feasibility and optimality, `lowest` and `highest` are the products of a distance and
    its dual variable. Source: Wächter and Biegler (2006), Mathematical Programming 106, equations (5) and (7).
    """
    while mu > least and error <= ERROR_FACTOR * mu:
        if max(highest - mu, mu - lowest) / dual_scale > ERROR_FACTOR * mu:
            break
        mu = max(least, min(DECREASE * mu, mu**POWER))
    return mu


@njit(cache=True, error_model="numpy")
def relaxation(mu, least):
    """Return the relaxation of bounds for the barrier's weight mu, relative to the magnitudes of bounds.

    `least` is the least relaxation.
    """
    return min(RELAXED, max(least, PER_WEIGHT * mu))


@njit(error_model="numpy")
def approach(unknowns, indices, side, magnitude, by, least, distance, closer):
    """Fill `closer` with the distances after all bounds have moved inside by `by`, relative to their magnitudes.

    Unknowns that would then be closer to a bound than `least`, relative to its magnitude, are moved inside. Return the
    sum of the logarithms of the new distances, and True if any unknown was moved.
    """
    moves = False
    for j in range(indices.size):
        closer[j] = distance[j] - by * magnitude[j]
        missing = least * magnitude[j] - closer[j]
        if missing > 0.0:
            unknowns[indices[j]] += side[j] * missing
            closer[j], moves = least * magnitude[j], True
    return sum_of_logarithms(closer), moves


@njit(cache=True, error_model="numpy")
def optimality(gradient, unknowns, is_multiplier, indices, side, distance, duals, spare):
    """Return seven measures of the optimality conditions, including the duals of bounds.

    The first measure is the max-norm of the stationarity. The next three are the sum, the least and the largest of the
    complementarities z d. Then follow the mean modulus of all multipliers and duals, and the mean of the duals alone.
    The last measure is the largest modulus of a primal unknown. `spare` (n,) is work space.
    """
    total, lowest, highest, size = 0.0, np.inf, -np.inf, 0.0
    for i in range(gradient.size):
        spare[i] = gradient[i]
    for j in range(indices.size):
        spare[indices[j]] -= side[j] * duals[j]
        product = duals[j] * distance[j]
        lowest, highest = min(lowest, product), max(highest, product)
        total += product
        size += duals[j]
    stationarity, multipliers, count, largest = 0.0, 0.0, 0, 0.0
    for i in range(gradient.size):
        if is_multiplier[i]:
            multipliers += abs(unknowns[i])
            count += 1
        else:
            stationarity = max(stationarity, abs(spare[i]))
            largest = max(largest, abs(unknowns[i]))
    mean = (multipliers + size) / max(count + indices.size, 1)
    return stationarity, total, lowest, highest, mean, size / max(indices.size, 1), largest


@njit(error_model="numpy")
def evaluated(problem, grid, bounds, unknowns, gradient, distance, duals, vectors):
    """Fill the `gradient` (n,); return (cost, residual, violation, stationarity, error) and the result of `optimality`.

    Stationarity and error include the duals of bounds.
    """
    steps, h, nodes, parameters, is_multiplier, sizes, _, weight, _, _, _, _ = grid
    cost, residual, violation, stationarity, error = measured_gradient(
        problem[0], unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, vectors[SCALED][: sizes.size],
        gradient,
    )  # fmt: skip
    indices, side = bounds[0], bounds[1]
    measured = optimality(gradient, unknowns, is_multiplier, indices, side, distance, duals, vectors[SPARE])
    if error < np.inf:
        stationarity = measured[0]
        error = max(residual, stationarity)
    return (cost, residual, violation, stationarity, error), measured


@njit(error_model="numpy")
def measured_again(bounds, is_multiplier, known, x, g, distance, duals, vectors):
    """Return the same as `evaluated` for other duals of bounds, without a new evaluation of the gradient.

    `known` are (cost, residual, violation, stationarity, error) of the unknowns `x` (n,) with the gradient `g` (n,).
    """
    cost, residual, violation, stationarity, error = known[0], known[1], known[2], np.inf, np.inf
    measured = optimality(g, x, is_multiplier, bounds[0], bounds[1], distance, duals, vectors[SPARE])
    if known[4] < np.inf:
        stationarity = measured[0]
        error = max(residual, stationarity)
    return (cost, residual, violation, stationarity, error), measured


@njit(error_model="numpy")
def factored(problem, grid, system, x, weight_of_cost, vectors, is_wanted, is_new=True):
    """Factor the KKT matrix with the right-hand side and the diagonal in the work space.

    Return the excess of negative eigenvalues, see `factor_at`. If `is_wanted`, fill the step in the work space.
    `weight_of_cost`, 0 or 1, multiplies the Hessian of the cost. If not `is_new`, the second derivatives are those of
    the last call.
    """
    steps, h, nodes, parameters, _, sizes, _, _, _, _, _, _ = grid
    tables, factors, orders, entries, scaled, costless, inverses, counts, equations, _, _ = system
    chosen = scaled if weight_of_cost == 1.0 else costless
    return factor_at(
        problem[1], problem[2], x, sizes, vectors[SCALED], chosen, steps, h, nodes, parameters, tables, entries,
        vectors[RIGHT], vectors[DIAGONAL], equations, factors, orders, inverses, counts, vectors[STEP], is_wanted,
        is_new,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def terms(problem, grid, system, x, is_costless, vectors):
    """Return the largest sum of absolute terms |K| |x| in an equation, and in a stationarity condition.

    K is the KKT matrix. If every unknown changes by half a unit in the last place, a residual changes by up to this sum
    times the unit roundoff. See Higham (2002), Accuracy and stability of numerical algorithms, section 7.2. With
    `is_costless`, the second sum is at least one.
    """
    steps, h, nodes, parameters, is_multiplier, sizes, _, weight, _, _, fillings, _ = grid
    _, _, _, entries, _, _, _, counts, _, rows, columns = system
    unknowns, sums = x, vectors[SPARE]
    if sizes.size:
        unknowns = vectors[SCALED]
        for i in range(x.size):
            unknowns[i] = x[i] * sizes[i]
    call_hessians(problem[1], unknowns, steps, h, nodes, parameters, counts, entries)
    for i in range(sums.size):
        sums[i] = 0.0
    multiply_entries(entries, rows, columns, steps, counts, unknowns, sums, True)
    for j in range(fillings.shape[0]):
        # Intervals put a one on the diagonal for an unknown that only the ends have. The one is no term of an equation:
        # the entry of the start subtracts it.
        value, row = entries[fillings[j, 0]], fillings[j, 1]
        sums[row] += (abs(value + 1.0) - 1.0 - abs(value)) * abs(unknowns[row])
    equations, stationarity = 0.0, 0.0
    for i in range(sums.size):
        size = sums[i] * weight * sizes[i] if sizes.size else sums[i]
        if is_multiplier[i]:
            equations = max(equations, size)
        else:
            stationarity = max(stationarity, size)
    return equations, max(1.0, stationarity) if is_costless else stationarity


@njit(error_model="numpy")
def is_small(value, size, tolerance):
    """Return True if a residual `value` is zero to the tolerance, or to rounding.

    `size` is the sum of the absolute terms whose sum is the residual.
    """
    return value <= max(tolerance * min(1.0, size), UNIT_ROUNDOFF * size, VANISHED)


@njit(error_model="numpy")
def is_solved(problem, grid, system, x, residual, stationarity, tolerance, is_costless, vectors):
    """Return True if residual and stationarity are within the tolerance, or at the rounding level of their terms.

    The tolerance is absolute if the terms of the equations exceed one, and relative to smaller terms.
    """
    if max(residual, stationarity) > max(tolerance, WORTH_MEASURING):
        return False
    if max(residual, stationarity) <= tolerance and have_large_terms(problem, grid, system, x, vectors):
        return True
    of_equations, of_stationarity = terms(problem, grid, system, x, is_costless, vectors)
    return is_small(residual, of_equations, tolerance) and is_small(stationarity, of_stationarity, tolerance)


@njit(error_model="numpy")
def have_large_terms(problem, grid, system, x, vectors):
    """Return True if an equation and a stationarity condition both have a term of one or more.

    The tolerance is then absolute, see `is_solved`. The test is faster than `terms`: most often, an end and a few
    intervals have such terms.
    """
    steps, h, nodes, parameters, is_multiplier, sizes, _, weight, _, _, fillings, _ = grid
    _, _, _, entries, _, _, _, counts, _, rows, columns = system
    unknowns = x
    if sizes.size:
        unknowns = vectors[SCALED]
        for i in range(x.size):
            unknowns[i] = x[i] * sizes[i]
    call_hessians(problem[1], unknowns, steps, h, nodes, parameters, counts, entries)
    bodies, own, element, stride, linking = counts[0], counts[4], counts[6], counts[7], x.size - counts[5]
    chain, has_equation, has_slope = steps * stride + element - stride, False, False
    for kind in (2, 1, 0):  # ends, starts, intervals
        count, place, first_local = counts[1 + kind], 0, 0
        for before in range(kind):
            place += bodies * counts[1 + before] * (steps if before == 0 else 1)
            first_local += counts[1 + before]
        for body in range(bodies):
            for k in range(steps if kind == 0 else 1):
                first = body * chain + (steps - 1 if kind == 2 else k) * stride
                for j in range(count):
                    if fillings.shape[0] and kind < 2 and k == 0:
                        break  # entries of a start may cancel entries of the first interval
                    row = global_index(rows[first_local + j], first, element, own, bodies, body, linking)
                    column = global_index(columns[first_local + j], first, element, own, bodies, body, linking)
                    for i, other in ((row, column), (column, row)):
                        term = abs(entries[place + j] * unknowns[other])
                        if sizes.size:
                            term *= weight * sizes[i]
                        if term >= 1.0:
                            has_equation = has_equation or is_multiplier[i]
                            has_slope = has_slope or not is_multiplier[i]
                if has_equation and has_slope:
                    return True
                place += count
    return False


@njit(error_model="numpy")
def is_at_rounding_level(problem, grid, system, x, residual, stationarity, is_costless, vectors):
    """Return True if residual and stationarity are at most a thousand rounding errors of their terms."""
    of_equations, of_stationarity = terms(problem, grid, system, x, is_costless, vectors)
    return residual <= 1e3 * UNIT_ROUNDOFF * of_equations and stationarity <= 1e3 * UNIT_ROUNDOFF * of_stationarity


@njit(error_model="numpy")
def is_acceptable(problem, grid, system, x, measures, measured, tolerance, is_costless, vectors):
    """Return True if an iterate is optimal to the tolerance, with the scaling (5) of large multipliers and duals.

    `measures` and `measured` are the results of `evaluated`.
    """
    stationarity, _, _, highest, mean, mean_dual, _ = measured
    if highest / (max(100.0, mean_dual) / 100.0) > tolerance:
        return False
    scaled = stationarity / (max(100.0, mean) / 100.0)
    return is_solved(problem, grid, system, x, measures[1], scaled, tolerance, is_costless, vectors)


@njit(cache=True, error_model="numpy")
def fill_newton_system(grid, bounds, g, distance, duals, mu, delta_w, delta_c, right, diagonal):
    """Fill the right-hand side and the diagonal (n,) of Newton's equations (13) for the weight `mu`.

    `g` is the gradient of the Lagrangian without the duals of bounds. `delta_w` and `delta_c` are the shifts of the
    Hessian and of the multipliers' diagonal.
    """
    is_multiplier, indices, side = grid[4], bounds[0], bounds[1]
    for i in range(g.size):
        is_rounding = indices.size > 0 and is_multiplier[i] and abs(g[i]) <= ROUNDING
        right[i] = 0.0 if is_rounding else g[i]
        diagonal[i] = -delta_c if is_multiplier[i] else delta_w
    for j in range(indices.size):
        inverse = 1.0 / distance[j]
        right[indices[j]] -= mu * side[j] * inverse
        diagonal[indices[j]] += duals[j] * inverse


@njit(cache=True, error_model="numpy")
def measure_step(grid, bounds, x, right, step, distance, duals, mu, dual_step):
    """Fill `dual_step` (m,); return (slope, is_of_rounding, longest primal length, longest dual length) of a step.

    `right` is the right-hand side of the step. The slope is the derivative of the barrier function along the primal
    part d. With the Jacobian A of the equations, A d = -residual. The slope of the Lagrangian along d therefore
    contains -multipliers . residual, which is subtracted again. A step that is far larger than its right-hand side is a
    rounding error. The longest lengths keep the part 1 - tau of all distances and duals (15), and half of every
    free duration: a far shorter motion needs huge controls, from which the search hardly returns.
    """
    is_multiplier, durations, indices, side = grid[4], grid[11], bounds[0], bounds[1]
    slope = size = largest = 0.0
    for i in range(x.size):
        slope += right[i] * (x[i] if is_multiplier[i] else step[i])
        size, largest = max(size, abs(step[i])), max(largest, abs(right[i]))
    if indices.size == 0:
        return slope, size > SINGULAR_STEP * largest, 1.0, 1.0
    tau = max(0.99, 1.0 - mu)
    # The largest part of a distance, and of a dual, that the full step takes away, but at least tau.
    primal, dual = tau, tau
    for i in durations:
        if x[i] > 0.0:
            primal = max(primal, -step[i] / x[i] * (tau / LARGEST_FALL))
    for j in range(indices.size):
        change, inverse = side[j] * step[indices[j]], 1.0 / distance[j]
        dual_step[j] = (mu - duals[j] * change) * inverse - duals[j]
        primal, dual = max(primal, -change * inverse), max(dual, -dual_step[j] / duals[j])
    return slope, size > SINGULAR_STEP * largest, tau / primal, tau / dual


@njit(cache=True, error_model="numpy")
def move(bounds, x, step, length, distance, duals, dual_step, dual_length, mu, trial, moved, pushed):
    """Fill the `trial` unknowns after a part of a step, and their distances `moved` and duals `pushed`.

    Return the sum of the logarithms of the distances. `length` and `dual_length` are the parts of the primal and of the
    dual step. Rounding does not make a distance zero. Duals stay within a factor of 1e10 of mu / d (16).
    """
    indices, side = bounds[0], bounds[1]
    for i in range(x.size):
        trial[i] = x[i] + length * step[i]
    if indices.size == 0:
        return 0.0
    for j in range(indices.size):
        d = distance[j] + side[j] * (length * step[indices[j]])
        moved[j] = max(d, 1e-16 * distance[j])
        centre = mu / moved[j]
        pushed[j] = max(min(duals[j] + dual_length * dual_step[j], 1e10 * centre), 1e-10 * centre)
    return sum_of_logarithms(moved)


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


@njit(error_model="numpy")
def fill_linear_residual(problem, grid, system, x, diagonal, right, step, weight_of_right, vectors, remainder):
    """Fill `remainder` (n,) with the residual KKT matrix . step + weight_of_right . right of a linear system.

    Return the `inaccuracy` of the step. `diagonal` (n,) is added to the diagonal of the matrix.
    """
    steps, h, nodes, parameters, is_multiplier, sizes, forces, _, ties, is_free, _, _ = grid
    _, _, _, entries, _, _, _, counts, _, rows, columns = system
    unknowns, vector = x, step
    if sizes.size:
        unknowns, vector = vectors[SCALED], vectors[SPARE]
        for i in range(x.size):
            unknowns[i] = x[i] * sizes[i]
            vector[i] = np.sqrt(sizes[i] * forces[i]) * step[i]
    call_hessians(problem[1], unknowns, steps, h, nodes, parameters, counts, entries)
    for i in range(remainder.size):
        remainder[i] = 0.0
    multiply_entries(entries, rows, columns, steps, counts, vector, remainder, False)
    for i in range(remainder.size):
        if sizes.size:
            remainder[i] *= np.sqrt(sizes[i] * forces[i])
        remainder[i] += diagonal[i] * step[i] + weight_of_right * right[i]
    for j in range(ties.shape[0]):
        remainder[ties[j, 1]] += remainder[ties[j, 0]]
    for i in range(remainder.size):
        if not is_free[i]:
            remainder[i] = 0.0
    return inaccuracy(right, step, remainder, is_multiplier)


@njit(error_model="numpy")
def inaccuracy(gradient, step, remainder, is_multiplier):
    """Return the residual `remainder` (n,) of a linear system, relative to its right-hand side and its solution.

    The result is the larger of two ratios: for the equations alone, and for all rows. Large multipliers, and barriers
    close to their bounds, do not count for the equations. The result is NaN if an entry is not finite. `gradient` (n,)
    is minus the right-hand side.
    """
    unsolved, remaining, right, slope, multiplier, primal = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(remainder.size):
        if not abs(remainder[i]) < np.inf:
            return np.nan
        if is_multiplier[i]:
            unsolved, right = max(unsolved, abs(remainder[i])), max(right, abs(gradient[i]))
            multiplier = max(multiplier, abs(step[i]))
        else:
            remaining, slope = max(remaining, abs(remainder[i])), max(slope, abs(gradient[i]))
            primal = max(primal, abs(step[i]))
    most = LARGE_STEP * max(right, slope)
    of_equations = unsolved / max(right + min(primal, most), 1e-300)
    scale = max(right, slope) + min(max(primal, multiplier), most)
    return max(of_equations, max(unsolved, remaining) / max(scale, 1e-300))


@njit(error_model="numpy")
def refined(problem, grid, system, x, vectors, room):
    """Refine the step in the work space until it is accurate, or until only rounding errors remain.

    Return True if corrections were made and have lowered the residual. `room` (2 SOLVED_AGAIN + 2, n) is work space for
    corrections, their products with the matrix, and residuals. The products are made orthogonal, so that each
    correction lowers the residual as much as possible. These are generalised conjugate residuals with the factors as
    preconditioner. Plain iterative refinement may diverge if the factors are inaccurate. Sources: Higham (2002),
    Accuracy and stability of numerical algorithms, chapter 12; Eisenstat, Elman and Schultz (1983), Variational
    iterative methods for nonsymmetric systems of linear equations. The residual is measured as in section 3.10 of
    Waechter and Biegler (2006).
    """
    steps, n = grid[0], x.size
    tables, factors, orders, _, _, _, inverses, counts, equations, _, _ = system
    right, step, remainder, scaled = vectors[RIGHT], vectors[STEP], room[2 * SOLVED_AGAIN], room[2 * SOLVED_AGAIN + 1]
    first = error = fill_linear_residual(
        problem, grid, system, x, vectors[DIAGONAL], right, step, 1.0, vectors, remainder
    )
    for again in range(SOLVED_AGAIN):
        if not ACCURATE < error < np.inf:
            return again > 0
        if again == 2 and 0.5 * first < error <= NEARLY_ACCURATE:
            return False
        correction, product, norm = room[2 * again], room[2 * again + 1], 0.0
        for i in range(n):
            norm += remainder[i] * remainder[i]
        norm = np.sqrt(norm)
        for i in range(n):
            scaled[i] = remainder[i] / norm
        solve_at(problem[2], steps, tables, scaled, equations, factors, orders, inverses, counts, correction)
        fill_linear_residual(
            problem, grid, system, x, vectors[DIAGONAL], right, correction, 0.0, vectors, product
        )  # fmt: skip
        for earlier in range(again):
            share = 0.0
            for i in range(n):
                share += room[2 * earlier + 1, i] * product[i]
            for i in range(n):
                product[i] -= share * room[2 * earlier + 1, i]
                correction[i] -= share * room[2 * earlier, i]
        size, share = 0.0, 0.0
        for i in range(n):
            size += product[i] * product[i]
        size = np.sqrt(size)
        if not 0.0 < size < np.inf:
            return True
        for i in range(n):
            product[i] /= size
            correction[i] /= size
            share -= product[i] * remainder[i]
        for i in range(n):
            step[i] += share * correction[i]
        error = fill_linear_residual(problem, grid, system, x, vectors[DIAGONAL], right, step, 1.0, vectors, remainder)
    return True


@njit(cache=True, error_model="numpy")
def regularise(problem, grid, system, bounds, x, g, distance, duals, mu, damping, careful, reals, integers, vectors,
               barriers, room):  # fmt: skip
    """Compute a Newton step with a shift delta_w of the Hessian that is just large enough for a descent step.

    This is algorithm IC. `damping` is the least shift. Dependent equations, such as those of a vehicle at rest, may
    have a zero eigenvalue with the sign of a rounding error. The number of negative eigenvalues then means nothing. A
    huge step, or a shift that grows without limit, reveals the dependence, and delta_c removes it.

    Without bounds, two changes save factorisations. If the previous iterate needed a shift, a lower shift is tried
    first; no shift is tried only once the shift is small. The more often in turn a lower shift has sufficed, the more
    the next shift is lowered. With `careful`, the residual of the linear system is measured, and the step is refined if
    the residual is large.

    Return (is_found, slope, longest primal length, longest dual length, delta_w, is_refined).
    """
    is_bounded, n = bounds[0].size > 0, x.size
    last, before, is_multiplier = reals[LAST_DELTA_W], reals[DELTA_W], grid[4]
    if is_bounded:
        least, at_once = max(1e-20, last / 3.0) if last > 0.0 else 1e-4, 0.0
    else:
        least = max(1e-20, last / 3.0 ** min(1 + integers[LOWERED], 40)) if last > 0.0 else 1e-4
        at_once = least if before > 0.0 and least > SMALL_DELTA_W and not integers[WAS_SINGULAR] else 0.0
    delta_c, shift_c = 0.0, DUAL_SHIFT * max(mu, 1e-100) ** 0.25 if is_bounded else DUAL_SHIFT
    delta_w = max(damping, at_once)
    right, step, is_new = vectors[RIGHT], vectors[STEP], True
    while delta_w < 1e20:
        fill_newton_system(grid, bounds, g, distance, duals, mu, delta_w, delta_c, right, vectors[DIAGONAL])
        excess = factored(problem, grid, system, x, 1.0, vectors, True, is_new)
        is_new = False
        integers[FACTORISATIONS] += 1
        if excess == 0:
            slope, of_rounding, longest, dual_length = measure_step(
                grid, bounds, x, right, step, distance, duals, mu, barriers[DUAL_STEP]
            )
            if of_rounding and delta_c == 0.0:
                delta_c = shift_c
                continue
            if of_rounding and delta_w == 0.0 and not is_bounded:  # a null direction of the Hessian, not of equations
                delta_w = least
                continue
            if not is_bounded and delta_c > 0.0 and last == 0.0 < delta_w < 1.0:
                size, largest = 0.0, 1.0
                for i in range(n):
                    if not is_multiplier[i]:
                        size, largest = max(size, abs(step[i])), max(largest, abs(x[i]))
                if size > FAR * largest:  # the first shift alone determines the length of such a step
                    delta_w *= 100.0
                    continue
            is_refined = False
            if careful:  # the step is measured again: it changes even if its residual does not fall
                is_refined, is_new = refined(problem, grid, system, x, vectors, room), True
                slope, of_rounding, longest, dual_length = measure_step(
                    grid, bounds, x, right, step, distance, duals, mu, barriers[DUAL_STEP]
                )
            if abs(slope) < np.inf:
                if not (delta_w == before == 0.0 and delta_c == 0.0):
                    integers[WAS_SINGULAR] = integers[WAS_SINGULAR] or delta_c > 0.0
                    enough = delta_w == least and not integers[WAS_SINGULAR]
                    integers[LOWERED] = integers[LOWERED] + 1 if enough else 0
                reals[DELTA_W] = delta_w
                reals[LAST_DELTA_W] = delta_w if delta_w > 0.0 else last
                return True, slope, longest, dual_length, delta_w, is_refined
        elif delta_c == 0.0 and (excess == SINGULAR or excess < 0 or delta_w > LARGE_SHIFT):
            delta_c = shift_c
            if delta_w > LARGE_SHIFT:
                delta_w = max(damping, at_once)
            continue
        if delta_w == 0.0:
            delta_w = least
        else:
            delta_w *= 100.0 if last == 0.0 else 8.0
    return False, 0.0, 0.0, 0.0, delta_w, False


@njit(error_model="numpy")
def is_minimum(problem, grid, system, bounds, x, g, distance, duals, tolerance, integers, vectors):
    """Return True if a stationary point is a minimum to second order.

    Instead of bounds, their barrier is added to the Hessian. Curvatures count as positive if they are above a small
    negative number, which is a multiple of the tolerance. Dependent equations need a delta_c, which lowers the
    curvature of an optimum that may move, such as a periodic motion in time, by delta_c times the square of the change
    of its multipliers. Therefore delta_c is zero at first, unless the search has met dependent equations.
    """
    shift = max(FLAT, 100.0 * tolerance)
    for delta_c in (0.0, FLAT):
        if delta_c > 0.0 or not integers[WAS_SINGULAR]:
            fill_newton_system(grid, bounds, g, distance, duals, 0.0, shift, delta_c, vectors[RIGHT], vectors[DIAGONAL])
            if factored(problem, grid, system, x, 1.0, vectors, False) == 0:
                return True
    return False


@njit(error_model="numpy")
def log_row(grid, g, cost, residual, stationarity, row):
    """Fill cost, residual and stationarity of a row of the log, in the problem's own units.

    Stationarity is the change of the cost if unknowns change by their scaling factors.
    """
    is_multiplier, forces, weight = grid[4], grid[6], grid[7]
    row[0], row[1], row[2] = cost / weight, residual, stationarity / weight
    if forces.size:
        row[1] = 0.0
        for i in range(g.size):
            if is_multiplier[i]:
                row[1] = max(row[1], abs(g[i] / forces[i]))


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


@njit(error_model="numpy")
def evaluate_iterate(problem, grid, reals, vectors):
    """Evaluate cost, gradient and norms of the iterate in the work space, without the duals of bounds."""
    steps, h, nodes, parameters, is_multiplier, sizes, _, weight, _, _, _, _ = grid
    measures = measured_gradient(
        problem[0], vectors[X], sizes, weight, steps, h, nodes, parameters, is_multiplier,
        vectors[SCALED][: sizes.size], vectors[G],
    )  # fmt: skip
    for i in range(5):
        reals[COST + i] = measures[i]


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


@njit(error_model="numpy")
def is_gross(problem, grid, system, reals, vectors):
    """Return True if the residual of the iterate exceeds GROSSLY times the largest terms of the equations."""
    if not reals[ERROR] < np.inf:
        return False
    of_equations, _ = terms(problem, grid, system, vectors[X], False, vectors)
    return reals[RESIDUAL] > GROSSLY * of_equations


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
