"""Frontal factorisation of the KKT matrix: assemble interval by interval, eliminate what is complete, count inertia.

The matrix of a body is a sum over intervals of one small symmetric element matrix, as in finite elements. Block k
holds the unknowns of node k and of the interval after it; with BACKWARD, blocks are counted from the end, and each
holds those of a node and of the interval before it. Blocks 1, 2, ... are eliminated in this order, with pivoting
inside each; that is the sweep of a Riccati recursion. BACKWARD eliminates the equations of an interval with the state
at its end, which they determine: with that at its start, rounding would grow as dissipative dynamics do backward in
time. Block 0 is singular by itself where its node is given, because its equations are matched by later unknowns: it is
BORDERED then, which means that it borders the front to the end and is eliminated with the last node. Where nothing is
given it is eliminated first, as at the end of a controller's horizon. Shared unknowns border all fronts of all bodies;
what elimination leaves of them is the Schur complement that ties bodies together, a dense matrix. The pivots' signs
give the inertia of the whole, by Sylvester's law. Sources: Irons (1970), A frontal solution program for finite element
analysis; Haynsworth (1968), Determination of the inertia of a partitioned Hermitian matrix; Rao, Wright and Rawlings
(1998), Application of interior-point methods to model predictive control, for the Riccati view.

Too many negative pivots show before the end. At a minimum, the rows that are eliminated and the multipliers of all
equations that reach into them make a matrix with one negative eigenvalue for every multiplier; without the multipliers
that are still to come it has at most as many (Cauchy's interlacing theorem).
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import clear, copy_part, zero_matrix, zero_vector
from codegen.runtime.kkt.element_condensed import add_element, allocate_condensed, prepare_condensed
from codegen.runtime.kkt.elements import (
    BLOCK, BORDER, COLUMNS, FIRST, INNER, IS_CURVATURE, IS_LACKING, LOCAL_IS_MULTIPLIER, RIGHT, ROWS, SIZE, TAIL,
    WIDTH, interval_of, padded, unknown_of,
)  # fmt: skip
from codegen.runtime.kkt.ends_linear import apply_boundary_conditions
from codegen.runtime.stand_ins.example import (
    BODIES, BORDERED, CARRIED, ELEMENT, HESSIAN_COLUMNS, HESSIAN_ROWS, IS_MULTIPLIER, NODE, ROOT, SCALED, SHARED,
    STRIDE, interval_hessian,
)  # fmt: skip
from codegen.runtime.unknowns.shared import root_index
from codegen.runtime.kkt.symmetric import eliminate_rows, subtract_products
from codegen.runtime.unknowns.times import span

REST = ROWS - BLOCK  # rows of what borders a block: node k + 1, block 0 if it stays, shared unknowns
REST_WIDTH = padded(REST)
LAST = NODE + BORDER  # unknowns that are eliminated as the last node is
LAST_WIDTH = padded(LAST + padded(CARRIED + SHARED))
MULTIPLIERS = np.count_nonzero(IS_MULTIPLIER)  # in a block
ENDING = np.count_nonzero(IS_MULTIPLIER[:NODE]) + MULTIPLIERS  # in the last node and in another block
COMMON = np.count_nonzero(LOCAL_IS_MULTIPLIER[STRIDE + NODE :])  # among the shared unknowns


def allocate_factors(grid):
    """Room for the factors of all bodies, and for what is condensed.

    A body has R rows: BLOCK for each block, then LAST for its last node, and for block 0 if it stays to the end. Three
    arrays hold the rows of the upper factor (BODIES, R, WIDTH), the inverse of the pivots (BODIES, R, 2), and the order
    of elimination (BODIES, R). The right-hand side, if it was carried along, is a column of the upper factor,
    multiplied by the inverse of the pivots already. Indices and the inverse of the pivots are zeros, so that solving
    without factors, as compilation does, stays inside the arrays. `inverses` and `couplings` are those of
    `allocate_condensed`.
    """
    rows = grid.steps * BLOCK + LAST
    upper, inverse = np.empty((BODIES, rows, WIDTH)), np.zeros((BODIES, rows, 2))
    return upper, inverse, np.zeros((BODIES, rows), np.uint64), *allocate_condensed(grid)


# Sums may be taken in any order, which lets them run in parallel in the processor.
@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def eliminate_body(
    unknowns, gradient, diagonal, steps, h, nodes, parameters, weight, parts, upper, inverse, order, inverses,
    couplings, last,
):  # fmt: skip
    """Run the front over all intervals of a body, then eliminate what is left: `last`, its last node and its border.

    `unknowns`, `gradient`, `diagonal` (N STRIDE + NODE,), `parameters` (P + SHARED,), `parts` (ELEMENT + SHARED,) and
    the factors `upper` (R, WIDTH), `inverse` (R, 2), `order` (R,), `inverses`, `couplings` are those of the body, as in
    `allocate_factors`; `nodes` (N + 1,), `last` (LAST + SHARED, LAST_WIDTH). Returns whether that was possible, the
    number of negative pivots, and by how many they are too many: when there are, the elimination has stopped.
    """
    if not prepare_condensed(h, nodes, parameters, weight, parts, diagonal, inverses):
        return False, 0, 0
    negative, hessian, factors = 0, zero_vector(HESSIAN_ROWS.size), zero_vector(HESSIAN_ROWS.size)
    is_weighted = fill_factors(weight, parts, factors)
    local, element, rest = zero_vector(ELEMENT), zero_matrix(ROWS, WIDTH), zero_matrix(REST, REST_WIDTH)
    for block in range(steps):
        k, first, behind = interval_of(block, steps), block * BLOCK, (block + 1) * BLOCK
        copy_part(unknowns, k * STRIDE, local)
        t, length = span(nodes, k, h)
        interval_hessian(local, t, length, parameters, hessian)
        if is_weighted:
            for j in range(hessian.size):
                hessian[j] *= factors[j]
        clear(element)
        if not add_element(hessian, diagonal, gradient, inverses, couplings, k, element):
            return False, 0, 0
        for i in range(BLOCK):
            element[i, i] += diagonal[unknown_of(block, i, steps)]
        if CARRIED:
            add_right_hand_side(gradient, block, steps, element)
        if k == 0 or k == steps - 1:
            apply_boundary_conditions(unknowns, k, steps, h, parameters, weight, parts, diagonal, element)
        if BORDERED:  # noqa: SIM102  decided when a module is made
            if block == 0:
                begin_front(element, rest)
                continue
        move_front(element, rest)
        found = eliminate_rows(element, INNER, COLUMNS, upper[first:behind], inverse[first:behind], order[first:behind])
        if found < 0:
            return False, 0, 0
        negative += found
        # What is left of blocks 0 to k + 1 has as many multipliers as the last node and one block.
        if negative > block * MULTIPLIERS + ENDING + COMMON:
            return True, negative, negative - (block * MULTIPLIERS + ENDING + COMMON)
        subtract_products(upper[first:behind], element, INNER, BLOCK, REST, REST_WIDTH, rest)
    end_front(rest, last)
    first = steps * BLOCK
    found = eliminate_rows(last, order.size - first, last.shape[1], upper[first:], inverse[first:], order[first:])
    if found < 0:
        return False, 0, 0
    # No multiplier of another body reaches into this one.
    negative += found
    return True, negative, negative - ((steps - 1) * MULTIPLIERS + ENDING + COMMON)


if CARRIED:

    @njit(error_model="numpy", inline="always")
    def add_right_hand_side(slopes, block, steps, element):
        """Subtract `slopes` (N STRIDE + NODE,) by a block, and by the node after all, from the column carried along."""
        for i in range(BLOCK):
            element[i, RIGHT] -= slopes[unknown_of(block, i, steps)]
        if block == steps - 1:
            for i in range(NODE):
                element[BLOCK + i, RIGHT] -= slopes[unknown_of(steps, i, steps)]


@njit(error_model="numpy")
def fill_parts(sizes, forces, parts):
    """Fill the sizes (ELEMENT + SHARED,) of an element's unknowns, by which derivatives are multiplied.

    The same on all intervals, they include the root of the cost's weight, and are ones where nothing is scaled:
    `sizes` and `forces` are (n,), or empty.
    """
    for i in range(parts.size):
        parts[i] = 1.0
    if SCALED and sizes.size:
        for i in range(ELEMENT):
            parts[i] = np.sqrt(sizes[i] * forces[i])
        for i in range(SHARED):
            index = sizes.size - ROOT + root_index(0, i)
            parts[ELEMENT + i] = np.sqrt(sizes[index] * forces[index])


@njit(error_model="numpy")
def fill_factors(weight, parts, factors):
    """Fill what an interval's `hessian` is multiplied by, entry by entry; return whether that makes a difference.

    It is the sizes of both unknowns, and the weight where both are primal. The one for a multiplier that there is not
    stays one: a shift of the multipliers' diagonal would turn a smaller one's sign, and so be counted as an equation.
    """
    is_weighted = False
    for j in range(factors.size):
        factors[j] = 1.0 if IS_LACKING[j] else parts[HESSIAN_ROWS[j]] * parts[HESSIAN_COLUMNS[j]]
        if IS_CURVATURE[j]:
            factors[j] *= weight
        is_weighted = is_weighted or factors[j] != 1.0
    return is_weighted


if BORDERED:

    @njit(error_model="numpy")
    def begin_front(element, rest):
        """Put the first `element` (ROWS, WIDTH) into `rest` (REST, REST_WIDTH), where block 0 has its place."""
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

    Its rows and columns of node k + 1 and of the shared unknowns, in turn, go to what borders block k: `rest` (REST,
    REST_WIDTH), of which only the upper triangle is in use. `element` is (ROWS, WIDTH).
    """
    for i in range(NODE):
        element[i, i] += rest[i, i]
        for j in range(i + 1, NODE):
            element[i, j] += rest[i, j]
            element[j, i] += rest[i, j]
        for j in range(NODE, REST + CARRIED):
            element[i, BLOCK + j] += rest[i, j]
    for i in range(NODE):
        for j in range(0, REST_WIDTH, 4):
            one, two = element[BLOCK + i, BLOCK + j], element[BLOCK + i, BLOCK + j + 1]
            three, four = element[BLOCK + i, BLOCK + j + 2], element[BLOCK + i, BLOCK + j + 3]
            rest[i, j] = one
            rest[i, j + 1] = two
            rest[i, j + 2] = three
            rest[i, j + 3] = four
    for i in range(SHARED):
        for j in range(SHARED + CARRIED):
            rest[LAST + i, LAST + j] += element[TAIL + i, TAIL + j]


@njit(error_model="numpy")
def end_front(rest, last):
    """Fill `last` (LAST + SHARED, LAST_WIDTH): last node and block 0 if it stays, both triangles; then shared."""
    clear(last)
    for i in range(REST):
        last[i, i] = rest[i, i]
        for j in range(i + 1, REST + CARRIED):
            last[i, j] = rest[i, j]
            if j < LAST:
                last[j, i] = rest[i, j]
