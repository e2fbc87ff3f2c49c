"""Frontal factorisation of the KKT matrix: assemble interval by interval, eliminate what is complete, count inertia.

The matrix of a body is a sum over intervals of one small symmetric element matrix, as in finite elements. Its rows are
those of block k, which is a node and its interval without what is condensed; of the next node; of block 0 if it stays
to the end; and of the linking variables. One more column is the right-hand side, if it is carried along. Blocks are
eliminated one after the other, with pivoting inside each; that is the sweep of a Riccati recursion. With `backward`,
blocks are counted from the end, and each holds a node and the interval before it: the equations of an interval are then
eliminated with the state at its end, which they determine. With the state at its start, rounding would grow as
dissipative dynamics do backward in time. Block 0 is singular by itself where its node is given, because its equations
are matched by later unknowns: then it is `bordered`, and eliminated with the last node. Linking variables border all
fronts of all bodies; elimination leaves their Schur complement, a dense matrix. The pivots' signs give the inertia of
the whole, by Sylvester's law. Sources: Irons (1970), A frontal solution program for finite element analysis; Haynsworth
(1968), Determination of the inertia of a partitioned Hermitian matrix; Rao, Wright and Rawlings (1998), Application of
interior-point methods to model predictive control, for the Riccati view.

Too many negative pivots show before the end. At a minimum, the rows that are eliminated and the multipliers of all
equations that reach into them make a matrix with one negative eigenvalue for every multiplier; without the multipliers
that are still to come it has at most as many (Cauchy's interlacing theorem).
"""

from numba import njit

from codegen.runtime.kkt.condensation import invert_block, scatter, subtract_schur_complement
from codegen.runtime.kkt.shape import (
    block_size,
    first_condensed,
    interval_of,
    last_size,
    padded,
    row_count,
    tail_of,
    unknown_of,
)
from codegen.runtime.kkt.stages import HAS_STAGES, eliminate_stages
from codegen.runtime.kkt.symmetric import clear, eliminate_once, eliminate_rows, subtract_products
from codegen.runtime.kkt.tables import (
    COMMON,
    COUNTS,
    END_COLUMNS,
    END_PINNED,
    END_ROWS,
    END_SHARED,
    END_TIED,
    ENDING,
    FIRST,
    MULTIPLIERS,
    START_COLUMNS,
    START_PINNED,
    START_ROWS,
    START_SHARED,
    START_TIED,
    count_of,
    place_of,
)


# Sums may be taken in any order, which lets them run in parallel in the processor.
@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def eliminate_body(
    shape, tables, entries, at_start, at_end, gradient, diagonal, steps, upper, inverse, order, inverses, couplings,
    kept, room, element, rest, last,
):  # fmt: skip
    """Run the front over all intervals of a body, then eliminate what remains: the last node and its border.

    `entries` (N, entries of an interval), `at_start` and `at_end` those of the ends, `gradient` and `diagonal`
    (N stride + node,); the factors `upper` (R, width), `inverse` (R, 2), `order` (R,) have R = N block + last rows;
    `inverses` (1 or N, condensed, condensed), `couplings` (N, condensed, width); `kept` and `room` are those of
    `stages`; `element` (rows, width), `rest` (rows - block, ..) and `last` (last + shared, ..) are work space. Return
    whether the matrix is regular, the number of negative pivots, and by how many these are too many: then the
    elimination has stopped.
    """
    block_rows, rows, counts = block_size(shape), row_count(shape), place_of(tables, COUNTS)
    remaining, negative = rows - block_rows, 0
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
            subtract_schur_complement(shape, tables, couplings[k], inverses[number], padded(rows), element)
        if HAS_STAGES and shape.stages:
            found = eliminate_stages(shape, tables, entries[k], gradient, diagonal, k, kept, room, element)
            if found < 0:
                return False, 0, 0
            negative += found
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
        move_front(shape, element, rest)
        found = eliminate_rows(
            element, shape.inner, padded(rows), upper[first:behind], inverse[first:behind], order[first:behind]
        )
        if found < 0:
            return False, 0, 0
        negative += found
        # Blocks 0 to k + 1 have as many multipliers left as the last node and one block.
        if negative > block * multipliers + ending:
            return True, negative, negative - (block * multipliers + ending)
        subtract_products(upper[first:behind], element, shape.inner, block_rows, remaining, padded(remaining), rest)
    end_front(shape, rest, remaining, last)
    first, size = steps * block_rows, last_size(shape)
    found = eliminate_once(last, size, last.shape[1], upper[first:], inverse[first:], order[first:])
    if found < 0:
        return False, 0, 0
    # No multiplier of another body reaches into this one.
    negative += found
    return True, negative, negative - ((steps - 1) * multipliers + ending)


@njit(error_model="numpy")
def apply_boundary_conditions(shape, tables, at_start, at_end, k, steps, diagonal, element):
    """Add the ends' own second derivatives to the first or last `element` (rows, width), and pin what is given.

    Rows and columns of unknowns that a boundary condition gives become those of the unit matrix.
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
    """Add entries of an end's Hessian to an element matrix, mirrored."""
    rows, columns = place_of(tables, of_rows), place_of(tables, of_columns)
    for j in range(count_of(tables, of_rows)):
        row, column = tables[rows + j], tables[columns + j]
        element[row, column] += entries[j]
        if row != column:
            element[column, row] += entries[j]


@njit(error_model="numpy")
def add_tied_rows(tables, of_tied, of_shared, first, tail, element):
    """Add rows and columns of unknowns that equal linking variables to those of the latter, which begin at `tail`."""
    tied, shared = place_of(tables, of_tied), place_of(tables, of_shared)
    for i in range(count_of(tables, of_tied)):
        index, to = first + tables[tied + i], tail + tables[shared + i]
        for j in range(element.shape[1]):
            element[to, j] += element[index, j]
        for j in range(element.shape[0]):
            element[j, to] += element[j, index]


@njit(error_model="numpy")
def pin(shape, tables, of_pinned, first, element):
    """Make rows and columns of an element matrix those of the unit matrix, and their right-hand sides zero."""
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
    """Put the first `element` (rows, width) into `rest`, where block 0 has its place."""
    block, rows, first = block_size(shape), row_count(shape), place_of(tables, FIRST)
    size = block + shape.node
    for i in range(shape.border):
        index = tables[first + i]
        for j in range(rows + shape.carried):
            element[size + i, j] = element[index, j]
        for j in range(rows):
            element[j, size + i] = element[j, index]
    for i in range(rows - block):
        for j in range(rows - block + shape.carried):
            rest[i, j] = element[block + i, block + j]


@njit(error_model="numpy", forceinline=True)
def move_front(shape, element, rest):
    """Add what borders block k - 1, of which the node is now in block k, to the element matrix of the interval.

    Rows and columns of the next node and of the linking variables, in turn, go to what borders block k: `rest`, of
    which only the upper triangle is in use. `element` is (rows, width).
    """
    block, tail, last, remaining = block_size(shape), tail_of(shape), last_size(shape), row_count(shape)
    remaining -= block
    for i in range(shape.node):
        element[i, i] += rest[i, i]
        for j in range(i + 1, shape.node):
            element[i, j] += rest[i, j]
            element[j, i] += rest[i, j]
        for j in range(shape.node, remaining + shape.carried):
            element[i, block + j] += rest[i, j]
    for i in range(shape.node):
        for j in range(0, padded(remaining), 4):
            one, two = element[block + i, block + j], element[block + i, block + j + 1]
            three, four = element[block + i, block + j + 2], element[block + i, block + j + 3]
            rest[i, j] = one
            rest[i, j + 1] = two
            rest[i, j + 2] = three
            rest[i, j + 3] = four
    for i in range(shape.shared):
        for j in range(shape.shared + shape.carried):
            rest[last + i, last + j] += element[tail + i, tail + j]


@njit(error_model="numpy")
def end_front(shape, rest, remaining, last):
    """Fill `last` (last + shared, ..): last node and block 0 if it stays, both triangles; then linking variables."""
    clear(last)
    for i in range(remaining):
        last[i, i] = rest[i, i]
        for j in range(i + 1, remaining + shape.carried):
            last[i, j] = rest[i, j]
            if j < last_size(shape):
                last[j, i] = rest[i, j]
