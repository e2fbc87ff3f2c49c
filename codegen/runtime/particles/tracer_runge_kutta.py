"""A step of tracer points by an explicit Runge-Kutta method, among particles that make the same step, and its inverse.

As for particles, V_i = V(x0 + h sum_j a_ij V_j) at the particles' stage i, and x1 = x0 + h sum_i b_i V_i. The inverse
solves this equation for x0 by Newton's method, with the derivative of the step. Shapes are those of `tracer_newton`.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import DIMENSION, POINTS, ROWS, WEIGHTS
from codegen.runtime.stand_ins.example_tracers import BLOCK, tracer_gradient, tracer_velocity
from codegen.runtime.particles.tracer_newton import (
    MOST,
    eliminated,
    extrapolated,
    has_settled,
    moved_positions,
    times,
    without_unsettled,
)


@njit(cache=True, error_model="numpy", nogil=True)
def tracer_step(k, h, stages, own, parameters, positions, tangents, velocities, known):
    """Move a block of points along step k, or backwards if h is negative; its `tangents` as well if there are any.

    `velocities`, shape (4, d*BLOCK), holds the means of as many `known` steps before, and gets that of this one.
    """
    size = DIMENSION * DIMENSION * BLOCK
    derivative, products, after = np.empty(size), np.empty(size), np.empty(DIMENSION * BLOCK)
    first, rates = k * POINTS, velocities[0]
    if h < 0.0:
        extrapolated(velocities, known, after)
        for m in range(DIMENSION * BLOCK):
            after[m] = positions[m] + h * after[m]
        inverse_positions(positions, -h, first, stages, own, parameters, after, rates, derivative)
        for m in range(DIMENSION * BLOCK):
            positions[m] = after[m]
        if tangents.size == 0:
            return
    wanted = derivative if tangents.size > 0 else tangents
    explicit_step(positions, abs(h), first, stages, own, parameters, rates, wanted)  # one call, or it is compiled twice
    if h < 0.0:
        eliminated(derivative, tangents, DIMENSION)
        return
    for m in range(DIMENSION * BLOCK):
        positions[m] += h * rates[m]
    if tangents.size > 0:
        times(derivative, tangents, products)
        for m in range(size):
            tangents[m] = products[m]


@njit(cache=True, error_model="numpy", nogil=True)
def explicit_step(positions, h, first, stages, own, parameters, rates, derivative):
    """Fill `rates` with the mean velocity of a step, and `derivative` with that of the step unless it is empty."""
    count, size = DIMENSION * BLOCK, DIMENSION * DIMENSION * BLOCK
    velocities, middle = np.empty((POINTS, count)), np.empty(count)
    slopes, gradients, along = np.empty((POINTS, size)), np.empty(size), np.empty(size)
    for s in range(POINTS):
        combined_positions(positions, h, velocities, ROWS[s], s, middle)
        if derivative.size == 0:
            tracer_velocity(middle, stages[first + s], own, parameters, velocities[s])
            continue
        tracer_gradient(middle, stages[first + s], own, parameters, velocities[s], gradients)
        unit_and_combined(h, slopes, ROWS[s], s, along)
        times(gradients, along, slopes[s])
    for m in range(count):
        rates[m] = 0.0
        for s in range(POINTS):
            rates[m] += WEIGHTS[s] * velocities[s, m]
    if derivative.size > 0:
        unit_and_combined(h, slopes, WEIGHTS, len(WEIGHTS), derivative)


@njit(cache=True, error_model="numpy", nogil=True)
def combined_positions(positions, h, velocities, weights, count, result):
    """Fill `result` with positions + h sum_r weights[r] velocities[r], shape (POINTS, d*BLOCK), over `count` stages."""
    for m in range(positions.size):
        result[m] = positions[m]
        for r in range(count):
            result[m] += h * weights[r] * velocities[r, m]


@njit(cache=True, error_model="numpy", nogil=True)
def unit_and_combined(h, slopes, weights, count, result):
    """Fill `result` with 1 + h sum_r weights[r] slopes[r], shape (POINTS, d*d*BLOCK), over the first `count` stages."""
    for a in range(DIMENSION):
        for b in range(DIMENSION):
            row = (a * DIMENSION + b) * BLOCK
            for m in range(row, row + BLOCK):
                result[m] = 1.0 if a == b else 0.0
                for r in range(count):
                    result[m] += h * weights[r] * slopes[r, m]


@njit(cache=True, error_model="numpy", nogil=True)
def inverse_positions(positions, h, first, stages, own, parameters, before, rates, derivative):
    """Solve before + h (mean velocity from there) = positions by Newton's method from the guess in `before`."""
    changes, previous = np.empty(DIMENSION * BLOCK), np.inf
    for _ in range(MOST):
        explicit_step(before, h, first, stages, own, parameters, rates, derivative)
        for m in range(DIMENSION * BLOCK):
            changes[m] = (positions[m] - before[m]) - h * rates[m]
        eliminated(derivative, changes, 1)
        change = moved_positions(before, changes)
        if has_settled(change, previous, False):
            return
        previous = change
    without_unsettled(before, changes)
