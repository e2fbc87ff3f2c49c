"""The motion of particles from an initial state: checks of arguments, steps, and quantities along the motion."""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.addresses import data_of, reals_at
from codegen.runtime.kernels import packed_operations
from codegen.runtime.particles.problem import PairProblem
from codegen.runtime.particles.steps import advance, energy_of
from codegen.runtime.search.grid import checked_count, checked_times
from codegen.runtime.stepping.motion import Solution, describe, require_finite
from codegen.runtime.stepping.steps import checked, stored, stored_last

FAILURES = {
    -1: ("non-finite", "a state is infinite or not a number; use more steps, or check start and parameters"),
    -3: ("newton failed", "the equations of the step were not solved; use more steps"),
}


class Grid(NamedTuple):
    """N steps of length h, common parameters, the initial state (2, n, d), own parameters (n, k), and the problem."""

    steps: int
    h: float
    parameters: np.ndarray
    start: np.ndarray
    own: np.ndarray
    problem: PairProblem


def checked_step_grid(problem, steps, duration, parameters, start, own):
    """Return a Grid; ValueError if a number is not finite or not positive, or a shape does not fit.

    `own` holds a number or an array (n,) for each own parameter.
    """
    steps, duration = checked_times(steps, duration)
    parameters, start = np.array(parameters, dtype=float), np.array(start, dtype=float)
    if start.ndim != 3 or start.shape[0] != 2 or start.shape[2] != problem.dimension:
        expected = f"(2, n, {problem.dimension}): positions, then momenta"
        raise ValueError(f"start has shape {start.shape}, expected {expected}")
    own = np.array([np.broadcast_to(np.asarray(values, dtype=float), start.shape[1:2]) for values in own])
    if not np.isfinite(own).all():
        raise ValueError("own parameters must be finite")
    require_finite(parameters, start)
    own = np.ascontiguousarray(own.reshape(-1, start.shape[1]).T)
    return Grid(steps, duration / steps, parameters, start, own, problem)


@njit(cache=True, error_model="numpy", nogil=True)
def follow_particles(pairs, start, steps, h, own, parameters, every, path, before):
    """Make all steps from the state `start` (2, n, d), and store states in rows of `path` and `before` (M, 2 n d).

    `stepping.steps.stored` explains `every`, `path` and `before`. A step that fails ends the motion; the last good
    state is then stored. Return four numbers: the steps made, the rows of `path` in use, the iterations, and the
    outcome. The outcome is 0, or a negative number for the reason of a failure.
    """
    state, end, rows, iterations, wait = start.copy(), np.empty(start.shape), 1, 0, every
    points = np.full((pairs.points, *start.shape), np.nan)  # NaN: nothing is known from an earlier step
    now, after, size = reals_at(data_of(state)), reals_at(data_of(end)), start.size
    states, states_before = reals_at(data_of(path)), reals_at(data_of(before))
    for i in range(size):
        path[0, i] = now[i]
    for k in range(steps):
        outcome = checked(advance(pairs, state, h, own, parameters, points, 0.0, end), size, after)
        if outcome < 0:
            break
        iterations += outcome
        wait, rows = stored(k + 1, steps, every, wait, rows, size, now, after, states, states_before)
    else:
        k, outcome = steps, 0
    if outcome < 0:
        rows = stored_last(wait, every, rows, size, reals_at(data_of(state)), states)
    return k, rows, iterations, outcome


@njit(cache=True, error_model="numpy", nogil=True)
def largest_difference(pairs, before, path, rows, h, own, parameters, shape):
    """Return the max-norm of the differences between repeated steps and stored states.

    For i from 1 to `rows` - 1, a step from row i - 1 of `before` is compared with row i of `path` (M, 2 n d). `shape`
    is the shape (2, n, d) of a state. The result is infinite if a step fails.
    """
    state, after, largest = np.empty(shape), np.empty(shape), 0.0
    points = np.full((pairs.points, *shape), np.nan)
    start, end = state.reshape(-1), after.reshape(-1)
    for row in range(1, rows):
        for i in range(start.size):
            start[i] = before[row - 1, i]
        if advance(pairs, state, h, own, parameters, points, 0.0, after) < 0:
            return np.inf
        for i in range(end.size):
            error = abs(end[i] - path[row, i])
            if not error < np.inf:
                return np.inf
            largest = max(largest, error)
    return largest


@njit(cache=True, error_model="numpy", nogil=True)
def energies_of(pairs, path, own, parameters, shape, values):
    """Fill `values` (M,) with H at the first M rows of `path` (.., 2 n d); a state has the shape `shape` (2, n, d)."""
    states = path.reshape((path.shape[0], *shape))
    for row in range(values.size):
        values[row] = energy_of(pairs.hamiltonian, states[row], own, parameters)


@packed_operations()
def follow_motion(grid, every=1):
    """Make all steps and return a Solution; a step that fails ends the motion without an error.

    The first, every `every`-th and the last state are stored. Columns of positions and momenta are coordinates,
    particle after particle. The residual is the max-norm of a repeated step minus the stored state. ValueError if
    `every` is not a positive integer.
    """
    steps, h, parameters, start, own, problem = grid
    every, size, pairs = min(checked_count("every", every), steps), start.size, problem.pairs
    path = np.empty((1 - (-steps // every), size))
    before = path if every == 1 else np.empty((path.shape[0] - 1, size))
    made, rows, iterations, outcome = follow_particles(pairs, start, steps, h, own, parameters, every, path, before)
    t, energy = h * np.minimum(every * np.arange(rows), made), np.empty(rows)
    energies_of(pairs, path, own, parameters, start.shape, energy)
    measured = rows if outcome == 0 else 1 + made // every
    residual = largest_difference(pairs, before, path, measured, h, own, parameters, start.shape)
    status, message = describe(steps, (h * made, h * (made + 1)), made, iterations, outcome, FAILURES)
    q, p = path[:rows, : size // 2].copy(), path[:rows, size // 2 :].copy()
    return Solution(status, message, made, t, q, p, energy, residual if made else np.nan, iterations)


def path_residual(grid, path):
    """Return the max-norm of the step from each state minus the next state, along `path` (M, 2 n d)."""
    path = np.array(path, dtype=float)
    arguments = grid.h, grid.own, grid.parameters, grid.start.shape
    return largest_difference(grid.problem.pairs, path, path, path.shape[0], *arguments)


def step(grid, state, t=0.0):
    """Return the state (2 n d,) one step after `state`; NaN if the step fails."""
    z, after = np.array(state, dtype=float).reshape(grid.start.shape), np.empty(grid.start.shape)
    points = np.full((grid.problem.points, *z.shape), np.nan)
    outcome = advance(grid.problem.pairs, z, grid.h, grid.own, grid.parameters, points, 0.0, after)
    return after.ravel() if outcome >= 0 else np.full(z.size, np.nan)
