"""One step of a composition method: in each substep the field is taken at one point between its ends.

z1 = z0 + f h F(q, p) at q = (1 - a) q0 + a q1, p = (1 - b) p0 + b p1. Implicit substeps are iterated as they stand,
which contracts by about f h |H''|; where that is slow, Newton's method takes over, with the generated second
derivatives factored anew only when the factor at hand no longer serves.
"""

import numpy as np
from numba import njit

from codegen.runtime.example_pairs import POINTS, SUBSTEPS, hamiltonian_gradient, hamiltonian_hessian
from codegen.runtime.pair_algebra import solve_dense
from codegen.runtime.pair_curvature import linearised_field

NON_FINITE, NOT_CONVERGED = -1, -3  # what `advance` returns when there is no solution
PLAIN, NEWTON = 30, 12  # iterations of the substep as it stands, and by Newton's method
ROUNDING = 1e-15  # relative change below which nothing is left but rounding


@njit(cache=True, error_model="numpy")
def advance(z, h, own, parameters, points, after):
    """Fill `points`, shape (POINTS, 2, n, d), and the state `after` a step; return iterations, or why it failed."""
    before, gradient, iterations = z.copy(), np.empty(z.shape), 0
    for s in range(POINTS):
        step, a, b = h * SUBSTEPS[s][0], SUBSTEPS[s][1], SUBSTEPS[s][2]
        if a == 0.0 and b == 0.0:
            points[s] = before
            hamiltonian_gradient(before, own, parameters, gradient)
            moved(before, step, gradient, after)
        else:
            outcome = implicit_substep(before, step, a, b, own, parameters, gradient, points[s], after)
            if outcome < 0:
                return outcome
            iterations += outcome
        if not np.isfinite(np.abs(after).sum()):
            return NON_FINITE
        before[:] = after
    return iterations


@njit(cache=True, error_model="numpy")
def moved(before, step, gradient, after):
    """Fill `after` with before + step (H_p, -H_q); return the largest change of its entries and their size."""
    change, size = 0.0, 0.0
    for i in range(before.shape[1]):
        for k in range(before.shape[2]):
            place = before[0, i, k] + step * gradient[1, i, k]
            momentum = before[1, i, k] - step * gradient[0, i, k]
            change = max(change, abs(place - after[0, i, k]), abs(momentum - after[1, i, k]))
            size = max(size, abs(place), abs(momentum))
            after[0, i, k], after[1, i, k] = place, momentum
    return change, size


@njit(cache=True, error_model="numpy")
def between(before, after, a, b, point):
    """Fill `point` with the place at which a substep evaluates the field."""
    for i in range(before.shape[1]):
        for k in range(before.shape[2]):
            point[0, i, k] = (1.0 - a) * before[0, i, k] + a * after[0, i, k]
            point[1, i, k] = (1.0 - b) * before[1, i, k] + b * after[1, i, k]


@njit(cache=True, error_model="numpy")
def implicit_substep(before, step, a, b, own, parameters, gradient, point, after):
    """Solve a substep from an explicit Euler step; return the iterations, or why there is no solution."""
    hamiltonian_gradient(before, own, parameters, gradient)
    moved(before, step, gradient, after)
    previous = np.inf
    for iteration in range(PLAIN):
        between(before, after, a, b, point)
        hamiltonian_gradient(point, own, parameters, gradient)
        change, size = moved(before, step, gradient, after)
        if change <= ROUNDING * size or (change <= 1e-13 * size and change >= 0.5 * previous):
            return iteration + 1
        if not change < np.inf or (iteration > 3 and change > 0.7 * previous):
            break
        previous = change
    return newton_substep(before, step, a, b, own, parameters, gradient, point, after)


@njit(cache=True, error_model="numpy")
def newton_substep(before, step, a, b, own, parameters, gradient, point, after):
    """Newton's method from an explicit Euler step."""
    size, half = before.size, before.size // 2
    hessian, matrix = np.empty((size, size)), np.empty((size, size))
    wanted, right = np.empty(before.shape), np.empty((size, 1))
    hamiltonian_gradient(before, own, parameters, gradient)
    moved(before, step, gradient, after)
    previous = np.inf
    for iteration in range(NEWTON):
        between(before, after, a, b, point)
        hamiltonian_gradient(point, own, parameters, gradient)
        hamiltonian_hessian(point, own, parameters, hessian)
        wanted[:] = after
        moved(before, step, gradient, wanted)
        right[:, 0] = (wanted - after).reshape(-1)
        for row in range(half):
            for column in range(size):
                weight = step * (a if column < half else b)
                matrix[row, column] = -weight * hessian[half + row, column]
                matrix[half + row, column] = weight * hessian[row, column]
        for row in range(size):
            matrix[row, row] += 1.0
        if not np.isfinite(np.abs(right).sum()) or not solve_dense(matrix, right):
            return NON_FINITE
        after += right.reshape(before.shape)
        change, scale = np.abs(right).max(), np.abs(after).max()
        if change <= 1e-14 * scale or (change <= 1e-9 * scale and change >= 0.5 * previous):
            between(before, after, a, b, point)
            return PLAIN + iteration + 1
        previous = change
    return NOT_CONVERGED


@njit(cache=True, error_model="numpy")
def advance_directions(hessians, points, first, h, own, parameters, directions, after):
    """Fill `after`, shape (2nd, m), with the derivative of a step times directions.

    The step's points are those from number `first`. Return whether the linear equations of every substep were solved.
    """
    before, middle = directions.copy(), np.empty(directions.shape)
    products, rates = np.empty(directions.shape), np.empty(directions.shape)
    half = directions.shape[0] // 2
    for s in range(POINTS):
        step, a, b = h * SUBSTEPS[s][0], SUBSTEPS[s][1], SUBSTEPS[s][2]
        after[:] = before
        previous, solved = np.inf, False
        for _ in range(1 if a == 0.0 and b == 0.0 else 2 * PLAIN):
            change, size = 0.0, 0.0
            middle[:half] = (1.0 - a) * before[:half] + a * after[:half]
            middle[half:] = (1.0 - b) * before[half:] + b * after[half:]
            linearised_field(hessians, points, first + s, own, parameters, middle, products, rates)
            for row in range(2 * half):
                for c in range(directions.shape[1]):
                    value = before[row, c] + step * rates[row, c]
                    change = max(change, abs(value - after[row, c]))
                    size = max(size, abs(value))
                    after[row, c] = value
            if change <= ROUNDING * size or (change <= 1e-13 * size and change >= 0.5 * previous):
                solved = True
                break
            previous = change
        if not solved and (a != 0.0 or b != 0.0):
            if hessians.shape[0] == 0:
                return False
            if not direct_directions(hessians[first + s], step, a, b, before, after):
                return False
        before[:] = after
    return True


@njit(cache=True, error_model="numpy")
def direct_directions(hessian, step, a, b, before, after):
    """Solve the linear equations of a substep by elimination."""
    size, half = hessian.shape[0], hessian.shape[0] // 2
    matrix = np.empty((size, size))
    after[:] = before
    for row in range(half):
        for column in range(size):
            place = a if column < half else b
            matrix[row, column] = -step * place * hessian[half + row, column]
            matrix[half + row, column] = step * place * hessian[row, column]
            after[row] += step * (1.0 - place) * hessian[half + row, column] * before[column]
            after[half + row] -= step * (1.0 - place) * hessian[row, column] * before[column]
    for row in range(size):
        matrix[row, row] += 1.0
    return solve_dense(matrix, after)
