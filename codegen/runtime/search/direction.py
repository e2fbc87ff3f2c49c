"""A step of Newton's method: the barrier's terms, inertia correction, refinement of the linear system, longest lengths.

Numbers of equations and sections refer to Waechter and Biegler (2006), and `descent` explains the arguments.
"""

import numpy as np
from numba import njit

from codegen.runtime.kkt.system import SINGULAR
from codegen.runtime.search.linear_system import call_hessians, factor_at, multiply_entries, solve_at
from codegen.runtime.search.workspace import (
    DELTA_W,
    DIAGONAL,
    DUAL_STEP,
    FACTORISATIONS,
    LAST_DELTA_W,
    LOWERED,
    RIGHT,
    SCALED,
    SPARE,
    STEP,
    WAS_SINGULAR,
)

# The barrier.
ERROR_FACTOR = 10.0  # the barrier parameter mu decreases if the error is below this multiple of mu
DECREASE, POWER = 0.2, 1.5  # the next parameter is the smaller of DECREASE * mu and mu**POWER
RELAXED, LEAST_RELAXED = 1e-8, 1e-12  # largest and least relaxation of a bound, relative to max(1, |bound|)
PER_WEIGHT = 1e-2  # the relaxation between these limits, relative to the barrier's weight
ROUNDING = 1e-15  # steps ignore residuals up to it: at a distance of 1e-12 these would change the signs of duals
LARGEST_FALL = 0.5  # largest part of a free duration that one step takes away; 0.75 and 0.9 take more iterations

# Inertia correction.
# The shift delta_w is added to the Hessian, delta_c is subtracted from the diagonal of the multipliers.
SINGULAR_STEP = 1e12  # a step that exceeds the right-hand side by this factor is a rounding error
LARGE_SHIFT = 1e8  # above this delta_w, a delta_c is tried: a zero eigenvalue has the sign of its rounding error
SMALL_DELTA_W = 1e-2  # if the next lower shift is below it, the first factorisation has no shift
FAR = 10.0  # a step larger than this multiple of the largest unknown needs a larger first shift
DUAL_SHIFT = 1e-8  # delta_c, for equations that may be dependent
FLAT = 1e-8  # curvatures above -FLAT count as positive

# Refinement.
ACCURATE = 1e-10  # largest residual, relative to right-hand side and solution, of a step that is not refined
NEARLY_ACCURATE = 1e-6  # if two corrections do not halve a smaller residual, it is a rounding error of a large solution
LARGE_STEP = 1e6  # residuals are compared with a solution up to this size, relative to the right-hand side
SOLVED_AGAIN = 10  # largest number of corrections, as in IPOPT


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
