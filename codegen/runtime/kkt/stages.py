"""Elimination of the stages of an interval, through the Jacobian of the equations that determine the stages.

Let s be the stages, m the multipliers of their equations, and y all other unknowns. A and B are the Jacobians of the
stage equations with respect to s and y. A Newton step satisfies

    H_yy dy + H_ys ds + B' dm = -g_y,    H_sy dy + H_ss ds + A' dm = -g_s,    B dy + A ds = -r.

A is square and regular: ds = S dy + s0 with S = -inverse(A) B and s0 = -inverse(A) r. The remaining equations are

    (H_yy + H_ys S + S' H_sy + S' H_ss S) dy = -(g_y + H_ys s0 + S' (g_s + H_ss s0)).

Stages and multipliers have as many negative as positive eigenvalues, and need no search for pivots. A is factored with
row exchanges: P A = L U. In feasibility restoration the multipliers have entries on the diagonal of the KKT matrix.
Then, and if A is singular, stages and multipliers are eliminated as a dense symmetric matrix. A search has no stages of
explicit schemes, see `search.shooting`.

The tuple `kept` holds the factors of the N intervals of a body; s is the number of stages.

- entries (N, entries + s): entries of the Hessian of an interval in the order of the table STAGED, then the diagonals
  of stages.
- reduced (N, s, reach): S. Its width is a multiple of four. The table REACH lists the rows of an element matrix that
  belong to its columns.
- offsets (N, s): s0.
- lower, upper (N, s, padded s): L and U.
- dense (N, 2 s, width), pivots (N, 2 s, 2): factors and inverse pivots of dense matrices.
- orders (N, 2 s + 1), integers: the order of pivots or rows. The last number is 1 if A was solved, and 0 if the dense
  matrix was eliminated.

The tuple `room` holds work space: weighted (s, reach), products (reach, reach), crossed (rows, reach) for the rows of
the table CROSSED, the dense matrix (2 s, width), and a vector (width,).

Functions for one interval take its rows of these arrays; `own` is its row of `entries`. The argument `first` is the
index of the first stage of the interval in the vector of unknowns of a body. `gradient` and `diagonal`
(N stride + node,) belong to a body.
"""

import numpy as np
from numba import carray, njit

from codegen.runtime.addresses import ahead
from codegen.runtime.kkt.shape import (
    CROSS_COLUMNS,
    CROSS_ROWS,
    CROSSED,
    CURVED_COLUMNS,
    CURVED_ROWS,
    OUTER_COLUMNS,
    OUTER_ROWS,
    REACH,
    SLOPE_COLUMNS,
    SLOPE_ROWS,
    STAGED,
    block_size,
    count_of,
    padded,
    place_of,
    row_count,
    tail_of,
)
from codegen.runtime.kkt.symmetric import (
    backward_once,
    clear,
    eliminate_once,
    forward_once,
    subtract_products,
    subtract_row,
)

HAS_STAGES = True
"""False in a system without stages, whose source has none of these functions."""
NEGLIGIBLE = 1e-6
"""Bound below which diagonals of multipliers are ignored: the stage equations are regular without them."""
SINGULAR_PIVOT = 1e-13  # least pivot of A, relative to its largest entry


@njit(error_model="numpy")
def dense_width(shape):
    """Return the number of columns of the dense matrix of stages and multipliers, with padding."""
    return padded(2 * shape.stages + padded(row_count(shape)))


@njit(error_model="numpy")
def stage_views(shape, tables, reals, integers, bodies, body, steps):
    """Return the tuple `kept` of a body and the tuple `room`, as views of storage.

    The storage begins at the pointers `reals` and `integers`.
    """
    stages, reach, width = shape.stages, shape.reach, dense_width(shape)
    copied = count_of(tables, STAGED) + stages
    of_body = steps * (copied + stages * (1 + reach) + 2 * stages * padded(stages) + 2 * stages * (width + 2))
    at_entries = body * of_body
    at_reduced = at_entries + steps * copied
    at_offsets = at_reduced + steps * stages * reach
    at_lower = at_offsets + steps * stages
    at_upper = at_lower + steps * stages * padded(stages)
    at_dense = at_upper + steps * stages * padded(stages)
    at_pivots = at_dense + steps * 2 * stages * width
    kept = (
        carray(ahead(reals, at_entries), (steps, copied)),
        carray(ahead(reals, at_reduced), (steps, stages, reach)),
        carray(ahead(reals, at_offsets), (steps, stages)),
        carray(ahead(reals, at_lower), (steps, stages, padded(stages))),
        carray(ahead(reals, at_upper), (steps, stages, padded(stages))),
        carray(ahead(reals, at_dense), (steps, 2 * stages, width)),
        carray(ahead(reals, at_pivots), (steps, 2 * stages, 2)),
        carray(ahead(integers, body * steps * (2 * stages + 1)), (steps, 2 * stages + 1)),
    )
    at_weighted = bodies * of_body
    at_products = at_weighted + stages * reach
    at_crossed = at_products + reach * reach
    at_matrix = at_crossed + row_count(shape) * reach
    at_values = at_matrix + 2 * stages * width
    room = (
        carray(ahead(reals, at_weighted), (stages, reach)),
        carray(ahead(reals, at_products), (reach, reach)),
        carray(ahead(reals, at_crossed), (row_count(shape), reach)),
        carray(ahead(reals, at_matrix), (2 * stages, width)),
        carray(ahead(reals, at_values), (width,)),
    )
    return kept, room


def stage_sizes(shape, copied, bodies, steps):
    """Return how many floating-point numbers and how many integers `stage_views` needs.

    `copied` is the number of entries of an interval in the table STAGED.
    """

    def fours(size):
        return -(-size // 4) * 4

    stages, reach = shape.stages, shape.reach
    rows = shape.stride - shape.condensed - 2 * stages + shape.node + shape.shared
    width = fours(2 * stages + fours(rows))
    of_interval = copied + stages * (2 + reach) + 2 * stages * fours(stages) + 2 * stages * (width + 2)
    room = reach * (stages + reach + rows) + 2 * stages * width + width
    return bodies * steps * of_interval + room, bodies * steps * (2 * stages + 1)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def eliminate_stages(shape, tables, hessian, gradient, diagonal, k, kept, room, element):
    """Eliminate the stages of interval k from its `element` matrix (rows, width); return the number of negative pivots.

    The result is -1 if the matrix of stages and multipliers is singular. `hessian` (entries,) belongs to the interval.
    If the element matrix has a column for the right-hand side, that column is reduced as well.
    """
    entries, reduced, offsets, lower, upper, dense, pivots, orders = kept
    stages, staged, count = shape.stages, place_of(tables, STAGED), count_of(tables, STAGED)
    first, own, order = k * shape.stride + shape.node, entries[k], orders[k]
    for j in range(count):
        own[j] = hessian[np.uint64(tables[staged + j])]
    largest = 0.0
    for i in range(stages):
        own[count + i] = diagonal[first + i]
        largest = max(largest, abs(diagonal[first + stages + i]))
    is_solved = largest <= NEGLIGIBLE
    if is_solved:
        is_solved = solve_by_factors(shape, tables, own, lower[k], upper[k], order, reduced[k])
    order[2 * stages] = is_solved
    if not is_solved:
        return eliminate_dense(shape, tables, own, gradient, diagonal, first, dense[k], pivots[k], order, room, element)
    add_reduced(shape, tables, own, reduced[k], room, element)
    if shape.carried:
        solve_offsets(shape, tables, own, gradient, first, lower[k], upper[k], order, offsets[k])
        rows = row_count(shape)
        totals = room[1][0]
        reduce_forcing(shape, tables, own, gradient, first, offsets[k], reduced[k], room, totals)
        places = place_of(tables, REACH)
        for c in range(count_of(tables, REACH)):
            element[tables[places + c], rows] -= totals[c]
        at, of_rows, columns = crossings(tables)
        for j in range(count_of(tables, CROSS_ROWS)):
            row = tables[place_of(tables, CROSSED) + tables[of_rows + j]]
            element[row, rows] -= own[at + j] * offsets[k, tables[columns + j]]
    return stages


@njit(error_model="numpy", forceinline=True)
def crossings(tables):
    """Return the index of the first entry of H_ys in `own`, and where the tables CROSS_ROWS and CROSS_COLUMNS begin.

    H_ys are the second derivatives with respect to another unknown and a stage.
    """
    before = count_of(tables, SLOPE_ROWS) + count_of(tables, OUTER_ROWS) + count_of(tables, CURVED_ROWS)
    return before, place_of(tables, CROSS_ROWS), place_of(tables, CROSS_COLUMNS)


@njit(error_model="numpy", forceinline=True)
def put_outer(tables, own, reduced):
    """Fill `reduced` (s, reach) with -B, minus the Jacobian of the stage equations with respect to other unknowns."""
    rows, columns, at = place_of(tables, OUTER_ROWS), place_of(tables, OUTER_COLUMNS), count_of(tables, SLOPE_ROWS)
    clear(reduced)
    for j in range(count_of(tables, OUTER_ROWS)):
        reduced[np.uint64(tables[rows + j]), np.uint64(tables[columns + j])] = -own[at + j]


@njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
def solve_by_factors(shape, tables, own, lower, upper, order, reduced):
    """Factor the stage Jacobian A, and fill `reduced` with S = -inverse(A) B; return True if A is regular.

    This is Gaussian elimination with row exchanges. `order` takes the row that is exchanged with each row. `lower`
    takes the factors left of the diagonal of L, and `upper` takes U; all other entries are zero.
    """
    stages, width = shape.stages, padded(shape.stages)
    rows, columns = place_of(tables, SLOPE_ROWS), place_of(tables, SLOPE_COLUMNS)
    clear(lower)
    clear(upper)
    put_outer(tables, own, reduced)
    largest = 0.0
    for j in range(count_of(tables, SLOPE_ROWS)):
        upper[np.uint64(tables[rows + j]), np.uint64(tables[columns + j])] = own[j]
        largest = max(largest, abs(own[j]))
    for c in range(stages):
        best, pivot = c, abs(upper[c, c])
        for i in range(c + 1, stages):
            if abs(upper[i, c]) > pivot:
                best, pivot = i, abs(upper[i, c])
        if not SINGULAR_PIVOT * largest < pivot < np.inf:
            return False
        order[c] = best
        if best != c:
            for j in range(width):
                upper[c, j], upper[best, j] = upper[best, j], upper[c, j]
                lower[c, j], lower[best, j] = lower[best, j], lower[c, j]
            for j in range(shape.reach):
                reduced[c, j], reduced[best, j] = reduced[best, j], reduced[c, j]
        reciprocal = 1.0 / upper[c, c]
        for i in range(c + 1, stages):
            factor = upper[i, c] * reciprocal
            if factor != 0.0:
                lower[i, c] = factor
                subtract_row(factor, upper, c, width, upper, i)
                upper[i, c] = 0.0
                subtract_row(factor, reduced, c, shape.reach, reduced, i)
    for c in range(stages - 1, -1, -1):
        for j in range(c + 1, stages):
            if upper[c, j] != 0.0:
                subtract_row(upper[c, j], reduced, j, shape.reach, reduced, c)
        reciprocal = 1.0 / upper[c, c]
        for j in range(shape.reach):
            reduced[c, j] *= reciprocal
    return True


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def add_reduced(shape, tables, own, reduced, room, element):
    """Add the effect of the eliminated stages, H_ys S + S' H_sy + S' H_ss S, to `element` (rows, width)."""
    weighted, products, crossed, _, _ = room
    stages, reach, count = shape.stages, shape.reach, count_of(tables, STAGED)
    for i in range(stages):
        for c in range(reach):
            weighted[i, c] = -own[count + i] * reduced[i, c]
    rows, columns = place_of(tables, CURVED_ROWS), place_of(tables, CURVED_COLUMNS)
    at = count_of(tables, SLOPE_ROWS) + count_of(tables, OUTER_ROWS)
    for j in range(count_of(tables, CURVED_ROWS)):
        row, column = np.uint64(tables[rows + j]), np.uint64(tables[columns + j])
        subtract_row(own[at + j], reduced, column, reach, weighted, row)
        if row != column:
            subtract_row(own[at + j], reduced, row, reach, weighted, column)
    # `weighted` is -H_ss S, and `subtract_products` subtracts: the signs cancel.
    clear(products)
    subtract_products(reduced, weighted, stages, 0, reach, reach, products)
    places, size = place_of(tables, REACH), count_of(tables, REACH)
    for a in range(size):
        row = np.uint64(tables[places + a])
        element[row, row] += products[a, a]
        for b in range(a + 1, size):
            column = np.uint64(tables[places + b])
            element[row, column] += products[a, b]
            element[column, row] += products[a, b]
    at, rows, columns = crossings(tables)
    of_crossed, number = place_of(tables, CROSSED), count_of(tables, CROSSED)
    for i in range(number):
        for c in range(reach):
            crossed[i, c] = 0.0
    for j in range(count_of(tables, CROSS_ROWS)):
        row, column = np.uint64(tables[rows + j]), np.uint64(tables[columns + j])
        subtract_row(-own[at + j], reduced, column, reach, crossed, row)
    for i in range(number):
        row = np.uint64(tables[of_crossed + i])
        for c in range(size):
            column = np.uint64(tables[places + c])
            element[row, column] += crossed[i, c]
            element[column, row] += crossed[i, c]


@njit(error_model="numpy", forceinline=True)
def solve_offsets(shape, tables, own, gradient, first, lower, upper, order, offsets):
    """Fill `offsets` (s,) with the Newton step of the stages, -inverse(A) r, if no other unknown changes.

    A is the Jacobian of the stage equations, in `own`, or in the factors `lower`, `upper` and `order`. The residual r
    is in `gradient` from index `first` + s on.
    """
    stages = shape.stages
    for i in range(stages):
        offsets[i] = -gradient[first + stages + i]
    for c in range(stages):
        best = order[c]
        offsets[c], offsets[best] = offsets[best], offsets[c]
    for i in range(stages):
        value = offsets[i]
        for j in range(i):
            value -= lower[i, j] * offsets[j]
        offsets[i] = value
    for i in range(stages - 1, -1, -1):
        value = offsets[i]
        for j in range(i + 1, stages):
            value -= upper[i, j] * offsets[j]
        offsets[i] = value / upper[i, i]


@njit(error_model="numpy", forceinline=True)
def solve_transposed(shape, tables, own, lower, upper, order, values):
    """Replace `values` (s,) by inverse(A') times `values`, where A is the Jacobian of the stage equations."""
    stages = shape.stages
    for i in range(stages):
        values[i] /= upper[i, i]
        for j in range(i + 1, stages):
            values[j] -= upper[i, j] * values[i]
    for i in range(stages - 1, -1, -1):
        for j in range(i):
            values[j] -= lower[i, j] * values[i]
    for c in range(stages - 1, -1, -1):
        best = order[c]
        values[c], values[best] = values[best], values[c]


@njit(error_model="numpy", forceinline=True)
def fill_forcing(shape, tables, own, gradient, first, moved, values):
    """Fill `values` with g_s + H_ss ds, the gradient with respect to stages after the changes ds = `moved` (s,)."""
    stages, count = shape.stages, count_of(tables, STAGED)
    for i in range(stages):
        values[i] = gradient[first + i] + own[count + i] * moved[i]
    rows, columns = place_of(tables, CURVED_ROWS), place_of(tables, CURVED_COLUMNS)
    at = count_of(tables, SLOPE_ROWS) + count_of(tables, OUTER_ROWS)
    for j in range(count_of(tables, CURVED_ROWS)):
        row, column = np.uint64(tables[rows + j]), np.uint64(tables[columns + j])
        values[row] += own[at + j] * moved[column]
        if row != column:
            values[column] += own[at + j] * moved[row]


@njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
def reduce_forcing(shape, tables, own, gradient, first, offsets, reduced, room, totals):
    """Fill `totals` (reach,) with S' (g_s + H_ss s0), the part of the reduced gradient with H_ss."""
    values = room[4]
    fill_forcing(shape, tables, own, gradient, first, offsets, values)
    for c in range(shape.reach):
        totals[c] = 0.0
    for i in range(shape.stages):
        for c in range(0, shape.reach, 4):
            one, two = totals[c] + reduced[i, c] * values[i], totals[c + 1] + reduced[i, c + 1] * values[i]
            three, four = totals[c + 2] + reduced[i, c + 2] * values[i], totals[c + 3] + reduced[i, c + 3] * values[i]
            totals[c] = one
            totals[c + 1] = two
            totals[c + 2] = three
            totals[c + 3] = four


@njit(error_model="numpy", forceinline=True)
def right_index(shape, row, number, steps):
    """Return the index in the right-hand side of a body that belongs to row `row` of the element matrix of a block.

    The block has the number `number`.
    """
    block = block_size(shape)
    return number * block + row if row < tail_of(shape) else steps * block + shape.node + row - tail_of(shape)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def reduce_right(shape, tables, gradient, k, number, steps, kept, room, right):
    """Subtract the effect of the stages of interval k from `right`, the right-hand side of a body.

    `number` is the number of the block to which the interval belongs.
    """
    entries, reduced, offsets, lower, upper, dense, pivots, orders = kept
    stages, first, own, order = shape.stages, k * shape.stride + shape.node, entries[k], orders[k]
    if not order[2 * stages]:
        values = room[4]
        solve_dense(shape, gradient, first, dense[k], pivots[k], order, values)
        for row in range(row_count(shape)):
            right[right_index(shape, row, number, steps)] += values[2 * stages + row]
        return
    solve_offsets(shape, tables, own, gradient, first, lower[k], upper[k], order, offsets[k])
    totals = room[1][0]
    reduce_forcing(shape, tables, own, gradient, first, offsets[k], reduced[k], room, totals)
    places = place_of(tables, REACH)
    for c in range(count_of(tables, REACH)):
        right[right_index(shape, tables[places + c], number, steps)] -= totals[c]
    at, rows, columns = crossings(tables)
    for j in range(count_of(tables, CROSS_ROWS)):
        row = tables[place_of(tables, CROSSED) + tables[rows + j]]
        right[right_index(shape, row, number, steps)] -= own[at + j] * offsets[k, tables[columns + j]]


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def recover_stages(shape, tables, gradient, k, number, steps, kept, room, solved, step):
    """Fill the entries of `step` (N stride + node,) for the stages and multipliers of interval k.

    `solved` holds the other unknowns of the body in the order of its right-hand side. `number` is the number of the
    block to which the interval belongs.
    """
    entries, reduced, offsets, lower, upper, dense, pivots, orders = kept
    stages, first, own, order = shape.stages, k * shape.stride + shape.node, entries[k], orders[k]
    if not order[2 * stages]:
        values = room[4]
        solve_dense(shape, gradient, first, dense[k], pivots[k], order, values)
        for row in range(row_count(shape)):
            values[2 * stages + row] = solved[right_index(shape, row, number, steps)]
        backward_once(dense[k], order, 2 * stages, dense_width(shape), values)
        for i in range(2 * stages):
            step[first + i] = values[i]
        return
    places, moved, around = place_of(tables, REACH), step[first : first + stages], room[1][0]
    for c in range(shape.reach):
        around[c] = 0.0
    for c in range(count_of(tables, REACH)):
        around[c] = solved[right_index(shape, tables[places + c], number, steps)]
    for i in range(stages):
        one = two = three = four = 0.0
        for c in range(0, shape.reach, 4):
            one += reduced[k, i, c] * around[c]
            two += reduced[k, i, c + 1] * around[c + 1]
            three += reduced[k, i, c + 2] * around[c + 2]
            four += reduced[k, i, c + 3] * around[c + 3]
        moved[i] = offsets[k, i] + ((one + two) + (three + four))
    values = room[4]
    fill_forcing(shape, tables, own, gradient, first, moved, values)
    at, rows, columns = crossings(tables)
    for j in range(count_of(tables, CROSS_ROWS)):
        row = tables[place_of(tables, CROSSED) + tables[rows + j]]
        values[tables[columns + j]] += own[at + j] * solved[right_index(shape, row, number, steps)]
    solve_transposed(shape, tables, own, lower[k], upper[k], order, values)
    for i in range(stages):
        step[first + stages + i] = -values[i]


@njit(error_model="numpy")
def eliminate_dense(shape, tables, own, gradient, diagonal, first, dense, pivots, order, room, element):
    """Eliminate stages and multipliers as a dense symmetric matrix; return the number of negative pivots.

    `element` is reduced as in `eliminate_stages`. The result is -1 if the matrix is singular.
    """
    _, _, _, matrix, _ = room
    stages, size, width, rows = shape.stages, 2 * shape.stages, dense_width(shape), row_count(shape)
    clear(matrix)
    at = 0
    to_rows, to_columns = place_of(tables, SLOPE_ROWS), place_of(tables, SLOPE_COLUMNS)
    for j in range(count_of(tables, SLOPE_ROWS)):
        row, column = stages + tables[to_rows + j], tables[to_columns + j]
        matrix[row, column] = matrix[column, row] = own[at + j]
    at += count_of(tables, SLOPE_ROWS)
    to_rows, to_columns = place_of(tables, OUTER_ROWS), place_of(tables, OUTER_COLUMNS)
    for j in range(count_of(tables, OUTER_ROWS)):
        column = size + tables[place_of(tables, REACH) + tables[to_columns + j]]
        matrix[stages + tables[to_rows + j], column] = own[at + j]
    at += count_of(tables, OUTER_ROWS)
    to_rows, to_columns = place_of(tables, CURVED_ROWS), place_of(tables, CURVED_COLUMNS)
    for j in range(count_of(tables, CURVED_ROWS)):
        row, column = tables[to_rows + j], tables[to_columns + j]
        matrix[row, column] = matrix[column, row] = own[at + j]
    at, to_rows, to_columns = crossings(tables)
    for j in range(count_of(tables, CROSS_ROWS)):
        column = size + tables[place_of(tables, CROSSED) + tables[to_rows + j]]
        matrix[tables[to_columns + j], column] = own[at + j]
    for i in range(size):
        matrix[i, i] += diagonal[first + i]
    negative = eliminate_once(matrix, size, width, dense, pivots, order)
    if negative < 0:
        return -1
    for i in range(rows):
        for j in range(i, rows):
            total = 0.0
            for c in range(size):
                total += dense[c, size + i] * matrix[c, size + j]
            element[i, j] -= total
            if i != j:
                element[j, i] -= total
    if shape.carried:
        values = room[4]
        solve_dense(shape, gradient, first, dense, pivots, order, values)
        for i in range(rows):
            element[i, rows] += values[size + i]
    return negative


@njit(error_model="numpy")
def solve_dense(shape, gradient, first, dense, pivots, order, values):
    """Fill `values` (width,) with the result of a forward substitution with the dense factors.

    The right-hand side is minus the gradient of stages and multipliers. From index 2 s on, the result is the change of
    the right-hand side of an element matrix.
    """
    size = 2 * shape.stages
    for i in range(values.size):
        values[i] = -gradient[first + i] if i < size else 0.0
    forward_once(dense, pivots, order, size, dense_width(shape), values)
