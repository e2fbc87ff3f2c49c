"""Shooting: Newton's method for the initial momenta with exact derivatives of the trajectory, after Broyden's method.

The equations are r(p0) = q_N(p0) + sigma^2 p_N(p0) - target. With sigma = 0, points meet their targets exactly. With
sigma > 0, the equations state that half the cost plus sum |q_N - target|^2/(2 sigma^2) is stationary. This follows
because p_N is the gradient of half the cost with respect to q_N. The same method solves for all states at once
(multiple shooting with one step for each interval). Then each step may have a defect, the step from a state minus the
next state. The states move along the linearised trajectory: this is elimination of the block-banded Jacobian.

A tangent is a linearised trajectory: the derivative of all states in one direction. With few unknowns, tangents in all
directions give the Jacobian. Many unknowns are first improved by Broyden's method, then solved for by GMRES. Its
preconditioner is duration times H_pp at the start plus sigma^2, the derivative of r for vanishing motion. The forcing
terms are choice 2 of Eisenstat and Walker (1996), SIAM Journal on Scientific Computing 17. The line search halves steps
until the residual decreases.

An iteration of Broyden's method costs one trajectory and no derivative. The preconditioner is the first approximation
of the derivative. Each step corrects the approximation by a matrix of rank one. Newton's method takes over when the
residual no longer decreases. Source: Kelley (1995), Iterative methods for linear and nonlinear equations, section 7.3
(the inverse as a product).
"""

import numpy as np
from numba import njit

from codegen.runtime.arithmetic import cholesky, factor_matrix, max_norm, solve_cholesky, solve_factored
from codegen.runtime.particles.steps import advance_directions, curvature_at, defects, follow

BROYDEN_STEPS = 40  # largest number of iterations; each keeps two vectors
PATIENCE = 6  # largest number of iterations in which the residual must be halved
ENOUGH = 1e-4  # relative accuracy of implicit steps, divided by the last relative residual


@njit(error_model="numpy")
def fill_end_residual(state, target, sigma, residual):
    """Fill `residual` (n d,) with q_N + sigma^2 p_N - target, from the last state (2, n, d).

    Return the largest modulus of an entry, and the 2-norm.
    """
    size, total, k = 0.0, 0.0, 0
    for i in range(target.shape[0]):
        for a in range(target.shape[1]):
            value = state[0, i, a] + sigma[i] * sigma[i] * state[1, i, a] - target[i, a]
            residual[k] = value
            size, total, k = max(size, abs(value)), total + value * value, k + 1
    return size, np.sqrt(total)


@njit(error_model="numpy")
def approximate_inverse(factor, left, right, values, change):
    """Fill `change` (n d,) with the approximate inverse of the derivative times `values` (n d,).

    `factor` is the result of `preconditioner`. Row i of `left` and of `right` (steps, nd) is the correction by step i
    of Broyden's method: the inverse is multiplied by 1 + left[i] right[i]'.
    """
    for k in range(values.size):
        change[k] = values[k]
    solve_cholesky(factor, change.reshape((factor.shape[0], values.size // factor.shape[0])))
    for c in range(left.shape[0]):
        product = 0.0
        for k in range(values.size):
            product += right[c, k] * change[k]
        for k in range(values.size):
            change[k] += left[c, k] * product


@njit(cache=True, error_model="numpy", nogil=True)
def broyden_steps(pairs, h, own, parameters, target, sigma, factor, tolerance, path, points):
    """Improve the initial momenta path[0, 1] (n, d) while the residual decreases; return the number of steps.

    At the end `path` and `points` belong to the best momenta. The residual of `path` is not returned: the caller has to
    evaluate it. `factor` is the result of `preconditioner`.
    """
    size = target.size
    left, right = np.empty((BROYDEN_STEPS, size)), np.empty((BROYDEN_STEPS, size))
    step, change, residual = np.empty(size), np.empty(size), np.empty(size)
    momenta = path[0, 1].reshape(size)
    kept = momenta.copy()
    error, norm = fill_end_residual(path[-1], target, sigma, residual)
    scale = max(max_norm(target.reshape(size)), 1e-300)
    start, best, halved, waited, made, is_kept = norm, norm, norm, 0, 0, True
    approximate_inverse(factor, left[:made], right[:made], residual, step)
    while made < BROYDEN_STEPS and error > tolerance and waited < PATIENCE:
        for k in range(size):
            step[k] = -step[k]
            momenta[k] += step[k]
        made, waited, is_kept = made + 1, waited + 1, False
        if follow(pairs, h, own, parameters, path, points, max(ENOUGH * error / scale, 1e-15)) < 0:
            break
        error, norm = fill_end_residual(path[-1], target, sigma, residual)
        if not norm <= 2.0 * start:
            break
        if norm < best:
            best, kept, is_kept = norm, momenta.copy(), True
        if norm < 0.5 * halved:
            halved, waited = norm, 0
        approximate_inverse(factor, left[: made - 1], right[: made - 1], residual, change)
        along = 0.0
        for k in range(size):
            along += step[k] * (step[k] + change[k])
        if not abs(along) > 0.0:
            break
        product = 0.0
        for k in range(size):
            left[made - 1, k], right[made - 1, k] = -change[k] / along, step[k]
            product += step[k] * change[k]
        for k in range(size):
            step[k] = change[k] * (1.0 - product / along)
    if not is_kept:
        for k in range(size):  # assigning arrays would make numba compile error messages: a tenth of all time
            momenta[k] = kept[k]
        follow(pairs, h, own, parameters, path, points, 0.0)
    return made


SOLVED, ROUNDED, LIMIT, STALLED, SINGULAR = 1, 2, 0, -5, -2  # outcomes of a search; `follow` has more negative ones
DENSE = 24  # largest number of unknowns for which the whole Jacobian is computed
BASIS = 80  # largest number of directions that GMRES keeps
HALVINGS = 14  # largest number of step lengths that the line search tries
UNIT = 2.0**-52  # a unit in the last place
SAMPLES = 8  # number of perturbed copies from which rounding errors are estimated
VISIBLE = 1e-8  # residuals above this are not attributed to rounding errors


@njit(cache=True, error_model="numpy", nogil=True)
def tangents(pairs, hessians, points, steps, h, own, parameters, directions):
    """Propagate `directions` (2 n d, m) over all steps in place; return True if all linear equations were solved."""
    after = np.empty(directions.shape)
    for k in range(steps):
        if not advance_directions(pairs, hessians, points, k * pairs.points, h, own, parameters, directions, after):
            return False
        for row in range(after.shape[0]):
            for c in range(after.shape[1]):
                directions[row, c] = after[row, c]
    return True


def end_residual_change(directions, sigma):
    """Return the change (n d, m) of q_N + sigma^2 p_N for changes `directions` (2 n d, m) of the last state."""
    half = directions.shape[0] // 2
    variances = np.repeat(sigma**2, half // sigma.size)
    return directions[:half] + variances[:, None] * directions[half:]


def end_residual(state, target, sigma):
    """Return q_N + sigma^2 p_N - target (n d,) for the last state (2, n, d)."""
    return (state[0] + sigma[:, None] ** 2 * state[1] - target).ravel()


@njit(cache=True, error_model="numpy")
def extend_basis(k, basis, rotated, rotations, remainder):
    """Make step k of GMRES: orthonormalise row k + 1 of `basis` (m + 1, nd), and update the least-squares problem.

    Before the call this row is the matrix times row k. Row k of `rotated` (m, m + 1) takes the coefficients of row
    k + 1 before it is orthonormalised: a column of a triangular matrix. Row k of `rotations` (m, 2) takes the cosine
    and sine of a rotation. The modulus of remainder[k + 1], shape (m + 1,), is then the norm of the residual.

    Source: Saad (2003), Iterative methods for sparse linear systems, algorithm 6.9 and section 6.5.3.
    """
    new, before = basis[k + 1], 0.0
    for row in range(k + 1):
        product = 0.0
        for i in range(new.size):
            product += new[i] * basis[row, i]
        rotated[k, row] = product
        for i in range(new.size):
            new[i] -= product * basis[row, i]
    for i in range(new.size):
        before += new[i] * new[i]
    length = np.sqrt(before)
    for row in range(k):
        upper = rotations[row, 0] * rotated[k, row] + rotations[row, 1] * rotated[k, row + 1]
        rotated[k, row + 1] = rotations[row, 0] * rotated[k, row + 1] - rotations[row, 1] * rotated[k, row]
        rotated[k, row] = upper
    radius = np.hypot(rotated[k, k], length)
    rotations[k, 0], rotations[k, 1] = rotated[k, k] / radius, length / radius
    rotated[k, k], rotated[k, k + 1] = radius, 0.0
    remainder[k + 1] = -rotations[k, 1] * remainder[k]
    remainder[k] *= rotations[k, 0]
    for i in range(new.size):
        new[i] /= max(length, 1e-300)


class Linearised:
    """The derivative of the residual with respect to the initial momenta, at one trajectory or one sequence of states.

    The attribute `count` is the number of tangents computed so far.
    """

    def __init__(self, case, points, factor):
        """Evaluate the second derivatives at all `points` (N POINTS, 2, n, d), unless there are too many to store.

        `factor` is the result of `preconditioner`.
        """
        self.case, self.points, self.factor, self.count = case, points, factor, 0
        self.hessians = curvature_at(case.problem, points, case.own, case.parameters)
        self.pairs = case.problem.pairs if self.hessians.size else case.problem.pairs_with_products

    def advance(self, k, directions, after):
        """Fill `after` (2 n d, m) with the derivative of step k times `directions` (2 n d, m).

        Return True if the linear equations of the step were solved.
        """
        case, first = self.case, k * self.pairs.points
        arguments = self.pairs, self.hessians, self.points, first, case.duration / case.steps, case.own, case.parameters
        return advance_directions(*arguments, directions, after)

    def tangents(self, directions):
        """Propagate `directions` (2 n d, m) over all steps in place, and return them.

        The result is NaN if the linear equations of a step cannot be solved.
        """
        case = self.case
        self.count += directions.shape[1]
        h = case.duration / case.steps
        arguments = self.pairs, self.hessians, self.points, case.steps, h, case.own, case.parameters
        if not tangents(*arguments, directions):
            directions[:] = np.nan
        return directions

    def product(self, change):
        """Return the change (n d,) of the residual for a `change` (n d,) of the initial momenta."""
        directions = np.zeros((2 * change.size, 1))
        directions[change.size :, 0] = change
        return end_residual_change(self.tangents(directions), self.case.sigma)[:, 0]

    def matrix(self):
        """Return the derivative of the residual with respect to the initial momenta as a matrix (n d, n d)."""
        size = self.case.start.size
        return end_residual_change(self.tangents(np.vstack([np.zeros((size, size)), np.eye(size)])), self.case.sigma)

    def solved(self, right, forcing):
        """Return the change (n d,) of the initial momenta that changes the residual by `right` (n d,).

        The result is NaN if the derivative is singular. GMRES stops at a residual of `forcing` relative to `right`.
        """
        if right.size > DENSE:
            return self.gmres(right, forcing)
        matrix, pivots, solution = self.matrix(), np.empty(right.size, dtype=np.int64), right.copy()
        if factor_matrix(matrix, pivots) >= 0:
            return np.full(right.size, np.nan)
        solve_factored(matrix, pivots, solution)
        return solution

    def preconditioned(self, vector):
        """Return the inverse of the preconditioner times a vector (n d,)."""
        if self.factor is None:
            return vector
        result = vector.copy().reshape(self.factor.shape[0], -1)
        solve_cholesky(self.factor, result)
        return result.ravel()

    def gmres(self, right, forcing):
        """Return an approximate result of `solved`, by GMRES.

        The relative residual is at most `forcing`, unless more than BASIS directions would be needed.
        """
        most, norm = min(BASIS, right.size), np.linalg.norm(right)
        basis, rotated = np.empty((most + 1, right.size)), np.zeros((most, most + 1))
        rotations, remainder = np.zeros((most, 2)), np.zeros(most + 1)
        basis[0], remainder[0], count = right / norm, norm, 0
        for k in range(most):
            basis[k + 1] = self.product(self.preconditioned(basis[k]))
            extend_basis(k, basis, rotated, rotations, remainder)
            if not np.isfinite(remainder[k + 1]):
                return np.full(right.size, np.nan)
            count = k + 1
            if abs(remainder[k + 1]) <= forcing * norm:
                break
        weights = np.linalg.solve(rotated[:count, :count].T, remainder[:count])
        return self.preconditioned(weights @ basis[:count])


def preconditioner(case):
    """Return the Cholesky factor of duration times H_pp at the start plus sigma^2.

    This matrix, (n, n) or (n d, n d), is the derivative of `end_residual` for small momenta. The result is None if the
    matrix is not positive definite.
    """
    size = case.start.shape[0] if case.problem.blocks == 1 else case.start.size
    matrix = np.empty((size, size))
    case.problem.momentum_matrix(np.stack([case.start, np.zeros_like(case.start)]), case.own, case.parameters, matrix)
    matrix *= case.duration
    matrix[np.diag_indices(size)] += np.repeat(case.sigma**2, size // case.start.shape[0])
    return matrix if cholesky(matrix) else None


def jittered(values):
    """Return SAMPLES copies of an array, with each entry changed by a unit in the last place.

    The signs of the changes are random.
    """
    generator = np.random.default_rng(0)
    return [values * (1.0 + UNIT * generator.choice((-1.0, 1.0), values.shape)) for _ in range(SAMPLES)]


def rounding(case, path):
    """Return the largest change of the residual when the initial momenta change by a unit in the last place.

    Momenta cannot be more exact than this, and rounding errors of the trajectory are added. No iteration can be
    expected to reach a smaller residual. Source: More and Wild (2011), Estimating computational noise, SIAM Journal on
    Scientific Computing 33.
    """
    h, residual, noise = case.duration / case.steps, end_residual(path[-1], case.target, case.sigma), 0.0
    trial, points = path.copy(), np.empty((case.steps * case.problem.points, *path.shape[1:]))
    for momenta in jittered(path[0, 1]):
        trial[0, 1] = momenta
        if follow(case.problem.pairs, h, case.own, case.parameters, trial, points, 0.0) >= 0:
            noise = max(noise, max_norm(end_residual(trial[-1], case.target, case.sigma) - residual))
    return noise


def rounding_of_states(case, path, errors):
    """Return the largest change of the defects `errors` when all states change by a unit in the last place.

    Defects have shape (N, 2, n, d).
    """
    h, noise = case.duration / case.steps, 0.0
    moved_errors, points = np.empty_like(errors), np.empty((case.steps * case.problem.points, *path.shape[1:]))
    for trial in jittered(path):
        if defects(case.problem.pairs, h, case.own, case.parameters, trial, points, moved_errors) >= 0:
            noise = max(noise, max_norm((moved_errors - errors).ravel()))
    return noise


def without_progress(error, noise):
    """Return the outcome of an iteration whose steps no longer reduce the residual `error`: ROUNDED or STALLED.

    `noise` estimates the effect of rounding errors; residuals above VISIBLE are not attributed to rounding.
    """
    return ROUNDED if error <= min(noise, VISIBLE) else STALLED


def shoot(case, factor, path, points, log):
    """Improve the initial momenta path[0, 1] until the trajectory reaches the target; fill `path`, `points` and `log`.

    `factor` is the result of `preconditioner`. Each row of `log` (max_iterations + 1, 3) describes one iteration:
    residual, number of tangents, and step length. Return the outcome, the number of iterations, and the last residual.
    """
    h = case.duration / case.steps
    trial_path, trial_points = np.empty_like(path), np.empty_like(points)
    outcome = follow(case.problem.pairs, h, case.own, case.parameters, path, points, 0.0)
    if outcome < 0:
        return outcome, 0, np.inf
    made = 0
    if factor is not None and case.start.size > DENSE:
        arguments = case.problem.pairs, h, case.own, case.parameters, case.target, case.sigma, factor, case.tolerance
        made = broyden_steps(*arguments, path, points)
    residual, previous = end_residual(path[-1], case.target, case.sigma), np.inf
    for iteration in range(case.max_iterations + 1):
        error, norm = max_norm(residual), np.linalg.norm(residual)
        log[iteration, 0] = error
        if error <= case.tolerance or iteration == case.max_iterations:
            return SOLVED if error <= case.tolerance else LIMIT, made + iteration, error
        forcing = max(min(0.1, 0.9 * (norm / previous) ** 2), min(0.1, 0.1 * case.tolerance / error), 1e-10)
        previous, linear = norm, Linearised(case, points, factor)
        change = linear.solved(-residual, forcing).reshape(case.start.shape)
        log[iteration, 1] = linear.count
        if not np.isfinite(change).all():
            return SINGULAR, made + iteration, error
        length, accepted = 1.0, False
        for _ in range(HALVINGS):
            trial_path[0, 0], trial_path[0, 1] = path[0, 0], path[0, 1] + length * change
            trial_points[:] = points
            if follow(case.problem.pairs, h, case.own, case.parameters, trial_path, trial_points, 1e-15) >= 0:
                trial = end_residual(trial_path[-1], case.target, case.sigma)
                if np.linalg.norm(trial) <= (1.0 - 1e-4 * length) * norm:
                    accepted = True
                    break
            length *= 0.5
        if not accepted:
            return without_progress(error, rounding(case, path)), made + iteration, error
        log[iteration, 2] = length
        path[:], points[:], residual = trial_path, trial_points, trial
    raise AssertionError("unreachable")


def all_states(case, factor, path, points, log):
    """Improve all states of `path`, with the positions at the start fixed; arguments and results as in `shoot`.

    The residual is the largest modulus of all defects and of the residual of the end conditions.
    """
    h = case.duration / case.steps
    errors, trial_errors = np.empty_like(path[1:]), np.empty_like(path[1:])
    trial_path, trial_points = np.empty_like(path), np.empty_like(points)
    outcome = defects(case.problem.pairs, h, case.own, case.parameters, path, points, errors)
    if outcome < 0:
        return outcome, 0, np.inf
    residual = end_residual(path[-1], case.target, case.sigma)
    for iteration in range(case.max_iterations + 1):
        error = max(max_norm(errors.ravel()), max_norm(residual))
        log[iteration, 0] = error
        if error <= case.tolerance or iteration == case.max_iterations:
            return SOLVED if error <= case.tolerance else LIMIT, iteration, error
        norm = np.hypot(np.linalg.norm(errors), np.linalg.norm(residual))
        linear = Linearised(case, points, factor)
        shifts = np.zeros((case.steps + 1, 2 * residual.size, 1))
        shift_states(linear, errors, shifts)
        right = -residual - end_residual_change(shifts[-1], case.sigma)[:, 0]
        shifts[0, residual.size :, 0] = linear.solved(right, min(1e-3, 0.1 * error)) if right.any() else 0.0
        shift_states(linear, errors, shifts)
        log[iteration, 1] = linear.count + 2
        if not np.isfinite(shifts).all():
            return SINGULAR, iteration, error
        length, accepted = 1.0, False
        for _ in range(HALVINGS):
            trial_path[:] = path + length * shifts.reshape(path.shape)
            outcome = -1
            if all(case.problem.domain_margin(z) > 0.0 for z in trial_path):
                arguments = case.problem.pairs, h, case.own, case.parameters
                outcome = defects(*arguments, trial_path, trial_points, trial_errors)
            if outcome >= 0:
                trial = end_residual(trial_path[-1], case.target, case.sigma)
                if np.hypot(np.linalg.norm(trial_errors), np.linalg.norm(trial)) <= (1.0 - 1e-4 * length) * norm:
                    accepted = True
                    break
            length *= 0.5
        if not accepted:
            return without_progress(error, rounding_of_states(case, path, errors)), iteration, error
        log[iteration, 2] = length
        path[:], points[:], residual, errors[:] = trial_path, trial_points, trial, trial_errors
    raise AssertionError("unreachable")


def shift_states(linear, errors, shifts):
    """Fill shifts[1:] (N, 2 n d, 1) with changes of the states that remove the defects of all steps.

    `errors` (N, 2, n, d) holds the defects. The changes follow the linearised trajectory from shifts[0]. If the linear
    equations of a step cannot be solved, later changes are NaN.
    """
    for k, error in enumerate(errors):
        solved = linear.advance(k, shifts[k], shifts[k + 1])
        shifts[k + 1, :, 0] += error.ravel() if solved else np.nan
