"""What drivers need of a connect problem: residuals and Jacobians of shooting and of all states at once."""

import numpy as np

from codegen.runtime.particles.cascade import guessed_path, momenta_of
from codegen.runtime.particles.shooting import Linearised, end_residual
from codegen.runtime.particles.trajectory import defects, discrete_cost, follow


def first_momenta(case):
    """Return the momenta of the straight way, shape (n, d)."""
    return momenta_of(case, case.start, (case.target - case.start) / case.duration)


def trajectory(case, momenta):
    """Return the outcome of all steps, the states, shape (N + 1, 2, n, d), and the points at which H is evaluated."""
    path = np.zeros((case.steps + 1, 2, *case.start.shape))
    path[0, 0], path[0, 1] = case.start, np.reshape(momenta, case.start.shape)
    points = np.zeros((case.steps * case.problem.points, *path.shape[1:]))
    outcome = follow(case.problem.pairs, case.duration / case.steps, case.own, case.parameters, path, points, 0.0)
    return outcome, path, points


def residual(case, momenta):
    """Return q_N + sigma^2 p_N - target for given initial momenta, (nd,); NaN if a step fails."""
    outcome, path, _ = trajectory(case, momenta)
    return end_residual(path[-1], case.target, case.sigma) if outcome >= 0 else np.full(case.start.size, np.nan)


def jacobian(case, momenta):
    """Return the derivative of `residual` by the initial momenta, shape (nd, nd); NaN where a step fails."""
    outcome, _, points = trajectory(case, momenta)
    if outcome < 0:
        return np.full((case.start.size, case.start.size), np.nan)
    return Linearised(case, points, None).matrix()


def path_cost(case, path):
    """Return the discrete cost of states, shape (N + 1, 2, n, d), from each of which a step is made."""
    points, errors = (
        np.zeros((case.steps * case.problem.points, *path.shape[1:])),
        np.zeros((case.steps, *path.shape[1:])),
    )
    h, pairs = case.duration / case.steps, case.problem.pairs
    defects(pairs, h, case.own, case.parameters, np.array(path, dtype=float), points, errors)
    return discrete_cost(pairs, h, case.own, case.parameters, points, case.problem.costs)


def path_errors(case, path):
    """Return each step from a state minus the next state, (N, 2, n, d), and the residual of the end, (nd,)."""
    points, errors = (
        np.zeros((case.steps * case.problem.points, *path.shape[1:])),
        np.zeros((case.steps, *path.shape[1:])),
    )
    h, path = case.duration / case.steps, np.array(path, dtype=float)
    if defects(case.problem.pairs, h, case.own, case.parameters, path, points, errors) < 0:
        errors[:] = np.nan
    return errors, end_residual(path[-1], case.target, case.sigma)


def path_of(case, unknowns):
    """Return the states, shape (N + 1, 2, n, d), that belong to the unknowns of `all_equations`."""
    path, size = np.empty((case.steps + 1, 2, *case.start.shape)), case.start.size
    inner = (case.steps - 1) * size
    path[1:-1, 0] = unknowns[:inner].reshape(case.steps - 1, *case.start.shape)
    path[:, 1] = unknowns[inner:].reshape(case.steps + 1, *case.start.shape)
    path[0, 0] = case.start
    path[-1, 0] = case.target - case.sigma[:, None] ** 2 * path[-1, 1]
    return path


def first_unknowns(case):
    """Return inner positions and all momenta on the guessed path, shape (2ndN,)."""
    path = guessed_path(case)
    return np.concatenate([path[1:-1, 0].ravel(), path[:, 1].ravel()])


def all_equations(case, unknowns):
    """Return every step from a state minus the next state, (2ndN,).

    Unknowns are the positions at inner nodes, then the momenta at all nodes; the last ones are target - sigma^2 p_N.
    """
    return path_errors(case, path_of(case, unknowns))[0].ravel()


def all_equations_jacobian(case, unknowns):
    """Return the derivative of `all_equations`, shape (2ndN, 2ndN)."""
    path, size, steps = path_of(case, unknowns), case.start.size, case.steps
    points, errors = np.zeros((steps * case.problem.points, *path.shape[1:])), np.zeros((steps, *path.shape[1:]))
    h = case.duration / steps
    defects(case.problem.pairs, h, case.own, case.parameters, path, points, errors)
    linear = Linearised(case, points, None)
    matrix, inner = np.zeros((2 * size * steps, 2 * size * steps)), (steps - 1) * size
    after, variance = np.empty((2 * size, 2 * size)), np.repeat(case.sigma**2, case.start.shape[1])
    for k in range(steps):
        rows = slice(2 * size * k, 2 * size * (k + 1))
        linear.advance(k, np.eye(2 * size), after)
        momenta = slice(inner + size * k, inner + size * (k + 1))
        later = slice(momenta.stop, momenta.stop + size)
        matrix[rows, momenta] += after[:, size:]
        matrix[rows, later][size:] -= np.eye(size)
        if k > 0:
            matrix[rows, size * (k - 1) : size * k] += after[:, :size]
        if k < steps - 1:
            matrix[rows, size * k : size * (k + 1)][:size] -= np.eye(size)
        else:
            matrix[rows, later][:size] += np.diag(variance)
    return matrix
