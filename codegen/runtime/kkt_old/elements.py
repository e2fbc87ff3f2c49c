"""Element matrices of the KKT system: one small symmetric matrix for each interval, closed at both ends.

The rows of an element matrix are those of block k, which is node k and its interval without what is eliminated inside
the interval; of node k + 1; of block 0 if it stays to the end; and of the shared unknowns. One more
column is the right-hand side: elimination carries it along where a row, as wide as a multiple of four, has room for it.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example import (
    BACKWARD, BORDERED, CARRIED, CONDENSED, END_PINNED, END_SHARED, END_TIED, HESSIAN_COLUMNS, HESSIAN_ROWS,
    IS_MULTIPLIER, NODE, ONLY_AT_ENDS, SHARED, SHARED_IS_MULTIPLIER, SHARED_MULTIPLIERS, START_PINNED, START_SHARED,
    START_TIED, STRIDE, TIED,
)  # fmt: skip
from codegen.runtime.unknowns.tied_ends import add_tied_rows_to_shared


def padded(size):
    """The next multiple of four: four entries of a row are computed at once."""
    return (size + 3) // 4 * 4


BLOCK = STRIDE - CONDENSED  # unknowns of a node and its interval
# Those to eliminate: what only ends have is zero in inner nodes, and is left out where it comes last.
INNER = BLOCK - ONLY_AT_ENDS.size
if ONLY_AT_ENDS.min(initial=BLOCK) < INNER:
    INNER = BLOCK
SIZE = BLOCK + NODE  # unknowns of an interval and both its nodes
LEFT_NODE, RIGHT_NODE = (BLOCK, 0) if BACKWARD else (0, BLOCK)  # rows of an element matrix where its nodes begin
FIRST_PINNED, LAST_PINNED = (END_PINNED, START_PINNED) if BACKWARD else (START_PINNED, END_PINNED)
FIRST_BLOCK = BORDERED  # the first block that is eliminated in its turn
if BORDERED:
    FIRST = np.setdiff1d(np.arange(BLOCK), FIRST_PINNED)  # what is not given of block 0, and stays to the end
    BORDER = FIRST.size
else:
    BORDER = 0
TAIL = SIZE + BORDER  # where shared unknowns begin
ROWS = TAIL + SHARED  # of an element matrix
COLUMNS = padded(ROWS)  # that elimination passes over
WIDTH = padded(BLOCK + padded(ROWS - BLOCK))  # and its columns, in fours from 0 and from BLOCK on
if CARRIED:
    RIGHT = ROWS  # the column of the right-hand side
LOCAL_IS_MULTIPLIER = np.concatenate([IS_MULTIPLIER, IS_MULTIPLIER[:NODE], np.zeros(SHARED, bool)])
if SHARED_MULTIPLIERS:
    LOCAL_IS_MULTIPLIER[STRIDE + NODE :] = SHARED_IS_MULTIPLIER
IS_CURVATURE = ~(LOCAL_IS_MULTIPLIER[HESSIAN_ROWS] | LOCAL_IS_MULTIPLIER[HESSIAN_COLUMNS])
# The Lagrangian is linear in multipliers: on their diagonal stands only a one for each that a node or interval lacks.
IS_LACKING = LOCAL_IS_MULTIPLIER[HESSIAN_ROWS] & (HESSIAN_ROWS == HESSIAN_COLUMNS)


if BACKWARD:

    @njit(error_model="numpy", inline="always")
    def interval_of(block, steps):
        """The interval of a block: the one before its node."""
        return steps - 1 - block

    @njit(error_model="numpy", inline="always")
    def unknown_of(block, i, steps):
        """The index, among a body's unknowns, of unknown i of a block; block N is the first node."""
        return (steps - block - (i >= NODE)) * STRIDE + i

else:

    @njit(error_model="numpy", inline="always")
    def interval_of(block, steps):
        """The interval of a block: the one after its node."""
        return block

    @njit(error_model="numpy", inline="always")
    def unknown_of(block, i, steps):
        """The index, among a body's unknowns, of unknown i of a block; block N is the last node."""
        return block * STRIDE + i


@njit(error_model="numpy")
def pin_ends(k, steps, diagonal, element):
    """Add the share of `diagonal` (N STRIDE + NODE,) of the node that comes last, and pin what is given at the ends.

    The row and column of `element` (ROWS, WIDTH) for what a boundary condition gives are those of the unit matrix.
    """
    if k == interval_of(steps - 1, steps):
        for i in range(NODE):
            element[BLOCK + i, BLOCK + i] += diagonal[unknown_of(steps, i, steps)]
    if k == 0:
        if TIED:
            add_tied_rows_to_shared(START_TIED, START_SHARED, LEFT_NODE, TAIL, element)
        for i in START_PINNED:
            pin(LEFT_NODE + i, element)
    if k == steps - 1:
        if TIED:
            add_tied_rows_to_shared(END_TIED, END_SHARED, RIGHT_NODE, TAIL, element)
        for i in END_PINNED:
            pin(RIGHT_NODE + i, element)


@njit(error_model="numpy")
def pin(index, element):
    """Make a row and column of `element` (ROWS, WIDTH) that of the unit matrix, and its right-hand side zero."""
    for i in range(element.shape[0]):
        element[index, i] = 0.0
        element[i, index] = 0.0
    element[index, index] = 1.0
    if CARRIED:
        element[index, RIGHT] = 0.0
