"""The globalisation cascade of the boundary-value problem: several attempts to connect given points, in turn.

The attempts are:

- shooting from the momenta H_pp^-1 (target - start)/duration;
- shooting from the momenta of a path of least action, if H is kinetic energy alone;
- shooting from rest;
- continuation in the target;
- Newton's method on all states at once, from a guessed path;
- continuation from more steps to fewer steps.

An attempt succeeds only if its residual is below the tolerance, or at the level of rounding errors. An attempt is a
function of (case, factor, path, points, log). `factor` is the result of `preconditioner`. The attempt starts from
`path` (N + 1, 2, n, d) and fills it, `points` (N POINTS, 2, n, d) and `log`, which `shoot` explains. The attempt
returns a key of OUTCOMES, the number of iterations, the residual, and sometimes a note for the message.
"""

from typing import NamedTuple

import numpy as np

from codegen.runtime.arithmetic import cholesky, solve_cholesky
from codegen.runtime.kernels import packed_operations
from codegen.runtime.particles.least_action import momenta_of_least_action, path_intervals
from codegen.runtime.particles.problem import PairProblem
from codegen.runtime.particles.shooting import all_states, preconditioner, shoot
from codegen.runtime.particles.steps import cost_and_energies
from codegen.runtime.search.grid import checked_count, checked_times, checked_tolerance

OUTCOMES = {
    1: "solved",
    2: "solved as far as rounding errors allow",
    0: "the iterations ran out",
    -1: "a state became infinite or not a number",
    -2: "the linear equations have no unique solution",
    -3: "the equations of an implicit step were not solved",
    -4: "a particle leaves its domain",
    -5: "no step along Newton's direction reduces the residual",
    -6: "no guessed path has a finite action, or there are too many particles to look for one",
}
MORE_STEPS = (2, 4)  # factors of the number of steps, tried after all other attempts
LEAST_PART = 1.0 / 256.0  # least fraction of the way in one step of continuation


def momenta_of(case, positions, velocity):
    """Return the momenta (n, d) of particles with given positions and velocities (n, d): H_pp^-1 velocity.

    If H_pp is not positive definite, the velocity itself is returned.
    """
    state = np.stack([positions, np.zeros_like(positions)])
    size = positions.shape[0] if case.problem.blocks == 1 else positions.size
    matrix = np.empty((size, size))
    case.problem.momentum_matrix(state, case.own, case.parameters, matrix)
    right = velocity.reshape(size, -1).copy()
    if cholesky(matrix):
        solve_cholesky(matrix, right)
    return right.reshape(positions.shape)


def straight_momenta(case, factor, target):
    """Return the momenta (n, d) of the straight way to a target, as an initial guess of shooting.

    `factor` is the result of `preconditioner`. If `factor` is None, the momenta are the velocity.
    """
    moved = target - case.start
    if factor is None:
        return moved / case.duration
    solve_cholesky(factor, moved.reshape(factor.shape[0], -1))
    return moved


def guessed_path(case, steps=None):
    """Return states (N + 1, 2, n, d) on the guessed way; the momenta are H_pp^-1 (q_k+1 - q_k)/h (Legendre transform).

    N is `steps`, or the number of steps of the case if `steps` is None.
    """
    steps = case.steps if steps is None else steps
    path = np.zeros((steps + 1, 2, *case.start.shape))
    for k in range(steps + 1):
        case.problem.guide(case.start, case.target, k / steps, path[k, 0])
    for k in range(steps):
        path[k, 1] = momenta_of(case, path[k, 0], (path[k + 1, 0] - path[k, 0]) * steps / case.duration)
    path[steps, 1] = path[steps - 1, 1]
    return path


def run_cascade(case, method, guess):
    """Make attempts until one succeeds; return (outcome, path, points, iterations, tangents, residual, attempts).

    With a `guess` (n, d) of the momenta, the only attempt is shooting from the guess. `tangents` is the number of
    linearised trajectories. `attempts` holds a sentence for each attempt.
    """
    (path, points), factor = allocate_path(case), preconditioner(case)
    log = np.zeros((case.max_iterations + 1, 3))
    attempts, iterations, tangents = [], 0, 0
    cascade = attempts_of(case, method) if guess is None else (("shooting from the given momenta", from_momenta),)
    for name, attempt in cascade:
        path[:, 0], path[:, 1] = case.start, 0.0 if guess is None else guess
        log[:] = 0.0
        outcome, made, residual, *note = attempt(case, factor, path, points, log)
        iterations, tangents = iterations + made, tangents + int(log[:, 1].sum())
        attempts.append(f"{name}: {OUTCOMES[outcome]}, {made} iterations, residual {residual:.1e}{''.join(note)}")
        if outcome > 0:
            break
    if case.problem.quadratic:
        is_doubtful = outcome > 0 and guess is None and attempt is not from_least_action
        if is_doubtful and misses_by_far(case, path[-1, 0]):
            made, cheaper, note = by_less_action(case, factor, path, points, log)
            iterations, tangents = iterations + made, tangents + int(log[:, 1].sum())
            residual = residual if cheaper is None else cheaper
            attempts.insert(len(attempts) - (cheaper is None), f"shooting from a path of least action: {note}")
    return outcome, path, points, iterations, tangents, residual, tuple(attempts)


def by_less_action(case, factor, path, points, log):
    """Shoot from a path of least action as well, and keep the path with the lower cost.

    If points have sigma > 0, any stationary point of the cost solves the equations. Two points that should change
    positions may, for example, end together half way. Return the number of iterations, the residual of a cheaper path
    or None, and a note.
    """
    other, other_points = allocate_path(case)
    log[:] = 0.0
    outcome, made, residual = from_least_action(case, factor, other, other_points, log)
    if outcome <= 0:
        return made, None, f"{OUTCOMES[outcome]}, {made} iterations"
    energy, h = np.empty(case.steps + 1), case.duration / case.steps
    arguments = case.problem.pairs, h, case.own, case.parameters
    costs = [
        penalised(case, cost_and_energies(*arguments, *solution, case.problem.costs, energy), solution[0][-1, 0])
        for solution in ((path, points), (other, other_points))
    ]
    if not costs[1] < costs[0]:
        return made, None, f"solved, {made} iterations, but nothing that costs less"
    path[:], points[:] = other, other_points
    return made, residual, f"solved, {made} iterations, residual {residual:.1e}, and it costs less"


def penalised(case, cost, end):
    """Return half the cost plus the sum of |q_N - target|^2/(2 sigma^2) over the points with sigma > 0.

    `end` (n, d) holds the positions q_N.
    """
    free = case.sigma > 0.0
    missed = ((end - case.target)[free] / case.sigma[free, None]) ** 2
    return 0.5 * (cost + missed.sum())


def misses_by_far(case, end):
    """Return True if a point with sigma > 0 misses its target by more than sigma.

    `end` (n, d) holds the last positions.
    """
    return (np.linalg.norm(end - case.target, axis=1) > case.sigma)[case.sigma > 0.0].any()


def shoot_at(case, target, factor, path, points, log):
    """Shoot from the initial momenta of `path` at the given target; see `shoot`."""
    return shoot(case._replace(target=target), factor, path, points, log)


def from_velocity(case, factor, path, points, log):
    """Shoot from the momenta of the straight way to the target."""
    path[0, 1] = straight_momenta(case, factor, case.target)
    return shoot_at(case, case.target, factor, path, points, log)


def from_momenta(case, factor, path, points, log):
    """Shoot from the initial momenta in `path`.

    If `path` starts from rest, the line search shortens the first step. This may succeed where straight momenta fail.
    """
    return shoot_at(case, case.target, factor, path, points, log)


def from_least_action(case, factor, path, points, log):
    """Shoot from the momenta at the start of a path of least action."""
    path[0, 1] = momenta_of_least_action(case)
    if not np.isfinite(path[0, 1]).all():
        return -6, 0, np.inf
    return shoot_at(case, case.target, factor, path, points, log)


def by_continuation(case, factor, path, points, log):
    """Move the target along the guessed way from the start to its final position, and shoot at each target.

    The parts of the way grow after success and shrink after failure. The momenta are extrapolated.
    """
    done, part, total = 0.0, 0.25, 0
    solved = [(0.0, path[0, 1].copy())]
    outcome, residual = 0, np.inf
    while done < 1.0 and part >= LEAST_PART:
        wanted = min(1.0, done + part)
        target = np.empty_like(case.target)
        case.problem.guide(case.start, case.target, wanted, target)
        if len(solved) > 1:
            (s0, p0), (s1, p1) = solved[-2:]
            path[0, 1] = p1 + (wanted - s1) / (s1 - s0) * (p1 - p0)
        else:
            path[0, 1] = straight_momenta(case, factor, target)
        log[:, 0] = log[:, 2] = 0.0
        before = log[:, 1].sum()
        outcome, made, residual = shoot_at(case, target, factor, path, points, log)
        log[-1, 1] = max(before, log[:, 1].sum())
        total += made
        if outcome > 0:
            done, part = wanted, 1.6 * part
            solved.append((wanted, path[0, 1].copy()))
        else:
            part *= 0.4
    return (outcome if done >= 1.0 or outcome <= 0 else 0), total, residual if done >= 1.0 else np.inf


def allocate_path(case, start_momenta=None):
    """Return new arrays `path` and `points` for the steps of a case.

    All states of `path` have the positions of the start. The momenta at the start are `start_momenta` (n, d), or zero.
    """
    path = np.zeros((case.steps + 1, 2, *case.start.shape))
    path[:, 0], path[0, 1] = case.start, 0.0 if start_momenta is None else start_momenta
    return path, np.zeros((case.steps * case.problem.points, *path.shape[1:]))


def by_steps(case, factor, path, points, log):
    """Solve with two or four times as many steps, then with fewer and fewer steps.

    The momenta are extrapolated in 1/N. With few explicit steps, the equations of large motions may have no solution.
    Then a note states the least number of steps with a solution.
    """
    total, outcome = 0, 0
    for multiple in MORE_STEPS:
        finer = case._replace(steps=multiple * case.steps)
        fine_path, fine_points = allocate_path(finer)
        is_sought = case.problem.quadratic and path_intervals(finer)
        attempt = from_least_action if is_sought else by_continuation
        outcome, made, residual = attempt(finer, factor, fine_path, fine_points, log)
        total += made
        if outcome > 0:
            break
    if outcome <= 0:
        return outcome, total, residual, f", with {finer.steps} steps"
    solved, ratio = [(1.0 / finer.steps, fine_path[0, 1].copy())], 0.7
    while finer.steps > case.steps:
        fewer = case._replace(steps=max(case.steps, min(finer.steps - 1, int(ratio * finer.steps))))
        momenta = solved[-1][1]
        if len(solved) > 1:
            (s0, p0), (s1, p1) = solved[-2:]
            momenta = p1 + (1.0 / fewer.steps - s1) / (s1 - s0) * (p1 - p0)
        fine_path, fine_points = allocate_path(fewer, momenta)
        outcome, made, residual = shoot_at(fewer, fewer.target, factor, fine_path, fine_points, log)
        total += made
        if outcome > 0:
            finer, ratio = fewer, max(0.5, 0.9 * ratio)
            solved.append((1.0 / finer.steps, fine_path[0, 1].copy()))
        elif fewer.steps == finer.steps - 1:
            return outcome, total, residual, f", with {fewer.steps} steps, but solved with {finer.steps}"
        else:
            ratio = ratio**0.4
    path[:], points[:] = fine_path, fine_points
    return outcome, total, residual, ""


def on_all_states(case, factor, path, points, log):
    """Solve for all states at once by Newton's method, from the guessed path."""
    path[:] = guessed_path(case)
    return all_states(case, factor, path, points, log)


LEAST_ACTION = ("shooting from the momenta of a path of least action", from_least_action)
SHOOTING = (
    ("shooting from the momenta of the straight way", from_velocity),
    LEAST_ACTION,
    ("shooting from rest", from_momenta),
    ("continuation in the target", by_continuation),
)
ALL_STATES = (("Newton's method on all states from the guessed path", on_all_states),)
LAST = (("continuation in the number of steps", by_steps),)


def attempts_of(case, method):
    """Return the attempts of a method in turn, as pairs of a name and a function.

    The method "stepping" begins with shooting, other methods with all states at once. The path of least action is left
    out unless H is kinetic energy alone.
    """
    shooting = tuple(attempt for attempt in SHOOTING if attempt is not LEAST_ACTION or case.problem.quadratic)
    first = (*shooting, *ALL_STATES) if method == "stepping" else (*ALL_STATES, *shooting)
    return (*first, *LAST)


class Solution(NamedTuple):
    """A motion that connects points.

    Attributes
    ----------
    status : str
        "solved" or "not connected".
    message : str
        A sentence on the attempts, with a remedy after failure.
    cost : float
        The sum of 2 h H at the points of the scheme, with the weights of the scheme.
    residual : float
        The largest error of an equation.
    iterations, tangents : int
        Steps of Broyden's and Newton's method, and linearised trajectories, of all attempts.
    attempts : tuple of str
        A line for each attempt.
    t : array (N + 1,)
        Times of the nodes.
    q, p : array (N + 1, n, d)
        Positions and momenta.
    energy : array (N + 1,)
        H.
    margin : float
        The least margin of the domain along the path, positive inside the domain.
    """

    status: str
    message: str
    cost: float
    residual: float
    iterations: int
    tangents: int
    attempts: tuple[str, ...]
    t: np.ndarray
    q: np.ndarray
    p: np.ndarray
    energy: np.ndarray
    margin: float


@packed_operations()
def solve_case(case, guess=None, method=None):
    """Connect the points of a case; return a Solution.

    `guess` (n, d) holds initial momenta to shoot from. `method` chooses the order of the attempts; the default is the
    method of the module. Numerical failures raise no error.
    """
    outcome, path, points, iterations, tangents, residual, attempts = run_cascade(
        case, method or case.problem.metadata.method, guess
    )
    status = "solved" if outcome > 0 else "not connected"
    message = (
        attempts[-1]
        if outcome > 0
        else f"no attempt connects the points ({'; '.join(attempts)}); take more steps, allow for a sigma, or leave "
        "out points that are close together and move apart"
    )
    h = case.duration / case.steps
    cost, energy, margin = np.nan, np.full(case.steps + 1, np.nan), np.nan
    if np.isfinite(path).all() and np.isfinite(points).all():
        arguments = case.problem.pairs, h, case.own, case.parameters, path, points
        cost = cost_and_energies(*arguments, case.problem.costs, energy)
        margin = min(case.problem.domain_margin(z) for z in path)
    t = h * np.arange(case.steps + 1)
    q, p = path[:, 0].copy(), path[:, 1].copy()
    return Solution(status, message, cost, residual, iterations, tangents, attempts, t, q, p, energy, margin)


class Case(NamedTuple):
    """The points to connect, with all settings.

    Attributes
    ----------
    start, target : array (n, d)
        Positions at the start and the end.
    sigma : array (n,)
        Scale of the deviation from each target, as in |q_N - target|^2/(2 sigma^2); 0 if the target is met exactly.
    own : array (n, k)
        Own parameters of each particle.
    parameters : array
        Common parameters.
    steps, duration : int, float
        Number of steps, and the time of the motion.
    tolerance, max_iterations : float, int
        Tolerance of the residual, and largest number of Newton iterations of one search.
    problem : PairProblem
        The problem.
    """

    start: np.ndarray
    target: np.ndarray
    sigma: np.ndarray
    own: np.ndarray
    parameters: np.ndarray
    steps: int
    duration: float
    tolerance: float
    max_iterations: int
    problem: PairProblem


def checked_case(problem, start, target, sigma, own, parameters, steps, duration, tolerance, max_iterations):
    """Return a Case; ValueError names an argument, or points, that cannot be used.

    `own` holds a number or an array (n,) for each own parameter.
    """
    start, target = np.array(start, dtype=float), np.array(target, dtype=float)
    if start.ndim != 2 or start.shape[1] != problem.dimension or start.shape[0] < 1:
        raise ValueError(f"start has shape {start.shape}, expected (n, {problem.dimension}) with at least one point")
    if target.shape != start.shape:
        raise ValueError(f"there are {len(start)} points at the start but {len(target)} at the target")
    count = len(start)
    sigma = np.array(np.broadcast_to(np.asarray(sigma, dtype=float), (count,)))
    if not np.isfinite(sigma).all() or (sigma < 0.0).any():
        raise ValueError("sigma must be finite and not negative")
    own = np.array([np.broadcast_to(np.asarray(values, dtype=float), (count,)) for values in own]).reshape(-1, count).T
    for name, column in zip(problem.metadata.own, own.T, strict=True):
        if not np.isfinite(column).all():
            raise ValueError(f"{name} must be finite, got {column}")
    for what, points in (("start", start), ("target", target)):
        require_possible(problem, what, points)
    parameters = np.array(parameters, dtype=float)
    if not np.isfinite(parameters).all():
        raise ValueError(f"parameters must be finite, got {parameters}")
    steps, duration = checked_times(steps, duration)
    own, max_iterations = np.ascontiguousarray(own), checked_count("max_iterations", max_iterations)
    tolerance = checked_tolerance(tolerance, 1e-6)
    return Case(start, target, sigma, own, parameters, steps, duration, tolerance, max_iterations, problem)


def require_possible(problem, what, points):
    """Raise ValueError for points (n, d) that are not finite, outside their domain, or in the same place.

    `what` names the points in messages.
    """
    if not np.isfinite(points).all():
        row = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise ValueError(f"{what} of point {row + 1} is {points[row]}, expected finite numbers")
    if not problem.domain_margin(np.stack([points, np.zeros_like(points)])) > 0.0:
        margins = (problem.domain_margin(np.stack([points[k : k + 1]] * 2)) for k in range(len(points)))
        row = next(k for k, margin in enumerate(margins) if not margin > 0.0)
        position = ", ".join(f"{x:.6g}" for x in points[row])
        raise ValueError(f"{what} of point {row + 1}, ({position}), is on or outside the boundary of the domain")
    order = np.lexsort(points.T)
    same = np.flatnonzero((points[order[1:]] == points[order[:-1]]).all(axis=1))
    if same.size:
        first, second = sorted(order[same[0] : same[0] + 2] + 1)
        raise ValueError(f"{what} of points {first} and {second} is the same place; no map separates or joins them")
