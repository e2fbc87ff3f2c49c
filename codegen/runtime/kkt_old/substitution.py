"""Solve with the factors of a body's part of the KKT matrix: forward and backward over its blocks.

A right-hand side that took part in the elimination needs no way forward any more: its column in the factors counts on
the way back, as if it belonged to one more unknown, with the value -1.
"""

from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.kkt.elements import (
    BLOCK, BORDER, COLUMNS, FIRST, FIRST_BLOCK, FIRST_PINNED, INNER, LAST_PINNED, RIGHT, SIZE, TAIL, WIDTH,
)  # fmt: skip
from codegen.runtime.stand_ins.example import BORDERED, CARRIED, NODE, SHARED
from codegen.runtime.kkt.frontal import LAST
from codegen.runtime.kkt.symmetric import solve_backward, solve_forward, solve_pivots


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def forward(upper, inverse, order, steps, right, last):
    """Solve with a body's upper factor, transposed, and the pivots; the last node's share goes to `last`.

    `upper` (R, WIDTH), `inverse` (R, 2), `order` (R,), `right` (N BLOCK + NODE + SHARED,), `last` (LAST_WIDTH,).
    """
    front = zero_vector(WIDTH)
    for i in FIRST_PINNED:
        right[i] = 0.0
    for i in LAST_PINNED:
        right[steps * BLOCK + i] = 0.0
    for k in range(FIRST_BLOCK, steps):
        first, behind = k * BLOCK, (k + 1) * BLOCK
        for i in range(BLOCK):
            front[i] = right[first + i]
        for i in range(NODE):
            front[BLOCK + i] = right[behind + i]
        solve_forward(upper[first:behind], order[first:behind], INNER, COLUMNS, front)
        solve_pivots(inverse[first:behind], order[first:behind], INNER, front)
        for i in range(BLOCK):
            right[first + i] = front[i]
        for i in range(NODE):
            right[behind + i] = front[BLOCK + i]
    first = steps * BLOCK
    for i in range(NODE):
        last[i] = right[first + i]
    if BORDERED:
        for i in range(BORDER):
            last[NODE + i] = right[FIRST[i]] + front[SIZE + i]
    for i in range(SHARED):
        last[LAST + i] = front[TAIL + i]
    solve_forward(upper[first:], order[first:], order.size - first, last.size, last)
    solve_pivots(inverse[first:], order[first:], order.size - first, last)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def backward(upper, order, steps, carried, last, right):
    """Solve with a body's upper factor, from its last node, and block 0 if it stays to the end, in `last`, backward.

    Arrays as in `forward`; `right` holds what is left of the right-hand side, zeros where that is a column of the
    factors.
    """
    front, first = zero_vector(WIDTH), steps * BLOCK
    if CARRIED:
        front[RIGHT] = -1.0 if carried else 0.0
    solve_backward(upper[first:], order[first:], order.size - first, last.size, last)
    for i in range(NODE):
        right[first + i] = last[i]
    if BORDERED:
        for i in range(BORDER):
            right[FIRST[i]] = front[SIZE + i] = last[NODE + i]
    for i in range(SHARED):
        front[TAIL + i] = last[LAST + i]
    for k in range(steps - 1, FIRST_BLOCK - 1, -1):
        first, behind = k * BLOCK, (k + 1) * BLOCK
        for i in range(BLOCK):
            front[i] = right[first + i]
        for i in range(NODE):
            front[BLOCK + i] = right[behind + i]
        solve_backward(upper[first:behind], order[first:behind], INNER, COLUMNS, front)
        for i in range(BLOCK):
            right[first + i] = front[i]
