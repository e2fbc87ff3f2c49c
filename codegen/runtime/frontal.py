"""Frontal LU factorisation of the KKT matrix: assemble interval by interval, eliminate what is complete.

The matrix is a sum over intervals of one small element matrix, as in finite elements. At interval k the front holds
NODE rows left over from before and the rows of interval k and of node k + 1; its columns are the unknowns of blocks k
and k + 1 and of node k + 2. All entries in the columns of block k are then known, and partial pivoting among all rows
of the front eliminates them. That makes it the banded LU with row exchanges, but on dense blocks of constant size.
Sources: Irons (1970), A frontal solution program for finite element analysis; Golub and Van Loan (2013), Matrix
computations, sections 3.4 and 4.3.
"""

import numpy as np
from numba import njit

from codegen.runtime.element_condensed import add_element, allocate_controls, condense, expand, prepare_controls
from codegen.runtime.elements import BLOCK, IS_CURVATURE, SIZE
from codegen.runtime.ends_flat import close_element
from codegen.runtime.example import ELEMENT, END_PINNED, HESSIAN_ROWS, NODE, START_PINNED, STRIDE, interval_hessian

WIDTH = 2 * BLOCK + NODE  # columns of the front


def allocate_system(grid):
    """Factors of the front at every interval (lower, upper, row exchanges), the last block, and what controls need."""
    return (
        np.empty((grid.steps, SIZE, BLOCK)),
        np.empty((grid.steps, BLOCK, WIDTH)),
        np.empty((grid.steps, BLOCK), np.int64),
        np.empty((NODE, NODE)),
        allocate_controls(grid),
    )


def factor_kkt(grid, unknowns, weight, shift, dual_shift, system):
    """Factor the KKT matrix; False when it is singular or the controls' block is not positive definite.

    The Hessian by primal unknowns is multiplied by `weight` and gets `shift` on its diagonal; the multipliers'
    diagonal gets -`dual_shift`.
    """
    lower, upper, exchanges, last, controls = system
    if not prepare_controls(weight, shift, controls):
        return False
    if not eliminate(
        unknowns,
        grid.steps,
        grid.h,
        grid.parameters,
        weight,
        shift,
        dual_shift,
        lower,
        upper,
        exchanges,
        last,
        controls,
    ):
        return False
    try:
        last[:] = np.linalg.inv(last)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(last).all())


# The most frequent calls are inlined: a call costs as much as the arithmetic of a small block.
@njit(cache=True, error_model="numpy")
def eliminate(unknowns, steps, h, parameters, weight, shift, dual_shift, lower, upper, exchanges, last, controls):
    """Run the front over all intervals and leave the last node's block; False when a pivot vanishes or is infinite."""
    front, element = np.empty((SIZE, WIDTH)), np.empty((SIZE, SIZE))
    for i in range(SIZE):
        for j in range(WIDTH):
            front[i, j] = 0.0
    gradient, hessian = np.empty(ELEMENT), np.empty(HESSIAN_ROWS.size)
    for k in range(-1, steps):
        if k >= 0:
            for i in range(NODE, SIZE):
                for j in range(SIZE):
                    front[i, j] = element[i, j]
                for j in range(SIZE, WIDTH):
                    front[i, j] = 0.0
        if k < steps - 1:
            fill_element(
                unknowns, k + 1, steps, h, parameters, weight, shift, dual_shift, gradient, hessian, controls, element
            )
            for i in range(NODE):
                for j in range(SIZE):
                    front[BLOCK + i, BLOCK + j] += element[i, j]
        if k >= 0 and not eliminate_block(front, lower[k], upper[k], exchanges[k]):
            return False
        for i in range(NODE):
            for j in range(SIZE):
                front[i, j] = front[BLOCK + i, BLOCK + j]
            for j in range(SIZE, WIDTH):
                front[i, j] = 0.0
    for i in range(NODE):
        for j in range(NODE):
            last[i, j] = front[i, j]
    return True


@njit(error_model="numpy", inline="always")
def fill_element(unknowns, k, steps, h, parameters, weight, shift, dual_shift, gradient, hessian, controls, element):
    """Fill the element matrix of interval k."""
    interval_hessian(unknowns[k * STRIDE : k * STRIDE + ELEMENT], k * h, h, parameters, gradient, hessian)
    if weight != 1.0:
        for j in range(hessian.size):
            if IS_CURVATURE[j]:
                hessian[j] *= weight
    for i in range(SIZE):
        for j in range(SIZE):
            element[i, j] = 0.0
    add_element(hessian, controls, k, element)
    close_element(unknowns, k, steps, h, parameters, weight, shift, dual_shift, element)


@njit(error_model="numpy", inline="always")
def eliminate_block(front, lower, upper, exchanges):
    """Eliminate the first BLOCK columns of the front with row exchanges; False when a pivot vanishes."""
    for c in range(BLOCK):
        pivot, largest = c, abs(front[c, c])
        for i in range(c + 1, SIZE):
            if abs(front[i, c]) > largest:
                pivot, largest = i, abs(front[i, c])
        if not 0.0 < largest < np.inf:
            return False
        exchanges[c] = pivot
        for j in range(WIDTH):
            upper[c, j] = front[pivot, j]
            front[pivot, j] = front[c, j]
        inverse = 1.0 / upper[c, c]
        for i in range(c + 1, SIZE):
            factor = front[i, c] * inverse
            lower[i, c] = factor
            for j in range(WIDTH):
                front[i, j] -= factor * upper[c, j]
    return True


def solve_kkt(grid, system, gradient, step):
    """Newton step for all unknowns: the solution of KKT matrix . step = -gradient."""
    lower, upper, exchanges, last, controls = system
    tail = grid.steps * BLOCK
    reduced = np.zeros(tail + NODE + BLOCK)  # the last front reaches BLOCK columns beyond the last node
    condense(gradient, controls, reduced)
    for i in START_PINNED:
        reduced[i] = 0.0
    for i in END_PINNED:
        reduced[tail + i] = 0.0
    forward(lower, exchanges, reduced)
    reduced[tail : tail + NODE] = last @ reduced[tail : tail + NODE]
    backward(upper, reduced)
    expand(gradient, controls, reduced, step)


@njit(cache=True, error_model="numpy")
def forward(lower, exchanges, reduced):
    """Apply row exchanges and lower factors of all intervals."""
    for k in range(lower.shape[0]):
        first = k * BLOCK
        for c in range(BLOCK):
            value = reduced[first + exchanges[k, c]]
            reduced[first + exchanges[k, c]] = reduced[first + c]
            reduced[first + c] = value
            for i in range(c + 1, SIZE):
                reduced[first + i] -= lower[k, i, c] * value


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def backward(upper, reduced):
    """Substitute backwards from the last node, whose unknowns are known; `reduced` ends with BLOCK zeros.

    The sums may be taken in any order, which lets them run in parallel in the processor.
    """
    for k in range(upper.shape[0] - 1, -1, -1):
        first = k * BLOCK
        for c in range(BLOCK - 1, -1, -1):
            value = reduced[first + c]
            for j in range(c + 1, BLOCK):
                value -= upper[k, c, j] * reduced[first + j]
            rest = 0.0
            for j in range(BLOCK, WIDTH):
                rest += upper[k, c, j] * reduced[first + j]
            reduced[first + c] = (value - rest) / upper[k, c, c]
