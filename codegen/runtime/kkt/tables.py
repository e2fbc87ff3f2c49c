"""Index tables of a linear system, one after the other in one array of integers.

The array begins with the place and the length of each table. What depends on the sparsity of a problem stands here, and
not in the constants of the compiled system, so that problems of one shape share it.
"""

import numpy as np
from numba import njit

NAMES = (
    "KEPT KEPT_ROWS KEPT_COLUMNS COUPLED COUPLED_ROWS COUPLED_COLUMNS INSIDE INSIDE_ROWS INSIDE_COLUMNS TOUCHED FIRST"
    " FIRST_PINNED LAST_PINNED START_PINNED END_PINNED START_TIED START_SHARED END_TIED END_SHARED START_ROWS"
    " START_COLUMNS END_ROWS END_COLUMNS COUNTS SHAPE STAGED SLOPE_ROWS SLOPE_COLUMNS OUTER_ROWS OUTER_COLUMNS"
    " CURVED_ROWS CURVED_COLUMNS CROSS_ROWS CROSS_COLUMNS CROSSED REACH"
).split()
(
    KEPT, KEPT_ROWS, KEPT_COLUMNS, COUPLED, COUPLED_ROWS, COUPLED_COLUMNS, INSIDE, INSIDE_ROWS, INSIDE_COLUMNS, TOUCHED,
    FIRST, FIRST_PINNED, LAST_PINNED, START_PINNED, END_PINNED, START_TIED, START_SHARED, END_TIED, END_SHARED,
    START_ROWS, START_COLUMNS, END_ROWS, END_COLUMNS, COUNTS, SHAPE, STAGED, SLOPE_ROWS, SLOPE_COLUMNS, OUTER_ROWS,
    OUTER_COLUMNS, CURVED_ROWS, CURVED_COLUMNS, CROSS_ROWS, CROSS_COLUMNS, CROSSED, REACH,
) = range(36)  # fmt: skip
"""Numbers of the tables.

The entries of an interval's Hessian whose unknowns both stay, one of which is condensed, and both; columns that
condensation changes; unknowns of block 0 that stay to the end; unknowns that are given in the nodes that come first and
last, at the start and at the end; those that equal linking variables, and these; rows and columns of an element matrix
for the entries of the ends' own Hessians; COUNTS; and the numbers of the shape.

For the stages of an interval: STAGED are the entries of its Hessian with stages, one kind after the other: the Jacobian
of their equations by stages (rows and columns SLOPE) and by other unknowns (OUTER, whose columns are numbers in REACH,
which has rows of an element matrix), second derivatives by stages (CURVED), and by other unknowns and stages (CROSS,
whose rows are numbers in CROSSED, which has rows of an element matrix). Diagonals come last in rows of SLOPE.
"""
OWN, MULTIPLIERS, ENDING, COMMON, ENTRIES = range(5)
"""Entries of COUNTS: linking variables of one body alone; multipliers of a block, of the last node with another block,
and among the linking variables; entries of an interval's Hessian."""


def packed(tables):
    """Return one array of integers with the tables of the given mapping, by the names in NAMES."""
    parts = [np.asarray(tables[name], dtype=np.int64).ravel() for name in NAMES]
    lengths = np.array([part.size for part in parts])
    places = 2 * len(parts) + np.concatenate([[0], np.cumsum(lengths)[:-1]])
    return np.concatenate([np.stack([places, lengths], axis=1).ravel(), *parts]).astype(np.int64)


@njit(error_model="numpy", forceinline=True)
def place_of(tables, number):
    """Return where a table begins."""
    return tables[2 * number]


@njit(error_model="numpy", forceinline=True)
def count_of(tables, number):
    """Return the length of a table."""
    return tables[2 * number + 1]
