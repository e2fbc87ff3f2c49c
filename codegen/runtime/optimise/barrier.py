"""The logarithmic barrier of bounds on unknowns: distances to the bounds, their duals, and what Newton's method needs.

Every finite bound is one entry of flat arrays: in `indices` that of its unknown x, its `value` b, and its `side` s,
1 for a lower and -1 for an upper bound. With distance d = s (x - b) and dual z, the perturbed optimality conditions are
gradient - s z = 0 and z d = mu. Eliminating the change of z = mu / d - z - (z / d) s dx from Newton's equations leaves
z / d on the diagonal and gradient - mu s / d on the right; see equations (11) and (13) of Waechter and Biegler (2006).
Distances are moved along with the unknowns instead of being computed anew, because close to a bound rounding would
leave nothing of a difference. Bounds are relaxed, so that equations may force unknowns onto them: by little, which goes
to rounding level with the weight of the barrier.

Of n unknowns with m finite bounds, `unknowns`, `gradient`, `right`, `step`, `slopes`, `diagonal`, `is_multiplier`,
`trial` and `sizes`, which may be empty, are (n,), and `indices`, `side`, `distance`, `duals`, `dual_step`, `moved` and
`moved_duals` (m,).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.optimise.descent import slope_of
from codegen.runtime.unknowns.point import measured_gradient


RELAXED, LEAST_RELAXED = 1e-8, 1e-12  # relaxations of a bound, relative to its value where that exceeds one
PER_WEIGHT = 1e-2  # relaxation in units of the barrier's weight, between these limits
MOST_RELAXING = RELAXED / PER_WEIGHT  # weights above it relax bounds no more
ROUNDING = 1e-15  # residuals up to it are taken for zero in steps: across a distance of 1e-12 they would turn duals


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
def take_step(
    is_new, unknowns, right, step, length, indices, side, distance, duals, dual_step, dual_length, mu, sizes, weight,
    steps, h, nodes, parameters, is_multiplier, trial, moved, moved_duals, gradient,
):  # fmt: skip
    """Move unknowns and duals by parts of their steps, and evaluate and measure there what belongs to an iterate.

    A step that `is_new`, solved for with the gradient `right`, is measured before, fills `dual_step`, and is taken
    for its longest lengths in place of those given. Fills `trial`, its distances `moved`, `moved_duals` and the
    `gradient`; returns what `measure_step` does, the sum of logarithms of distances, what a Point holds beside unknowns
    and gradient, with these duals in its stationarity, and what `measure_optimality` does. It is one function, because
    that of a short motion is over before Python has called another four.
    """
    slope, is_of_rounding = 0.0, False
    if is_new:
        barrier = is_multiplier, indices, side, distance, duals, mu, max(0.99, 1.0 - mu)
        slope, is_of_rounding, length, dual_length = measure_step(unknowns, right, step, *barrier, dual_step)
    logarithms = move(unknowns, step, length, indices, side, distance, trial, moved)
    cost, residual, violation, _, error = measured_gradient(
        trial, sizes, weight, steps, h, nodes, parameters, is_multiplier, gradient
    )
    bounds = is_multiplier, indices, side, moved
    measured = move_duals(gradient, trial, *bounds, duals, dual_step, dual_length, mu, moved_duals)
    stationarity = measured[0]
    if error < np.inf:
        error = stationarity if stationarity > residual else residual
    evaluated = cost, residual, violation, stationarity, error
    return (slope, is_of_rounding, length, dual_length), logarithms, evaluated, measured


@njit(error_model="numpy")
def move(unknowns, step, length, indices, side, distance, trial, moved):
    """Fill `trial` with unknowns + length * step, and `moved` with its distances; return the sum of their logarithms.

    Rounding must not make a distance vanish.
    """
    for i in range(unknowns.size):
        trial[i] = unknowns[i] + length * step[i]
    for j in range(indices.size):
        d = distance[j] + side[j] * (length * step[indices[j]])
        moved[j] = d if d > 1e-16 * distance[j] else 1e-16 * distance[j]
    return sum_of_logarithms(moved)


@njit(error_model="numpy")
def sum_of_logarithms(distance):
    """The sum of the logarithms of positive numbers, from products of many: a logarithm takes long."""
    total, product = 0.0, 1.0
    for j in range(distance.size):
        product *= distance[j]
        if not 1e-150 < product < 1e150:
            total += np.log(product)
            product = 1.0
    return total + np.log(product)


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
def slopes_without_multipliers(gradient, is_multiplier, indices, side, duals, slopes, diagonal):
    """Fill `slopes` with the gradient less the duals, zero by multipliers, and the `diagonal` of least squares."""
    for i in range(gradient.size):
        slopes[i] = 0.0 if is_multiplier[i] else gradient[i]
        diagonal[i] = -1e-12 if is_multiplier[i] else 1.0
    for j in range(indices.size):
        slopes[indices[j]] -= side[j] * duals[j]


@njit(cache=True, error_model="numpy")
def add_barrier(gradient, is_multiplier, indices, side, distance, duals, mu, delta_w, delta_c, right, diagonal):
    """Fill `right` with the gradient less mu s / d, and `diagonal` with the shifts and the barrier's z / d.

    Residuals of rounding size are left out: where z / d is 1e13 the duals would follow them, and never come to rest.
    """
    for i in range(gradient.size):
        right[i] = 0.0 if is_multiplier[i] and abs(gradient[i]) <= ROUNDING else gradient[i]
        diagonal[i] = -delta_c if is_multiplier[i] else delta_w
    for j in range(indices.size):
        inverse = 1.0 / distance[j]
        right[indices[j]] -= mu * side[j] * inverse
        diagonal[indices[j]] += duals[j] * inverse


@njit(error_model="numpy")
def measure_step(unknowns, gradient, step, is_multiplier, indices, side, distance, duals, mu, tau, dual_step):
    """Fill `dual_step`; return what `slope_of` does of the step, and its longest primal and dual lengths.

    They keep 1 - tau of every distance and of every dual (15).
    """
    primal, dual = tau, tau  # the largest parts of a distance, and of a dual, that the step takes away, or tau
    for j in range(indices.size):
        change, inverse = side[j] * step[indices[j]], 1.0 / distance[j]
        dual_step[j] = (mu - duals[j] * change) * inverse - duals[j]
        primal, dual = max(primal, -change * inverse), max(dual, -dual_step[j] / duals[j])
    slope, is_of_rounding = slope_of(unknowns, gradient, step, is_multiplier)
    return slope, is_of_rounding, tau / primal, tau / dual


@njit(error_model="numpy")
def move_duals(
    gradient, unknowns, is_multiplier, indices, side, distance, duals, dual_step, length, mu, result
):  # fmt: skip
    """Fill `result` with duals + length * dual_step, kept within a factor of 1e10 of mu / d (16), and measure it."""
    for j in range(duals.size):
        centre = mu / distance[j]
        result[j] = max(min(duals[j] + length * dual_step[j], 1e10 * centre), 1e-10 * centre)
    return measure_optimality(gradient, unknowns, is_multiplier, indices, side, distance, result)


@njit(cache=True, error_model="numpy")
def approach(unknowns, indices, side, magnitude, by, least, distance, closer):
    """Fill `closer` with the distances to bounds that are `by` nearer, in parts of their magnitudes.

    `unknowns` that are then closer than `least` move inside. Return the sum of logarithms, and whether any moved.
    """
    moves = False
    for j in range(indices.size):
        closer[j] = distance[j] - by * magnitude[j]
        missing = least * magnitude[j] - closer[j]
        if missing > 0.0:
            unknowns[indices[j]] += side[j] * missing
            closer[j], moves = least * magnitude[j], True
    return sum_of_logarithms(closer), moves
