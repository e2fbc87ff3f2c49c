"""Solve with the factors of a body's part of the KKT matrix: forward and backward over its blocks.

A right-hand side that took part in the elimination needs no way forward: its column in the factors counts on the way
back, as if it belonged to one more unknown, with the value -1.
"""

from numba import njit

from codegen.runtime.kkt.shape import block_size, last_size, padded, row_count, tail_of
from codegen.runtime.kkt.symmetric import backward_once, forward_once, solve_backward, solve_forward, solve_pivots
from codegen.runtime.kkt.tables import FIRST, FIRST_PINNED, LAST_PINNED, count_of, place_of


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def forward(shape, tables, upper, inverse, order, steps, right, front, last):
    """Solve with a body's upper factor, transposed, and the pivots; the share of the last node goes to `last`.

    `upper` (R, width), `inverse` (R, 2), `order` (R,), `right` (N block + node + shared,), `front` (width,), `last`.
    """
    block, size, columns = block_size(shape), block_size(shape) + shape.node, padded(row_count(shape))
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
        solve_forward(upper[first:behind], order[first:behind], shape.inner, columns, front)
        solve_pivots(inverse[first:behind], order[first:behind], shape.inner, front)
        for i in range(block):
            right[first + i] = front[i]
        for i in range(shape.node):
            right[behind + i] = front[block + i]
    first, end = steps * block, last_size(shape)
    for i in range(shape.node):
        last[i] = right[first + i]
    place = place_of(tables, FIRST)
    for i in range(shape.border):
        last[shape.node + i] = right[tables[place + i]] + front[size + i]
    for i in range(shape.shared):
        last[end + i] = front[tail_of(shape) + i]
    forward_once(upper[first:], inverse[first:], order[first:], end, last.size, last)


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def backward(shape, tables, upper, order, steps, carried, last, front, right):
    """Solve with a body's upper factor, from its last node and block 0 if it stays to the end, in `last`, backward.

    Arrays as in `forward`; `right` holds what the way forward has left, zeros where the right-hand side was carried.
    """
    block, size, columns = block_size(shape), block_size(shape) + shape.node, padded(row_count(shape))
    first = steps * block
    for i in range(front.size):
        front[i] = 0.0
    if shape.carried:
        front[row_count(shape)] = -1.0 if carried else 0.0
    backward_once(upper[first:], order[first:], last_size(shape), last.size, last)
    for i in range(shape.node):
        right[first + i] = last[i]
    place = place_of(tables, FIRST)
    for i in range(shape.border):
        right[tables[place + i]] = front[size + i] = last[shape.node + i]
    for i in range(shape.shared):
        front[tail_of(shape) + i] = last[last_size(shape) + i]
    for k in range(steps - 1, shape.bordered - 1, -1):
        first, behind = k * block, (k + 1) * block
        for i in range(block):
            front[i] = right[first + i]
        for i in range(shape.node):
            front[block + i] = right[behind + i]
        solve_backward(upper[first:behind], order[first:behind], shape.inner, columns, front)
        for i in range(block):
            right[first + i] = front[i]
