"""Tracer points: points without momenta that the motion of particles carries along, forward or backward.

Tracer points make the same steps as the particles, a block of points at once. A substep of a composition method is

    x1 = x0 + f h V(x) at x = (1 - a) x0 + a x1.

Here V is the velocity at the state at which the field of the particles was evaluated. The inverse is a substep of
length -f h with 1 - a in place of a. An explicit Runge-Kutta method is

    V_i = V(x0 + h sum_j a_ij V_j) at stage i of the particles,    x1 = x0 + h sum_i b_i V_i.

Its inverse solves the last equation for x0. Equations are solved by Newton's method with the exact derivative.

The positions, velocities and changes of a block have shape (d block,): one coordinate after the other, each for all
points. Matrices of d rows and c columns, one for each point, are stored in the same way, entry after entry:
(d c block,). Functions with `d` and `block` among their arguments take such arrays.

`stages` (N points, 2, n, d) are the states of the particles at which the scheme evaluates H, from `stages_of`.
"""

from typing import NamedTuple

import numpy as np
from numba import carray, njit

from codegen.runtime.addresses import call, data_of, reals_at
from codegen.runtime.particles.steps import defects

MOST = 30  # largest number of iterations of Newton's method
SETTLED = 1e-15  # changes of a position below this are negligible, in units of length
NEAR = 3e-5  # after smaller changes, the next iteration uses the same derivative


class Tracers(NamedTuple):
    """The data of tracer points for compiled code, all as integers: addresses of two kernels, then numbers.

    `points` is the number of points of a step at which H is evaluated. `is_runge_kutta` and `coefficients` are the
    fields of `steps.Pairs`.
    """

    velocity: int
    gradient: int
    dimension: int
    block: int
    points: int
    is_runge_kutta: int
    coefficients: int


@njit(error_model="numpy", forceinline=True)
def velocity_at(tracers, positions, z, own, parameters, rates):
    """Fill `rates` (d block,) with the velocities of tracer points for the state z of the particles."""
    arguments = data_of(positions), data_of(z), z.shape[1], data_of(own), data_of(parameters), data_of(rates)
    call(tracers.velocity, arguments)


@njit(error_model="numpy", forceinline=True)
def gradient_at(tracers, positions, z, own, parameters, rates, gradients):
    """Fill `rates` (d block,) with velocities, and `gradients` (d d block,) with their Jacobians."""
    arguments = data_of(positions), data_of(z), z.shape[1], data_of(own), data_of(parameters), data_of(rates)
    call(tracers.gradient, (*arguments, data_of(gradients)))


@njit(cache=True, error_model="numpy", nogil=True)
def carry_points(tracers, points, h, first, last, stages, own, parameters, carried, jacobians):
    """Fill `carried` (n, d) with the positions of `points` (n, d) after the motion from time `first` to time `last`.

    `jacobians` (n, d, d) takes the derivatives of this map, unless the array is empty. Times are in steps.
    """
    d, block, count = tracers.dimension, tracers.block, points.shape[0]
    square = d * d
    positions, velocities = np.empty(d * block), np.empty((4, d * block))
    tangents = np.empty(square * block if jacobians.size > 0 else 0)
    for start in range(0, count, block):
        for m in range(block):
            row = min(start + m, count - 1)
            for a in range(d):
                positions[a * block + m] = points[row, a]
        velocities[:] = 0.0
        for e in range(tangents.size):
            tangents[e] = 1.0 if (e // block) % (d + 1) == 0 else 0.0
        low, high = min(first, last), max(first, last)
        begin, end = int(np.floor(low)), int(np.ceil(high))
        for turn in range(end - begin):
            k = begin + turn if last > first else end - 1 - turn
            share = min(high, k + 1.0) - max(low, float(k))
            step = h * share if last > first else -h * share
            if tracers.is_runge_kutta:
                runge_kutta_step(tracers, k, step, stages, own, parameters, positions, tangents, velocities, turn)
            else:
                substeps(tracers, k, step, stages, own, parameters, positions, tangents, velocities, turn)
        for m in range(min(block, count - start)):
            for a in range(d):
                carried[start + m, a] = positions[a * block + m]
            for e in range(square if jacobians.size > 0 else 0):
                jacobians[start + m, e // d, e % d] = tangents[e * block + m]


@njit(error_model="numpy")
def substeps(tracers, k, h, stages, own, parameters, positions, tangents, velocities, known):
    """Move a block of points along step k, or backward if h is negative.

    `tangents` (d d block,), unless empty, are multiplied by the derivative of the step. The rows of `velocities`
    (4, d block) hold the velocities of earlier steps, the latest first; `known` of them are valid. The first row takes
    the velocities of this step.
    """
    d, block = tracers.dimension, tracers.block
    backwards, size, count = h < 0.0, d * d * block, tracers.points
    gradients, matrices, products = np.empty(size), np.empty(size), np.empty(size)
    middle, guess, rates = np.empty(d * block), np.empty(d * block), velocities[0]
    table = carray(reals_at(tracers.coefficients), (count, 3))
    for turn in range(count):
        s = count - 1 - turn if backwards else turn
        step, weight = h * table[s, 0], 1.0 - table[s, 1] if backwards else table[s, 1]
        z = stages[k * count + s]
        extrapolated(velocities, known if count == 1 else 1, guess)
        for m in range(d * block):
            middle[m] = positions[m] + step * weight * guess[m]
        if weight > 0.0:
            implicit_positions(
                tracers, positions, step * weight, z, own, parameters, middle, guess, gradients, matrices
            )
        if tangents.size > 0:
            gradient_at(tracers, middle, z, own, parameters, rates, gradients)
            shifted_unit(d, block, gradients, step * (1.0 - weight), matrices)
            times(d, block, matrices, tangents, products)
            for m in range(size):
                tangents[m] = products[m]
            if weight > 0.0:
                shifted_unit(d, block, gradients, -step * weight, matrices)
                eliminated(d, block, matrices, tangents, d)
        elif weight == 0.0:
            velocity_at(tracers, middle, z, own, parameters, rates)
        for m in range(d * block):
            if weight > 0.0:
                change = (middle[m] - positions[m]) / weight
                rates[m] = change / step
                positions[m] += change
            else:
                positions[m] += step * rates[m]


@njit(error_model="numpy")
def implicit_positions(tracers, positions, step, z, own, parameters, middle, rates, gradients, matrices):
    """Solve middle = positions + step V(middle) by Newton's method from the initial guess in `middle`.

    Close to the solution only velocities are evaluated; the derivative of the iteration before is used again.
    """
    d, block = tracers.dimension, tracers.block
    changes, previous, is_chord = np.empty(d * block), np.inf, False
    for _ in range(MOST):
        if is_chord:
            velocity_at(tracers, middle, z, own, parameters, rates)
        else:
            gradient_at(tracers, middle, z, own, parameters, rates, gradients)
        shifted_unit(d, block, gradients, -step, matrices)
        for m in range(d * block):
            changes[m] = (positions[m] - middle[m]) + step * rates[m]
        eliminated(d, block, matrices, changes, 1)
        change = moved_positions(middle, changes)
        if has_settled(change, previous, is_chord):
            return
        is_chord, previous = change < NEAR and (not is_chord or change < 1e-3 * previous), change
    without_unsettled(d, block, middle, changes)


@njit(error_model="numpy")
def runge_kutta_step(tracers, k, h, stages, own, parameters, positions, tangents, velocities, known):
    """Move a block of points along step k of an explicit Runge-Kutta method; arguments as in `substeps`.

    `velocities` holds mean velocities of steps.
    """
    d, block = tracers.dimension, tracers.block
    size = d * d * block
    derivative, products, after = np.empty(size), np.empty(size), np.empty(d * block)
    first, rates = k * tracers.points, velocities[0]
    if h < 0.0:
        extrapolated(velocities, known, after)
        for m in range(d * block):
            after[m] = positions[m] + h * after[m]
        inverse_positions(tracers, positions, -h, first, stages, own, parameters, after, rates, derivative)
        for m in range(d * block):
            positions[m] = after[m]
        if tangents.size == 0:
            return
    wanted = derivative if tangents.size > 0 else tangents
    explicit_step(tracers, positions, abs(h), first, stages, own, parameters, rates, wanted)
    if h < 0.0:
        eliminated(d, block, derivative, tangents, d)
        return
    for m in range(d * block):
        positions[m] += h * rates[m]
    if tangents.size > 0:
        times(d, block, derivative, tangents, products)
        for m in range(size):
            tangents[m] = products[m]


@njit(error_model="numpy")
def explicit_step(tracers, positions, h, first, stages, own, parameters, rates, derivative):
    """Fill `rates` with the mean velocity of a step from `positions`.

    `derivative` (d d block,) takes the derivative of the step, unless the array is empty. The stages of the step begin
    at index `first`.
    """
    d, block, points = tracers.dimension, tracers.block, tracers.points
    count, size = d * block, d * d * block
    table = carray(reals_at(tracers.coefficients), (points + 1, points))
    velocities, middle = np.empty((points, count)), np.empty(count)
    slopes, gradients, along = np.empty((points, size)), np.empty(size), np.empty(size)
    for s in range(points):
        combined_positions(positions, h, velocities, table[s], s, middle)
        if derivative.size == 0:
            velocity_at(tracers, middle, stages[first + s], own, parameters, velocities[s])
            continue
        gradient_at(tracers, middle, stages[first + s], own, parameters, velocities[s], gradients)
        unit_and_combined(d, block, h, slopes, table[s], s, along)
        times(d, block, gradients, along, slopes[s])
    for m in range(count):
        rates[m] = 0.0
    for s in range(points):
        weight = table[points, s]
        for m in range(count):
            rates[m] += weight * velocities[s, m]
    if derivative.size > 0:
        unit_and_combined(d, block, h, slopes, table[points], points, derivative)


@njit(error_model="numpy")
def combined_positions(positions, h, velocities, weights, count, result):
    """Fill `result` with positions + h sum_r weights[r] velocities[r] over the first `count` stages.

    `velocities` has shape (points, d block).
    """
    for m in range(positions.size):
        result[m] = positions[m]
    for r in range(count):
        weight = h * weights[r]
        for m in range(positions.size):
            result[m] += weight * velocities[r, m]


@njit(error_model="numpy")
def unit_and_combined(d, block, h, slopes, weights, count, result):
    """Fill `result` with the unit matrix plus h sum_r weights[r] slopes[r] over the first `count` stages.

    `slopes` has shape (points, d d block).
    """
    for a in range(d):
        for b in range(d):
            row = (a * d + b) * block
            unit = 1.0 if a == b else 0.0
            for m in range(row, row + block):
                result[m] = unit
            for r in range(count):
                weight = h * weights[r]
                for m in range(row, row + block):
                    result[m] += weight * slopes[r, m]


@njit(error_model="numpy")
def inverse_positions(tracers, positions, h, first, stages, own, parameters, before, rates, derivative):
    """Solve before + h V = positions by Newton's method, where V is the mean velocity of the step from `before`.

    The initial guess is in `before`. The stages of the step begin at index `first`.
    """
    d, block = tracers.dimension, tracers.block
    changes, previous = np.empty(d * block), np.inf
    for _ in range(MOST):
        explicit_step(tracers, before, h, first, stages, own, parameters, rates, derivative)
        for m in range(d * block):
            changes[m] = (positions[m] - before[m]) - h * rates[m]
        eliminated(d, block, derivative, changes, 1)
        change = moved_positions(before, changes)
        if has_settled(change, previous, False):
            return
        previous = change
    without_unsettled(d, block, before, changes)


@njit(error_model="numpy")
def eliminated(d, block, matrices, right, columns):
    """Solve the linear equations of each point in place; `right` has `columns` columns for each point.

    There is no pivoting: the matrices are close to the unit matrix, unless steps are too long to be inverted.
    """
    factors = np.empty(block)
    for c in range(d):
        pivot = c * (d + 1) * block
        for a in range(c + 1, d):
            for m in range(block):
                factors[m] = matrices[(a * d + c) * block + m] / matrices[pivot + m]
            for b in range(c + 1, d):
                row, other = (a * d + b) * block, (c * d + b) * block
                for m in range(block):
                    matrices[row + m] -= factors[m] * matrices[other + m]
            for b in range(columns):
                row, other = (a * columns + b) * block, (c * columns + b) * block
                for m in range(block):
                    right[row + m] -= factors[m] * right[other + m]
    for b in range(columns):
        for a in range(d - 1, -1, -1):
            row, pivot = (a * columns + b) * block, a * (d + 1) * block
            for c in range(a + 1, d):
                factor, other = (a * d + c) * block, (c * columns + b) * block
                for m in range(block):
                    right[row + m] -= matrices[factor + m] * right[other + m]
            for m in range(block):
                right[row + m] /= matrices[pivot + m]


@njit(error_model="numpy")
def shifted_unit(d, block, gradients, factor, matrices):
    """Fill `matrices` with the unit matrix plus factor times `gradients`."""
    for e in range(d * d):
        unit = 1.0 if e % (d + 1) == 0 else 0.0
        for m in range(e * block, (e + 1) * block):
            matrices[m] = factor * gradients[m] + unit


@njit(error_model="numpy")
def times(d, block, matrices, tangents, products):
    """Fill `products` with the matrix of each point times the tangent matrix of the point."""
    for a in range(d):
        for b in range(d):
            row = (a * d + b) * block
            for m in range(block):
                products[row + m] = 0.0
            for c in range(d):
                one, other = (a * d + c) * block, (c * d + b) * block
                for m in range(block):
                    products[row + m] += matrices[one + m] * tangents[other + m]


@njit(error_model="numpy")
def moved_positions(positions, changes):
    """Add `changes` to the positions; return the largest modulus of a change."""
    largest = 0.0
    for k in range(positions.size):
        positions[k] += changes[k]
        if abs(changes[k]) > largest:
            largest = abs(changes[k])
    return largest


@njit(error_model="numpy")
def extrapolated(velocities, known, guess):
    """Fill `guess` with the next velocity, extrapolated from the last `known` velocities at equally spaced times.

    The first row of `velocities` is the latest. Then shift the rows down to make room for the next velocity.
    """
    for m in range(guess.size):
        a, b, c, d = velocities[0, m], velocities[1, m], velocities[2, m], velocities[3, m]
        if known < 2:
            guess[m] = a
        elif known == 2:
            guess[m] = 2.0 * a - b
        elif known == 3:
            guess[m] = 3.0 * (a - b) + c
        else:
            guess[m] = 4.0 * (a + c) - 6.0 * b - d
        velocities[1, m], velocities[2, m], velocities[3, m] = a, b, c


@njit(error_model="numpy")
def has_settled(change, previous, is_chord):
    """Return True if another iteration of Newton's method would hardly change the positions.

    `change` and `previous` are the largest changes in the last two iterations. Changes decrease quadratically: the next
    change is about change^3/previous^2. If the derivative of the iteration before was used (`is_chord`), the next
    change is 2 change^2/previous. The largest changes of a block may belong to different points, hence the factor of
    ten.
    """
    ratio = change / previous
    return change <= SETTLED or (previous < np.inf and 10.0 * change * (2.0 if is_chord else ratio) * ratio <= SETTLED)


@njit(error_model="numpy")
def without_unsettled(d, block, positions, changes):
    """Set points of a block to NaN if Newton's method has not converged for them."""
    for m in range(block):
        for a in range(d):
            if abs(changes[a * block + m]) > 1e-13:
                for b in range(d):
                    positions[b * block + m] = np.nan


def stages_of(case, path):
    """Return the states (N points, 2, n, d) at which the scheme evaluates H, in the steps from the states `path`.

    ValueError if no step can be made from a state.
    """
    pairs, h = case.problem.pairs, case.duration / case.steps
    points, errors = np.zeros((case.steps * pairs.points, *path.shape[1:])), np.zeros((case.steps, *path.shape[1:]))
    path = np.array(path, dtype=float)
    if defects(pairs, h, case.own, case.parameters, path, points, errors) < 0:
        raise ValueError("path has a state from which no step can be made; carry points along a solved path")
    return points


def carry(case, stages, points, first=0.0, last=None, derivative=False):
    """Carry tracer points (m, d) along the motion of the particles, from time `first` to time `last`.

    Times are in steps, from 0 to the number of steps; by default these are the first and the last node. If `last` is
    earlier than `first`, the points are carried backward, by the inverse of the map from `last` to `first`. A time
    between two nodes is reached by a part of a step. `stages` is the result of `stages_of`.

    Return the positions (m, d), and the derivatives (m, d, d) of the map or, without `derivative`, None. A point
    outside the domain of the particles keeps its position. A point becomes NaN if the equations of an implicit step
    have no solution. ValueError if points or times are unusable.
    """
    tracers, d = case.problem.tracers, case.problem.dimension
    points = np.array(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != d:
        raise ValueError(f"points have shape {points.shape}, expected (m, {d})")
    first, last = float(first), float(case.steps if last is None else last)
    for name, time in (("first", first), ("last", last)):
        if not 0.0 <= time <= case.steps:
            raise ValueError(f"{name} is {time}, expected a time between 0 and {case.steps} steps")
    carried, jacobians = np.empty(points.shape), np.empty((len(points) if derivative else 0, d, d))
    h = case.duration / case.steps
    carry_points(tracers, points, h, first, last, stages, case.own, case.parameters, carried, jacobians)
    return carried, jacobians if derivative else None
