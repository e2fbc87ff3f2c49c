"""The optimality of an iterate: residual, stationarity and complementarity, and the magnitudes of their terms.

Numbers of equations and sections refer to Waechter and Biegler (2006), and `descent` explains the arguments.
"""

import numpy as np
from numba import njit

from codegen.runtime.search.linear_system import call_hessians, global_index, multiply_entries
from codegen.runtime.search.point import measured_gradient
from codegen.runtime.search.workspace import COST, ERROR, RESIDUAL, SCALED, SPARE, G, X

# Magnitudes of residuals and of the terms of equations.
UNIT_ROUNDOFF = 2.2e-16
VANISHED = 1e-20  # a residual below it counts as zero, since a cost of squares may vanish with all its terms
WORTH_MEASURING = 1e-7  # for larger errors, the magnitudes of terms are not computed
GROSSLY = 0.03  # larger residuals, relative to the equations' terms, are a gross violation


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


def is_small(value, size, tolerance, roundings):
    """Return True if a residual `value` is zero to the tolerance, or to the given number of rounding errors.

    `size` is the sum of the absolute terms whose sum is the residual.
    """
    return value <= max(tolerance * min(1.0, size), roundings * UNIT_ROUNDOFF * size, VANISHED)


is_small_compiled = njit(error_model="numpy")(is_small)


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
    is_closed = is_small_compiled(residual, of_equations, tolerance, 1.0)
    return is_closed and is_small_compiled(stationarity, of_stationarity, tolerance, 1.0)


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


@njit(error_model="numpy")
def is_gross(problem, grid, system, reals, vectors):
    """Return True if the residual of the iterate exceeds GROSSLY times the largest terms of the equations."""
    if not reals[ERROR] < np.inf:
        return False
    of_equations, _ = terms(problem, grid, system, vectors[X], False, vectors)
    return reals[RESIDUAL] > GROSSLY * of_equations


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
