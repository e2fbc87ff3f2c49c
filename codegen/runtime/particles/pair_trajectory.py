"""Step after step, the discrete cost, and how far a path is from satisfying the scheme's equations."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import COST_WEIGHTS, POINTS, domain_margin, hamiltonian
from codegen.runtime.particles.pair_runge_kutta import advance

OUTSIDE = -4  # what `follow` returns when a particle leaves its domain


@njit(cache=True, error_model="numpy")
def follow(h, own, parameters, path, points, near=0.0):
    """Fill `path`, shape (N + 1, 2, n, d), from its first state, and `points`, shape (N POINTS, 2, n, d).

    Where `points` are those of a nearby trajectory, `near` is the relative accuracy that suffices for implicit steps,
    which then begin there; else it is zero.
    Return the iterations of all implicit steps, or a negative number that says why a step failed.
    """
    given, iterations = (parameters, own), 0
    for k in range(path.shape[0] - 1):
        work = points[k * POINTS : (k + 1) * POINTS], near
        outcome = advance(path[k], k * h, h, given, work, path[k + 1])
        if outcome < 0:
            return outcome
        if not domain_margin(path[k + 1]) > 0.0:
            return OUTSIDE
        iterations += outcome
    return iterations


@njit(cache=True, error_model="numpy")
def discrete_cost(h, own, parameters, points):
    """The sum of 2 h H over the points, shape (N POINTS, 2, n, d), with the scheme's weights."""
    cost = 0.0
    for k in range(points.shape[0]):
        cost += 2.0 * h * COST_WEIGHTS[k % POINTS] * hamiltonian(points[k], own, parameters)
    return cost


@njit(cache=True, error_model="numpy")
def defects(h, own, parameters, path, points, errors):
    """Fill `errors`, shape (N, 2, n, d), with a step from each state minus the next state; return as `follow` does."""
    after, given, iterations = np.empty(path[0].shape), (parameters, own), 0
    for k in range(path.shape[0] - 1):
        outcome = advance(path[k], k * h, h, given, (points[k * POINTS : (k + 1) * POINTS], 0.0), after)
        if outcome < 0:
            return outcome
        for s in range(2):
            for i in range(after.shape[1]):
                for a in range(after.shape[2]):
                    errors[k, s, i, a] = after[s, i, a] - path[k + 1, s, i, a]
        iterations += outcome
    return iterations


@njit(cache=True, error_model="numpy")
def cost_and_energies(h, own, parameters, path, points, energy):
    """Fill `energy`, shape (N + 1,), with H at every state; return the discrete cost, see `discrete_cost`.

    H is evaluated once where the first point of a step is the state from which it starts.
    """
    cost = 0.0
    for k in range(path.shape[0]):
        energy[k] = hamiltonian(path[k], own, parameters)
    for k in range(points.shape[0]):
        state = points[k]
        value = energy[k // POINTS] if same_state(state, path[k // POINTS]) else hamiltonian(state, own, parameters)
        cost += 2.0 * h * COST_WEIGHTS[k % POINTS] * value
    return cost


@njit(cache=True, error_model="numpy")
def same_state(one, other):
    """Whether two states, shape (2, n, d), are equal in every number."""
    for s in range(2):
        for i in range(one.shape[1]):
            for a in range(one.shape[2]):
                if one[s, i, a] != other[s, i, a]:
                    return False
    return True
