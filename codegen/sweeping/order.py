"""The order in which the cases of a chunk are solved: a path on which each has a neighbour just before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from codegen.interfaces import Matrix


def serpentine(shape: Sequence[int]) -> NDArray[np.intp]:
    """The cells of a grid, counted with the last dimension varying fastest, such that neighbours follow each other.

    Every other row is run through backwards, in all dimensions.
    """
    order = np.zeros(1, dtype=np.intp)
    size = 1
    for length in reversed(shape):
        order = np.concatenate([k * size + (order if k % 2 == 0 else order[::-1]) for k in range(length)])
        size *= length
    return order


def nearest_chain(points: Matrix) -> NDArray[np.intp]:
    """Points (n, dimensions) from the first one on, each followed by the nearest of those that are left."""
    number = len(points)
    order = np.zeros(number, dtype=np.intp)
    left, rest = np.arange(1, number), points[1:].copy()
    for place in range(1, number):
        nearest = int(np.argmin(((rest - points[order[place - 1]]) ** 2).sum(axis=1)))
        order[place] = left[nearest]
        # The last one takes the place of the one that is taken, so that nothing is moved.
        left[nearest], rest[nearest] = left[-1], rest[-1]
        left, rest = left[:-1], rest[:-1]
    return order
