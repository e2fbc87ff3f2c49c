"""Solve with the factors of the KKT matrix for many right-hand sides at once, eight beside each other.

What `substitution` does for one right-hand side waits for one product after the other; eight take twice to three times
as long as one, and read the factors once. The numbers of a row, one for each right-hand side, are its lanes: they lie
side by side, and are computed four at a time, which a compiler turns into one instruction each (`packed_operations`).
"""

from numba import njit

from codegen.runtime.arrays import zero_matrix
from codegen.runtime.kkt.elements import (
    BLOCK, BORDER, FIRST, FIRST_BLOCK, FIRST_PINNED, INNER, LAST_PINNED, ROWS, SIZE, TAIL, interval_of, unknown_of,
)  # fmt: skip
from codegen.runtime.kkt.frontal import LAST
from codegen.runtime.stand_ins.example import (
    BACKWARD, BODIES, BORDERED, CONDENSED, END_SHARED, END_TIED, NODE, ROOT, SHARED, START_SHARED, START_TIED, STRIDE,
    TIED,
)  # fmt: skip
from codegen.runtime.unknowns.shared import root_index

LANES = 8


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def substitute_all(gradients, steps, factors, solutions):
    """Fill `solutions` (m, n) with Newton steps for `gradients` (m, n), where m is a multiple of LANES.

    The `factors` are those that `factor_kkt` has left.
    """
    upper, inverse, order, inverses, couplings = factors[:5]
    chain, rows = steps * STRIDE + NODE, steps * BLOCK + NODE
    right, last = zero_matrix(BODIES * (rows + SHARED), LANES), zero_matrix(BODIES * (LAST + SHARED), LANES)
    shared, (start, end) = zero_matrix(ROOT, LANES), (steps * BLOCK, 0) if BACKWARD else (0, steps * BLOCK)
    if ROOT:
        root_upper, root_inverse, root_order, _ = factors[5:]
    for lane in range(0, len(gradients), LANES):
        slopes, found = gradients[lane : lane + LANES], solutions[lane : lane + LANES]
        if ROOT:
            for i in range(ROOT):
                for d in range(LANES):
                    shared[i, d] = -slopes[d, slopes.shape[1] - ROOT + i]
        for body in range(BODIES):
            own, ending = right[body * (rows + SHARED) :], last[body * (LAST + SHARED) :]
            condense_all(slopes, body * chain, inverses[body], couplings[body], steps, own)
            if TIED:
                for i in range(START_SHARED.size):
                    add_row(own, start + START_TIED[i], 1.0, shared, root_index(body, START_SHARED[i]))
                for i in range(END_SHARED.size):
                    add_row(own, end + END_TIED[i], 1.0, shared, root_index(body, END_SHARED[i]))
            forward_all(upper[body], inverse[body], order[body], steps, own, ending)
            for i in range(SHARED):
                add_row(own, rows + i, 1.0, shared, root_index(body, i))
                add_row(ending, LAST + i, 1.0, shared, root_index(body, i))
        if ROOT:
            eliminate_all(root_upper, root_order, 0, ROOT, ROOT, shared)
            divide_by_pivots(root_inverse, root_order, 0, ROOT, shared)
            resolve_all(root_upper, root_order, 0, ROOT, ROOT, shared)
            for i in range(ROOT):
                for d in range(LANES):
                    found[d, found.shape[1] - ROOT + i] = shared[i, d]
        for body in range(BODIES):
            own, ending = right[body * (rows + SHARED) :], last[body * (LAST + SHARED) :]
            for i in range(SHARED):
                copy_row(shared, root_index(body, i), ending, LAST + i)
                copy_row(shared, root_index(body, i), own, rows + i)
            backward_all(upper[body], order[body], steps, ending, own)
            if TIED:
                for i in range(START_SHARED.size):
                    copy_row(shared, root_index(body, START_SHARED[i]), own, start + START_TIED[i])
                for i in range(END_SHARED.size):
                    copy_row(shared, root_index(body, END_SHARED[i]), own, end + END_TIED[i])
            recover_all(slopes, body * chain, inverses[body], couplings[body], steps, own, found)


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def add_row(source, p, factor, target, i):
    """Add a multiple of row p of `source` (.., LANES) to row i of `target` (.., LANES), another or the same."""
    for d in range(0, LANES, 4):
        one, two = target[i, d] + factor * source[p, d], target[i, d + 1] + factor * source[p, d + 1]
        three, four = target[i, d + 2] + factor * source[p, d + 2], target[i, d + 3] + factor * source[p, d + 3]
        target[i, d] = one
        target[i, d + 1] = two
        target[i, d + 2] = three
        target[i, d + 3] = four


@njit(error_model="numpy", forceinline=True)
def copy_row(source, p, target, i):
    """Copy row p of `source` (.., LANES) to row i of `target` (.., LANES)."""
    for d in range(LANES):
        target[i, d] = source[p, d]


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def eliminate_all(upper, order, first, count, width, values):
    """As `solve_forward` with the rows of the factor from `first` on; `values` (width, LANES)."""
    for c in range(count):
        p = order[first + c]
        for j in range(width):
            add_row(values, p, -upper[first + p, j], values, j)


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def divide_by_pivots(inverse, order, first, count, values):
    """As `solve_pivots`."""
    paired = False
    for c in range(count):
        if paired:  # with the row before it
            paired = False
            continue
        p, own, beside = order[first + c], inverse[first + c, 0], inverse[first + c, 1]
        paired = beside != 0.0
        if paired:
            q, other = order[first + c + 1], inverse[first + c + 1, 0]
            for d in range(LANES):
                values[p, d], values[q, d] = (
                    own * values[p, d] + beside * values[q, d],
                    beside * values[p, d] + other * values[q, d],
                )
        else:
            for d in range(LANES):
                values[p, d] *= own


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def resolve_all(upper, order, first, count, width, values):
    """As `solve_backward`."""
    for p in range(count):
        for j in range(count, width):
            add_row(values, j, -upper[first + p, j], values, p)
    for c in range(count - 2, -1, -1):
        p = order[first + c]
        for k in range(count - 1, c, -1):
            add_row(values, order[first + k], -upper[first + p, order[first + k]], values, p)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def forward_all(upper, inverse, order, steps, right, last):
    """As `forward`; `right` (N BLOCK + NODE + SHARED, LANES), `last` (LAST + SHARED, LANES)."""
    front = zero_matrix(ROWS, LANES)
    for d in range(LANES):
        for i in FIRST_PINNED:
            right[i, d] = 0.0
        for i in LAST_PINNED:
            right[steps * BLOCK + i, d] = 0.0
    for k in range(FIRST_BLOCK, steps):
        first = k * BLOCK
        for i in range(SIZE):
            copy_row(right, first + i, front, i)
        eliminate_all(upper, order, first, INNER, ROWS, front)
        divide_by_pivots(inverse, order, first, INNER, front)
        for i in range(SIZE):
            copy_row(front, i, right, first + i)
    first = steps * BLOCK
    for i in range(NODE):
        copy_row(right, first + i, last, i)
    if BORDERED:
        for i in range(BORDER):
            copy_row(right, FIRST[i], last, NODE + i)
            add_row(front, SIZE + i, 1.0, last, NODE + i)
    for i in range(SHARED):
        copy_row(front, TAIL + i, last, LAST + i)
    eliminate_all(upper, order, first, LAST, LAST + SHARED, last)
    divide_by_pivots(inverse, order, first, LAST, last)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def backward_all(upper, order, steps, last, right):
    """As `backward`."""
    front, first = zero_matrix(ROWS, LANES), steps * BLOCK
    resolve_all(upper, order, first, LAST, LAST + SHARED, last)
    for i in range(NODE):
        copy_row(last, i, right, first + i)
    if BORDERED:
        for i in range(BORDER):
            copy_row(last, NODE + i, right, FIRST[i])
            copy_row(last, NODE + i, front, SIZE + i)
    for i in range(SHARED):
        copy_row(last, LAST + i, front, TAIL + i)
    for k in range(steps - 1, FIRST_BLOCK - 1, -1):
        first = k * BLOCK
        for i in range(SIZE):
            copy_row(right, first + i, front, i)
        resolve_all(upper, order, first, INNER, ROWS, front)
        for i in range(BLOCK):
            copy_row(front, i, right, first + i)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def condense_all(gradients, begin, inverses, couplings, steps, right):
    """As `condense`, of a body whose unknowns begin at `begin`; `gradients` (LANES, n)."""
    for i in range(NODE):
        for d in range(LANES):
            right[steps * BLOCK + i, d] = -gradients[d, begin + unknown_of(steps, i, steps)]
    for i in range(SHARED):
        for d in range(LANES):
            right[steps * BLOCK + NODE + i, d] = 0.0
    condensed = zero_matrix(CONDENSED, LANES)
    for block in range(steps - 1, -1, -1):
        k = interval_of(block, steps)
        for i in range(BLOCK):
            for d in range(LANES):
                right[block * BLOCK + i, d] = -gradients[d, begin + unknown_of(block, i, steps)]
        for b in range(CONDENSED):
            for d in range(LANES):
                condensed[b, d] = gradients[d, begin + k * STRIDE + BLOCK + b]
        for a in range(CONDENSED):
            inverse = inverses[min(k + 1, inverses.shape[0] - 1)]
            for b in range(CONDENSED):
                for i in range(SIZE):
                    add_row(condensed, b, couplings[k, a, i] * inverse[a, b], right, block * BLOCK + i)
                for i in range(SHARED):
                    add_row(condensed, b, couplings[k, a, TAIL + i] * inverse[a, b], right, steps * BLOCK + NODE + i)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def recover_all(gradients, begin, inverses, couplings, steps, solved, solutions):
    """As `recover_condensed`, of a body whose unknowns begin at `begin`; `gradients`, `solutions` (LANES, n)."""
    for i in range(NODE):
        for d in range(LANES):
            solutions[d, begin + unknown_of(steps, i, steps)] = solved[steps * BLOCK + i, d]
    forcing = zero_matrix(CONDENSED, LANES)
    for block in range(steps):
        k = interval_of(block, steps)
        for i in range(BLOCK):
            for d in range(LANES):
                solutions[d, begin + unknown_of(block, i, steps)] = solved[block * BLOCK + i, d]
        for b in range(CONDENSED):
            for d in range(LANES):
                forcing[b, d] = gradients[d, begin + k * STRIDE + BLOCK + b]
            for i in range(SIZE):
                add_row(solved, block * BLOCK + i, couplings[k, b, i], forcing, b)
            for i in range(SHARED):
                add_row(solved, steps * BLOCK + NODE + i, couplings[k, b, TAIL + i], forcing, b)
        for a in range(CONDENSED):
            inverse = inverses[min(k + 1, inverses.shape[0] - 1)]
            for d in range(LANES):
                value = 0.0
                for b in range(CONDENSED):
                    value -= inverse[a, b] * forcing[b, d]
                solutions[d, begin + k * STRIDE + BLOCK + a] = value
