"""Frontal factorisation of the KKT matrix: assemble interval by interval, eliminate what is complete, count inertia.

The matrix of a body is a sum over intervals of one small symmetric element matrix, as in finite elements. Block k holds
the unknowns of node k and of the interval after it. Blocks 1, 2, ... are eliminated in this order, with pivoting inside
each; that is the forward sweep of a Riccati recursion. Block 0 is singular by itself, because its equations are matched
by later unknowns, so it borders the front to the end and is eliminated with the last node. Shared unknowns border all
fronts of all bodies; what elimination leaves of them is the Schur complement that ties bodies together, a dense matrix.
The pivots' signs give the inertia of the whole, by Sylvester's law. Sources: Irons (1970), A frontal solution program
for finite element analysis; Haynsworth (1968), Determination of the inertia of a partitioned Hermitian matrix; Rao,
Wright and Rawlings (1998), Application of interior-point methods to model predictive control, for the Riccati view.
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
from codegen.runtime.callbacks import multiplier_unknowns
from codegen.runtime.shared import follow_shared, read_shared, root_place
from codegen.runtime.symmetric import eliminate_symmetric, solve_lower, solve_pivots, solve_upper

FIRST = np.setdiff1d(np.arange(BLOCK), START_PINNED)  # what is not given of block 0
BORDER = FIRST.size
FRONT = SIZE + BORDER + SHARED  # rows of the front: block k, node k + 1, block 0, shared unknowns
LAST = NODE + BORDER  # unknowns that are eliminated together with the last node


def allocate_system(grid):
    """Room for the factors, for what is condensed, and the number of equations.

    The factors of all blocks, of the last nodes and of the shared unknowns are a lower factor, the inverse of the
    pivots and the exchanges each.
    """
    factors = (
        np.zeros((BODIES, grid.steps, FRONT, BLOCK)),
        np.zeros((BODIES, grid.steps, BLOCK, 2)),
        np.zeros((BODIES, grid.steps, BLOCK), np.int64),
        np.zeros((BODIES, LAST + SHARED, LAST)),
        np.zeros((BODIES, LAST, 2)),
        np.zeros((BODIES, LAST), np.int64),
        np.zeros((ROOT, ROOT)),
        np.zeros((ROOT, 2)),
        np.zeros(ROOT, np.int64),
        allocate_condensed(grid),
    )
    return factors, multiplier_unknowns(grid).size


def factor_kkt(grid, unknowns, weight, diagonal, system):
    """Factor the KKT matrix and return how many more negative eigenvalues it has than there are equations.

    Zero means that the reduced Hessian is positive definite, as at a minimum. None means that the matrix is singular,
    or that a block that is condensed is not positive definite. The Hessian by primal unknowns is multiplied by
    `weight`; then `diagonal`, an array as long as the unknowns, is added to the diagonal of the whole matrix.
    """
    factors, equations = system
    negative = factor(unknowns, grid.steps, grid.h, grid.parameters, weight, diagonal, factors)
    return None if negative < 0 else negative - equations


# Sums may be taken in any order, which lets them run in parallel in the processor.
@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def factor(unknowns, steps, h, parameters, weight, diagonal, factors):
    """Run the front over all intervals of all bodies; the number of negative pivots, or -1 where it cannot go on."""
    lower, inverse, places, last_lower, last_inverse, last_places, root_lower, root_inverse, root_places = factors[:9]
    condensed = factors[9]
    if not prepare_condensed(weight, diagonal, condensed):
        return -1
    chain, negative = steps * STRIDE + NODE, 0
    front, element = np.empty((FRONT, FRONT)), np.empty((SIZE + SHARED, SIZE + SHARED))
    last, root, hessian = np.empty((LAST + SHARED, LAST + SHARED)), np.zeros((ROOT, ROOT)), np.empty(HESSIAN_ROWS.size)
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        own, added = unknowns[body * chain : (body + 1) * chain], diagonal[body * chain : (body + 1) * chain]
        for k in range(steps):
            interval = body * steps + k
            if not fill_element(
                own, k, steps, h, parameters[body], weight, added, hessian, condensed, interval, element
            ):
                return -1
            if k == 0:
                begin_front(element, front)
                continue
            add_to_front(element, front)
            found = eliminate_symmetric(front, BLOCK, FRONT, lower[body, k], inverse[body, k], places[body, k])
            if found < 0:
                return -1
            negative += found
            move_on(front)
        end_front(front, last)
        found = eliminate_symmetric(last, LAST, LAST + SHARED, last_lower[body], last_inverse[body], last_places[body])
        if found < 0:
            return -1
        negative += found
        for i in range(SHARED):
            for j in range(SHARED):
                root[root_place(body, i), root_place(body, j)] += last[LAST + max(i, j), LAST + min(i, j)]
    if SHARED:
        for i in range(ROOT):
            root[i, i] += diagonal[diagonal.size - ROOT + i]
        if COUPLINGS:
            add_coupling_matrix(unknowns, parameters[0], weight, root)
        found = eliminate_symmetric(root, ROOT, ROOT, root_lower, root_inverse, root_places)
        if found < 0:
            return -1
        negative += found
    return negative


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


@njit(error_model="numpy")
def begin_front(element, front):
    """Put the first element matrix into an empty front: node 1 where node k stands, block 0 into the border."""
    for i in range(FRONT):
        for j in range(FRONT):
            front[i, j] = 0.0
    for i in range(NODE):
        for j in range(NODE):
            front[i, j] = element[BLOCK + i, BLOCK + j]
        for j in range(BORDER):
            front[SIZE + j, i] = element[FIRST[j], BLOCK + i]
        for j in range(SHARED):
            front[SIZE + BORDER + j, i] = element[SIZE + j, BLOCK + i]
    for i in range(BORDER):
        for j in range(BORDER):
            front[SIZE + i, SIZE + j] = element[FIRST[i], FIRST[j]]
        for j in range(SHARED):
            front[SIZE + BORDER + j, SIZE + i] = element[SIZE + j, FIRST[i]]
    for i in range(SHARED):
        for j in range(SHARED):
            front[SIZE + BORDER + i, SIZE + BORDER + j] = element[SIZE + i, SIZE + j]


@njit(error_model="numpy", inline="always")
def add_to_front(element, front):
    """Add the element matrix of interval k to the front, where node k stands already."""
    for i in range(BLOCK):
        for j in range(BLOCK):
            front[i, j] += element[i, j]
    for i in range(BLOCK, SIZE):
        for j in range(i + 1):
            front[i, j] += element[i, j]
    for i in range(SHARED):
        for j in range(SIZE):
            front[SIZE + BORDER + i, j] += element[SIZE + i, j]
        for j in range(i + 1):
            front[SIZE + BORDER + i, SIZE + BORDER + j] += element[SIZE + i, SIZE + j]


@njit(error_model="numpy", inline="always")
def move_on(front):
    """Move what elimination left of node k + 1 to the place of node k, and clear the rest of the block."""
    for i in range(NODE):
        for j in range(i + 1):
            front[i, j] = front[BLOCK + i, BLOCK + j]
            front[j, i] = front[i, j]
    for i in range(SIZE, FRONT):
        for j in range(NODE):
            front[i, j] = front[i, BLOCK + j]
        for j in range(NODE, SIZE):
            front[i, j] = 0.0
    for i in range(NODE, SIZE):
        for j in range(i + 1):
            front[i, j] = 0.0
            if i < BLOCK:
                front[j, i] = 0.0


@njit(error_model="numpy")
def end_front(front, last):
    """The last node, block 0 and the shared unknowns without the gap between them, both triangles."""
    for i in range(LAST + SHARED):
        row = i if i < NODE else i + BLOCK
        for j in range(i + 1):
            last[i, j] = front[row, j if j < NODE else j + BLOCK]
            last[j, i] = last[i, j]


def solve_kkt(grid, system, gradient, step):
    """Newton step for all unknowns: the solution of KKT matrix . step = -gradient, after factor_kkt."""
    substitute(gradient, grid.steps, system[0], step)


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def substitute(gradient, steps, factors, step):
    """Solve with the factors: forward over all bodies, the shared unknowns, backward over all bodies."""
    lower, inverse, places, last_lower, last_inverse, last_places, root_lower, root_inverse, root_places = factors[:9]
    condensed = factors[9]
    reduced, last = np.zeros((BODIES, steps * BLOCK + NODE)), np.empty((BODIES, LAST))
    shared = np.empty(ROOT)
    for i in range(ROOT):
        shared[i] = -gradient[gradient.size - ROOT + i]
    condense(gradient, condensed, steps, reduced, shared)
    for body in range(BODIES):
        right = reduced[body]
        for i in START_PINNED:
            right[i] = 0.0
        for i in END_PINNED:
            right[steps * BLOCK + i] = 0.0
        forward(lower[body], places[body], body, right, shared)
        gather_last(right, steps, last[body])
        solve_lower(last_lower[body], last_places[body], LAST, last[body])
        for i in range(SHARED):
            for c in range(LAST):
                shared[root_place(body, i)] -= last_lower[body, LAST + i, c] * last[body, c]
    if SHARED:
        solve_lower(root_lower, root_places, ROOT, shared)
        solve_pivots(root_inverse, root_places, ROOT, shared)
        solve_upper(root_lower, root_places, ROOT, shared)
        for i in range(ROOT):
            step[step.size - ROOT + i] = shared[i]
    for body in range(BODIES):
        solve_pivots(last_inverse[body], last_places[body], LAST, last[body])
        for i in range(SHARED):
            for c in range(LAST):
                last[body, c] -= last_lower[body, LAST + i, c] * shared[root_place(body, i)]
        solve_upper(last_lower[body], last_places[body], LAST, last[body])
        scatter_last(last[body], steps, reduced[body])
        backward(lower[body], inverse[body], places[body], body, shared, reduced[body])
    expand(gradient, condensed, steps, reduced, shared, step)
    if SHARED:
        follow_shared(steps * STRIDE + NODE, step)


@njit(error_model="numpy")
def forward(lower, places, body, right, shared):
    """Solve with the lower factors of the blocks of a body, and subtract from what borders them."""
    for k in range(1, lower.shape[0]):
        block = right[k * BLOCK : (k + 1) * BLOCK]
        solve_lower(lower[k], places[k], BLOCK, block)
        for i in range(NODE):
            right[(k + 1) * BLOCK + i] -= product(lower[k, BLOCK + i], block)
        for i in range(BORDER):
            right[FIRST[i]] -= product(lower[k, SIZE + i], block)
        for i in range(SHARED):
            shared[root_place(body, i)] -= product(lower[k, SIZE + BORDER + i], block)


@njit(error_model="numpy", inline="always")
def product(row, block):
    """Scalar product of two vectors of a block's size."""
    value = 0.0
    for c in range(BLOCK):
        value += row[c] * block[c]
    return value


@njit(error_model="numpy")
def backward(lower, inverse, places, body, shared, right):
    """Solve with the pivots and transposed factors, from the last block to block 1."""
    for k in range(lower.shape[0] - 1, 0, -1):
        block = right[k * BLOCK : (k + 1) * BLOCK]
        solve_pivots(inverse[k], places[k], BLOCK, block)
        for i in range(NODE):
            subtract(lower[k, BLOCK + i], right[(k + 1) * BLOCK + i], block)
        for i in range(BORDER):
            subtract(lower[k, SIZE + i], right[FIRST[i]], block)
        for i in range(SHARED):
            subtract(lower[k, SIZE + BORDER + i], shared[root_place(body, i)], block)
        solve_upper(lower[k], places[k], BLOCK, block)


@njit(error_model="numpy", inline="always")
def subtract(row, value, block):
    """Subtract a multiple of a factor's row from a block."""
    for c in range(BLOCK):
        block[c] -= row[c] * value


@njit(error_model="numpy")
def gather_last(right, steps, last):
    """The entries of the last node and of block 0."""
    for i in range(NODE):
        last[i] = right[steps * BLOCK + i]
    for i in range(BORDER):
        last[NODE + i] = right[FIRST[i]]


@njit(error_model="numpy")
def scatter_last(last, steps, right):
    """Put the solution of the last node and of block 0 into its places."""
    for i in range(NODE):
        right[steps * BLOCK + i] = last[i]
    for i in range(BORDER):
        right[FIRST[i]] = last[NODE + i]
