"""Solve with the factors of the KKT matrix: forward over all bodies, the shared unknowns, backward over all bodies.

A right-hand side that took part in the elimination needs no way forward any more: its column in the factors counts on
the way back, as if it belonged to one more unknown, with the value -1.
"""

import numpy as np
from numba import njit

from codegen.runtime.condensation import condense, expand
from codegen.runtime.element_condensed import condensed_parts
from codegen.runtime.elements import BLOCK, BORDER, CARRIED, COLUMNS, FIRST, INNER, RIGHT, SIZE, TAIL, WIDTH
from codegen.runtime.example import BODIES, END_PINNED, NODE, ROOT, SHARED, START_PINNED, TIED
from codegen.runtime.frontal import LAST, LAST_WIDTH, ROOT_WIDTH, factor_parts
from codegen.runtime.shared import root_place
from codegen.runtime.symmetric import solve_backward, solve_forward, solve_pivots
from codegen.runtime.equal_ends import follow_shared, release_tied


def solve_kkt(grid, system, gradient, step, carried=False):
    """Newton step for all unknowns: the solution of KKT matrix . step = -gradient, after factor_kkt gave a number.

    That number must not have been positive. `carried` says that `factor_kkt` was given the same gradient.
    """
    substitute(gradient, carried and CARRIED > 0, grid.steps, *system[0], step)


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def substitute(gradient, carried, steps, numbers, places, storage, step):
    """Solve with the factors: forward unless elimination has done that, the shared unknowns, and backward."""
    blocks, ends, (root_upper, root_inverse, root_order, right) = factor_parts(numbers, places, steps)
    (upper, inverse, order), (last_upper, last_inverse, last_order) = blocks, ends
    condensed = condensed_parts(storage, steps)
    reduced, last = np.zeros((BODIES, steps * BLOCK + NODE)), np.zeros((BODIES, LAST_WIDTH))
    shared = np.zeros(ROOT_WIDTH)
    if not carried:
        for i in range(ROOT):
            right[i] = -gradient[gradient.size - ROOT + i]
        condense(gradient, condensed, steps, reduced, right)
        for body in range(BODIES):
            if TIED:
                release_tied(reduced[body], 0, steps * BLOCK, body, right)
            forward(upper[body], inverse[body], order[body], reduced[body], last[body])
            solve_forward(last_upper[body], last_order[body], *last_upper.shape[1:], last[body])
            solve_pivots(last_inverse[body], last_order[body], LAST, last[body])
            for i in range(SHARED):
                right[root_place(body, i)] += last[body, LAST + i]
    if SHARED:
        for i in range(ROOT):
            shared[i] = right[i]
        solve_forward(root_upper, root_order, *root_upper.shape, shared)
        solve_pivots(root_inverse, root_order, ROOT, shared)
        solve_backward(root_upper, root_order, *root_upper.shape, shared)
        for i in range(ROOT):
            step[step.size - ROOT + i] = shared[i]
    for body in range(BODIES):
        for i in range(SHARED):
            last[body, LAST + i] = shared[root_place(body, i)]
        if CARRIED:
            last[body, LAST + SHARED] = -1.0 if carried else 0.0
        solve_backward(last_upper[body], last_order[body], *last_upper.shape[1:], last[body])
        backward(upper[body], order[body], last[body], carried, reduced[body])
        if TIED:
            follow_shared(reduced[body], 0, steps * BLOCK, body, shared)
    expand(gradient, condensed, steps, reduced, shared, step)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def forward(upper, inverse, order, right, last):
    """Solve with the upper factors of a body's blocks, transposed, and the pivots; `last` takes what borders them."""
    steps, front = upper.shape[0], np.zeros(WIDTH)
    for i in START_PINNED:
        right[i] = 0.0
    for i in END_PINNED:
        right[steps * BLOCK + i] = 0.0
    for k in range(1, steps):
        for i in range(BLOCK):
            front[i] = right[k * BLOCK + i]
        for i in range(NODE):
            front[BLOCK + i] = right[(k + 1) * BLOCK + i]
        solve_forward(upper[k], order[k], INNER, COLUMNS, front)
        solve_pivots(inverse[k], order[k], INNER, front)
        for i in range(BLOCK):
            right[k * BLOCK + i] = front[i]
        for i in range(NODE):
            right[(k + 1) * BLOCK + i] = front[BLOCK + i]
    for i in range(NODE):
        last[i] = right[steps * BLOCK + i]
    for i in range(BORDER):
        last[NODE + i] = right[FIRST[i]] + front[SIZE + i]
    for i in range(SHARED):
        last[LAST + i] = front[TAIL + i]


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def backward(upper, order, last, carried, right):
    """Solve with the upper factors of a body's blocks, from the last node and block 0, in `last`, to block 1.

    `right` holds what is left of the right-hand side, zeros where that is a column of the factors.
    """
    steps, front = upper.shape[0], np.zeros(WIDTH)
    if CARRIED:
        front[RIGHT] = -1.0 if carried else 0.0
    for i in range(NODE):
        right[steps * BLOCK + i] = last[i]
    for i in range(BORDER):
        right[FIRST[i]] = front[SIZE + i] = last[NODE + i]
    for i in range(SHARED):
        front[TAIL + i] = last[LAST + i]
    for k in range(steps - 1, 0, -1):
        for i in range(BLOCK):
            front[i] = right[k * BLOCK + i]
        for i in range(NODE):
            front[BLOCK + i] = right[(k + 1) * BLOCK + i]
        solve_backward(upper[k], order[k], INNER, COLUMNS, front)
        for i in range(BLOCK):
            right[k * BLOCK + i] = front[i]
