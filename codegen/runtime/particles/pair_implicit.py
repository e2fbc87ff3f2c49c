"""Implicit substeps, and their derivatives.

They are iterated as they stand, which contracts by about h |H''|; where that is slow, Newton's method takes over with
the generated second derivatives. Its matrix is factored anew only when the factors at hand no longer serve.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import hamiltonian_gradient, hamiltonian_hessian
from codegen.runtime.lu import factor_matrix, solve_factored
from codegen.runtime.particles.pair_algebra import copy_state
from codegen.runtime.particles.pair_curvature import linearised_field
from codegen.runtime.particles.pair_moved import moved

NOT_CONVERGED = -3  # what `implicit_substep` returns when there is no solution
PLAIN, NEWTON = 40, 25  # iterations of a substep as it stands, and by Newton's method
ROUNDING = 1e-15  # relative change below which nothing is left but rounding


@njit(cache=True, error_model="numpy")
def between(before, after, a, b, point):
    """Fill `point`, shape (2, n, d) as both ends, with where a substep evaluates the field."""
    for i in range(before.shape[1]):
        for k in range(before.shape[2]):
            point[0, i, k] = before[0, i, k] + a * (after[0, i, k] - before[0, i, k])
            point[1, i, k] = before[1, i, k] + b * (after[1, i, k] - before[1, i, k])


@njit(cache=True, error_model="numpy")
def is_settled(change, previous, size, accuracy):
    """Whether an iteration has come to a relative accuracy, or to where only rounding errors change it."""
    return change <= accuracy * size or (change <= 1e-12 * size and change >= 0.5 * previous)


@njit(cache=True, error_model="numpy")
def implicit_substep(before, step, a, b, own, parameters, near, gradient, point, after):
    """Fill `after`, shape (2, n, d), with the end of a substep; return the iterations, or why there is no solution.

    Where `point` is near to where the field will be evaluated, `near` is the relative accuracy that suffices, and the
    iteration starts with the field at `point`. Else it is zero, and the start is an explicit Euler step.
    """
    if not near > 0.0:
        copy_state(before, point)
    hamiltonian_gradient(point, own, parameters, gradient)
    moved(before, step, gradient, after)
    previous, earlier = np.inf, np.inf
    for iteration in range(PLAIN):
        between(before, after, a, b, point)
        hamiltonian_gradient(point, own, parameters, gradient)
        change, size = moved(before, step, gradient, after)
        if is_settled(change, previous, size, max(near, ROUNDING)):
            return iteration + 1
        # Positions and momenta take turns, so that two iterations are compared.
        if not change < np.inf or (iteration > 3 and change > 0.5 * earlier):
            break
        previous, earlier = change, previous
    return newton_substep(before, step, a, b, own, parameters, gradient, point, after)


@njit(cache=True, error_model="numpy")
def newton_substep(before, step, a, b, own, parameters, gradient, point, after):
    """The same by Newton's method from an explicit Euler step; arrays (2, n, d)."""
    size = before.size
    hessian, matrix, pivots = np.empty((size, size)), np.empty((size, size)), np.empty(size, np.int64)
    wanted, right = np.empty(before.shape), np.empty(size)
    ends, goals = after.reshape(size), wanted.reshape(size)
    hamiltonian_gradient(before, own, parameters, gradient)
    moved(before, step, gradient, after)
    previous, is_factored = np.inf, False
    for iteration in range(NEWTON):
        between(before, after, a, b, point)
        hamiltonian_gradient(point, own, parameters, gradient)
        copy_state(after, wanted)
        moved(before, step, gradient, wanted)
        if not is_factored:
            hamiltonian_hessian(point, own, parameters, hessian)
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


@njit(cache=True, error_model="numpy")
def substep_matrix(hessian, step, a, b, matrix):
    """Fill `matrix`, shape (2nd, 2nd), with 1 - step J H'' diag(a, b): the derivative of the equations by the end."""
    size, half = hessian.shape[0], hessian.shape[0] // 2
    for row in range(half):
        for column in range(size):
            weight = step * (a if column < half else b)
            matrix[row, column] = -weight * hessian[half + row, column]
            matrix[half + row, column] = weight * hessian[row, column]
    for row in range(size):
        matrix[row, row] += 1.0


@njit(cache=True, error_model="numpy")
def implicit_directions(hessians, anew, points, k, step, a, b, own, parameters, before, products, after):
    """Fill `after` with the derivative of a substep times the directions `before`, both (2nd, m), or return False."""
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
        linearised_field(hessians, anew, points, k, own, parameters, middle, products)
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
    if anew is None:
        return direct_directions(hessians[k], step, a, b, before, after)
    return False


@njit(cache=True, error_model="numpy")
def direct_directions(hessian, step, a, b, before, after):
    """Solve the linear equations of a substep by elimination; otherwise as `implicit_directions`."""
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
