"""Newton's method on the initial momenta, by exact tangents of the trajectory.

The equations are r(p0) = q_N(p0) + sigma^2 p_N(p0) - target; with sigma = 0 points are met exactly. For sigma > 0 this
is stationarity of the cost's half plus sum |q_N - target|^2/(2 sigma^2), since p_N is its gradient by q_N. The same
method solves for all states at once (multiple shooting with one step for each interval): then each step may have a
defect, and states move along the linearised trajectory, which is what elimination of the block-banded Jacobian gives.

Few unknowns are solved for by tangents in all directions at once, many by GMRES preconditioned with H_pp at the start,
the derivative of r for vanishing motion. The forcing terms are those of Eisenstat and Walker (1996), SIAM Journal on
Scientific Computing 17, choice 2; the line search halves steps until the residual decreases.
"""

import numpy as np
from numba import njit

from codegen.runtime.example_pairs import BLOCKS, POINTS, domain_margin, momentum_matrix
from codegen.runtime.pair_algebra import cholesky, solve_cholesky, solve_dense
from codegen.runtime.pair_curvature import curvature_at
from codegen.runtime.pair_runge_kutta import advance_directions
from codegen.runtime.pair_trajectory import defects, follow

SOLVED, LIMIT, STALLED, SINGULAR = 1, 0, -5, -2  # how a Newton iteration ends; other negative numbers: see `follow`
DENSE = 24  # unknowns up to which tangents in all directions are taken
BASIS = 80  # directions that GMRES keeps
HALVINGS = 14
ROUNDING = 1e-10  # residuals below this count as solved once no step makes them smaller


@njit(cache=True, error_model="numpy")
def tangents(hessians, points, steps, h, own, parameters, directions):
    """Propagate directions, shape (2nd, m), over all steps in place; return whether every step was solved."""
    after = np.empty(directions.shape)
    for k in range(steps):
        if not advance_directions(hessians, points, k * POINTS, h, own, parameters, directions, after):
            return False
        directions[:] = after
    return True


@njit(cache=True, error_model="numpy")
def arrival(directions, sigma):
    """The change of q_N + sigma^2 p_N along directions, shape (nd, m)."""
    half = directions.shape[0] // 2
    change = directions[:half].copy()
    axes = half // sigma.size
    for row in range(half):
        for c in range(directions.shape[1]):
            change[row, c] += sigma[row // axes] ** 2 * directions[half + row, c]
    return change


@njit(cache=True, error_model="numpy")
def end_residual(state, target, sigma, residual):
    """Fill `residual`, shape (nd,), with q_N + sigma^2 p_N - target."""
    axes = state.shape[2]
    for i in range(state.shape[1]):
        for a in range(axes):
            residual[i * axes + a] = state[0, i, a] + sigma[i] ** 2 * state[1, i, a] - target[i, a]


@njit(cache=True, error_model="numpy")
def preconditioner(state, duration, own, parameters):
    """The Cholesky factor of duration times H_pp, an empty array if that is not positive definite."""
    size = state.shape[1] if BLOCKS == 1 else state.shape[1] * state.shape[2]
    matrix = np.empty((size, size))
    momentum_matrix(state, own, parameters, matrix)
    matrix *= duration
    if cholesky(matrix):
        return matrix
    return np.empty((0, 0))


@njit(cache=True, error_model="numpy")
def preconditioned(factor, vector):
    """The preconditioner's inverse times a vector, shape (nd,)."""
    if factor.shape[0] == 0:
        return vector.copy()
    result = vector.copy().reshape((factor.shape[0], vector.size // factor.shape[0]))
    solve_cholesky(factor, result)
    return result.reshape(-1)


@njit(cache=True, error_model="numpy")
def sensitivity(hessians, points, steps, h, own, parameters, sigma, change):
    """The change of the residual for a change of the initial momenta, shape (nd,)."""
    half = change.size
    directions = np.zeros((2 * half, 1))
    directions[half:, 0] = change
    if not tangents(hessians, points, steps, h, own, parameters, directions):
        return np.full(half, np.nan)
    return arrival(directions, sigma)[:, 0].copy()


@njit(cache=True, error_model="numpy")
def shooting_jacobian(hessians, points, steps, h, own, parameters, sigma):
    """The derivative of the residual by the initial momenta, shape (nd, nd)."""
    half = points[0].size // 2
    directions = np.zeros((2 * half, half))
    for c in range(half):
        directions[half + c, c] = 1.0
    if not tangents(hessians, points, steps, h, own, parameters, directions):
        return np.full((half, half), np.nan)
    return arrival(directions, sigma)


@njit(cache=True, error_model="numpy")
def gmres(hessians, points, steps, h, own, parameters, sigma, factor, right, forcing):
    """Solve sensitivity(x) = right to a relative residual of `forcing`; return x and the number of products."""
    size = right.size
    most = min(BASIS, size)
    norm = np.sqrt((right * right).sum())
    basis = np.empty((most + 1, size))
    rotated = np.zeros((most, most + 1))  # columns of the Hessenberg matrix, rotated to triangular form
    cosines, sines, remainder = np.empty(most), np.empty(most), np.zeros(most + 1)
    basis[0], remainder[0], count = right / norm, norm, 0
    for k in range(most):
        new = sensitivity(hessians, points, steps, h, own, parameters, sigma, preconditioned(factor, basis[k]))
        for row in range(k + 1):
            product = (new * basis[row]).sum()
            rotated[k, row] = product
            new -= product * basis[row]
        length = np.sqrt((new * new).sum())
        if not length < np.inf:
            break
        for row in range(k):
            upper = cosines[row] * rotated[k, row] + sines[row] * rotated[k, row + 1]
            rotated[k, row + 1] = cosines[row] * rotated[k, row + 1] - sines[row] * rotated[k, row]
            rotated[k, row] = upper
        radius = np.hypot(rotated[k, k], length)
        if not radius > 0.0:
            break
        cosines[k], sines[k] = rotated[k, k] / radius, length / radius
        rotated[k, k] = radius
        remainder[k + 1] = -sines[k] * remainder[k]
        remainder[k] *= cosines[k]
        count = k + 1
        if abs(remainder[k + 1]) <= forcing * norm or length <= 1e-15 * radius:
            break
        basis[k + 1] = new / length
    solution = np.zeros(size)
    for k in range(count - 1, -1, -1):
        for column in range(k + 1, count):
            remainder[k] -= rotated[column, k] * remainder[column]
        remainder[k] /= rotated[k, k]
        solution += remainder[k] * basis[k]
    return preconditioned(factor, solution), count


@njit(cache=True, error_model="numpy")
def newton_direction(hessians, points, steps, h, own, parameters, sigma, factor, right, forcing):
    """The change of initial momenta that changes the residual by `right`, and the number of tangents taken."""
    if right.size > DENSE:
        return gmres(hessians, points, steps, h, own, parameters, sigma, factor, right, forcing)
    matrix = shooting_jacobian(hessians, points, steps, h, own, parameters, sigma)
    solution = right.copy().reshape((right.size, 1))
    if not solve_dense(matrix, solution):
        return np.full(right.size, np.nan), right.size
    return solution[:, 0].copy(), right.size


@njit(cache=True, error_model="numpy")
def largest(values):
    """Max-norm; infinite when an entry is not a number."""
    size = 0.0
    for value in values.flat:
        if not abs(value) < np.inf:
            return np.inf
        size = max(size, abs(value))
    return size


@njit(cache=True, error_model="numpy")
def shoot(h, own, parameters, target, sigma, tolerance, max_iterations, path, points, log):
    """Improve the initial momenta path[0, 1] until the trajectory arrives; fill `path`, `points` and `log`.

    A row of `log` is (residual, tangents, step length). Return how it ended, the iterations and the last residual.
    """
    steps, half = path.shape[0] - 1, path[0].size // 2
    factor = preconditioner(path[0], h * steps, own, parameters)
    residual, trial = np.empty(half), np.empty(half)
    trial_path, trial_points = np.empty(path.shape), np.empty(points.shape)
    outcome = follow(h, own, parameters, path, points)
    if outcome < 0:
        return outcome, 0, np.inf
    end_residual(path[steps], target, sigma, residual)
    error, forcing, previous = largest(residual), 0.1, np.inf
    for iteration in range(max_iterations):
        log[iteration, 0] = error
        if error <= tolerance:
            return SOLVED, iteration, error
        norm = np.sqrt((residual * residual).sum())
        forcing = max(min(0.1, 0.9 * (norm / previous) ** 2), min(0.1, 0.1 * tolerance / error), 1e-10)
        previous = norm
        hessians = curvature_at(points, own, parameters)
        change, log[iteration, 1] = newton_direction(
            hessians, points, steps, h, own, parameters, sigma, factor, -residual, forcing
        )
        if not largest(change) < np.inf:
            return SINGULAR, iteration, error
        length, accepted = 1.0, False
        for _ in range(HALVINGS):
            trial_path[0, 0] = path[0, 0]
            trial_path[0, 1] = path[0, 1] + length * change.reshape(path[0, 1].shape)
            if follow(h, own, parameters, trial_path, trial_points) >= 0:
                end_residual(trial_path[steps], target, sigma, trial)
                if np.sqrt((trial * trial).sum()) <= (1.0 - 1e-4 * length) * norm:
                    accepted = True
                    break
            length *= 0.5
        log[iteration, 2] = length if accepted else 0.0
        if not accepted:
            return SOLVED if error <= ROUNDING else STALLED, iteration, error
        path[:], points[:], residual[:] = trial_path, trial_points, trial
        error = largest(residual)
    log[max_iterations, 0] = error
    return SOLVED if error <= tolerance else LIMIT, max_iterations, error


@njit(cache=True, error_model="numpy")
def all_states(h, own, parameters, target, sigma, tolerance, max_iterations, path, points, log):
    """Improve all states of `path` but the places at the start; otherwise as `shoot`.

    The residual is the largest of all defects of steps and of the end conditions.
    """
    steps, half = path.shape[0] - 1, path[0].size // 2
    factor = preconditioner(path[0], h * steps, own, parameters)
    errors, trial_errors = np.empty((steps, *path[0].shape)), np.empty((steps, *path[0].shape))
    residual, trial = np.empty(half), np.empty(half)
    trial_path, trial_points = np.empty(path.shape), np.empty(points.shape)
    outcome = defects(h, own, parameters, path, points, errors)
    if outcome < 0:
        return outcome, 0, np.inf
    end_residual(path[steps], target, sigma, residual)
    for iteration in range(max_iterations):
        error = max(largest(errors), largest(residual))
        log[iteration, 0] = error
        if error <= tolerance:
            return SOLVED, iteration, error
        norm = np.sqrt((errors * errors).sum() + (residual * residual).sum())
        hessians = curvature_at(points, own, parameters)
        shifts = np.zeros((steps + 1, 2 * half, 1))
        if not shifted(hessians, points, h, own, parameters, errors, shifts):
            return SINGULAR, iteration, error
        right = -residual - arrival(shifts[steps], sigma)[:, 0]
        change, log[iteration, 1] = newton_direction(
            hessians, points, steps, h, own, parameters, sigma, factor, right, 1e-6
        )
        shifts[0, half:, 0] = change
        if not shifted(hessians, points, h, own, parameters, errors, shifts) or not largest(shifts) < np.inf:
            return SINGULAR, iteration, error
        length, accepted = 1.0, False
        for _ in range(HALVINGS):
            trial_path[:] = path + length * shifts.reshape(path.shape)
            if is_inside(trial_path) and defects(h, own, parameters, trial_path, trial_points, trial_errors) >= 0:
                end_residual(trial_path[steps], target, sigma, trial)
                size = np.sqrt((trial_errors * trial_errors).sum() + (trial * trial).sum())
                if size <= (1.0 - 1e-4 * length) * norm:
                    accepted = True
                    break
            length *= 0.5
        log[iteration, 2] = length if accepted else 0.0
        if not accepted:
            return SOLVED if error <= ROUNDING else STALLED, iteration, error
        path[:], points[:], residual[:], errors[:] = trial_path, trial_points, trial, trial_errors
    error = max(largest(errors), largest(residual))
    return SOLVED if error <= tolerance else LIMIT, max_iterations, error


@njit(cache=True, error_model="numpy")
def shifted(hessians, points, h, own, parameters, errors, shifts):
    """Fill shifts[1:] with the linearised trajectory from shifts[0] that removes the defects."""
    for k in range(errors.shape[0]):
        if not advance_directions(hessians, points, k * POINTS, h, own, parameters, shifts[k], shifts[k + 1]):
            return False
        shifts[k + 1, :, 0] += errors[k].reshape(-1)
    return True


@njit(cache=True, error_model="numpy")
def is_inside(path):
    """Whether every particle is in its domain at every node."""
    for k in range(path.shape[0]):
        if not domain_margin(path[k]) > 0.0:
            return False
    return True
