"""Unknowns of the first and last node that equal shared ones: what acts on them acts on those, and they follow."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example import (
    BODIES, END_SHARED, END_TIED, NODE, ROOT, SCALED, SHARED, START_SHARED, START_TIED, STRIDE,
)  # fmt: skip
from codegen.runtime.unknowns.shared import root_index


@njit(error_model="numpy", inline="always")
def add_tied_to_shared(values, first, last, body, root):
    """Move `values` of what equals a shared unknown to its, in `root` (ROOT,); nodes begin at `first` and `last`."""
    for i in range(START_SHARED.size):
        root[root_index(body, START_SHARED[i])] += values[first + START_TIED[i]]
    for i in range(END_SHARED.size):
        root[root_index(body, END_SHARED[i])] += values[last + END_TIED[i]]


if SCALED:

    @njit(error_model="numpy")
    def add_tied(values, steps):
        """Add `values` (n,) of what equals a shared unknown to its, and leave them there as well."""
        root = values[values.size - ROOT :]
        for body in range(BODIES):
            first = body * (steps * STRIDE + NODE)
            add_tied_to_shared(values, first, first + steps * STRIDE, body, root)


@njit(error_model="numpy", inline="always")
def copy_shared_to_tied(values, first, last, body, root):
    """Give what equals a shared unknown, in `values`, the value of that unknown, in `root` (ROOT,)."""
    for i in range(START_SHARED.size):
        values[first + START_TIED[i]] = root[root_index(body, START_SHARED[i])]
    for i in range(END_SHARED.size):
        values[last + END_TIED[i]] = root[root_index(body, END_SHARED[i])]


@njit(error_model="numpy", inline="always")
def add_tied_rows_to_shared(indices, shared, first, size, element):
    """Add the rows and columns of `element` at `indices` (c,) to those of `shared` (c,), which begin at `size`."""
    for i in range(indices.size):
        index, to = first + indices[i], size + shared[i]
        for j in range(element.shape[1]):
            element[to, j] += element[index, j]
        for j in range(element.shape[0]):
            element[j, to] += element[j, index]


def shared_representatives(grid, size):
    """For every unknown its own index, or that of the shared unknown which it equals: (size,)."""
    indices, chain = np.arange(size), grid.steps * STRIDE + NODE
    for body in range(BODIES):
        shared = np.array([size - ROOT + root_index(body, j) for j in range(SHARED)])
        indices[body * chain + START_TIED] = shared[START_SHARED]
        indices[(body + 1) * chain - NODE + END_TIED] = shared[END_SHARED]
    return indices
