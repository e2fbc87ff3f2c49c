"""Warped volumes and displacement fields, slab by slab, so that few places are in memory at a time."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.registration.grid import Grid, mesh, slabs
from codegen.registration.volumes.files import Volume
from codegen.registration.volumes.nodes import Nodes
from codegen.registration.warp import ORDERS, sample_band, spline_of

PORTION = 1 << 19
"""Voxels whose places are in memory at once."""


@dataclass(frozen=True, eq=False)
class Warped:
    """Samples of the result, shape (slices, rows, columns), and how many of them come from outside the source.

    `field`, shape (slices, rows, columns, 3), or None if it was not asked for, is what is added to the place of a voxel
    of the result to come to that in the source at which its value is read.
    """

    samples: NDArray[Any]
    outside: int
    field: NDArray[np.float32] | None


def warped(source: Volume, nodes: Nodes, interpolation: str, with_field: bool = False, fill: float = 0.0) -> Warped:
    """The source in the grid of the nodes, whose map says where voxels come from; its dtype is kept."""
    grid, order = nodes.grid, ORDERS[interpolation]
    samples = np.empty(grid.shape, source.samples.dtype)
    field = np.empty((*grid.shape, 3), np.float32) if with_field else None
    layer, outside = spline_of(source.samples, order), 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for part in _parts(grid):
            shifts = nodes.slab(part)
            if field is not None:
                field[part] = shifts
            indices = _sources(source.grid, grid, part, shifts)

            def one(k: int, first: int = part.start, indices: NDArray[np.float64] = indices) -> int:
                return sample_band([layer], indices[k], source.samples.shape, order, fill, samples[first + k])

            outside += sum(pool.map(one, range(len(indices))))
    return Warped(samples, outside, field)


def _parts(grid: Grid) -> list[slice]:
    columns, rows, slices = grid.size
    return list(slabs(slices, max(1, PORTION // (columns * rows))))


def _sources(source: Grid, grid: Grid, part: slice, shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Indices (column, row, slice) in the source of the voxels of some slices, shape (slices, rows, columns, 3)."""
    columns, rows, _ = grid.size
    lines = [np.arange(float(columns)), np.arange(float(rows)), np.arange(float(part.start), float(part.stop))]
    places = grid.to_places(mesh(lines))
    places = places + shifts.reshape(places.shape)
    return source.to_indices(places).reshape(shifts.shape)
