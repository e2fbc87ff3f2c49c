"""A path of nearly least action between given points: the initial guess of shooting where a straight way misleads.

The action is sum_k v.G(q)^-1 v/(2h), with v = q_k+1 - q_k, q midway between the nodes, and G = H_pp. It is bounded
below and grows without bound as points approach each other, so that a descent method finds a minimum from any path.
Points with sigma > 0 may miss their targets: the action then contains |q_N - target|^2/(2 sigma^2), and the last
positions are free.

The method is BFGS with limited memory. It begins with the inverse of the second derivatives for constant G, a
block-tridiagonal matrix. Source: Nocedal and Wright (2006), Numerical optimization, algorithms 7.4 and 7.5.

Arrays: n particles with d coordinates, N intervals. G has m rows, where m is n if G acts on all coordinates alike, else
n d. `case` is a `cascade.Case`.
"""

import numpy as np

INTERVALS = 20  # least number of intervals of a path; ten are too few where particles pass closely
BENDS = (0.0, 0.1, -0.1, 0.3, -0.3)  # bends of the paths to start from: particles may collide on the guessed path
DESCENTS = 300  # largest number of iterations
REFRESHED = 5  # number of iterations with the same second derivatives; then the memory is cleared
WORTHWHILE = 1e-6  # least predicted decrease in an iteration, relative to the action
SUFFICIENT = 1e-4  # a step must reach this fraction of the decrease along the slope
SHORTEST = 2.0**-20  # least step length of the line search
MOST_ENTRIES = 5_000_000  # largest number of entries of the matrices G of a path, with about 500 particles


def action_of(case, positions):
    """Return the action of a path, its gradient, the momenta, and the inverses of G.

    `positions` and the gradient (N + 1, n, d) belong to the nodes, the momenta (N, n, d) and the inverses (N, m, m) to
    the intervals. If the path leaves the domain or G is not positive definite, the action is infinite and the rest
    None.
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
    """Return the factors of the Hessian of the action at nodes 1 ... N, for constant G: a block-tridiagonal matrix.

    The factors are the inverse pivots (N, m, m) and the couplings (N - 1, m, m) of neighbouring nodes. `inverses`
    (N, m, m) holds the inverses of G.
    """
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
    """Return the solution (N, n, d) of the block-tridiagonal equations for the right-hand side `forces` (N, n, d).

    `pivots` and `couplings` are the results of `stiffness`.
    """
    right = forces.reshape(*pivots.shape[:2], -1).copy()
    for k, coupling in enumerate(couplings):
        right[k + 1] -= coupling.T @ pivots[k] @ right[k]
    right[-1] = pivots[-1] @ right[-1]
    for k in range(len(couplings) - 1, -1, -1):
        right[k] = pivots[k] @ (right[k] - couplings[k] @ right[k + 1])
    return right.reshape(forces.shape)


def direction(pivots, couplings, memory, gradient):
    """Return the direction of descent (N, n, d) of limited-memory BFGS for a gradient (N, n, d).

    `memory` is a list of pairs (step, change of the gradient), the latest pair last.
    """
    forces, weights = -gradient, []
    for step, change in reversed(memory):
        weights.append((step * forces).sum() / (step * change).sum())
        forces = forces - weights[-1] * change
    way = relaxed(pivots, couplings, forces)
    for (step, change), weight in zip(memory, reversed(weights), strict=True):
        way += (weight - (change * way).sum() / (step * change).sum()) * step
    return way


def bent_path(case, count, bend):
    """Return positions (count + 1, n, d) on the guessed way, moved sideways in the middle.

    The largest displacement is the way of each particle times `bend`, turned by 90 degrees if d is 2.
    """
    positions, d = np.empty((count + 1, *case.start.shape)), case.start.shape[1]
    for k in range(count + 1):
        case.problem.guide(case.start, case.target, k / count, positions[k])
    aside = (case.target - case.start) @ (np.tri(d, d, -1) - np.tri(d, d, -1).T)  # a quarter of a turn in the plane
    return positions + bend * np.sin(np.pi * np.linspace(0.0, 1.0, count + 1))[:, None, None] * aside


def path_intervals(case):
    """Return the number of intervals of a path, or zero if its matrices would be too large."""
    size = case.start.shape[0] if case.problem.blocks == 1 else case.start.size
    most = MOST_ENTRIES // size**2
    return min(max(INTERVALS, case.steps), most) if most >= INTERVALS else 0


def momenta_of_least_action(case):
    """Return the momenta (n, d) at the start of a path of nearly least action.

    The result is NaN if no guessed path has a finite action, or if `path_intervals` finds too many particles.
    """
    count = path_intervals(case)
    with np.errstate(all="ignore"):  # the code tests for non-finite numbers where they matter
        positions, momenta = descended(case, count) if count else (None, None)
    if momenta is None:
        return np.full(case.start.shape, np.nan)
    state, slope = np.stack([0.5 * (positions[0] + positions[1]), momenta[0]]), np.empty((2, *case.start.shape))
    case.problem.gradient(state, case.own, case.parameters, slope)
    return momenta[0] + 0.5 * case.duration / count * slope[0]


def descended(case, count):
    """Return the positions (N + 1, n, d) and the momenta (N, n, d) of a path of nearly least action.

    The momenta are None if no guessed path has a finite action.
    """
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
