"""Step after step from given places and momenta of particles, and what is measured along the stored states."""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.optimise.counts import checked_count
from codegen.runtime.stand_ins.example_pairs import DIMENSION, POINTS, hamiltonian, make_own
from codegen.runtime.particles.pair_separable import advance

FAILURES = {
    -1: ("non-finite", "a state is infinite or not a number; use more steps, or check start and parameters"),
    -3: ("newton failed", "the equations of the step were not solved; use more steps"),
}


class Grid(NamedTuple):
    """N steps of length h, parameters, own parameters of particles, shape (n, k), and the start, shape (2, n, d)."""

    steps: int
    h: float
    parameters: np.ndarray
    own: np.ndarray
    start: np.ndarray


@njit(cache=True, error_model="numpy")
def follow(start, steps, h, own, parameters, every, path, before):
    """Make the steps and store every `every`-th state, and the last, in rows of `path`, shape (M, 2, n, d).

    Row i of `before` takes the state one step before that of row i + 1 of `path`. Returns the number of steps made,
    the rows of `path` in use, the iterations and 0, or a negative number that says why the next step failed.
    """
    state, after, points = start.copy(), np.empty(start.shape), np.full((POINTS, *start.shape), np.nan)
    rows, iterations, wait = 1, 0, every
    stored(state, path[0])
    for k in range(steps):
        outcome = advance(state, h, own, parameters, points, after)
        if outcome < 0:
            if wait < every:
                stored(state, path[rows])
                rows += 1
            return k, rows, iterations, outcome
        iterations += outcome
        wait -= 1
        if wait == 0 or k == steps - 1:
            stored(state, before[rows - 1])
            stored(after, path[rows])
            rows += 1
            wait = every
        stored(after, state)
    return steps, rows, iterations, 0


@njit(cache=True, error_model="numpy")
def stored(state, row):
    """Copy a state."""
    for s in range(2):
        for i in range(state.shape[1]):
            for k in range(state.shape[2]):
                row[s, i, k] = state[s, i, k]


@njit(cache=True, error_model="numpy")
def largest_defect(before, path, h, own, parameters):
    """Max-norm of a step from each state of `before` minus the next row of `path`."""
    after, points, largest = np.empty(path[0].shape), np.full((POINTS, *path[0].shape), np.nan), 0.0
    for row in range(1, path.shape[0]):
        if advance(before[row - 1], h, own, parameters, points, after) < 0:
            return np.inf
        for s in range(2):
            for i in range(after.shape[1]):
                for k in range(after.shape[2]):
                    largest = max(largest, abs(after[s, i, k] - path[row, s, i, k]))
    return largest


@njit(cache=True, error_model="numpy")
def energies(path, own, parameters):
    """H at every stored state."""
    values = np.empty(path.shape[0])
    for row in range(path.shape[0]):
        values[row] = hamiltonian(path[row], own, parameters)
    return values


def checked_grid(steps, duration, parameters, own, start):
    """A Grid; ValueError when a number is not finite, a shape does not fit, or steps or duration are not positive."""
    steps = checked_count("steps", steps)
    if not 0.0 < duration < np.inf:
        raise ValueError(f"duration is {duration!r}, expected a positive number")
    parameters, start = np.array(parameters, dtype=float), np.array(start, dtype=float)
    if start.ndim != 3 or start.shape[0] != 2 or start.shape[2] != DIMENSION:
        raise ValueError(f"start has shape {start.shape}, expected (2, n, {DIMENSION}): places, then momenta")
    own = np.array([np.broadcast_to(np.asarray(values, dtype=float), start.shape[1:2]) for values in own])
    own = np.ascontiguousarray(own.reshape(-1, start.shape[1]).T)
    for name, values in (("parameters", parameters), ("own parameters", own), ("start", start)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite")
    return Grid(steps, float(duration) / steps, parameters, own, start)


def integrate(grid, every):
    """Follow the motion; return (status, message, steps, t, q, p, energy, residual, iterations)."""
    every = min(checked_count("every", every), grid.steps)
    path = np.empty((1 - (-grid.steps // every), *grid.start.shape))
    before = np.empty((path.shape[0] - 1, *grid.start.shape))
    steps, rows, iterations, outcome = follow(
        grid.start, grid.steps, grid.h, grid.own, grid.parameters, every, path, before
    )
    measured = rows if outcome == 0 else 1 + steps // every
    residual = largest_defect(before[: measured - 1], path[:measured], grid.h, grid.own, grid.parameters)
    t = grid.h * np.minimum(every * np.arange(rows), steps)
    energy = energies(path[:rows], grid.own, grid.parameters)
    q, p = (path[:rows, part].reshape(rows, -1).copy() for part in (0, 1))
    if outcome == 0:
        status, message = "solved", f"all {steps} steps were made"
    else:
        status, remedy = FAILURES[outcome]
        place = f"step {steps + 1} of {grid.steps}, from t = {steps * grid.h:g} to {(steps + 1) * grid.h:g}"
        message = f"{status} in {place}: {remedy}"
    return status, message, steps, t, q, p, energy, residual if steps else np.nan, iterations


def path_residual(grid, path):
    """Max-norm of each step minus the next state along consecutive states, shape (M, 2 n d)."""
    states = np.ascontiguousarray(path, dtype=float).reshape(-1, *grid.start.shape)
    return largest_defect(states[:-1], states, grid.h, grid.own, grid.parameters)


def energy(state, t, parameters, own=None):
    """H at a state, shape (2 n d,), for the default particles unless their own parameters are given."""
    own = make_own() if own is None else own
    return hamiltonian(np.ascontiguousarray(state, dtype=float).reshape(2, -1, DIMENSION), own, parameters)
