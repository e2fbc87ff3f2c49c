"""Landmarks that are given twice: pairs that are one to within what nobody can see, which are carried as one.

Two points so close have nearly the same rows in the Green's function; below some 1e-5 pixels rounding makes their
momenta arbitrary, and no motion is found although there is an obvious one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

ONE = 1e-4
"""Distance in pixels, in the moving and in the fixed image, up to which two pairs are carried as one."""


def groups_of(moving: NDArray[np.float64], fixed: NDArray[np.float64], pixel: float = 1.0) -> NDArray[np.intp]:
    """The number of the group of each pair, from zero in the order of their first members, shape (n,).

    `pixel` is the size of a pixel in the units of the points.
    """
    close = KDTree(fixed).query_pairs(ONE * pixel, output_type="ndarray")
    close = close[np.linalg.norm(moving[close[:, 0]] - moving[close[:, 1]], axis=1) <= ONE * pixel]
    count = len(fixed)
    if not close.size:
        return np.arange(count)
    graph = coo_array((np.ones(len(close)), (close[:, 0], close[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    _, first, numbers = np.unique(labels, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[numbers], dtype=np.intp)
