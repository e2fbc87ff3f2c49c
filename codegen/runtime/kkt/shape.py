"""Sizes of the linear systems of Newton's method, and index tables of the sparsity of a problem.

A `Shape` holds the numbers of unknowns: the constants of a factorisation of the KKT matrix. The index tables hold the
sparsity of a problem. They lie one after the other in one array of integers. The array begins with two numbers for each
table: the index of its first entry, and its length. Sparsity is not part of a Shape, so that all problems of equal
Shape share a compiled system. `elimination` explains element matrices.
"""

from typing import NamedTuple

import numpy as np
from numba import njit


class Shape(NamedTuple):
    """Numbers of unknowns of an interval and of the parts of the linear system around an interval.

    A block is a node and the interval after it (with `backward`: before it), without stages and condensed unknowns.

    Attributes
    ----------
    node, stride : int
        Unknowns of a node, and of a node together with the interval after it.
    condensed : int
        Unknowns of an interval that static condensation eliminates before all others; the last ones of the interval.
    inner : int
        Unknowns of a block that are eliminated with the block. Trailing unknowns that only the end nodes have are left
        out.
    border : int
        Unknowns of block 0 that are eliminated after later blocks; used only if `bordered` is 1.
    shared : int
        Linking variables in the equations of one body: its own, and the common ones of all bodies.
    root : int
        Linking variables of all bodies, and multipliers of the conditions between them.
    backward : int
        1 if elimination goes from the last interval to the first, else 0.
    bordered : int
        1 if block 0 is kept and eliminated after later blocks, else 0.
    carried : int
        1 if the factorisation also reduces the right-hand side, as one more column of the matrices, else 0.
    constant : int
        1 if the block of condensed unknowns is the same on all intervals of equal length, else 0.
    stages : int
        Stages of an interval; they are eliminated with the multipliers of their equations.
    reach : int
        Unknowns other than stages in the equations of the stages, rounded up to a multiple of four.
    states : int
        Unknowns of a node, each determined by the equation of the interval before it with the same number; 0 if other
        equations or costs of the interval contain any of them.
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
    states: int = 0


@njit(error_model="numpy", forceinline=True)
def padded(size):
    """Return `size` rounded up to a multiple of four, because four entries of a row are computed at once."""
    return (size + 3) // 4 * 4


@njit(error_model="numpy", forceinline=True)
def block_size(shape):
    """Return the number of unknowns of a block. Stages, their multipliers and condensed unknowns do not count."""
    return shape.stride - shape.condensed - 2 * shape.stages


@njit(error_model="numpy", forceinline=True)
def tail_of(shape):
    """Return the index of the first row of an element matrix that belongs to linking variables."""
    return block_size(shape) + shape.node


@njit(error_model="numpy", forceinline=True)
def row_count(shape):
    """Return the number of rows of an element matrix without the border: block, next node, and linking variables.

    It is also the index of the column with the right-hand side, if there is one.
    """
    return tail_of(shape) + shape.shared


@njit(error_model="numpy", forceinline=True)
def border_of(shape):
    """Return the index of the first row of an element matrix that belongs to the border."""
    return row_count(shape) + shape.carried


@njit(error_model="numpy", forceinline=True)
def column_count(shape):
    """Return the number of columns of an element matrix: with the right-hand side and the border, without padding."""
    return border_of(shape) + shape.border


@njit(error_model="numpy", forceinline=True)
def row_width(shape):
    """Return the number of columns of an element matrix, with padding.

    The padding lets four columns be read at once, both from column 0 and from the first column after the first block.
    """
    block = block_size(shape)
    return padded(block + padded(column_count(shape) - block))


@njit(error_model="numpy", forceinline=True)
def last_size(shape):
    """Return the number of unknowns that are eliminated with the last node: the node and the border."""
    return shape.node + shape.border


@njit(error_model="numpy", forceinline=True)
def last_width(shape):
    """Return the number of columns of the matrix of the last node, with padding."""
    return padded(last_size(shape) + padded(shape.carried + shape.shared))


@njit(error_model="numpy", forceinline=True)
def unknown_of(shape, block, i, steps):
    """Return the index of unknown `i` of a block in the vector of unknowns of a body.

    There are N = `steps` intervals. Block N is the node that is eliminated last.
    """
    of_interval = i >= shape.node  # skip the stages, which come first in an interval
    if shape.backward:
        return (steps - block - of_interval) * shape.stride + i + of_interval * 2 * shape.stages
    return block * shape.stride + i + of_interval * 2 * shape.stages


@njit(error_model="numpy", forceinline=True)
def first_condensed(shape, k):
    """Return the index of the first condensed unknown of interval k in the vector of unknowns of a body."""
    return (k + 1) * shape.stride - shape.condensed


@njit(error_model="numpy", forceinline=True)
def interval_of(shape, block, steps):
    """Return the index of the interval of a block: after its node, or before it if elimination goes backward."""
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
"""Numbers of the index tables.

- KEPT, COUPLED, INSIDE: entries of the Hessian of an interval with no, one and two condensed unknowns. Each has tables
  of its ROWS and COLUMNS in the element matrix, or among the condensed unknowns.
- TOUCHED: columns of the element matrix that condensation changes.
- FIRST: unknowns of block 0 that are kept as the border.
- FIRST_PINNED, LAST_PINNED: prescribed unknowns of the node that is eliminated first, and last.
- START_PINNED, END_PINNED: prescribed unknowns of the nodes at the start and at the end.
- START_TIED, END_TIED: unknowns of these nodes that equal linking variables. START_SHARED and END_SHARED are the
  numbers of these linking variables.
- START_ROWS, START_COLUMNS, END_ROWS, END_COLUMNS: rows and columns of an element matrix for the entries of the
  Hessians of the start and the end.
- COUNTS: numbers in the order of OWN, MULTIPLIERS and so on. SHAPE: the numbers of the Shape.

The other tables concern the stages of an interval. STAGED lists the entries of the Hessian of an interval with stages
or multipliers of their equations. It has four parts, in this order:

- SLOPE: the Jacobian of the stage equations with respect to stages.
- OUTER: the Jacobian of the stage equations with respect to other unknowns. Its columns are indices of REACH.
- CURVED: second derivatives with respect to two stages.
- CROSS: second derivatives with respect to another unknown (row) and a stage (column). Its rows are indices of CROSSED.

REACH and CROSSED hold rows of an element matrix.
"""
OWN, MULTIPLIERS, ENDING, COMMON, ENTRIES = range(5)
"""Indices of the numbers in COUNTS.

- OWN: linking variables of one body alone.
- MULTIPLIERS: multipliers of a node and its interval.
- ENDING: the same number plus the multipliers of the last node.
- COMMON: multipliers among the linking variables.
- ENTRIES: entries of the Hessian of an interval.
"""


def packed(tables):
    """Return the index tables as one array of integers; `tables` maps each name in NAMES to an array."""
    parts = [np.asarray(tables[name], dtype=np.int64).ravel() for name in NAMES]
    lengths = np.array([part.size for part in parts])
    places = 2 * len(parts) + np.concatenate([[0], np.cumsum(lengths)[:-1]])
    return np.concatenate([np.stack([places, lengths], axis=1).ravel(), *parts]).astype(np.int64)


@njit(error_model="numpy", forceinline=True)
def place_of(tables, number):
    """Return the index of the first entry of table `number` in the packed array `tables`."""
    return tables[2 * number]


@njit(error_model="numpy", forceinline=True)
def count_of(tables, number):
    """Return the length of table `number` in the packed array `tables`."""
    return tables[2 * number + 1]
