"""Frontal factorisation of the KKT matrix: assemble interval by interval, eliminate what is complete, count inertia.

The matrix of a body is a sum over intervals of one small symmetric element matrix, as in finite elements. Block k holds
the unknowns of node k and of the interval after it. Blocks 1, 2, ... are eliminated in this order, with pivoting inside
each; that is the forward sweep of a Riccati recursion. Block 0 is singular by itself, because its equations are matched
by later unknowns, so it borders the front to the end and is eliminated with the last node. Shared unknowns border all
fronts of all bodies; what elimination leaves of them is the Schur complement that ties bodies together, a dense matrix.
The pivots' signs give the inertia of the whole, by Sylvester's law. Sources: Irons (1970), A frontal solution program
for finite element analysis; Haynsworth (1968), Determination of the inertia of a partitioned Hermitian matrix; Rao,
Wright and Rawlings (1998), Application of interior-point methods to model predictive control, for the Riccati view.

Too many negative pivots show before the end. At a minimum, the rows that are eliminated and the multipliers of all
equations that reach into them make a matrix with one negative eigenvalue for every multiplier; without the multipliers
that are still to come it has at most as many (Cauchy's interlacing theorem).
"""

import numpy as np
from numba import njit

from codegen.runtime.coupling import add_coupling_matrix
from codegen.runtime.element_condensed import add_element, allocate_condensed, condensed_parts, prepare_condensed
from codegen.runtime.elements import (
    BLOCK,
    BORDER,
    CARRIED,
    COLUMNS,
    FIRST,
    INNER,
    IS_CURVATURE,
    LOCAL_IS_MULTIPLIER,
    RIGHT,
    ROWS,
    SIZE,
    TAIL,
    WIDTH,
    padded,
)
from codegen.runtime.ends_flat import close_element
from codegen.runtime.example import (
    BODIES,
    COUPLINGS,
    ELEMENT,
    HESSIAN_ROWS,
    IS_MULTIPLIER,
    NODE,
    ROOT,
    SHARED,
    STRIDE,
    interval_hessian,
)
from codegen.runtime.layout import multiplier_unknowns
from codegen.runtime.shared import read_shared, root_place
from codegen.runtime.symmetric import eliminate_rows, subtract_products

REST = ROWS - BLOCK  # rows of what borders a block: node k + 1, block 0, shared unknowns
REST_WIDTH = padded(REST)
LAST = NODE + BORDER  # unknowns that are eliminated together with the last node
SHARED_WIDTH, ROOT_WIDTH = padded(SHARED + CARRIED), padded(ROOT)
LAST_WIDTH = padded(LAST + SHARED_WIDTH)
MULTIPLIERS = np.count_nonzero(IS_MULTIPLIER)  # in a block
ENDING = np.count_nonzero(IS_MULTIPLIER[:NODE]) + MULTIPLIERS  # in the last node and in block 0
COMMON = np.count_nonzero(LOCAL_IS_MULTIPLIER[STRIDE + NODE :])  # among the shared unknowns


def allocate_system(grid):
    """Room for the factors and for what is condensed, and the number of equations.

    The factors are an array of numbers and one of places, of which `factor_parts` tells the meaning: few arrays are
    handed to compiled functions quickly. Places and the inverse of the pivots are zeros, so that solving without
    factors, as compilation does, stays inside the arrays.
    """
    blocks, last = BODIES * grid.steps * BLOCK, BODIES * LAST
    rows, numbers = blocks + last + ROOT, blocks * WIDTH + last * LAST_WIDTH + ROOT * ROOT_WIDTH
    factors = np.empty(numbers + 2 * rows + ROOT), np.zeros(rows, np.uint64), allocate_condensed(grid)
    factors[0][numbers:] = 0.0
    return factors, multiplier_unknowns(grid).size


@njit(error_model="numpy")
def factor_parts(numbers, places, steps):
    """The factors of all blocks, of the last nodes and of the shared unknowns, as views.

    Each is the rows of an upper factor, the inverse of the pivots, and the order of elimination; and for the shared
    unknowns their right-hand side, less what the elimination of the bodies has taken away. That of blocks and last
    nodes, if it was carried along, is a column of the upper factor, multiplied by the inverse of the pivots already.
    """
    # First rows, and where in `numbers` their upper factors begin; then come the inverse of all pivots, and the rest.
    last, root = BODIES * steps * BLOCK, BODIES * (steps * BLOCK + LAST)
    last_upper = last * WIDTH
    root_upper = last_upper + BODIES * LAST * LAST_WIDTH
    inverse = root_upper + ROOT * ROOT_WIDTH
    blocks = (
        numbers[:last_upper].reshape((BODIES, steps, BLOCK, WIDTH)),
        numbers[inverse : inverse + 2 * last].reshape((BODIES, steps, BLOCK, 2)),
        places[:last].reshape((BODIES, steps, BLOCK)),
    )
    ends = (
        numbers[last_upper:root_upper].reshape((BODIES, LAST, LAST_WIDTH)),
        numbers[inverse + 2 * last : inverse + 2 * root].reshape((BODIES, LAST, 2)),
        places[last:root].reshape((BODIES, LAST)),
    )
    shared = (
        numbers[root_upper:inverse].reshape((ROOT, ROOT_WIDTH)),
        numbers[inverse + 2 * root : inverse + 2 * (root + ROOT)].reshape((ROOT, 2)),
        places[root:],
        numbers[inverse + 2 * (root + ROOT) :],
    )
    return blocks, ends, shared


def factor_kkt(grid, unknowns, weight, diagonal, system, gradient=None):
    """Factor the KKT matrix and return how many more negative eigenvalues it has than there are equations.

    Zero means that the reduced Hessian is positive definite, as at a minimum. A positive number may be too low: the
    elimination stops when there are too many. None means that the matrix is singular, or that a block that is
    condensed is not positive definite. The Hessian by primal unknowns is multiplied by `weight`; then `diagonal`, an
    array as long as the unknowns, is added to the diagonal of the whole matrix. The right-hand side -`gradient` takes
    part in the elimination where there is room for it, which takes a third of the work of `solve_kkt` away.
    """
    factors, equations = system
    right = unknowns if gradient is None else gradient  # anything will do where nobody asks for the solution
    regular, excess = factor(
        unknowns, right, grid.steps, grid.h, grid.parameters, weight, diagonal, equations, *factors
    )
    return excess if regular else None


def is_factored(excess):
    """Whether what `factor_kkt` gave says that the whole matrix was factored, so that `solve_kkt` may follow."""
    return excess is not None and excess <= 0


@njit(cache=True, error_model="numpy")
def factor(unknowns, gradient, steps, h, parameters, weight, diagonal, equations, numbers, places, storage):
    """Eliminate all bodies, then the shared unknowns; whether that was possible, and the excess of negative pivots."""
    blocks, ends, (root_upper, root_inverse, root_order, right) = factor_parts(numbers, places, steps)
    condensed = condensed_parts(storage, steps)
    factors = blocks, ends, condensed
    if not prepare_condensed(weight, diagonal, condensed):
        return False, 0
    negative = 0
    root, left = np.zeros((ROOT, ROOT_WIDTH)), np.empty((SHARED, SHARED_WIDTH))
    for i in range(ROOT):
        right[i] = -gradient[gradient.size - ROOT + i]
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        regular, found, excess = eliminate_body(
            unknowns, gradient, body, steps, h, parameters, weight, diagonal, factors, left
        )
        if not regular or excess > 0:
            return regular, excess
        negative += found
        for i in range(SHARED):
            for j in range(SHARED):
                root[root_place(body, i), root_place(body, j)] += left[min(i, j), max(i, j)]
            if CARRIED:
                right[root_place(body, i)] += left[i, SHARED]
    if SHARED:
        for i in range(ROOT):
            root[i, i] += diagonal[diagonal.size - ROOT + i]
        if COUPLINGS:
            add_coupling_matrix(unknowns, parameters[0], weight, root)
        found = eliminate_rows(root, *root.shape, root_upper, root_inverse, root_order)
        if found < 0:
            return False, 0
        negative += found
    return True, negative - equations


# Sums may be taken in any order, which lets them run in parallel in the processor.
@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def eliminate_body(unknowns, gradient, body, steps, h, parameters, weight, diagonal, factors, left):
    """Run the front over all intervals of a body; `left` takes what that leaves for the shared unknowns.

    Returns whether that was possible, the number of negative pivots, and by how many they are too many: when there are,
    the elimination has stopped.
    """
    (upper, inverse, order), (last_upper, last_inverse, last_order), condensed = factors
    chain, negative = steps * STRIDE + NODE, 0
    own, added = unknowns[body * chain : (body + 1) * chain], diagonal[body * chain : (body + 1) * chain]
    slopes = gradient[body * chain : (body + 1) * chain]
    element, rest = np.empty((ROWS, WIDTH)), np.zeros((REST, REST_WIDTH))
    last, hessian = np.empty((LAST, LAST_WIDTH)), np.empty(HESSIAN_ROWS.size)
    for k in range(steps):
        interval_hessian(own[k * STRIDE : k * STRIDE + ELEMENT], k * h, h, parameters[body], hessian)
        if weight != 1.0:
            weigh(weight, hessian)
        element[:] = 0.0
        here, slope = added[k * STRIDE : (k + 1) * STRIDE], slopes[k * STRIDE : (k + 1) * STRIDE]
        if not add_element(hessian, here, slope, condensed, body * steps + k, element):
            return False, 0, 0
        for i in range(BLOCK):
            element[i, i] += here[i]
        if CARRIED:
            add_right_hand_side(slopes, k, steps, element)
        if k == 0 or k == steps - 1:
            close_element(own, k, steps, h, parameters[body], weight, added, element)
        if k == 0:
            begin_front(element, rest)
            continue
        move_front(element, rest)
        found = eliminate_rows(element, INNER, COLUMNS, upper[body, k], inverse[body, k], order[body, k])
        if found < 0:
            return False, 0, 0
        negative += found
        # Node k + 1 and block 0 have as many multipliers as the last node and block 0.
        if negative > k * MULTIPLIERS + ENDING + COMMON:
            return True, negative, negative - (k * MULTIPLIERS + ENDING + COMMON)
        subtract_products(upper[body, k], element, INNER, BLOCK, REST, REST_WIDTH, rest)
    end_front(rest, last, left)
    found = eliminate_rows(last, *last.shape, last_upper[body], last_inverse[body], last_order[body])
    if found < 0:
        return False, 0, 0
    if SHARED:
        subtract_products(last_upper[body], last, LAST, LAST, SHARED, SHARED_WIDTH, left)
    # No multiplier of another body reaches into this one.
    negative += found
    return True, negative, max(0, negative - ((steps - 1) * MULTIPLIERS + ENDING + COMMON))


@njit(error_model="numpy", inline="always")
def add_right_hand_side(slopes, k, steps, element):
    """Subtract the gradient by block k, and by the last node, from the column that elimination carries along."""
    for i in range(BLOCK):
        element[i, RIGHT] -= slopes[k * STRIDE + i]
    if k == steps - 1:
        for i in range(NODE):
            element[BLOCK + i, RIGHT] -= slopes[steps * STRIDE + i]


@njit(error_model="numpy")
def weigh(weight, hessian):
    """Multiply the second derivatives by primal unknowns."""
    for j in range(hessian.size):
        if IS_CURVATURE[j]:
            hessian[j] *= weight


@njit(error_model="numpy")
def begin_front(element, rest):
    """Put the first element matrix into what borders a block, where the unknowns of block 0 have their place."""
    for i in range(BORDER):
        for j in range(ROWS + CARRIED):
            element[SIZE + i, j] = element[FIRST[i], j]
        for j in range(ROWS):
            element[j, SIZE + i] = element[j, FIRST[i]]
    for i in range(REST):
        for j in range(REST + CARRIED):
            rest[i, j] = element[BLOCK + i, BLOCK + j]


@njit(error_model="numpy", inline="always")
def move_front(element, rest):
    """Add what borders block k - 1, of which node k is now in block k, to the element matrix of interval k.

    Its rows and columns of node k + 1 and of the shared unknowns, in turn, go to what borders block k. Of `rest`, only
    the upper triangle is in use.
    """
    for i in range(NODE):
        element[i, i] += rest[i, i]
        for j in range(i + 1, NODE):
            element[i, j] += rest[i, j]
            element[j, i] += rest[i, j]
        for j in range(NODE, REST + CARRIED):
            element[i, BLOCK + j] += rest[i, j]
    for i in range(NODE):
        for j in range(REST + CARRIED):
            rest[i, j] = element[BLOCK + i, BLOCK + j]
    for i in range(SHARED):
        for j in range(SHARED + CARRIED):
            rest[LAST + i, LAST + j] += element[TAIL + i, TAIL + j]


@njit(error_model="numpy")
def end_front(rest, last, left):
    """The rows of the last node and of block 0, both triangles; what is left for the shared unknowns."""
    last[:] = 0.0
    for i in range(LAST):
        last[i, i] = rest[i, i]
        for j in range(i + 1, REST + CARRIED):
            last[i, j] = rest[i, j]
            if j < LAST:
                last[j, i] = rest[i, j]
    for i in range(SHARED):
        for j in range(SHARED + CARRIED):
            left[i, j] = rest[LAST + i, LAST + j]
