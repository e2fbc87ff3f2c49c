"""The logarithmic barrier of bounds on unknowns: distances to the bounds, their duals, and what Newton's method needs.

Every finite bound is one entry of flat arrays: `place` of its unknown x, its `value` b, and `side` s, which is 1 for a
lower and -1 for an upper bound. With distance d = s (x - b) and dual z, the perturbed optimality conditions are
gradient - s z = 0 and z d = mu. Eliminating the change of z = mu / d - z - (z / d) s dx from Newton's equations leaves
z / d on the diagonal and gradient - mu s / d on the right; see equations (11) and (13) of Waechter and Biegler (2006).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.example import variable_bounds


class Bounds(NamedTuple):
    """Places, values and sides of all finite bounds."""

    place: np.ndarray
    value: np.ndarray
    side: np.ndarray


def finite_bounds(grid):
    """The bounds that exist, lower ones first."""
    lower, upper = variable_bounds(grid)
    below, above = np.flatnonzero(lower > -np.inf), np.flatnonzero(upper < np.inf)
    side = np.ones(below.size + above.size)
    side[below.size :] = -1.0
    return Bounds(np.concatenate([below, above]), np.concatenate([lower[below], upper[above]]), side)


def push_inside(grid, unknowns, push):
    """Unknowns at least `push` max(1, |bound|) inside their bounds, or that fraction of the way between two (36)."""
    lower, upper = variable_bounds(grid)
    width = push * (upper - lower)
    with np.errstate(invalid="ignore"):
        least = lower + np.minimum(push * np.maximum(1.0, np.abs(lower)), width)
        greatest = upper - np.minimum(push * np.maximum(1.0, np.abs(upper)), width)
    return np.minimum(np.maximum(unknowns, np.where(lower > -np.inf, least, -np.inf)),
                      np.where(upper < np.inf, greatest, np.inf))


@njit(cache=True, error_model="numpy")
def move(unknowns, step, length, place, value, side, trial, distance):
    """Fill `trial` with unknowns + length * step and `distance`; return the sum of the logarithms of distances.

    Rounding must not put an unknown on its bound: it keeps at least one unit in the last place.
    """
    for i in range(unknowns.size):
        trial[i] = unknowns[i] + length * step[i]
    logarithms = 0.0
    for j in range(place.size):
        i = place[j]
        d = side[j] * (trial[i] - value[j])
        if not d > 0.0:
            trial[i] = value[j] + side[j] * max(2.3e-16 * abs(value[j]), 1e-300)
            d = side[j] * (trial[i] - value[j])
        distance[j] = d
        logarithms += np.log(d)
    return logarithms


@njit(cache=True, error_model="numpy")
def measure_optimality(gradient, unknowns, is_multiplier, place, side, distance, duals, stationary):
    """Fill `stationary` with the gradient less bound duals; return norms.

    Max-norm of the stationarity; smallest, mean and greatest complementarity z d; the same greatest with entries as small as rounding left out;
    sums of all |multipliers| and duals.
    """
    for i in range(gradient.size):
        stationary[i] = gradient[i]
    total, least, greatest, excess, size = 0.0, np.inf, 0.0, 0.0, 0.0
    for j in range(place.size):
        stationary[place[j]] -= side[j] * duals[j]
        product = duals[j] * distance[j]
        total += product
        least = min(least, product)
        greatest = max(greatest, product)
        if product > 4e-16 * abs(unknowns[place[j]]) * duals[j]:
            excess = max(excess, product)
        size += duals[j]
    stationarity, multipliers = 0.0, 0.0
    for i in range(gradient.size):
        if is_multiplier[i]:
            multipliers += abs(unknowns[i])
        else:
            stationarity = max(stationarity, abs(stationary[i]))
    return stationarity, least, total / max(place.size, 1), greatest, excess, multipliers, size


@njit(cache=True, error_model="numpy")
def fill_diagonal(is_multiplier, place, distance, duals, shift, dual_shift, diagonal):
    """Fill `diagonal` with the shifts and the barrier's z / d."""
    for i in range(diagonal.size):
        diagonal[i] = -dual_shift if is_multiplier[i] else shift
    for j in range(place.size):
        diagonal[place[j]] += duals[j] / distance[j]


@njit(cache=True, error_model="numpy")
def add_barrier(gradient, place, side, distance, mu, result):
    """Fill `result` with the gradient less mu s / d."""
    for i in range(gradient.size):
        result[i] = gradient[i]
    for j in range(place.size):
        result[place[j]] -= mu * side[j] / distance[j]


@njit(cache=True, error_model="numpy")
def step_duals(step, place, side, distance, duals, mu, tau, dual_step):
    """Fill `dual_step`; return the longest primal and dual step that keep 1 - tau of every distance and dual (15)."""
    primal, dual = 1.0, 1.0
    for j in range(place.size):
        change = side[j] * step[place[j]]
        dual_step[j] = (mu - duals[j] * change) / distance[j] - duals[j]
        if -change * primal > tau * distance[j]:
            primal = -tau * distance[j] / change
        if -dual_step[j] * dual > tau * duals[j]:
            dual = -tau * duals[j] / dual_step[j]
    return primal, dual


@njit(cache=True, error_model="numpy")
def move_duals(duals, dual_step, length, distance, mu, result):
    """Fill `result` with duals + length * dual_step, kept within a factor of 1e10 of mu / d (16)."""
    for j in range(duals.size):
        centre = mu / distance[j]
        result[j] = max(min(duals[j] + length * dual_step[j], 1e10 * centre), 1e-10 * centre)


@njit(cache=True, error_model="numpy")
def quality(affine, centring, place, side, distance, duals, mu, tau, residual, stationarity):
    """Sum of squares of what the linear model leaves of all optimality conditions after a step aimed at mu."""
    primal, dual = 1.0, 1.0
    for j in range(place.size):
        change = side[j] * (affine[place[j]] + mu * centring[place[j]])
        other = (mu - duals[j] * change) / distance[j] - duals[j]
        if -change * primal > tau * distance[j]:
            primal = -tau * distance[j] / change
        if -other * dual > tau * duals[j]:
            dual = -tau * duals[j] / other
    total = 0.0
    for j in range(place.size):
        change = side[j] * (affine[place[j]] + mu * centring[place[j]])
        other = (mu - duals[j] * change) / distance[j] - duals[j]
        product = (distance[j] + primal * change) * (duals[j] + dual * other)
        total += product * product
    return total / place.size + (1.0 - primal) ** 2 * residual + (1.0 - dual) ** 2 * stationarity
