"""Static condensation of the unknowns inside an interval: Schur complement, right-hand sides, recovery.

With C the block of these unknowns in the Hessian of an interval and B their rows beside all other unknowns, elimination
leaves K - B' inverse(C) B. C is inverted on each interval, or once where it is the same on all of them.
"""

import numpy as np
from numba import njit

from codegen.runtime.kkt.shape import block_size, first_condensed, interval_of, tail_of, unknown_of
from codegen.runtime.kkt.stages import HAS_STAGES, recover_stages, reduce_right
from codegen.runtime.kkt.symmetric import subtract_row
from codegen.runtime.kkt.tables import (
    COUPLED,
    COUPLED_COLUMNS,
    COUPLED_ROWS,
    INSIDE,
    INSIDE_COLUMNS,
    INSIDE_ROWS,
    KEPT,
    KEPT_COLUMNS,
    KEPT_ROWS,
    TOUCHED,
    count_of,
    place_of,
)


@njit(error_model="numpy", forceinline=True)
def scatter(shape, tables, hessian, k, element, couplings):
    """Put the second derivatives of interval k by unknowns that stay into the element matrix, others into `couplings`.

    `hessian` (entries,), `element` (rows, width), `couplings` (N, condensed, width).
    """
    kept, rows, columns = place_of(tables, KEPT), place_of(tables, KEPT_ROWS), place_of(tables, KEPT_COLUMNS)
    for j in range(count_of(tables, KEPT)):
        row, column = np.uint64(tables[rows + j]), np.uint64(tables[columns + j])
        element[row, column] = element[column, row] = hessian[np.uint64(tables[kept + j])]
    if shape.condensed:
        coupling = couplings[k]
        kept, rows = place_of(tables, COUPLED), place_of(tables, COUPLED_ROWS)
        columns = place_of(tables, COUPLED_COLUMNS)
        for j in range(count_of(tables, COUPLED)):
            row, column = np.uint64(tables[rows + j]), np.uint64(tables[columns + j])
            coupling[row, column] = hessian[np.uint64(tables[kept + j])]


@njit(error_model="numpy", forceinline=True)
def invert_block(shape, tables, hessian, diagonal, k, block):
    """Invert the block C of interval k; return False if it is not positive definite.

    `diagonal` (N stride + node,) is added; `block` (condensed, condensed).
    """
    kept, rows, columns = place_of(tables, INSIDE), place_of(tables, INSIDE_ROWS), place_of(tables, INSIDE_COLUMNS)
    first = first_condensed(shape, k)
    for a in range(shape.condensed):
        for b in range(shape.condensed):
            block[a, b] = 0.0
        block[a, a] = diagonal[first + a]
    for j in range(count_of(tables, INSIDE)):
        row, column = np.uint64(tables[rows + j]), np.uint64(tables[columns + j])
        value = hessian[np.uint64(tables[kept + j])]
        block[row, column] += value
        if row != column:
            block[column, row] += value
    return invert_positive_definite(block, shape.condensed)


@njit(error_model="numpy", forceinline=True)
def invert_positive_definite(block, size):
    """Invert a symmetric `block` (size, size) in place by Gauss-Jordan; return False if it is not positive definite."""
    for k in range(size):
        pivot = block[k, k]
        if not 0.0 < pivot < np.inf:
            return False
        block[k, k] = 1.0
        for j in range(size):
            block[k, j] /= pivot
        for i in range(size):
            if i != k:
                factor = block[i, k]
                block[i, k] = 0.0
                for j in range(size):
                    block[i, j] -= factor * block[k, j]
    return True


@njit(error_model="numpy", forceinline=True)
def subtract_schur_complement(shape, tables, coupling, inverse, width, element):
    """Subtract B' inverse(C) B from `element` (rows, width); B is `coupling` (condensed, width)."""
    touched = place_of(tables, TOUCHED)
    for j in range(count_of(tables, TOUCHED)):
        i = np.uint64(tables[touched + j])
        for a in range(shape.condensed):
            weighted = 0.0
            for b in range(shape.condensed):
                weighted += inverse[a, b] * coupling[b, i]
            subtract_row(weighted, coupling, a, width, element, i)


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def condense(shape, tables, gradient, inverses, couplings, kept, room, steps, right):
    """Fill a body's `right` (N block + node + shared,) with -(g - B' inverse(C) g_u), and take stages out of it.

    `gradient` (N stride + node,), `inverses` (1 or N, condensed, condensed), `couplings` (N, condensed, width); `kept`
    and `room` are those of `stages`.
    """
    block, tail = block_size(shape), tail_of(shape)
    for i in range(shape.shared):
        right[steps * block + shape.node + i] = 0.0
    for i in range(shape.node):
        right[steps * block + i] = -gradient[unknown_of(shape, steps, i, steps)]
    for number in range(steps - 1, -1, -1):
        k = interval_of(shape, number, steps)
        for i in range(block):
            right[number * block + i] = -gradient[unknown_of(shape, number, i, steps)]
        if shape.condensed:
            inverse = inverses[min(k, inverses.shape[0] - 1)]
            for a in range(shape.condensed):
                weighted = 0.0
                for b in range(shape.condensed):
                    weighted += inverse[a, b] * gradient[first_condensed(shape, k) + b]
                for i in range(block + shape.node):
                    right[number * block + i] += couplings[k, a, i] * weighted
                for i in range(shape.shared):
                    right[steps * block + shape.node + i] += couplings[k, a, tail + i] * weighted
    if HAS_STAGES and shape.stages:
        for number in range(steps):
            k = interval_of(shape, number, steps)
            reduce_right(shape, tables, gradient, k, number, steps, kept, room, right)


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def recover_condensed(shape, tables, gradient, inverses, couplings, kept, room, steps, solved, step):
    """Fill a body's `step` (N stride + node,) with what is `solved`, -inverse(C) (g_u + B d), and stages.

    Other arguments are those of `condense`.
    """
    block, tail = block_size(shape), tail_of(shape)
    for i in range(shape.node):
        step[unknown_of(shape, steps, i, steps)] = solved[steps * block + i]
    for number in range(steps):
        k = interval_of(shape, number, steps)
        for i in range(block):
            step[unknown_of(shape, number, i, steps)] = solved[number * block + i]
        if shape.condensed:
            first = first_condensed(shape, k)
            inverse = inverses[min(k, inverses.shape[0] - 1)]
            for a in range(shape.condensed):
                step[first + a] = 0.0
            for b in range(shape.condensed):
                forcing = gradient[first + b]
                for i in range(block + shape.node):
                    forcing += couplings[k, b, i] * solved[number * block + i]
                for i in range(shape.shared):
                    forcing += couplings[k, b, tail + i] * solved[steps * block + shape.node + i]
                for a in range(shape.condensed):
                    step[first + a] -= inverse[a, b] * forcing
        if HAS_STAGES and shape.stages:
            recover_stages(shape, tables, gradient, k, number, steps, kept, room, solved, step)
