"""Step after step of particles, the discrete cost, and by how much a path misses the scheme's equations."""

import numpy as np
from numba import njit

from codegen.runtime.addresses import call_value, data_of
from codegen.runtime.particles.steps import advance

OUTSIDE = -4  # what `follow` returns when a particle leaves its domain


@njit(error_model="numpy", forceinline=True)
def energy_of(hamiltonian, z, own, parameters):
    """Return H at a state (2, n, d), by a Value at an address."""
    return call_value(hamiltonian, (data_of(z), z.shape[1], data_of(own), data_of(parameters)))


@njit(cache=True, error_model="numpy", nogil=True)
def follow(pairs, h, own, parameters, path, points, near):
    """Fill `path` (N + 1, 2, n, d) from its first state, and `points` (N points, 2, n, d).

    Where `points` are those of a nearby trajectory, `near` is the relative accuracy that suffices for implicit steps,
    which then begin there; else it is zero. Return the iterations of all implicit steps, or a negative number that says
    why a step failed.
    """
    iterations, count = 0, pairs.points
    for k in range(path.shape[0] - 1):
        after = path[k + 1]
        outcome = advance(pairs, path[k], h, own, parameters, points[k * count : (k + 1) * count], near, after)
        if outcome < 0:
            return outcome
        if not call_value(pairs.domain_margin, (data_of(after), after.shape[1])) > 0.0:
            return OUTSIDE
        iterations += outcome
    return iterations


@njit(cache=True, error_model="numpy", nogil=True)
def discrete_cost(pairs, h, own, parameters, points, weights):
    """Return the sum of 2 h H over the points (N points, 2, n, d), with the scheme's weights."""
    cost = 0.0
    for k in range(points.shape[0]):
        cost += 2.0 * h * weights[k % pairs.points] * energy_of(pairs.hamiltonian, points[k], own, parameters)
    return cost


@njit(cache=True, error_model="numpy", nogil=True)
def defects(pairs, h, own, parameters, path, points, errors):
    """Fill `errors` (N, 2, n, d) with a step from each state minus the next state; return as `follow` does."""
    after, iterations, count = np.empty(path[0].shape), 0, pairs.points
    for k in range(path.shape[0] - 1):
        outcome = advance(pairs, path[k], h, own, parameters, points[k * count : (k + 1) * count], 0.0, after)
        if outcome < 0:
            return outcome
        for s in range(2):
            for i in range(after.shape[1]):
                for a in range(after.shape[2]):
                    errors[k, s, i, a] = after[s, i, a] - path[k + 1, s, i, a]
        iterations += outcome
    return iterations


@njit(cache=True, error_model="numpy", nogil=True)
def cost_and_energies(pairs, h, own, parameters, path, points, weights, energy):
    """Fill `energy` (N + 1,) with H at every state; return the discrete cost, see `discrete_cost`.

    H is evaluated once where the first point of a step is the state from which it starts.
    """
    cost, count = 0.0, pairs.points
    for k in range(path.shape[0]):
        energy[k] = energy_of(pairs.hamiltonian, path[k], own, parameters)
    for k in range(points.shape[0]):
        if same_state(points[k], path[k // count]):
            value = energy[k // count]
        else:
            value = energy_of(pairs.hamiltonian, points[k], own, parameters)
        cost += 2.0 * h * weights[k % count] * value
    return cost


@njit(error_model="numpy")
def same_state(one, other):
    """Return True if two states (2, n, d) are equal in every number."""
    for s in range(2):
        for i in range(one.shape[1]):
            for a in range(one.shape[2]):
                if one[s, i, a] != other[s, i, a]:
                    return False
    return True
