"""Warped volumes: places by slabs on a coarse grid of nodes, samples by blocks, and the result of a pair.

Where voxels come from, by slabs: cubic splines between exactly mapped nodes, and exact places where these err. As for
pictures in `codegen.registration.warp`, nothing is proved of the splines' errors. They are measured at all nodes, with
those of the splines through every second one; a quarter of that is taken for the error, and what is larger than a bound
is mapped exactly, voxel by voxel, with all that lies about it. In space a map has a kink at every landmark, so that
what lies about these is mapped exactly whatever was measured. Distances between nodes are as equal in all directions as
the spacing allows; only one slab of places is in memory at a time.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import binary_dilation, maximum_filter

from codegen.registration.grid import Grid, mesh, slabs
from codegen.registration.jobs import Outcome
from codegen.registration.pairs import PointArray
from codegen.registration.volumes.files import Volume
from codegen.registration.warp import HALVING, ORDERS, basis, sample_band, spline_of

BOUND = 5e-4
"""The largest error of a place in finest spacings: a thousandth of a voxel is promised, and fields are rounded."""
LARGEST = 16
"""Voxels between nodes, at most."""
FEWEST = 6
"""Intervals along an axis, at least: every second node must determine a cubic spline."""
CHEAP = 12
"""Half the distance makes eight times as many nodes, each of which has to be worth more than a voxel."""
CHECKED, NODES_PORTION = 256, 32
"""Cells at whose centres the spline is compared with exact places, and how many of them at once."""

Map: TypeAlias = Callable[[PointArray], PointArray]


@dataclass(frozen=True, eq=False)
class Nodes:
    """Every so-many-th sample of a grid along each axis, `steps`, and what the map adds to its place.

    `lines` are the nodes' indices and `shifts` has shape (slices, rows, columns, 3), in this order. `doubtful` says
    which cells between nodes are to be mapped exactly. `bound` is the largest estimated error of the others, in the
    units of the grid, and `exact` the share of samples that are mapped.
    """

    function: Map
    grid: Grid
    steps: tuple[int, ...]
    lines: tuple[NDArray[np.float64], ...]
    shifts: NDArray[np.float64]
    doubtful: NDArray[np.bool_]
    bound: float

    @classmethod
    def of(cls, function: Map, grid: Grid, singular: PointArray, bound: float = BOUND) -> Nodes:
        """Halve the distance between nodes until that no longer pays; `bound` is in finest spacings.

        `function` carries places, shape (n, 3), and is not smooth at those that are `singular`.
        """
        distance = float(LARGEST)
        while True:
            found = cls._with_steps(function, grid, _steps(grid, distance), singular, bound * grid.pixel)
            cells = found.doubtful.sum() * np.prod(found.steps)
            if max(found.steps) == 1 or cells <= CHEAP * found.shifts[..., 0].size:
                return found.checked(bound * grid.pixel)
            distance *= 0.5

    @classmethod
    def _with_steps(
        cls, function: Map, grid: Grid, steps: tuple[int, ...], singular: PointArray, bound: float
    ) -> Nodes:
        lines = tuple(_line(length, step) for length, step in zip(grid.size[::-1], steps[::-1], strict=True))
        places = grid.to_places(mesh(lines[::-1]))
        shifts = (function(places) - places).reshape(*map(len, lines), 3)
        found = cls(function, grid, steps, lines, shifts, np.zeros([len(line) - 1 for line in lines], np.bool_), 0.0)
        errors = found._errors()
        large = ~(errors <= bound)
        cells = np.floor(grid.to_indices(singular) / steps).astype(int)[:, ::-1]
        inside = ((cells >= 0) & (cells < large.shape)).all(axis=1)
        large[tuple(cells[inside].T)] = True
        doubtful = np.asarray(binary_dilation(large, np.ones((3, 3, 3))))
        left = float(np.where(doubtful, 0.0, errors).max())
        return cls(function, grid, steps, lines, shifts, doubtful, left)

    def _errors(self) -> NDArray[np.float64]:
        """The spline's estimated error in each cell, the largest at its corners."""
        coarse = self.shifts[::2, ::2, ::2]
        for axis, line in enumerate(self.lines):
            coarse = np.asarray(make_interp_spline((line[::2]), coarse, k=3, axis=axis)(line))
        errors = np.linalg.norm(coarse - self.shifts, axis=-1) / HALVING
        return np.asarray(maximum_filter(errors, size=(2, 2, 2), origin=-1)[:-1, :-1, :-1])

    def checked(self, bound: float) -> Nodes:
        """The same with cells of neighbours, too, where the spline errs at the centres of cells that were trusted."""
        trusted = np.argwhere(~self.doubtful)
        chosen = trusted[np.random.default_rng(0).permutation(len(trusted))[:CHECKED]]
        if not len(chosen):
            return self
        steps = np.array(self.steps[::-1])
        inside = ((chosen + 0.5) * steps <= np.array(self.grid.shape) - 1.0).all(axis=1)
        centres = ((chosen[inside] + 0.5) * steps)[:, ::-1]
        if not len(centres):
            return self
        places = self.grid.to_places(centres)
        found = np.concatenate(
            [self._at(centres[k : k + NODES_PORTION]) for k in range(0, len(centres), NODES_PORTION)]
        )
        errors = np.linalg.norm(found - (self.function(places) - places), axis=1)
        doubtful = self.doubtful.copy()
        doubtful[tuple(chosen[inside][~(errors <= bound)].T)] = True
        doubtful = np.asarray(binary_dilation(doubtful, np.ones((3, 3, 3)))) if (errors > bound).any() else doubtful
        left = max(self.bound, float(errors[errors <= bound].max(initial=0.0)))
        return Nodes(self.function, self.grid, self.steps, self.lines, self.shifts, doubtful, left)

    def _at(self, indices: NDArray[np.float64]) -> NDArray[np.float64]:
        """The spline at indices (column, row, slice), shape (n, 3)."""
        z, y, x = (basis(line, at) for line, at in zip(self.lines, indices.T[::-1], strict=True))
        flat = (z @ self._coefficients.reshape(len(self.lines[0]), -1)).reshape(len(indices), *self.shifts.shape[1:])
        rows = np.einsum("nyxc,ny->nxc", flat, y.toarray())
        return np.asarray(np.einsum("nxc,nx->nc", rows, x.toarray()))

    @property
    def exact(self) -> float:
        """The share of samples that are mapped exactly."""
        volumes = [np.diff(np.minimum(line, length)) for line, length in zip(self.lines, self.grid.shape, strict=True)]
        return float(np.einsum("zyx,z,y,x->", self.doubtful.astype(float), *volumes) / self.grid.count)

    @cached_property
    def _coefficients(self) -> NDArray[np.float64]:
        found = self.shifts
        for axis, line in enumerate(self.lines):
            found = np.moveaxis(make_interp_spline(line, np.moveaxis(found, axis, 0), k=3).c, 0, axis)
        return found

    def slab(self, part: slice) -> NDArray[np.float64]:
        """What the map adds to the places of some slices, shape (slices, rows, columns, 3)."""
        found = self._coefficients
        indices = [np.arange(part.start, part.stop), *(np.arange(length) for length in self.grid.shape[1:])]
        for axis, (line, at) in enumerate(zip(self.lines, indices, strict=True)):
            # A sparse matrix applied along an axis.
            matrix = basis(line, at)
            first = np.moveaxis(found, axis, 0)
            made = matrix @ first.reshape(len(first), -1)
            found = np.moveaxis(made.reshape(-1, *first.shape[1:]), 0, axis)
        cells = [np.minimum(at // step, len(line) - 2) for at, step, line in zip(indices, self.steps[::-1], self.lines)]
        marked = np.nonzero(self.doubtful[np.ix_(*cells)])
        if marked[0].size:
            places = self.grid.to_places(np.stack([marked[2], marked[1], marked[0] + part.start], axis=1).astype(float))
            found[marked] = self.function(places) - places
        return found


def _steps(grid: Grid, distance: float) -> tuple[int, ...]:
    """Powers of two along columns, rows and slices, whose lengths are about `distance` finest spacings."""
    steps = []
    for length, spacing in zip(grid.size, grid.spacing, strict=True):
        step = 2 ** max(0, round(np.log2(distance * grid.pixel / spacing)))
        while step > 1 and FEWEST * step > length:
            step //= 2
        steps.append(int(step))
    return tuple(steps)


def _line(length: int, step: int) -> NDArray[np.float64]:
    return step * np.arange(max(FEWEST, 2 * -(-length // (2 * step))) + 1.0)


BLOCKS_PORTION = 1 << 19
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
        columns, rows, slices = grid.size
        for part in list(slabs(slices, max(1, BLOCKS_PORTION // (columns * rows)))):
            shifts = nodes.slab(part)
            if field is not None:
                field[part] = shifts
            indices = _sources(source.grid, grid, part, shifts)

            def one(k: int, first: int = part.start, indices: NDArray[np.float64] = indices) -> int:
                return sample_band([layer], indices[k], source.samples.shape, order, fill, samples[first + k])

            outside += sum(pool.map(one, range(len(indices))))
    return Warped(samples, outside, field)


def _sources(source: Grid, grid: Grid, part: slice, shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Indices (column, row, slice) in the source of the voxels of some slices, shape (slices, rows, columns, 3)."""
    columns, rows, _ = grid.size
    lines = [np.arange(float(columns)), np.arange(float(rows)), np.arange(float(part.start), float(part.stop))]
    places = grid.to_places(mesh(lines))
    places = places + shifts.reshape(places.shape)
    return source.to_indices(places).reshape(shifts.shape)


@dataclass(frozen=True, eq=False, kw_only=True)
class VolumeResult(Outcome):
    """What a job found of volumes, with all that a report shows."""

    moving: Volume
    fixed: Volume | None
    inverse: bool = False
    warped: Warped | None = None

    @property
    def source(self) -> Volume:
        """The volume that is warped."""
        return self.fixed if self.inverse and self.fixed is not None else self.moving

    @property
    def target(self) -> Volume | None:
        """The volume in whose frame the result is, if there is one."""
        return self.moving if self.inverse else self.fixed
