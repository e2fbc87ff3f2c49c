"""The motion of particles: what its steps are given, and what is measured along the stored states."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import DIMENSION, POINTS, hamiltonian, make_own
from codegen.runtime.particles.pair_separable import advance

FAILURES = {
    -1: ("non-finite", "a state is infinite or not a number; use more steps, or check start and parameters"),
    -3: ("newton failed", "the equations of the step were not solved; use more steps"),
}


def settings_for(start, own):
    """What steps are given beside parameters: own parameters, shape (n, k); ValueError when a shape does not fit."""
    if start.ndim != 3 or start.shape[0] != 2 or start.shape[2] != DIMENSION:
        raise ValueError(f"start has shape {start.shape}, expected (2, n, {DIMENSION}): positions, then momenta")
    own = np.array([np.broadcast_to(np.asarray(values, dtype=float), start.shape[1:2]) for values in own])
    if not np.isfinite(own).all():
        raise ValueError("own parameters must be finite")
    return (np.ascontiguousarray(own.reshape(-1, start.shape[1]).T),)


@njit(cache=True, error_model="numpy")
def allocate_work(h, given):
    """The points of a step, shape (POINTS, 2, n, d), of which none is known, and that none is near."""
    return np.full((POINTS, 2, given[1].shape[0], DIMENSION), np.nan), 0.0


@njit(cache=True, error_model="numpy")
def largest_residual(before, path, rows, steps, h, given, every):
    """Max-norm of a step from the states in rows of `before` minus rows 1, 2, ... of `path`, of shape (2 n d,)."""
    state = np.empty((2, given[1].shape[0], DIMENSION))
    after, work, largest = np.empty(state.shape), allocate_work(h, given), 0.0
    start, end = state.reshape(-1), after.reshape(-1)
    for row in range(1, rows):
        for i in range(start.size):
            start[i] = before[row - 1, i]
        if advance(state, 0.0, h, given, work, after) < 0:
            return np.inf
        for i in range(end.size):
            error = abs(end[i] - path[row, i])
            if not error < np.inf:
                return np.inf
            largest = max(largest, error)
    return largest


@njit(cache=True, error_model="numpy")
def energies(path, times, given, values):
    """Fill `values`, shape (M,), with H at the states in the first rows of `path`, of shape (2 n d,)."""
    parameters, own = given
    states = path.reshape((path.shape[0], 2, own.shape[0], DIMENSION))
    for row in range(values.size):
        values[row] = hamiltonian(states[row], own, parameters)


def energy(state, t, parameters, own=None):
    """H at a state, shape (2 n d,), for the default particles unless their own parameters are given."""
    own = make_own() if own is None else own
    return hamiltonian(np.ascontiguousarray(state, dtype=float).reshape(2, -1, DIMENSION), own, parameters)
