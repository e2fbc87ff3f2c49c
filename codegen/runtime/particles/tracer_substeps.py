"""A step of tracer points by a composition method, among particles that make the same step, and its inverse.

As for particles, x1 = x0 + f h V(x) at x = (1 - a) x0 + a x1, where V belongs to the particles' position at which their
field was evaluated. The inverse of a substep is a substep of length -f h with 1 - a in place of a. Shapes are those of
`tracer_newton`.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import DIMENSION, POINTS, SUBSTEPS
from codegen.runtime.stand_ins.example_tracers import BLOCK, tracer_gradient, tracer_velocity
from codegen.runtime.particles.tracer_newton import (
    MOST,
    NEAR,
    eliminated,
    extrapolated,
    has_settled,
    moved_positions,
    shifted_unit,
    times,
    without_unsettled,
)


@njit(cache=True, error_model="numpy", nogil=True)
def tracer_step(k, h, stages, own, parameters, positions, tangents, velocities, known):
    """Move a block of points along step k, or backwards if h is negative; its `tangents` as well if there are any.

    `velocities`, shape (4, d*BLOCK), holds those of as many `known` steps before, and gets those of this one.
    """
    backwards, size = h < 0.0, DIMENSION * DIMENSION * BLOCK
    gradients, matrices, products = np.empty(size), np.empty(size), np.empty(size)
    middle, guess, rates = np.empty(DIMENSION * BLOCK), np.empty(DIMENSION * BLOCK), velocities[0]
    for turn in range(POINTS):
        s = POINTS - 1 - turn if backwards else turn
        step, weight = h * SUBSTEPS[s][0], 1.0 - SUBSTEPS[s][1] if backwards else SUBSTEPS[s][1]
        z = stages[k * POINTS + s]
        extrapolated(velocities, known if POINTS == 1 else 1, guess)
        for m in range(DIMENSION * BLOCK):
            middle[m] = positions[m] + step * weight * guess[m]
        if weight > 0.0:
            implicit_positions(positions, step * weight, z, own, parameters, middle, guess, gradients, matrices)
        if tangents.size > 0:
            tracer_gradient(middle, z, own, parameters, rates, gradients)
            shifted_unit(gradients, step * (1.0 - weight), matrices)
            times(matrices, tangents, products)
            for m in range(size):
                tangents[m] = products[m]
            if weight > 0.0:
                shifted_unit(gradients, -step * weight, matrices)
                eliminated(matrices, tangents, DIMENSION)
        elif weight == 0.0:
            tracer_velocity(middle, z, own, parameters, rates)
        for m in range(DIMENSION * BLOCK):
            if weight > 0.0:
                change = (middle[m] - positions[m]) / weight
                rates[m] = change / step
                positions[m] += change
            else:
                positions[m] += step * rates[m]


@njit(cache=True, error_model="numpy", nogil=True)
def implicit_positions(positions, step, z, own, parameters, middle, rates, gradients, matrices):
    """Solve middle = positions + step V(middle) by Newton's method from the guess in `middle`.

    Once the positions are near, velocities alone are evaluated, and the derivative of the last iteration serves again.
    """
    changes, previous, is_chord = np.empty(DIMENSION * BLOCK), np.inf, False
    for _ in range(MOST):
        if is_chord:
            tracer_velocity(middle, z, own, parameters, rates)
        else:
            tracer_gradient(middle, z, own, parameters, rates, gradients)
        shifted_unit(gradients, -step, matrices)
        for m in range(DIMENSION * BLOCK):
            changes[m] = (positions[m] - middle[m]) + step * rates[m]
        eliminated(matrices, changes, 1)
        change = moved_positions(middle, changes)
        if has_settled(change, previous, is_chord):
            return
        is_chord, previous = change < NEAR and (not is_chord or change < 1e-3 * previous), change
    without_unsettled(middle, changes)
