"""A path of nearly least action between given points: a start of shooting where the straight way misleads it.

The action sum_k v.G(q)^-1 v/(2h), with v = q_k+1 - q_k, q midway and G = H_pp, is bounded below. It grows without bound
as points approach each other, so that a descent method finds a minimum from any path. With a sigma,
|q_N - target|^2/(2 sigma^2) is added and the last positions move as well. The method is BFGS with limited memory. It
begins with the inverse of the second derivatives without the change of G, a block-tridiagonal matrix. Source: Nocedal
and Wright (2006), Numerical optimization, algorithms 7.4 and 7.5.
"""

import numpy as np

INTERVALS = 20  # least number of intervals of the path; ten mislead where particles pass closely
BENDS = (0.0, 0.1, -0.1, 0.3, -0.3)  # bends of the first paths: particles may collide on the guessed path
DESCENTS = 300  # iterations at most
REFRESHED = 5  # iterations after which second derivatives are evaluated again and the memory is cleared
WORTHWHILE = 1e-6  # least relative decrease of the action in an iteration
SUFFICIENT = 1e-4  # part of the decrease along the slope that a step has to reach
SHORTEST = 2.0**-20  # least part of a step that is tried
MOST_ENTRIES = 5_000_000  # largest number of entries of the matrices G of a path, with about 500 particles


def action_of(case, positions):
    """Return the action of positions (N + 1, n, d) at the nodes, its gradient, momenta (N, n, d), and all G^-1.

    The action is infinite, and the rest None, if a path leaves the domain or G has no inverse.
    """
    count, (n, d) = len(positions) - 1, case.start.shape
    h, size = case.duration / count, n if case.problem.blocks == 1 else n * d
    states, matrices = np.zeros((count, 2, n, d)), np.empty((count, size, size))
    states[:, 0] = 0.5 * (positions[:-1] + positions[1:])
    if not np.isfinite(states).all() or not all(case.problem.domain_margin(z) > 0.0 for z in states):
        return np.inf, None, None, None
    for z, matrix in zip(states, matrices, strict=True):
        case.problem.momentum_matrix(z, case.own, case.parameters, matrix)
    try:
        inverses = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return np.inf, None, None, None
    ways = (positions[1:] - positions[:-1]).reshape(count, size, -1)
    states[:, 1] = (inverses @ ways / h).reshape(count, n, d)
    parts = (states[:, 1].reshape(ways.shape) * ways).sum(axis=(1, 2))
    if not (parts >= 0.0).all():  # rounding has made G indefinite
        return np.inf, None, None, None
    slopes, gradient = np.empty_like(states), np.zeros_like(positions)
    for z, slope in zip(states, slopes, strict=True):
        case.problem.gradient(z, case.own, case.parameters, slope)
    gradient[:-1] -= states[:, 1] + 0.5 * h * slopes[:, 0]
    gradient[1:] += states[:, 1] - 0.5 * h * slopes[:, 0]
    missed = np.where(case.sigma > 0.0, 1.0, 0.0)[:, None] * (positions[-1] - case.target)
    weighted = missed / np.where(case.sigma > 0.0, case.sigma, 1.0)[:, None] ** 2
    gradient[-1] += weighted
    gradient[-1, case.sigma == 0.0] = 0.0
    return 0.5 * parts.sum() + 0.5 * (missed * weighted).sum(), gradient, states[:, 1], inverses


def stiffness(case, inverses):
    """Return pivots (N, m, m) and couplings (N - 1, m, m) of the block-tridiagonal Hessian at nodes 1 ... N."""
    blocks = inverses * (len(inverses) / case.duration)
    size = blocks.shape[1]
    free = np.repeat(case.sigma > 0.0, size // len(case.sigma))
    weights = np.repeat(case.sigma, size // len(case.sigma))[free] ** -2.0
    diagonal, couplings = blocks.copy(), -blocks[1:]
    diagonal[:-1] += blocks[1:]
    couplings[-1][:, ~free] = 0.0
    diagonal[-1][~free], diagonal[-1][:, ~free] = 0.0, 0.0
    diagonal[-1][~free, ~free] = 1.0
    diagonal[-1][free, free] += weights
    pivots = np.empty_like(diagonal)
    pivots[0] = np.linalg.inv(diagonal[0])
    for k, coupling in enumerate(couplings):
        pivots[k + 1] = np.linalg.inv(diagonal[k + 1] - coupling.T @ pivots[k] @ coupling)
    return pivots, couplings


def relaxed(pivots, couplings, forces):
    """Solve with the result of `stiffness`, for forces at the nodes 1 ... N, shape (N, n, d)."""
    right = forces.reshape(*pivots.shape[:2], -1).copy()
    for k, coupling in enumerate(couplings):
        right[k + 1] -= coupling.T @ pivots[k] @ right[k]
    right[-1] = pivots[-1] @ right[-1]
    for k in range(len(couplings) - 1, -1, -1):
        right[k] = pivots[k] @ (right[k] - couplings[k] @ right[k + 1])
    return right.reshape(forces.shape)


def direction(pivots, couplings, memory, gradient):
    """Return the direction of descent for a gradient (N, n, d), by two loops over pairs (step, gradient change)."""
    forces, weights = -gradient, []
    for step, change in reversed(memory):
        weights.append((step * forces).sum() / (step * change).sum())
        forces = forces - weights[-1] * change
    way = relaxed(pivots, couplings, forces)
    for (step, change), weight in zip(memory, reversed(weights), strict=True):
        way += (weight - (change * way).sum() / (step * change).sum()) * step
    return way


def bent_path(case, count, bend):
    """Return positions (count + 1, n, d) on the guessed way, moved aside in the middle by a part of its length."""
    positions, d = np.empty((count + 1, *case.start.shape)), case.start.shape[1]
    for k in range(count + 1):
        case.problem.guide(case.start, case.target, k / count, positions[k])
    aside = (case.target - case.start) @ (np.tri(d, d, -1) - np.tri(d, d, -1).T)  # a quarter of a turn in the plane
    return positions + bend * np.sin(np.pi * np.linspace(0.0, 1.0, count + 1))[:, None, None] * aside


def path_intervals(case):
    """Return the number of intervals of a path, zero if its matrices would be too large."""
    size = case.start.shape[0] if case.problem.blocks == 1 else case.start.size
    most = MOST_ENTRIES // size**2
    return min(max(INTERVALS, case.steps), most) if most >= INTERVALS else 0


def momenta_of_least_action(case):
    """Return momenta (n, d) at the start of a path of nearly least action.

    NaN if no guessed path has a finite action, and if there are too many particles for `path_intervals`.
    """
    count = path_intervals(case)
    with np.errstate(all="ignore"):  # non-finite numbers are tested where they matter
        positions, momenta = descended(case, count) if count else (None, None)
    if momenta is None:
        return np.full(case.start.shape, np.nan)
    state, slope = np.stack([0.5 * (positions[0] + positions[1]), momenta[0]]), np.empty((2, *case.start.shape))
    case.problem.gradient(state, case.own, case.parameters, slope)
    return momenta[0] + 0.5 * case.duration / count * slope[0]


def descended(case, count):
    """Return positions (N + 1, n, d) at the nodes and momenta of the intervals, or None if no guessed path has any."""
    memory, pivots, couplings = [], None, None
    positions = min((bent_path(case, count, bend) for bend in BENDS), key=lambda path: action_of(case, path)[0])
    action, gradient, momenta, inverses = action_of(case, positions)
    if gradient is None:
        return positions, None
    for iteration in range(DESCENTS):
        if iteration % REFRESHED == 0:
            memory = []
            try:
                pivots, couplings = stiffness(case, inverses)
            except np.linalg.LinAlgError:  # rounding has made the matrix singular: keep the path so far
                break
        way = direction(pivots, couplings, memory, gradient[1:])
        decrease = -(way * gradient[1:]).sum()
        if not decrease > WORTHWHILE * action:
            break
        length, reached = 1.0, None
        while length >= SHORTEST and reached is None:
            trial = positions.copy()
            trial[1:] += length * way
            result = action_of(case, trial)
            reached = result if result[0] <= action - SUFFICIENT * length * decrease else None
            length *= 0.5
        if reached is None:
            break
        step, change = trial[1:] - positions[1:], reached[1][1:] - gradient[1:]
        if (step * change).sum() > 0.0:
            memory.append((step, change))
        positions, (action, gradient, momenta, inverses) = trial, reached
    return positions, momenta
