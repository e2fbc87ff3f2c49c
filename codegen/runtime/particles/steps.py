"""Steps of particles that interact in pairs, derivatives of steps, and sequences of steps.

A composition method evaluates the field F = (H_p, -H_q) of each substep at one point between its ends:

    z1 = z0 + f h F(q, p),    q = (1 - a) q0 + a q1,    p = (1 - b) p0 + b p1.

Implicit substeps are solved by fixed-point iteration, which contracts by about h |H''|. If the contraction is slow,
Newton's method takes over with the generated second derivatives. Its matrix is factored again only if convergence with
the present factors is slow. If H is separable and a and b are zero or one, positions and momenta are updated in turn.
An explicit Runge-Kutta method is

    k_i = F(z0 + h sum_j a_ij k_j),    z1 = z0 + h sum_i b_i k_i.

The derivative of F is J H'' with J = (0 1; -1 0). States have shape (2, n, d), own parameters (n, k). The points of a
step are the states at which the scheme evaluates H.
"""

from typing import NamedTuple

import numpy as np
from numba import carray, njit

from codegen.runtime.addresses import call, call_value, data_of, reals_at
from codegen.runtime.arithmetic import copy_state, factor_matrix, solve_factored, symmetric_product

NON_FINITE, NOT_CONVERGED = -1, -3  # outcomes of a failed step
OUTSIDE = -4  # outcome of `follow` if a particle leaves its domain
PLAIN, NEWTON = 40, 25  # largest numbers of fixed-point and of Newton iterations of a substep
ROUNDING = 1e-15  # smaller relative changes are rounding errors
STORED = 3.0e7  # largest number of entries of stored second derivatives (240 MB)


class Pairs(NamedTuple):
    """The data of a `PairProblem` for compiled code, all as integers, so that passing them counts no references.

    The first seven fields are addresses of kernels, 0 for a missing kernel. `points` is the number of points of a step.
    `is_runge_kutta` is 1 for Runge-Kutta methods, else 0. `coefficients` is the address of the coefficients of the
    scheme.
    """

    hamiltonian: int
    gradient: int
    hessian: int
    products: int
    slope: int
    velocity: int
    domain_margin: int
    points: int
    is_runge_kutta: int
    coefficients: int


@njit(error_model="numpy", forceinline=True)
def fill(kernel, z, own, parameters, filled):
    """Call the kernel at the address `kernel` for a state z and parameters; the kernel fills the array `filled`."""
    call(kernel, (data_of(z), z.shape[1], data_of(own), data_of(parameters), data_of(filled)))


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def advance(pairs, z, h, own, parameters, points, near, after):
    """Fill `after` with the state one step after z; return the iterations, or the negative outcome of a failure.

    `points` (points, 2, n, d) takes the states at which H is evaluated. If `near` is positive, `points` must hold the
    points of a step from a nearby state. Implicit substeps then begin at these points and stop at the relative accuracy
    `near`. Otherwise `near` is zero.
    """
    if pairs.slope:
        return take_turns(pairs, z, h, own, parameters, points, after)
    if pairs.is_runge_kutta:
        return runge_kutta_step(pairs, z, h, own, parameters, points, after)
    return composed_step(pairs, z, h, own, parameters, points, near, after)


@njit(error_model="numpy")
def composed_step(pairs, z, h, own, parameters, points, near, after):
    """Make a step by a composition method; arguments and result as in `advance`."""
    before, gradient, iterations = np.empty(z.shape), np.empty(z.shape), 0
    table = carray(reals_at(pairs.coefficients), (pairs.points, 3))
    copy_state(z, before)
    for s in range(pairs.points):
        step, a, b = h * table[s, 0], table[s, 1], table[s, 2]
        if a > 0.0 or b > 0.0:
            outcome = implicit_substep(pairs, before, step, a, b, own, parameters, near, gradient, points[s], after)
            if outcome < 0:
                return outcome
            iterations += outcome
        else:
            copy_state(before, points[s])
            fill(pairs.gradient, before, own, parameters, gradient)
            moved(before, step, gradient, after)
        if not copy_state(after, before):
            return NON_FINITE
    return iterations


@njit(error_model="numpy")
def runge_kutta_step(pairs, z, h, own, parameters, points, after):
    """Make a step by an explicit Runge-Kutta method; arguments and result as in `advance`."""
    count = pairs.points
    table, gradients = carray(reals_at(pairs.coefficients), (count + 1, count)), np.empty((count, *z.shape))
    for s in range(count):
        combined(z, h, gradients, table[s], s, points[s])
        fill(pairs.gradient, points[s], own, parameters, gradients[s])
    combined(z, h, gradients, table[count], count, after)
    return 0 if copy_state(after, gradients[0]) else NON_FINITE


@njit(error_model="numpy")
def combined(z, h, gradients, weights, count, result):
    """Fill `result` (2, n, d) with z + h sum_r weights[r] (H_p, -H_q)_r over the first `count` stages."""
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            position, momentum = z[0, i, k], z[1, i, k]
            for r in range(count):
                position += h * weights[r] * gradients[r, 1, i, k]
                momentum -= h * weights[r] * gradients[r, 0, i, k]
            result[0, i, k], result[1, i, k] = position, momentum


@njit(error_model="numpy")
def take_turns(pairs, z, h, own, parameters, points, after):
    """Make a step of a separable Hamiltonian without solving equations; arguments and result as in `advance`.

    Neighbouring substeps share derivatives: H_q while the positions are unchanged, H_p while the momenta are unchanged.
    `points[0]` keeps H_q and the positions at which H_q was evaluated, for the next step.
    """
    rates, slopes, positions = np.empty(z[0].shape), points[0, 0], points[0, 1]
    table = carray(reals_at(pairs.coefficients), (pairs.points, 3))
    has_rates, has_slopes = False, True
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            after[0, i, k], after[1, i, k] = z[0, i, k], z[1, i, k]
            has_slopes = has_slopes and positions[i, k] == z[0, i, k]
    for s in range(pairs.points):
        step, a, b = h * table[s, 0], table[s, 1], table[s, 2]
        if not (a > 0.0 or has_slopes):
            fill(pairs.slope, after, own, parameters, slopes)
            has_slopes = True
        if b > 0.0:
            shifted(after, 1, -step, slopes)
            has_rates = False
        if not has_rates:
            fill(pairs.velocity, after, own, parameters, rates)
            has_rates = True
        if not (a > 0.0 or b > 0.0):
            shifted(after, 1, -step, slopes)
            has_rates = False
        shifted(after, 0, step, rates)
        has_slopes = False
        if a > 0.0:
            fill(pairs.slope, after, own, parameters, slopes)
            shifted(after, 1, -step, slopes)
            has_rates, has_slopes = False, True
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            positions[i, k] = after[0, i, k] if has_slopes else np.nan
    return 0


@njit(error_model="numpy")
def shifted(z, part, step, rates):
    """Add `step` times `rates` (n, d) to the positions (`part` 0) or to the momenta (`part` 1) of a state."""
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            z[part, i, k] += step * rates[i, k]


@njit(error_model="numpy")
def moved(before, step, gradient, after):
    """Fill `after` (2, n, d) with before + step (H_p, -H_q).

    Return the largest change of a number in `after`, and the largest modulus in `after`.
    """
    change, size = 0.0, 0.0
    for i in range(before.shape[1]):
        for k in range(before.shape[2]):
            position = before[0, i, k] + step * gradient[1, i, k]
            momentum = before[1, i, k] - step * gradient[0, i, k]
            change = max(change, abs(position - after[0, i, k]), abs(momentum - after[1, i, k]))
            size = max(size, abs(position), abs(momentum))
            after[0, i, k], after[1, i, k] = position, momentum
    return change, size


@njit(error_model="numpy")
def between(before, after, a, b, point):
    """Fill `point` (2, n, d) with the state at which a substep evaluates the field.

    This is q = (1 - a) q0 + a q1, p = (1 - b) p0 + b p1, from the states `before` and `after` the substep.
    """
    for i in range(before.shape[1]):
        for k in range(before.shape[2]):
            point[0, i, k] = before[0, i, k] + a * (after[0, i, k] - before[0, i, k])
            point[1, i, k] = before[1, i, k] + b * (after[1, i, k] - before[1, i, k])


@njit(error_model="numpy")
def is_settled(change, previous, size, accuracy):
    """Return True if an iteration has reached the relative accuracy, or if only rounding errors change its result.

    `change` and `previous` are the largest changes in the last two iterations, and `size` is the largest modulus.
    """
    return change <= accuracy * size or (change <= 1e-12 * size and change >= 0.5 * previous)


@njit(error_model="numpy")
def implicit_substep(pairs, before, step, a, b, own, parameters, near, gradient, point, after):
    """Fill `after` (2, n, d) with the end of a substep; return the iterations, or the negative outcome of a failure.

    If `near` is positive, `point` must be near the point of the solution. The iteration then starts with the field at
    `point` and stops at the relative accuracy `near`. If `near` is zero, the initial guess is an explicit Euler step.
    """
    if not near > 0.0:
        copy_state(before, point)
    fill(pairs.gradient, point, own, parameters, gradient)
    moved(before, step, gradient, after)
    previous, earlier = np.inf, np.inf
    for iteration in range(PLAIN):
        between(before, after, a, b, point)
        fill(pairs.gradient, point, own, parameters, gradient)
        change, size = moved(before, step, gradient, after)
        if is_settled(change, previous, size, max(near, ROUNDING)):
            return iteration + 1
        # Positions and momenta may change in turn: compare with the change two iterations before.
        if not change < np.inf or (iteration > 3 and change > 0.5 * earlier):
            break
        previous, earlier = change, previous
    return newton_substep(pairs, before, step, a, b, own, parameters, gradient, point, after)


@njit(error_model="numpy")
def newton_substep(pairs, before, step, a, b, own, parameters, gradient, point, after):
    """Make a substep by Newton's method from an explicit Euler step.

    Arguments and result are as in `implicit_substep`.
    """
    size = before.size
    hessian, matrix, pivots = np.empty((size, size)), np.empty((size, size)), np.empty(size, np.int64)
    wanted, right = np.empty(before.shape), np.empty(size)
    ends, goals = after.reshape(size), wanted.reshape(size)
    fill(pairs.gradient, before, own, parameters, gradient)
    moved(before, step, gradient, after)
    previous, is_factored = np.inf, False
    for iteration in range(NEWTON):
        between(before, after, a, b, point)
        fill(pairs.gradient, point, own, parameters, gradient)
        copy_state(after, wanted)
        moved(before, step, gradient, wanted)
        if not is_factored:
            fill(pairs.hessian, point, own, parameters, hessian)
            substep_matrix(hessian, step, a, b, matrix)
            if factor_matrix(matrix, pivots) >= 0:
                return NOT_CONVERGED
        for k in range(size):
            right[k] = goals[k] - ends[k]
        solve_factored(matrix, pivots, right)
        change, scale = 0.0, 0.0
        for k in range(size):
            ends[k] += right[k]
            change, scale = max(change, abs(right[k])), max(scale, abs(ends[k]))
            if not abs(right[k]) < np.inf:
                return NOT_CONVERGED
        if is_settled(change, previous, scale, ROUNDING):
            between(before, after, a, b, point)
            return PLAIN + iteration + 1
        is_factored = change < 0.1 * previous and iteration > 0
        previous = change
    return NOT_CONVERGED


@njit(error_model="numpy")
def substep_matrix(hessian, step, a, b, matrix):
    """Fill `matrix` (2 n d, 2 n d) with the unit matrix minus step J H'' diag(a, b).

    This is the derivative of the equations of a substep with respect to the state at its end.
    """
    size, half = hessian.shape[0], hessian.shape[0] // 2
    for row in range(half):
        for column in range(size):
            weight = step * (a if column < half else b)
            matrix[row, column] = -weight * hessian[half + row, column]
            matrix[half + row, column] = weight * hessian[row, column]
    for row in range(size):
        matrix[row, row] += 1.0


def curvature_at(problem, points, own, parameters):
    """Return the second derivatives (P, 2 n d, 2 n d) of H at points (P, 2, n, d).

    The array is empty if there are more than STORED entries.
    """
    are_too_many = float(points.shape[0]) * points[0].size ** 2 > STORED
    hessians = np.empty((0 if are_too_many else points.shape[0], points[0].size, points[0].size))
    if hessians.size:
        fill_curvature(problem.hessian.address, points, own, parameters, hessians)
    return hessians


@njit(cache=True, error_model="numpy", nogil=True)
def fill_curvature(hessian, points, own, parameters, hessians):
    """Fill `hessians` (P, 2 n d, 2 n d) with the second derivatives of H at all points.

    `hessian` is the address of the kernel.
    """
    for k in range(points.shape[0]):
        fill(hessian, points[k], own, parameters, hessians[k])


@njit(error_model="numpy")
def linearised_field(pairs, hessians, points, k, own, parameters, directions, products):
    """Fill `products` with the derivative J H'' of the field at the k-th point times `directions`, both (2 n d, m).

    H'' is read from `hessians` (P, 2 n d, 2 n d). If this array is empty, a kernel computes the products.
    """
    if hessians.shape[0] > 0:
        symmetric_product(hessians[k], directions, products)
    else:
        z, columns = points[k], directions.shape[1]
        arguments = data_of(own), data_of(parameters), data_of(directions), columns, data_of(products)
        call(pairs.products, (data_of(z), z.shape[1], *arguments))
    half = directions.shape[0] // 2
    for row in range(half):
        for c in range(directions.shape[1]):
            by_position = products[row, c]
            products[row, c] = products[half + row, c]
            products[half + row, c] = -by_position


@njit(cache=True, error_model="numpy", nogil=True)
def advance_directions(pairs, hessians, points, first, h, own, parameters, directions, after):
    """Fill `after` (2 n d, m) with the derivative of a step times `directions`.

    The points of the step begin at index `first` of `points`. Return True if the linear equations of all substeps were
    solved.
    """
    products = np.empty(directions.shape)
    if pairs.is_runge_kutta:
        count = pairs.points
        table, rates = carray(reals_at(pairs.coefficients), (count + 1, count)), np.empty((count, *directions.shape))
        for s in range(count):
            combined_directions(directions, h, rates, table[s], s, products)
            linearised_field(pairs, hessians, points, first + s, own, parameters, products, rates[s])
        combined_directions(directions, h, rates, table[count], count, after)
        return True
    before, table = directions.copy(), carray(reals_at(pairs.coefficients), (pairs.points, 3))
    for s in range(pairs.points):
        step, a, b = h * table[s, 0], table[s, 1], table[s, 2]
        if a > 0.0 or b > 0.0:
            if not implicit_directions(
                pairs, hessians, points, first + s, step, a, b, own, parameters, before, products, after
            ):
                return False
        else:
            linearised_field(pairs, hessians, points, first + s, own, parameters, before, products)
            for row in range(before.shape[0]):
                for c in range(before.shape[1]):
                    after[row, c] = before[row, c] + step * products[row, c]
        for row in range(before.shape[0]):
            for c in range(before.shape[1]):
                before[row, c] = after[row, c]
    return True


@njit(error_model="numpy")
def combined_directions(directions, h, rates, weights, count, result):
    """Fill `result` (2 n d, m) with directions + h sum_r weights[r] rates[r] over the first `count` stages."""
    for row in range(directions.shape[0]):
        for c in range(directions.shape[1]):
            value = directions[row, c]
            for r in range(count):
                value += h * weights[r] * rates[r, row, c]
            result[row, c] = value


@njit(error_model="numpy")
def implicit_directions(pairs, hessians, points, k, step, a, b, own, parameters, before, products, after):
    """Fill `after` (2 n d, m) with the derivative of an implicit substep times the directions `before` (2 n d, m).

    Return True if the linear equations were solved. `k` is the index of the point of the substep.
    """
    middle, half = np.empty(before.shape), before.shape[0] // 2
    for row in range(before.shape[0]):
        for c in range(before.shape[1]):
            after[row, c] = before[row, c]
    previous = np.inf
    for _ in range(2 * PLAIN):
        change, size = 0.0, 0.0
        for row in range(before.shape[0]):
            weight = a if row < half else b
            for c in range(before.shape[1]):
                middle[row, c] = before[row, c] + weight * (after[row, c] - before[row, c])
        linearised_field(pairs, hessians, points, k, own, parameters, middle, products)
        for row in range(before.shape[0]):
            for c in range(before.shape[1]):
                value = before[row, c] + step * products[row, c]
                change, size = max(change, abs(value - after[row, c])), max(size, abs(value))
                after[row, c] = value
        if is_settled(change, previous, size, ROUNDING):
            return True
        if not change < np.inf:
            break
        previous = change
    if hessians.shape[0] > 0:
        return direct_directions(hessians[k], step, a, b, before, after)
    return False


@njit(error_model="numpy")
def direct_directions(hessian, step, a, b, before, after):
    """Solve the linear equations of an implicit substep by elimination.

    The results are as in `implicit_directions`. `hessian` (2 n d, 2 n d) holds the second derivatives at the point.
    """
    size, half = hessian.shape[0], hessian.shape[0] // 2
    matrix, pivots, middle, right = np.empty((size, size)), np.empty(size, np.int64), np.empty(size), np.empty(size)
    substep_matrix(hessian, step, a, b, matrix)
    if factor_matrix(matrix, pivots) >= 0:
        return False
    for c in range(before.shape[1]):
        for row in range(size):
            middle[row] = (1.0 - (a if row < half else b)) * before[row, c]
        for row in range(half):
            position, momentum = before[row, c], before[half + row, c]
            for column in range(size):
                position += step * hessian[half + row, column] * middle[column]
                momentum -= step * hessian[row, column] * middle[column]
            right[row], right[half + row] = position, momentum
        solve_factored(matrix, pivots, right)
        for row in range(size):
            after[row, c] = right[row]
    return True


@njit(error_model="numpy", forceinline=True)
def energy_of(hamiltonian, z, own, parameters):
    """Return H at a state (2, n, d).

    `hamiltonian` is the address of a compiled function that returns H.
    """
    return call_value(hamiltonian, (data_of(z), z.shape[1], data_of(own), data_of(parameters)))


@njit(cache=True, error_model="numpy", nogil=True)
def follow(pairs, h, own, parameters, path, points, near):
    """Fill the states `path` (N + 1, 2, n, d) from the first state, and `points` (N points, 2, n, d).

    Return the number of iterations of all implicit steps, or the negative outcome of a failure. If `near` is positive,
    `points` must hold the points of a nearby trajectory. Implicit steps then begin at these points and stop at the
    relative accuracy `near`.
    """
    iterations, count = 0, pairs.points
    for k in range(path.shape[0] - 1):
        after = path[k + 1]
        outcome = advance(pairs, path[k], h, own, parameters, points[k * count : (k + 1) * count], near, after)
        if outcome < 0:
            return outcome
        if not call_value(pairs.domain_margin, (data_of(after), after.shape[1])) > 0.0:
            return OUTSIDE
        iterations += outcome
    return iterations


@njit(cache=True, error_model="numpy", nogil=True)
def discrete_cost(pairs, h, own, parameters, points, weights):
    """Return the sum of 2 h H over the points (N points, 2, n, d), with the `weights` (points,) of the scheme."""
    cost = 0.0
    for k in range(points.shape[0]):
        cost += 2.0 * h * weights[k % pairs.points] * energy_of(pairs.hamiltonian, points[k], own, parameters)
    return cost


@njit(cache=True, error_model="numpy", nogil=True)
def defects(pairs, h, own, parameters, path, points, errors):
    """Fill `errors` (N, 2, n, d) with the step from each state minus the next state, and `points` with the points.

    Return the number of iterations of all implicit steps, or the negative outcome of a failure.
    """
    after, iterations, count = np.empty(path[0].shape), 0, pairs.points
    for k in range(path.shape[0] - 1):
        outcome = advance(pairs, path[k], h, own, parameters, points[k * count : (k + 1) * count], 0.0, after)
        if outcome < 0:
            return outcome
        for s in range(2):
            for i in range(after.shape[1]):
                for a in range(after.shape[2]):
                    errors[k, s, i, a] = after[s, i, a] - path[k + 1, s, i, a]
        iterations += outcome
    return iterations


@njit(cache=True, error_model="numpy", nogil=True)
def cost_and_energies(pairs, h, own, parameters, path, points, weights, energy):
    """Fill `energy` (N + 1,) with H at every state of `path`; return the discrete cost, see `discrete_cost`.

    If the first point of a step is the state at its start, H is evaluated only once for both.
    """
    cost, count = 0.0, pairs.points
    for k in range(path.shape[0]):
        energy[k] = energy_of(pairs.hamiltonian, path[k], own, parameters)
    for k in range(points.shape[0]):
        if same_state(points[k], path[k // count]):
            value = energy[k // count]
        else:
            value = energy_of(pairs.hamiltonian, points[k], own, parameters)
        cost += 2.0 * h * weights[k % count] * value
    return cost


@njit(error_model="numpy")
def same_state(one, other):
    """Return True if all numbers of two states (2, n, d) are equal."""
    for s in range(2):
        for i in range(one.shape[1]):
            for a in range(one.shape[2]):
                if one[s, i, a] != other[s, i, a]:
                    return False
    return True
