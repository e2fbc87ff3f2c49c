"""Frontal LU factorisation of the KKT matrix: assemble interval by interval, eliminate what is complete.

The matrix of a body is a sum over intervals of one small element matrix, as in finite elements. At interval k the
front holds NODE rows left over from before and the rows of interval k and of node k + 1; its columns are the unknowns
of blocks k and k + 1 and of node k + 2. All entries in the columns of block k are then known, and partial pivoting
among all rows of the front eliminates them. That makes it the banded LU with row exchanges, but on dense blocks of
constant size. Rows and columns of shared unknowns border the front; they are never pivots, and what elimination leaves
in them is the Schur complement that ties bodies together. Sources: Irons (1970), A frontal solution program for finite
element analysis; Golub and Van Loan (2013), Matrix computations, sections 3.4 and 4.3.
"""

import numpy as np
from numba import njit

from codegen.runtime.coupling import add_coupling_matrix
from codegen.runtime.element_condensed import add_element, allocate_condensed, prepare_condensed
from codegen.runtime.condensation import condense, expand
from codegen.runtime.elements import BLOCK, IS_CURVATURE, SIZE
from codegen.runtime.ends_flat import close_element
from codegen.runtime.example import (
    BODIES,
    COUPLINGS,
    ELEMENT,
    END_PINNED,
    HESSIAN_ROWS,
    NODE,
    ROOT,
    SHARED,
    START_PINNED,
    STRIDE,
    interval_hessian,
)
from codegen.runtime.shared import follow_shared, read_shared, root_place

WIDTH = 2 * BLOCK + NODE  # columns of the front, without its border


def allocate_system(grid):
    """Factors of the front at every interval (lower, upper, row exchanges), the shared block, and what was condensed.

    The last front of a body eliminates its last node alone.
    """
    return (
        np.zeros((BODIES, grid.steps + 1, SIZE + SHARED, BLOCK)),
        np.zeros((BODIES, grid.steps + 1, BLOCK, WIDTH + SHARED)),
        np.zeros((BODIES, grid.steps + 1, BLOCK), np.int64),
        np.zeros((ROOT, ROOT)),
        allocate_condensed(grid),
    )


def factor_kkt(grid, unknowns, weight, diagonal, system):
    """Factor the KKT matrix; False when it is singular or a block that is condensed is not positive definite.

    The Hessian by primal unknowns is multiplied by `weight`; then `diagonal`, an array as long as the unknowns, is
    added to the diagonal of the whole matrix.
    """
    lower, upper, exchanges, root, condensed = system
    if not prepare_condensed(grid, weight, diagonal, condensed):
        return False
    data = grid.steps, grid.h, grid.parameters, weight, diagonal
    if not eliminate(unknowns, *data, lower, upper, exchanges, root, condensed):
        return False
    if SHARED:
        root.flat[:: ROOT + 1] += diagonal[diagonal.size - ROOT :]
        try:
            root[:] = np.linalg.inv(root)
        except np.linalg.LinAlgError:
            return False
        return bool(np.isfinite(root).all())
    return True


# The most frequent calls are inlined: a call costs as much as the arithmetic of a small block.
@njit(cache=True, error_model="numpy")
def eliminate(unknowns, steps, h, parameters, weight, diagonal, lower, upper, exchanges, root, condensed):
    """Run the front over all intervals of all bodies; False when a pivot vanishes or is infinite.

    The Schur complements of the shared unknowns are added up in `root`.
    """
    chain = steps * STRIDE + NODE
    front, element = np.empty((SIZE + SHARED, WIDTH + SHARED)), np.empty((SIZE + SHARED, SIZE + SHARED))
    hessian = np.empty(HESSIAN_ROWS.size)
    for i in range(ROOT):
        for j in range(ROOT):
            root[i, j] = 0.0
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        own, added = unknowns[body * chain : (body + 1) * chain], diagonal[body * chain : (body + 1) * chain]
        data = parameters[body]
        for i in range(SIZE + SHARED):
            for j in range(WIDTH + SHARED):
                front[i, j] = 0.0
        for k in range(-1, steps):
            if k >= 0:
                load_rows(element, front)
            if k < steps - 1:
                interval = body * steps + k + 1
                if not fill_element(own, k + 1, steps, h, data, weight, added, hessian, condensed, interval, element):
                    return False
                add_node(element, front)
            if k >= 0 and not eliminate_block(front, lower[body, k], upper[body, k], exchanges[body, k]):
                return False
            move_on(front)
        if not eliminate_last(front, lower[body, steps], upper[body, steps], exchanges[body, steps]):
            return False
        for i in range(SHARED):
            for j in range(SHARED):
                root[root_place(body, i), root_place(body, j)] += front[SIZE + i, WIDTH + j]
    if COUPLINGS:
        add_coupling_matrix(unknowns, parameters[0], weight, root)
    return True


@njit(error_model="numpy", inline="always")
def fill_element(own, k, steps, h, parameters, weight, added, hessian, condensed, interval, element):
    """Fill the element matrix of interval k of a body; False when what is condensed is not positive definite."""
    interval_hessian(own[k * STRIDE : k * STRIDE + ELEMENT], k * h, h, parameters, hessian)
    if weight != 1.0:
        for j in range(hessian.size):
            if IS_CURVATURE[j]:
                hessian[j] *= weight
    for i in range(SIZE + SHARED):
        for j in range(SIZE + SHARED):
            element[i, j] = 0.0
    regular = add_element(hessian, added[k * STRIDE : (k + 1) * STRIDE], condensed, interval, element)
    close_element(own, k, steps, h, parameters, weight, added, element)
    return regular


@njit(error_model="numpy", inline="always")
def load_rows(element, front):
    """Put the rows of an interval and of the node after it into the front, and add those of shared unknowns."""
    for i in range(NODE, SIZE):
        for j in range(SIZE):
            front[i, j] = element[i, j]
        for j in range(SIZE, WIDTH):
            front[i, j] = 0.0
        for j in range(SHARED):
            front[i, WIDTH + j] = element[i, SIZE + j]
    for i in range(SIZE, SIZE + SHARED):
        for j in range(SIZE):
            front[i, j] += element[i, j]
        for j in range(SHARED):
            front[i, WIDTH + j] += element[i, SIZE + j]


@njit(error_model="numpy", inline="always")
def add_node(element, front):
    """Add the rows of an element's left node to the front, where they complete those of the node."""
    for i in range(NODE):
        for j in range(SIZE):
            front[BLOCK + i, BLOCK + j] += element[i, j]
        for j in range(SHARED):
            front[BLOCK + i, WIDTH + j] += element[i, SIZE + j]


@njit(error_model="numpy", inline="always")
def move_on(front):
    """Move what is left in the front one block up and to the left."""
    for i in range(NODE):
        for j in range(SIZE):
            front[i, j] = front[BLOCK + i, BLOCK + j]
        for j in range(SIZE, WIDTH):
            front[i, j] = 0.0
        for j in range(WIDTH, WIDTH + SHARED):
            front[i, j] = front[BLOCK + i, j]
    for i in range(SIZE, SIZE + SHARED):
        for j in range(SIZE):
            front[i, j] = front[i, BLOCK + j]
        for j in range(SIZE, WIDTH):
            front[i, j] = 0.0


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
        for j in range(WIDTH + SHARED):
            upper[c, j] = front[pivot, j]
            front[pivot, j] = front[c, j]
        inverse = 1.0 / upper[c, c]
        for i in range(c + 1, SIZE + SHARED):
            factor = front[i, c] * inverse
            lower[i, c] = factor
            for j in range(WIDTH + SHARED):
                front[i, j] -= factor * upper[c, j]
    return True


@njit(error_model="numpy")
def eliminate_last(front, lower, upper, exchanges):
    """Eliminate the last node in the same way, by the NODE rows that are left; False when a pivot vanishes."""
    for c in range(NODE):
        pivot = c
        for i in range(c + 1, NODE):
            if abs(front[i, c]) > abs(front[pivot, c]):
                pivot = i
        if not 0.0 < abs(front[pivot, c]) < np.inf:
            return False
        exchanges[c] = pivot
        for j in range(WIDTH + SHARED):
            upper[c, j] = front[pivot, j]
            front[pivot, j] = front[c, j]
        for i in range(c + 1, SIZE + SHARED):
            if i < NODE or i >= SIZE:
                lower[i, c] = front[i, c] / upper[c, c]
                for j in range(WIDTH + SHARED):
                    front[i, j] -= lower[i, c] * upper[c, j]
    return True


def solve_kkt(grid, system, gradient, step):
    """Newton step for all unknowns: the solution of KKT matrix . step = -gradient."""
    lower, upper, exchanges, root, condensed = system
    # A front reaches BLOCK + NODE columns beyond the last node.
    reduced = np.zeros((BODIES, (grid.steps + 2) * BLOCK + 2 * NODE))
    shared = -gradient[gradient.size - ROOT :]
    condense(gradient, condensed, grid.steps, reduced, shared)
    for i in START_PINNED:
        reduced[:, i] = 0.0
    for i in END_PINNED:
        reduced[:, grid.steps * BLOCK + i] = 0.0
    forward(lower, exchanges, reduced, shared)
    if SHARED:
        shared = root @ shared
        step[step.size - ROOT :] = shared
    backward(upper, reduced, shared)
    expand(gradient, condensed, grid.steps, reduced, shared, step)
    if SHARED:
        follow_shared(grid.steps * STRIDE + NODE, step)


@njit(cache=True, error_model="numpy")
def forward(lower, exchanges, reduced, shared):
    """Apply row exchanges and lower factors of all intervals and of the last node, body by body."""
    steps = lower.shape[1] - 1
    for body in range(BODIES):
        right = reduced[body]
        for k in range(steps + 1):
            first, columns, rows = k * BLOCK, BLOCK, SIZE
            if k == steps:
                columns, rows = NODE, NODE
            for c in range(columns):
                value = right[first + exchanges[body, k, c]]
                right[first + exchanges[body, k, c]] = right[first + c]
                right[first + c] = value
                for i in range(c + 1, rows):
                    right[first + i] -= lower[body, k, i, c] * value
                for i in range(SHARED):
                    shared[root_place(body, i)] -= lower[body, k, SIZE + i, c] * value


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def backward(upper, reduced, shared):
    """Substitute backwards from the last node; `shared` is known, and every row of `reduced` ends with zeros.

    The sums may be taken in any order, which lets them run in parallel in the processor.
    """
    steps = upper.shape[1] - 1
    for body in range(BODIES):
        right = reduced[body]
        for k in range(steps, -1, -1):
            first = k * BLOCK
            for c in range((NODE if k == steps else BLOCK) - 1, -1, -1):
                value = right[first + c]
                for j in range(c + 1, BLOCK):
                    value -= upper[body, k, c, j] * right[first + j]
                rest = 0.0
                for j in range(BLOCK, WIDTH):
                    rest += upper[body, k, c, j] * right[first + j]
                for j in range(SHARED):
                    rest += upper[body, k, c, WIDTH + j] * shared[root_place(body, j)]
                right[first + c] = (value - rest) / upper[body, k, c, c]
