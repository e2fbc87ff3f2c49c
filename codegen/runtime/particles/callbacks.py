"""Functions of a connect problem for external solvers, in three formulations.

A connect problem seeks a motion from given points, the start, to other points, the target. `case` is a `cascade.Case`
with N steps, n particles and d coordinates.

- Shooting: the unknowns are the initial momenta.
- All states at once: the equations are each step from a state minus the next state. The unknowns are the positions at
  inner nodes, then the momenta at all nodes.
- The discrete action: minimise a cost subject to constraints. The unknowns are the positions at inner nodes, then one
  momentum P_k of each interval.

The discrete action, with the abscissa c of the scheme, is

    minimise 2 h sum_k H(q, P_k) such that q_k+1 - q_k = h H_p(q, P_k), both at q = (1 - c) q_k + c q_k+1.

At a minimum the multipliers are 2 P_k. The conditions for the positions are then the equations of the scheme for the
momenta.
"""

import numpy as np

from codegen.runtime.particles.cascade import guessed_path, momenta_of
from codegen.runtime.particles.shooting import Linearised, end_residual
from codegen.runtime.particles.steps import defects, discrete_cost, follow


def first_momenta(case):
    """Return the initial momenta (n, d) that correspond to the constant velocity of the straight way."""
    return momenta_of(case, case.start, (case.target - case.start) / case.duration)


def trajectory(case, momenta):
    """Make all steps from initial momenta (n d,); return the outcome, the states, and the points.

    The outcome is negative if a step fails. H is evaluated at the points. States have shape (N + 1, 2, n, d), points
    (N POINTS, 2, n, d).
    """
    path = np.zeros((case.steps + 1, 2, *case.start.shape))
    path[0, 0], path[0, 1] = case.start, np.reshape(momenta, case.start.shape)
    points = np.zeros((case.steps * case.problem.points, *path.shape[1:]))
    outcome = follow(case.problem.pairs, case.duration / case.steps, case.own, case.parameters, path, points, 0.0)
    return outcome, path, points


def residual(case, momenta):
    """Return the residual (n d,) of the end conditions for initial momenta (n d,); NaN if a step fails.

    The residual is q_N + sigma^2 p_N - target.
    """
    outcome, path, _ = trajectory(case, momenta)
    return end_residual(path[-1], case.target, case.sigma) if outcome >= 0 else np.full(case.start.size, np.nan)


def jacobian(case, momenta):
    """Return the derivative (n d, n d) of `residual` with respect to the initial momenta; NaN if a step fails."""
    outcome, _, points = trajectory(case, momenta)
    if outcome < 0:
        return np.full((case.start.size, case.start.size), np.nan)
    return Linearised(case, points, None).matrix()


def path_cost(case, path):
    """Return the discrete cost of the steps from all states of `path` (N + 1, 2, n, d) except the last."""
    h, pairs = case.duration / case.steps, case.problem.pairs
    points = stepped(case, path)[1]
    return discrete_cost(pairs, h, case.own, case.parameters, points, case.problem.costs)


def path_errors(case, path):
    """Return the defects (N, 2, n, d) of the states `path`, and the residual (n d,) of the end conditions.

    A defect is the step from a state minus the next state. All defects are NaN if a step fails.
    """
    outcome, _, errors = stepped(case, path)
    if outcome < 0:
        errors[:] = np.nan
    return errors, end_residual(np.array(path[-1], dtype=float), case.target, case.sigma)


def stepped(case, path):
    """Make a step from each state of `path` (N + 1, 2, n, d) except the last.

    Return the outcome, the points, and the defects. `trajectory` explains the outcome and the points, `path_errors` the
    defects.
    """
    points = np.zeros((case.steps * case.problem.points, *path.shape[1:]))
    errors, h = np.zeros((case.steps, *path.shape[1:])), case.duration / case.steps
    path = np.array(path, dtype=float)
    outcome = defects(case.problem.pairs, h, case.own, case.parameters, path, points, errors)
    return outcome, points, errors


def path_of(case, unknowns):
    """Return the states (N + 1, 2, n, d) that correspond to the unknowns of `all_equations`.

    The first positions are the start, the last positions target - sigma^2 p_N.
    """
    path, size = np.empty((case.steps + 1, 2, *case.start.shape)), case.start.size
    inner = (case.steps - 1) * size
    path[1:-1, 0] = unknowns[:inner].reshape(case.steps - 1, *case.start.shape)
    path[:, 1] = unknowns[inner:].reshape(case.steps + 1, *case.start.shape)
    path[0, 0] = case.start
    path[-1, 0] = case.target - case.sigma[:, None] ** 2 * path[-1, 1]
    return path


def first_unknowns(case):
    """Return the initial guess (2 n d N,) of the unknowns of `all_equations`, from the guessed path."""
    path = guessed_path(case)
    return np.concatenate([path[1:-1, 0].ravel(), path[:, 1].ravel()])


def all_equations(case, unknowns):
    """Return each step from a state minus the next state, as a vector (2 n d N,).

    The unknowns are the positions at inner nodes, then the momenta at all nodes. The last positions are
    target - sigma^2 p_N.
    """
    return path_errors(case, path_of(case, unknowns))[0].ravel()


def all_equations_jacobian(case, unknowns):
    """Return the derivative (2 n d N, 2 n d N) of `all_equations` with respect to the unknowns."""
    path, size, steps = path_of(case, unknowns), case.start.size, case.steps
    linear = Linearised(case, stepped(case, path)[1], None)
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


def action_start(case):
    """Return the initial guess (n d (2 N - 1),) of the unknowns of the discrete action, from the guessed path."""
    path = guessed_path(case)
    return np.concatenate([path[1:-1, 0].ravel(), path[:-1, 1].ravel()])


def action_states(case, unknowns):
    """Return the positions (N + 1, n, d) at all nodes, and the states (N, 2, n, d) at which H is evaluated."""
    inner = (case.steps - 1) * case.start.size
    between = unknowns[:inner].reshape(case.steps - 1, *case.start.shape)
    positions = np.concatenate([case.start[None], between, case.target[None]])
    momenta, c = unknowns[inner:].reshape(case.steps, *case.start.shape), case.problem.abscissa
    return positions, np.stack([(1.0 - c) * positions[:-1] + c * positions[1:], momenta], axis=1)


def action_cost(case, unknowns):
    """Return the discrete cost 2 h sum_k H(q, P_k)."""
    _, states = action_states(case, unknowns)
    total = sum(case.problem.hamiltonian(z, case.own, case.parameters) for z in states)
    return 2.0 * case.duration / case.steps * total


def action_gradients(case, states):
    """Return H_q and H_p (N, 2, n, d) at the states (N, 2, n, d)."""
    gradients = np.empty_like(states)
    for z, gradient in zip(states, gradients, strict=True):
        case.problem.gradient(z, case.own, case.parameters, gradient)
    return gradients


def action_cost_gradient(case, unknowns):
    """Return the gradient (n d (2 N - 1),) of the discrete cost with respect to the unknowns."""
    gradients = 2.0 * case.duration / case.steps * action_gradients(case, action_states(case, unknowns)[1])
    at_nodes, c = np.zeros((case.steps + 1, *case.start.shape)), case.problem.abscissa
    at_nodes[:-1] += (1.0 - c) * gradients[:, 0]
    at_nodes[1:] += c * gradients[:, 0]
    return np.concatenate([at_nodes[1:-1].ravel(), gradients[:, 1].ravel()])


def action_constraints(case, unknowns):
    """Return q_k+1 - q_k - h H_p of all intervals, as a vector (n d N,)."""
    positions, states = action_states(case, unknowns)
    velocities = action_gradients(case, states)[:, 1]
    return (positions[1:] - positions[:-1] - case.duration / case.steps * velocities).ravel()


def action_blocks(case, states):
    """Return the second derivatives (N, 2 n d, 2 n d) of H at the states (N, 2, n, d)."""
    hessians = np.empty((len(states), states[0].size, states[0].size))
    for z, hessian in zip(states, hessians, strict=True):
        case.problem.hessian(z, case.own, case.parameters, hessian)
    return hessians


def action_columns(case, k):
    """Return slices of the unknowns: positions at the start and the end of interval k, and its momenta.

    A slice of prescribed positions is None.
    """
    size, inner = case.start.size, (case.steps - 1) * case.start.size
    left = slice(size * (k - 1), size * k) if k > 0 else None
    right = slice(size * k, size * (k + 1)) if k < case.steps - 1 else None
    return left, right, slice(inner + size * k, inner + size * (k + 1))


def action_jacobian(case, unknowns):
    """Return the derivative (n d N, n d (2 N - 1)) of `action_constraints` with respect to the unknowns."""
    _, states = action_states(case, unknowns)
    size, h, c = case.start.size, case.duration / case.steps, case.problem.abscissa
    matrix = np.zeros((case.steps * size, unknowns.size))
    for k, hessian in enumerate(action_blocks(case, states)):
        rows = matrix[size * k : size * (k + 1)]
        left, right, momenta = action_columns(case, k)
        if left is not None:
            rows[:, left] -= np.eye(size) + h * (1.0 - c) * hessian[size:, :size]
        if right is not None:
            rows[:, right] += np.eye(size) - h * c * hessian[size:, :size]
        rows[:, momenta] -= h * hessian[size:, size:]
    return matrix


def action_hessian(case, unknowns, multipliers):
    """Return the second derivatives (n d (2 N - 1), n d (2 N - 1)) of cost + multipliers . constraints.

    H is quadratic in the momenta: v . H_p(q, P) = H(q, P + v) - H(q, P) - H(q, v). Therefore no third derivatives are
    needed.
    """
    _, states = action_states(case, unknowns)
    size, h, c = case.start.size, case.duration / case.steps, case.problem.abscissa
    weights = np.reshape(multipliers, (case.steps, *case.start.shape))
    both, alone = states.copy(), states.copy()
    both[:, 1] += weights
    alone[:, 1] = weights
    cost, with_weights, of_weights = (action_blocks(case, s) for s in (states, both, alone))
    matrix = np.zeros((unknowns.size, unknowns.size))
    for k in range(case.steps):
        block = 2.0 * h * cost[k]
        block[:size, :size] -= h * (with_weights[k] - cost[k] - of_weights[k])[:size, :size]
        block[:size, size:] -= h * (with_weights[k] - cost[k])[:size, size:]
        block[size:, :size] = block[:size, size:].T
        left, right, momenta = action_columns(case, k)
        matrix[momenta, momenta] += block[size:, size:]
        for columns, weight in ((left, 1.0 - c), (right, c)):
            if columns is None or weight == 0.0:
                continue
            matrix[columns, momenta] += weight * block[:size, size:]
            matrix[momenta, columns] += weight * block[size:, :size]
            for others, other_weight in ((left, 1.0 - c), (right, c)):
                if others is not None:
                    matrix[columns, others] += weight * other_weight * block[:size, :size]
    return matrix


def action_path(case, unknowns):
    """Return the states (N + 1, 2, n, d) at the nodes: p_k = P_k + (1 - c) h H_q and p_k+1 = P_k - c h H_q."""
    positions, states = action_states(case, unknowns)
    slopes, c = case.duration / case.steps * action_gradients(case, states)[:, 0], case.problem.abscissa
    momenta = np.concatenate([states[:1, 1] + (1.0 - c) * slopes[:1], states[:, 1] - c * slopes])
    return np.stack([positions, momenta], axis=1)
