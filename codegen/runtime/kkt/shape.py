"""Shapes of linear systems, the constants of a factorisation of the KKT matrix, and their index tables.

The index tables lie one after the other in one array of integers, which begins with the place and the length of each
table. They depend on the sparsity of a problem. Because sparsity is not part of the constants, all problems of one
shape share a compiled system.
"""

from typing import NamedTuple

import numpy as np
from numba import njit


class Shape(NamedTuple):
    """Numbers of unknowns of an interval and of its borders.

    Attributes
    ----------
    node, stride, condensed : int
        Unknowns of a node, of a node and the interval after it, and those of an interval that are eliminated first.
    inner : int
        Unknowns of a block that are eliminated with it.
    border : int
        Unknowns of block 0 that stay to the end of the elimination; meaningful if `bordered`.
    shared, root : int
        Linking variables of one body, and of all, with the multipliers of conditions between them.
    backward, bordered, carried, constant : int
        1 if elimination goes from the last interval to the first; if block 0 stays to the end; if the right-hand side
        takes part in the elimination; if the condensed block is the same on all intervals of one length.
    stages, reach, triangular : int
        Stages of an interval, which are eliminated with the multipliers of their equations; unknowns that these
        equations contain, rounded up to a multiple of four; 1 if their Jacobian by the stages is a lower triangle.
    """

    node: int
    stride: int
    condensed: int
    inner: int
    border: int
    shared: int
    root: int
    backward: int
    bordered: int
    carried: int
    constant: int
    stages: int = 0
    reach: int = 0
    triangular: int = 0


@njit(error_model="numpy", forceinline=True)
def padded(size):
    """Return the next multiple of four: four entries of a row are computed at once."""
    return (size + 3) // 4 * 4


@njit(error_model="numpy", forceinline=True)
def block_size(shape):
    """Return the number of unknowns of a block: a node and its interval without stages and condensed unknowns."""
    return shape.stride - shape.condensed - 2 * shape.stages


@njit(error_model="numpy", forceinline=True)
def tail_of(shape):
    """Return the first row of an element matrix that belongs to linking variables."""
    return block_size(shape) + shape.node + shape.border


@njit(error_model="numpy", forceinline=True)
def row_count(shape):
    """Return the number of rows of an element matrix."""
    return tail_of(shape) + shape.shared


@njit(error_model="numpy", forceinline=True)
def row_width(shape):
    """Return the number of columns of an element matrix, in fours from 0 and from the border of the block on."""
    block = block_size(shape)
    return padded(block + padded(row_count(shape) - block))


@njit(error_model="numpy", forceinline=True)
def last_size(shape):
    """Return the number of unknowns that are eliminated as the last node is."""
    return shape.node + shape.border


@njit(error_model="numpy", forceinline=True)
def last_width(shape):
    """Return the number of columns of the matrix of the last node."""
    return padded(last_size(shape) + padded(shape.carried + shape.shared))


@njit(error_model="numpy", forceinline=True)
def unknown_of(shape, block, i, steps):
    """Return the index, among a body's unknowns, of unknown i of a block; block N is the last eliminated node."""
    of_interval = i >= shape.node  # stages come first in an interval
    if shape.backward:
        return (steps - block - of_interval) * shape.stride + i + of_interval * 2 * shape.stages
    return block * shape.stride + i + of_interval * 2 * shape.stages


@njit(error_model="numpy", forceinline=True)
def first_condensed(shape, k):
    """Return the index, among a body's unknowns, of the first one of interval k that is condensed."""
    return (k + 1) * shape.stride - shape.condensed


@njit(error_model="numpy", forceinline=True)
def interval_of(shape, block, steps):
    """Return the interval of a block: the one after its node, or before it if elimination goes backward."""
    if shape.backward:
        return steps - 1 - block
    return block


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

The tables are: entries of an interval's Hessian with no, one and two condensed unknowns; columns that condensation
changes; unknowns of block 0 that stay to the end; prescribed unknowns of the first and last eliminated nodes, of the
start and of the end; unknowns that equal linking variables, and these variables; rows and columns of an element matrix
for the entries of the Hessians of the ends; COUNTS; and the numbers of the shape.

For the stages of an interval: STAGED are the entries of its Hessian with stages, one kind after the other: the Jacobian
of their equations by stages (rows and columns SLOPE) and by other unknowns (OUTER, whose columns are numbers in REACH,
which has rows of an element matrix), second derivatives by stages (CURVED), and by other unknowns and stages (CROSS,
whose rows are numbers in CROSSED, which has rows of an element matrix). Diagonals come last in rows of SLOPE.
"""
OWN, MULTIPLIERS, ENDING, COMMON, ENTRIES = range(5)
"""Entries of COUNTS: linking variables of one body alone; multipliers of a block, of the last node with another block,
and among the linking variables; entries of an interval's Hessian."""


def packed(tables):
    """Return one array of integers with the tables of a mapping, by the names in NAMES."""
    parts = [np.asarray(tables[name], dtype=np.int64).ravel() for name in NAMES]
    lengths = np.array([part.size for part in parts])
    places = 2 * len(parts) + np.concatenate([[0], np.cumsum(lengths)[:-1]])
    return np.concatenate([np.stack([places, lengths], axis=1).ravel(), *parts]).astype(np.int64)


@njit(error_model="numpy", forceinline=True)
def place_of(tables, number):
    """Return the first index of a table."""
    return tables[2 * number]


@njit(error_model="numpy", forceinline=True)
def count_of(tables, number):
    """Return the length of a table."""
    return tables[2 * number + 1]
