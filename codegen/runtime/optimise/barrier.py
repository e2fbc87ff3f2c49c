"""The logarithmic barrier of bounds on unknowns: distances to the bounds, their duals, and what Newton's method needs.

Every finite bound is one entry of flat arrays: in `indices` that of its unknown x, its `value` b, and its `side` s,
1 for a lower and -1 for an upper bound. With distance d = s (x - b) and dual z, the perturbed optimality conditions are
gradient - s z = 0 and z d = mu. Eliminating the change of z = mu / d - z - (z / d) s dx from Newton's equations leaves
z / d on the diagonal and gradient - mu s / d on the right; see equations (11) and (13) of Waechter and Biegler (2006).
Distances are moved along with the unknowns instead of being computed anew, because close to a bound rounding would
leave nothing of a difference. Bounds are relaxed, so that equations may force unknowns onto them: by little, which goes
to rounding level with the weight of the barrier.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.optimise.descent import slope_of


RELAXED, LEAST_RELAXED = 1e-8, 1e-12  # relaxations of a bound, relative to its value where that exceeds one
PER_WEIGHT = 1e-2  # relaxation in units of the barrier's weight, between these limits


class Bounds(NamedTuple):
    """Indices, values, sides and magnitudes, one or more, of all finite bounds."""

    indices: np.ndarray
    value: np.ndarray
    side: np.ndarray
    magnitude: np.ndarray


def finite_bounds(lower, upper):
    """The bounds that exist, lower ones first."""
    (below,), (above,) = (lower > -np.inf).nonzero(), (upper < np.inf).nonzero()
    side = np.ones(below.size + above.size)
    side[below.size :] = -1.0
    value = np.concatenate([lower[below], upper[above]])
    return Bounds(np.concatenate([below, above]), value, side, np.maximum(1.0, np.abs(value)))


def relaxation(mu, least):
    """How much farther away bounds are taken to be while the barrier's weight is mu, relative to their magnitudes.

    Where equations hold an unknown on its bound, its dual is mu / relaxation: it stays moderate for every mu.
    """
    return min(RELAXED, max(least, PER_WEIGHT * mu))


@njit(cache=True, error_model="numpy")
def push_inside(lower, upper, unknowns, push):
    """Unknowns at least `push` max(1, |bound|) inside their bounds, or that fraction of the way between two (36)."""
    inside = unknowns.copy()
    for i in range(inside.size):
        width = push * (upper[i] - lower[i])
        if lower[i] > -np.inf:
            least = lower[i] + min(push * max(1.0, abs(lower[i])), width)
            if inside[i] < least:
                inside[i] = least
        if upper[i] < np.inf:
            greatest = upper[i] - min(push * max(1.0, abs(upper[i])), width)
            if inside[i] > greatest:
                inside[i] = greatest
    return inside


@njit(cache=True, error_model="numpy")
def move(unknowns, step, length, indices, side, distance, trial, moved):
    """Fill `trial` with unknowns + length * step, and `moved` with its distances; return the sum of their logarithms.

    Rounding must not make a distance vanish.
    """
    for i in range(unknowns.size):
        trial[i] = unknowns[i] + length * step[i]
    logarithms = 0.0
    for j in range(indices.size):
        d = distance[j] + side[j] * (length * step[indices[j]])
        moved[j] = d if d > 1e-16 * distance[j] else 1e-16 * distance[j]
        logarithms += np.log(moved[j])
    return logarithms


@njit(cache=True, error_model="numpy")
def measure_optimality(gradient, unknowns, is_multiplier, indices, side, distance, duals):
    """Max-norm of the stationarity, sum of complementarities z d, least and largest z d, and sizes.

    The sizes are the means of all |multipliers| and duals together and of the duals alone, and the largest |unknown|.
    """
    stationary = gradient.copy()
    total, lowest, highest, size = 0.0, np.inf, -np.inf, 0.0
    for j in range(indices.size):
        stationary[indices[j]] -= side[j] * duals[j]
        product = duals[j] * distance[j]
        lowest, highest = min(lowest, product), max(highest, product)
        total += product
        size += duals[j]
    stationarity, multipliers, count, largest = 0.0, 0.0, 0, 0.0
    for i in range(gradient.size):
        if is_multiplier[i]:
            multipliers += abs(unknowns[i])
            count += 1
        else:
            stationarity = max(stationarity, abs(stationary[i]))
            largest = max(largest, abs(unknowns[i]))
    mean = (multipliers + size) / max(count + indices.size, 1)
    return stationarity, total, lowest, highest, mean, size / max(indices.size, 1), largest


@njit(cache=True, error_model="numpy")
def add_barrier(gradient, is_multiplier, indices, side, distance, duals, mu, delta_w, delta_c, right, diagonal):
    """Fill `right` with the gradient less mu s / d, and `diagonal` with the shifts and the barrier's z / d."""
    for i in range(gradient.size):
        right[i] = gradient[i]
        diagonal[i] = -delta_c if is_multiplier[i] else delta_w
    for j in range(indices.size):
        right[indices[j]] -= mu * side[j] / distance[j]
        diagonal[indices[j]] += duals[j] / distance[j]


@njit(cache=True, error_model="numpy")
def measure_step(unknowns, gradient, step, is_multiplier, indices, side, distance, duals, mu, tau, dual_step):
    """Fill `dual_step`; return the slope along the step, and its longest primal and dual lengths.

    They keep 1 - tau of every distance and of every dual (15).
    """
    primal, dual = 1.0, 1.0
    for j in range(indices.size):
        change = side[j] * step[indices[j]]
        dual_step[j] = (mu - duals[j] * change) / distance[j] - duals[j]
        if -change * primal > tau * distance[j]:
            primal = -tau * distance[j] / change
        if -dual_step[j] * dual > tau * duals[j]:
            dual = -tau * duals[j] / dual_step[j]
    return slope_of(unknowns, gradient, step, is_multiplier), primal, dual


@njit(cache=True, error_model="numpy")
def move_duals(duals, dual_step, length, distance, mu, result):
    """Fill `result` with duals + length * dual_step, kept within a factor of 1e10 of mu / d (16)."""
    for j in range(duals.size):
        centre = mu / distance[j]
        result[j] = max(min(duals[j] + length * dual_step[j], 1e10 * centre), 1e-10 * centre)
