"""Newton's method for blocks of tracer points: when it has come to an end, and linear equations of each point.

A matrix of each point, d rows of c columns, is kept entry after entry, with all points of the block in each: in an
array of shape (d*c*BLOCK,). Positions, velocities and their changes have shape (d*BLOCK,).
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import DIMENSION
from codegen.runtime.stand_ins.example_tracers import BLOCK

MOST = 30  # iterations of Newton's method
SETTLED = 1e-15  # a change of a position, in units of length, that is not made any more
NEAR = 3e-5  # a change after which the derivative at hand serves for another iteration


@njit(cache=True, error_model="numpy", nogil=True)
def eliminated(matrices, right, columns):
    """Solve the equations of each point, with a number of `columns` on the right, in place.

    The matrices are close to the unit matrix, or their steps would be too long to be inverted: there is no pivoting.
    """
    d = DIMENSION
    for m in range(BLOCK):
        for c in range(d):
            for a in range(c + 1, d):
                factor = matrices[(a * d + c) * BLOCK + m] / matrices[c * (d + 1) * BLOCK + m]
                for b in range(c + 1, d):
                    matrices[(a * d + b) * BLOCK + m] -= factor * matrices[(c * d + b) * BLOCK + m]
                for b in range(columns):
                    right[(a * columns + b) * BLOCK + m] -= factor * right[(c * columns + b) * BLOCK + m]
        for b in range(columns):
            for a in range(d - 1, -1, -1):
                value = right[(a * columns + b) * BLOCK + m]
                for c in range(a + 1, d):
                    value -= matrices[(a * d + c) * BLOCK + m] * right[(c * columns + b) * BLOCK + m]
                right[(a * columns + b) * BLOCK + m] = value / matrices[a * (d + 1) * BLOCK + m]


@njit(cache=True, error_model="numpy", nogil=True)
def shifted_unit(gradients, factor, matrices):
    """Fill `matrices` with 1 + factor times the gradients."""
    for e in range(DIMENSION * DIMENSION):
        unit = 1.0 if e % (DIMENSION + 1) == 0 else 0.0
        for m in range(e * BLOCK, (e + 1) * BLOCK):
            matrices[m] = factor * gradients[m] + unit


@njit(cache=True, error_model="numpy", nogil=True)
def times(matrices, tangents, products):
    """Fill `products` with the matrix of each point times its tangent, which is a matrix as well."""
    d = DIMENSION
    for m in range(BLOCK):
        for a in range(d):
            for b in range(d):
                value = 0.0
                for c in range(d):
                    value += matrices[(a * d + c) * BLOCK + m] * tangents[(c * d + b) * BLOCK + m]
                products[(a * d + b) * BLOCK + m] = value


@njit(cache=True, error_model="numpy", nogil=True)
def moved_positions(positions, changes):
    """Add `changes` to the positions; return the largest of them."""
    largest = 0.0
    for k in range(DIMENSION * BLOCK):
        positions[k] += changes[k]
        if abs(changes[k]) > largest:
            largest = abs(changes[k])
    return largest


@njit(cache=True, error_model="numpy", nogil=True)
def extrapolated(velocities, known, guess):
    """Fill `guess` with what follows the last `known` of equally spaced velocities, the latest of which is the first.

    Then make room for another one in their place.
    """
    for m in range(DIMENSION * BLOCK):
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


@njit(cache=True, error_model="numpy", nogil=True)
def has_settled(change, previous, is_chord):
    """Whether another iteration would change next to nothing.

    Changes decrease quadratically, the next one is about change^3/previous^2; after an iteration with the derivative of
    the one before, it is 2 change^2/previous. The largest changes of a block may belong to different points, for which
    there is a factor of ten.
    """
    ratio = change / previous
    return change <= SETTLED or (previous < np.inf and 10.0 * change * (2.0 if is_chord else ratio) * ratio <= SETTLED)


@njit(cache=True, error_model="numpy", nogil=True)
def without_unsettled(positions, changes):
    """Make those points of a block NaN for which Newton's method has found no position."""
    for m in range(BLOCK):
        for a in range(DIMENSION):
            if abs(changes[a * BLOCK + m]) > 1e-13:
                for b in range(DIMENSION):
                    positions[b * BLOCK + m] = np.nan
