"""Elimination of the unknowns of a body interval by interval, and substitution with the factors.

The matrix of a body is a sum of one small symmetric element matrix for each interval, as in finite elements. The rows
of the element matrix of block k are, in this order:

- block k: a node and its interval, without stages and condensed unknowns;
- the next node;
- the linking variables.

One more column is the right-hand side, if it takes part in the elimination (`carried`). The last columns are the
border: unknowns of block 0, if block 0 is kept. Blocks are eliminated one after the other, with pivoting inside each:
this is the sweep of a Riccati recursion. The Schur complement on the rows after the block is the front; the front is
added to the next element matrix. The signs of the pivots give the inertia of the matrix, by Sylvester's law.

With `backward`, blocks are counted from the end, and each holds a node and the interval before it. The equations of an
interval are then eliminated with the state at its end, which they determine. With the state at its start, rounding
errors would grow as dissipative dynamics do backward in time. If the node of block 0 is prescribed, block 0 is singular
by itself, because its equations determine later unknowns. Then block 0 is `bordered`: its unknowns are a border of the
front until the border is regular, at the latest until the last node is eliminated. The border is tried after 1, 3, 7
and so on blocks. Linking variables border the fronts of all bodies. The elimination leaves their Schur complement, a
dense matrix.

If an equation determines each state at the end of an interval, as in a Runge-Kutta scheme, the states are eliminated
with their equations first, see `eliminate_states`.

Too many negative pivots are detected before the elimination ends. Consider the eliminated rows and the multipliers of
all equations that contain their unknowns. At a minimum, they form a matrix with one negative eigenvalue for every
multiplier. Without the multipliers still to come, the matrix has at most this number of negative eigenvalues (Cauchy's
interlacing theorem).

Unknowns inside an interval are condensed first. Let C be their block in the Hessian of an interval, and B their rows
for all other unknowns. Their elimination leaves K - B' inverse(C) B. C is inverted on each interval, or once if it is
the same on all intervals.

A right-hand side that took part in the elimination needs no forward substitution. Its column in the factors acts in the
backward substitution as one more unknown with the value -1.

Arrays of a body with N intervals: `entries` (N, entries of an interval) holds second derivatives; `gradient` and
`diagonal` are (N stride + node,), and `diagonal` is added to the diagonal of the matrix. The factors `upper`
(R, width), `inverse` (R, 2) and `order` (R + 1,) have R = N block + last rows, see `symmetric`. The last number of
`order` is the number of the last block with a border, 0 if the border is eliminated with the last node. `inverses`
(1 or N, condensed, condensed) holds inverse(C), and `couplings` (N, condensed, width) holds B. `stages` explains the
tuples `kept` and `room`.

Sources: Irons (1970), A frontal solution program for finite element analysis; Haynsworth (1968), Determination of the
inertia of a partitioned Hermitian matrix; Rao, Wright and Rawlings (1998), Application of interior-point methods to
model predictive control, for the Riccati view.
"""

import numpy as np
from numba import njit

from codegen.runtime.kkt.shape import (
    COMMON,
    COUNTS,
    COUPLED,
    COUPLED_COLUMNS,
    COUPLED_ROWS,
    END_COLUMNS,
    END_PINNED,
    END_ROWS,
    END_SHARED,
    END_TIED,
    ENDING,
    FIRST,
    FIRST_PINNED,
    INSIDE,
    INSIDE_COLUMNS,
    INSIDE_ROWS,
    KEPT,
    KEPT_COLUMNS,
    KEPT_ROWS,
    LAST_PINNED,
    MULTIPLIERS,
    START_COLUMNS,
    START_PINNED,
    START_ROWS,
    START_SHARED,
    START_TIED,
    TOUCHED,
    block_size,
    border_of,
    column_count,
    count_of,
    first_condensed,
    interval_of,
    last_size,
    padded,
    place_of,
    row_count,
    tail_of,
    unknown_of,
)
from codegen.runtime.kkt.stages import HAS_STAGES, eliminate_stages, recover_stages, reduce_right
from codegen.runtime.kkt.symmetric import (
    are_determined,
    backward_once,
    clear,
    eliminate_once,
    eliminate_rows,
    eliminate_states,
    forward_once,
    solve_backward,
    solve_forward,
    solve_pivots,
    subtract_products,
    subtract_row,
    subtract_two_rows,
)

REACHED = 1e4
"""Largest entry of the factors of the border with which it is eliminated before the last node."""


@njit(error_model="numpy", forceinline=True)
def scatter(shape, tables, hessian, k, element, couplings):
    """Write the second derivatives `hessian` (entries,) of interval k into `element` and `couplings`.

    `element` (rows, width) takes the entries without condensed unknowns, `couplings` the entries with one condensed
    unknown.
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
    """Fill `block` (condensed, condensed) with inverse(C) of interval k; return False if C is not positive definite.

    `hessian` (entries,) belongs to the interval. `diagonal` is added to the diagonal of C.
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
    """Subtract B' inverse(C) B from `element` (rows, width).

    `coupling` (condensed, width) is B, and `inverse` is inverse(C).
    """
    touched = place_of(tables, TOUCHED)
    for j in range(count_of(tables, TOUCHED)):
        i = np.uint64(tables[touched + j])
        for a in range(0, shape.condensed - 1, 2):
            weighted = other = 0.0
            for b in range(shape.condensed):
                weighted += inverse[a, b] * coupling[b, i]
                other += inverse[a + 1, b] * coupling[b, i]
            subtract_two_rows(weighted, a, other, a + 1, coupling, width, element, i)
        if shape.condensed % 2:
            weighted, a = 0.0, shape.condensed - 1
            for b in range(shape.condensed):
                weighted += inverse[a, b] * coupling[b, i]
            subtract_row(weighted, coupling, a, width, element, i)


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def condense(shape, tables, gradient, inverses, couplings, kept, room, steps, right):
    """Fill `right` (N block + node + shared,) with -(g - B' inverse(C) g_u), and subtract the effect of the stages.

    Here g_u is the gradient with respect to the condensed unknowns. `right` is the right-hand side of a body: all
    blocks, the last node, and the linking variables.
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
    """Fill `step` (N stride + node,) from the solution `solved` of the condensed equations of a body.

    The condensed unknowns are -inverse(C) (g_u + B d), where d are the other unknowns. `solved` has the order of
    `right` in `condense`. The module `stages` computes the stages.
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


# Sums may be taken in any order ("reassoc"), so that the processor computes several numbers at once.
@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def eliminate_body(
    shape, tables, entries, at_start, at_end, gradient, diagonal, steps, upper, inverse, order, inverses, couplings,
    kept, room, element, rest, last,
):  # fmt: skip
    """Eliminate all blocks of a body one after the other, then the last node and its border.

    `at_start` and `at_end` are the entries of the Hessians of the start and the end. `element` (rows, width), `rest`
    (rows - block, ..) for the front, and `last` (last + shared, ..) are work space. Return three results: True if the
    matrix is regular, the number of negative pivots, and its excess over the number at a minimum. A positive excess
    stops the elimination.
    """
    block_rows, rows, counts = block_size(shape), row_count(shape), place_of(tables, COUNTS)
    negative, last_bordered = 0, 0
    clear(rest)
    multipliers, ending = tables[counts + MULTIPLIERS], tables[counts + ENDING] + tables[counts + COMMON]
    for block in range(steps):
        k, first, behind = interval_of(shape, block, steps), block * block_rows, (block + 1) * block_rows
        clear(element)
        scatter(shape, tables, entries[k], k, element, couplings)
        if shape.condensed:
            number = min(k, inverses.shape[0] - 1)
            if inverses.shape[0] > 1 or block == 0:  # noqa: SIM102
                if not invert_block(shape, tables, entries[k], diagonal, k, inverses[number]):
                    return False, 0, 0
            if shape.carried:
                for a in range(shape.condensed):
                    couplings[k, a, rows] = -gradient[first_condensed(shape, k) + a]
            subtract_schur_complement(shape, tables, couplings[k], inverses[number], padded(border_of(shape)), element)
        if HAS_STAGES and shape.stages:
            pivots = eliminate_stages(shape, tables, entries[k], gradient, diagonal, k, kept, room, element)
            if pivots < 0:
                return False, 0, 0
            negative += pivots
        for i in range(block_rows):
            element[i, i] += diagonal[unknown_of(shape, block, i, steps)]
        if shape.carried:
            for i in range(block_rows):
                element[i, rows] -= gradient[unknown_of(shape, block, i, steps)]
            if block == steps - 1:
                for i in range(shape.node):
                    element[block_rows + i, rows] -= gradient[unknown_of(shape, steps, i, steps)]
        if k == 0 or k == steps - 1:
            apply_boundary_conditions(shape, tables, at_start, at_end, k, steps, diagonal, element)
        if shape.bordered and block == 0:
            begin_front(shape, tables, element, rest)
            continue
        upper_rows, inverse_rows, order_rows = upper[first:behind], inverse[first:behind], order[first:behind]
        if shape.bordered and last_bordered == 0:
            pivots = eliminate_block(
                shape, element, block, column_count(shape), column_count(shape), upper_rows, inverse_rows, order_rows,
                rest,
            )  # fmt: skip
        else:
            pivots = eliminate_block(
                shape, element, block, rows, border_of(shape), upper_rows, inverse_rows, order_rows, rest
            )
        if pivots < 0:
            return False, 0, 0
        negative += pivots
        # The bound: multipliers of blocks 0 to `block`, of the next node, and among the linking variables.
        if negative > block * multipliers + ending:
            return True, negative, negative - (block * multipliers + ending)
        if shape.bordered and last_bordered == 0 and block & (block + 1) == 0:  # after 1, 3, 7, ... blocks
            pivots = eliminate_border(shape, rest, element, upper, inverse, order)
            if pivots >= 0:
                negative, last_bordered = negative + pivots, block
    order[steps * block_rows + last_size(shape)] = last_bordered
    end_front(shape, rest, last_bordered == 0, last)
    first, size = steps * block_rows, last_size(shape)
    pivots = eliminate_once(last, size, last.shape[1], upper[first:], inverse[first:], order[first:])
    if pivots < 0:
        return False, 0, 0
    # The equations of other bodies do not contain unknowns of this body.
    negative += pivots
    return True, negative, negative - ((steps - 1) * multipliers + ending)


@njit(error_model="numpy")
def apply_boundary_conditions(shape, tables, at_start, at_end, k, steps, diagonal, element):
    """Apply the boundary conditions to the first or the last `element` matrix (rows, width).

    The second derivatives of the start or the end are added, and the diagonal of the node that is eliminated last. Rows
    of unknowns that equal linking variables are added to the rows of these variables. Rows and columns of prescribed
    unknowns become rows and columns of the unit matrix.
    """
    block, tail = block_size(shape), tail_of(shape)
    left, right = (block, 0) if shape.backward else (0, block)
    if k == 0:
        add_entries(tables, START_ROWS, START_COLUMNS, at_start, element)
    if k == steps - 1:
        add_entries(tables, END_ROWS, END_COLUMNS, at_end, element)
    if k == interval_of(shape, steps - 1, steps):
        for i in range(shape.node):
            element[block + i, block + i] += diagonal[unknown_of(shape, steps, i, steps)]
    if k == 0:
        add_tied_rows(tables, START_TIED, START_SHARED, left, tail, element)
        pin(shape, tables, START_PINNED, left, element)
    if k == steps - 1:
        add_tied_rows(tables, END_TIED, END_SHARED, right, tail, element)
        pin(shape, tables, END_PINNED, right, element)


@njit(error_model="numpy")
def add_entries(tables, of_rows, of_columns, entries, element):
    """Add the lower-triangle `entries` of the Hessian of the start or the end to `element`, in both triangles."""
    rows, columns = place_of(tables, of_rows), place_of(tables, of_columns)
    for j in range(count_of(tables, of_rows)):
        row, column = tables[rows + j], tables[columns + j]
        element[row, column] += entries[j]
        if row != column:
            element[column, row] += entries[j]


@njit(error_model="numpy")
def add_tied_rows(tables, of_tied, of_shared, first, tail, element):
    """Add rows and columns of unknowns that equal linking variables to the rows and columns of these linking variables.

    Unknowns of the node begin at row `first`, linking variables at row `tail`.
    """
    tied, shared = place_of(tables, of_tied), place_of(tables, of_shared)
    for i in range(count_of(tables, of_tied)):
        index, to = first + tables[tied + i], tail + tables[shared + i]
        for j in range(element.shape[1]):
            element[to, j] += element[index, j]
        for j in range(element.shape[0]):
            element[j, to] += element[j, index]


@njit(error_model="numpy")
def pin(shape, tables, of_pinned, first, element):
    """Replace rows and columns of prescribed unknowns by rows and columns of the unit matrix.

    Their right-hand sides become zero. `of_pinned` is the number of the table of prescribed unknowns. The unknowns of
    the node begin at row `first`.
    """
    pinned = place_of(tables, of_pinned)
    for n in range(count_of(tables, of_pinned)):
        index = first + tables[pinned + n]
        for i in range(element.shape[0]):
            element[index, i] = 0.0
            element[i, index] = 0.0
        element[index, index] = 1.0
        if shape.carried:
            element[index, row_count(shape)] = 0.0


@njit(error_model="numpy")
def begin_front(shape, tables, element, rest):
    """Fill the front `rest` from the `element` matrix of block 0, some rows of which are the border."""
    block, right, first = block_size(shape), row_count(shape), place_of(tables, FIRST)
    count = border_of(shape) - block
    for i in range(right - block):
        for j in range(count):
            rest[i, j] = element[block + i, block + j]
    for j in range(shape.border):
        index = tables[first + j]
        for i in range(count):
            rest[i, count + j] = element[index, block + i]
        for i in range(shape.border):
            rest[count + i, count + j] = element[tables[first + i], index]


@njit(error_model="numpy", forceinline=True)
def move_front(shape, element, width, rest):
    """Add the front of the previous block to the `element` matrix (rows, ..), and start the front of this block.

    The node of the front is now part of the block. The new front `rest` takes the rows and columns of the next node and
    of the linking variables. `width` is the number of columns of the front. Only the upper triangle of `rest` is used.
    """
    block, tail = block_size(shape), tail_of(shape)
    for i in range(shape.node):
        element[i, i] += rest[i, i]
        for j in range(i + 1, shape.node):
            element[i, j] += rest[i, j]
            element[j, i] += rest[i, j]
        for j in range(shape.node, width):
            element[i, block + j] += rest[i, j]
    for i in range(shape.node):
        for j in range(0, padded(width), 4):
            one, two = element[block + i, block + j], element[block + i, block + j + 1]
            three, four = element[block + i, block + j + 2], element[block + i, block + j + 3]
            rest[i, j] = one
            rest[i, j + 1] = two
            rest[i, j + 2] = three
            rest[i, j + 3] = four
    for i in range(shape.shared):
        for j in range(shape.shared + shape.carried):
            rest[shape.node + i, shape.node + j] += element[tail + i, tail + j]


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def eliminate_block(shape, element, block, rows, columns, upper, inverse, order, rest):
    """Add the front to the `element` matrix of a block, eliminate the block, and leave its Schur complement in `rest`.

    Return the number of negative pivots, or -1 if the matrix is singular. Rows and columns from `rows` and `columns` on
    are zero: of the right-hand side and the border if they take no part, and padding.
    """
    first = block_size(shape)
    move_front(shape, element, columns - first, rest)
    # The last node may be prescribed: its equations do not determine it.
    states = shape.states if block > 0 and are_determined(element, shape.states) else 0
    if states:
        eliminate_states(element, shape.states, shape.inner, padded(columns), upper, inverse, order)
    negative = eliminate_rows(element, 2 * states, shape.inner, padded(columns), upper, inverse, order)
    if negative >= 0:
        subtract_products(upper, element, shape.inner, first, rows - first, padded(columns - first), rest)
        negative += states
    return negative


@njit(error_model="numpy")
def eliminate_border(shape, rest, matrix, upper, inverse, order):
    """Eliminate the border from the front `rest`, unless its equations are still nearly singular.

    The conditions at the prescribed node determine the multipliers in the border as soon as the controls of the
    eliminated blocks can reach any state there. Return the number of negative pivots, or -1 if the front is unchanged.
    `matrix` is work space. The factors are stored as in `eliminate_rows`, with the columns of the front last.
    """
    size, count = shape.border, border_of(shape) - block_size(shape)
    width = padded(size + padded(count))
    for i in range(size):
        for j in range(width):
            matrix[i, j] = 0.0
        for j in range(size):
            matrix[i, j] = rest[count + min(i, j), count + max(i, j)]
        for j in range(count):
            matrix[i, size + j] = rest[j, count + i]
    negative = eliminate_once(matrix, size, width, upper, inverse, order)
    if negative < 0:
        return -1
    for i in range(size):
        for j in range(size, size + shape.node + shape.shared):
            if not abs(upper[i, j]) <= REACHED:
                return -1
    for i in range(count):
        for j in range(i, count):
            for c in range(size):
                rest[i, j] -= upper[c, size + i] * matrix[c, size + j]
        for j in range(size):
            rest[i, count + j] = 0.0
    return negative


@njit(error_model="numpy")
def end_front(shape, rest, has_border, last):
    """Fill `last` (last + shared, ..) with the front `rest` that remains after all blocks.

    The order of rows is node, border, linking variables; the right-hand side is the last column. Both triangles are
    filled for node and border, and only the upper triangle for the linking variables. If the border is eliminated
    already, not `has_border`, its rows are those of the unit matrix.
    """
    clear(last)
    node, size, count, end = shape.node, shape.border, border_of(shape) - block_size(shape), last_size(shape)
    for i in range(node):
        for j in range(node):
            last[i, j] = rest[min(i, j), max(i, j)]
    for i in range(node + shape.shared):
        row = i if i < node else i - node + end
        for j in range(max(node, i), count):
            last[row, j - node + end] = rest[i, j]
    for i in range(size):
        if not has_border:
            last[node + i, node + i] = 1.0
            continue
        for j in range(size):
            last[node + i, node + j] = rest[count + min(i, j), count + max(i, j)]
        for j in range(node):
            last[node + i, j] = last[j, node + i] = rest[j, count + i]
        for j in range(node, count):
            last[node + i, j - node + end] = rest[j, count + i]


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def forward(shape, tables, upper, inverse, order, steps, right, front, margin, last):
    """Multiply the right-hand side of a body by inverse(D) inverse(U'), block after block.

    `right` (N block + node + shared,) is overwritten. `last` takes the results for the last node, the border and the
    linking variables. `front` and `margin` (width,) are work space.
    """
    block, tail, of_border = block_size(shape), tail_of(shape), border_of(shape)
    first_of_border, last_bordered = place_of(tables, FIRST), order[steps * block_size(shape) + last_size(shape)]
    for i in range(front.size):
        front[i] = 0.0
    for i in range(last.size):
        last[i] = 0.0
    place = place_of(tables, FIRST_PINNED)
    for i in range(count_of(tables, FIRST_PINNED)):
        right[tables[place + i]] = 0.0
    place = place_of(tables, LAST_PINNED)
    for i in range(count_of(tables, LAST_PINNED)):
        right[steps * block + tables[place + i]] = 0.0
    for k in range(shape.bordered, steps):
        first, behind = k * block, (k + 1) * block
        for i in range(block):
            front[i] = right[first + i]
        for i in range(shape.node):
            front[block + i] = right[behind + i]
        if shape.bordered and (last_bordered == 0 or k <= last_bordered):
            solve_forward(upper[first:behind], order[first:behind], shape.inner, padded(column_count(shape)), front)
        else:
            solve_forward(upper[first:behind], order[first:behind], shape.inner, padded(row_count(shape)), front)
        solve_pivots(inverse[first:behind], order[first:behind], shape.inner, front)
        for i in range(block):
            right[first + i] = front[i]
        for i in range(shape.node):
            right[behind + i] = front[block + i]
        if shape.bordered and k == last_bordered:
            for i in range(margin.size):
                margin[i] = 0.0
            for i in range(shape.border):
                margin[i] = right[tables[first_of_border + i]] + front[of_border + i]
                front[of_border + i] = 0.0
            forward_once(upper, inverse, order, shape.border, padded(shape.border + padded(of_border - block)), margin)
            for i in range(shape.border):
                right[tables[first_of_border + i]] = margin[i]
            for i in range(shape.node):
                right[behind + i] += margin[shape.border + i]
            for i in range(shape.shared):
                front[tail + i] += margin[shape.border + shape.node + i]
    first, end = steps * block, last_size(shape)
    for i in range(shape.node):
        last[i] = right[first + i]
    if shape.bordered and last_bordered == 0:
        for i in range(shape.border):
            last[shape.node + i] = right[tables[first_of_border + i]] + front[of_border + i]
    for i in range(shape.shared):
        last[end + i] = front[tail + i]
    forward_once(upper[first:], inverse[first:], order[first:], end, last.size, last)


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def backward(shape, tables, upper, order, steps, carried, last, front, margin, right):
    """Substitute backward with U through a body, from the last node to the first block.

    At the beginning `last` holds the result of `forward` for the last node and the border, then the solution of the
    linking variables. `right` holds the result of `forward`, or zeros if the right-hand side took part in the
    elimination (`carried`). The solution overwrites `right`.
    """
    block, tail, of_border, first = block_size(shape), tail_of(shape), border_of(shape), steps * block_size(shape)
    first_of_border, last_bordered = place_of(tables, FIRST), order[first + last_size(shape)]
    for i in range(front.size):
        front[i] = 0.0
    if shape.carried:
        front[row_count(shape)] = -1.0 if carried else 0.0
    backward_once(upper[first:], order[first:], last_size(shape), last.size, last)
    for i in range(shape.node):
        right[first + i] = last[i]
    if shape.bordered and last_bordered == 0:
        for i in range(shape.border):
            right[tables[first_of_border + i]] = front[of_border + i] = last[shape.node + i]
    for i in range(shape.shared):
        front[tail + i] = last[last_size(shape) + i]
    for k in range(steps - 1, shape.bordered - 1, -1):
        first, behind = k * block, (k + 1) * block
        if shape.bordered and k == last_bordered:
            for i in range(shape.border):
                margin[i] = right[tables[first_of_border + i]]
            for i in range(margin.size - shape.border):
                margin[shape.border + i] = 0.0
            for i in range(shape.node):
                margin[shape.border + i] = right[behind + i]
            for i in range(shape.shared + shape.carried):
                margin[shape.border + shape.node + i] = front[tail + i]
            backward_once(upper, order, shape.border, padded(shape.border + padded(of_border - block)), margin)
            for i in range(shape.border):
                right[tables[first_of_border + i]] = front[of_border + i] = margin[i]
        for i in range(block):
            front[i] = right[first + i]
        for i in range(shape.node):
            front[block + i] = right[behind + i]
        if shape.bordered and (last_bordered == 0 or k <= last_bordered):
            solve_backward(upper[first:behind], order[first:behind], shape.inner, padded(column_count(shape)), front)
        else:
            solve_backward(upper[first:behind], order[first:behind], shape.inner, padded(border_of(shape)), front)
        for i in range(block):
            right[first + i] = front[i]
