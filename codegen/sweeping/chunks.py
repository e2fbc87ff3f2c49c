"""Chunks: blocks of cases that are solved one after the other, and written as a whole.

They belong to the sweep and not to who solves it: results are the same however many processes share the work.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.drivers import DRIVERS
from codegen.interfaces import GeneratedModule, Matrix
from codegen.runtime.record import Task
from codegen.solutions.result import Run

MOST = 4096
"""The most cases of a chunk: finding neighbours takes time in proportion to their square."""
OVERHEAD = 3e-4
"""Seconds that a case takes beside its iterations."""
CONTROL_RATE, SIMULATE_RATE, CONNECT_RATE = 1.6e-8, 3e-7, 5e-9
"""Seconds per iteration, interval and square of the unknowns on it; of a simulation per step and number of a state; of
particles that are connected per iteration, step and square of all coordinates."""
RATES = 5
"""As many iterations take as long as the sensitivities of a case."""
SLOWER = 50.0
"""How many times as long drivers take that are no generated solver."""


@dataclass(frozen=True)
class Chunks:
    """The cells of a grid of cases, cut into blocks of one shape, smaller at the far edges; counted likewise."""

    shape: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """How many blocks there are along every dimension."""
        return tuple(-(-size // part) for size, part in zip(self.shape, self.block, strict=True))

    @property
    def number(self) -> int:
        """How many blocks there are."""
        return math.prod(self.counts)

    def region(self, number: int) -> tuple[slice, ...]:
        """Where a block lies in each dimension."""
        place = np.unravel_index(number, self.counts)
        begins = (int(k) * part for k, part in zip(place, self.block, strict=True))
        return tuple(slice(begin, min(begin + part, size)) for begin, part, size in zip(begins, self.block, self.shape))

    def extent(self, number: int) -> tuple[int, ...]:
        """The shape of a block."""
        return tuple(part.stop - part.start for part in self.region(number))

    def cases(self, number: int) -> NDArray[np.intp]:
        """The cases of a block (n,), with its last dimension varying fastest."""
        parts = np.ix_(*(np.arange(part.start, part.stop) for part in self.region(number)))
        return np.asarray(np.ravel_multi_index(parts, self.shape)).ravel()


@dataclass(frozen=True, eq=False)
class Piece:
    """A chunk as whoever solves it needs it: where it lies, and its cases in the order in which they are counted.

    `columns` has the values (n,) of each quantity, `points` (n, quantities) has them in parts of their ranges.
    """

    number: int
    region: tuple[slice, ...]
    is_grid: bool
    columns: Mapping[str, NDArray[Any]]
    points: NDArray[np.float64]

    @property
    def extent(self) -> tuple[int, ...]:
        """The shape of the block."""
        return tuple(part.stop - part.start for part in self.region)


def blocks_of(shape: Sequence[int], size: int, whole: Sequence[bool]) -> Chunks:
    """Blocks of about `size` cells: whole rows of the last dimensions as far as they fit, then a part of one.

    A dimension that is not `whole` is cut into single cells: its values belong to different modules.
    """
    block, left = [1] * len(shape), max(1, min(size, MOST))
    for axis in reversed(range(len(shape))):
        if not whole[axis]:
            continue
        block[axis] = min(shape[axis], left)
        left //= block[axis]
        if block[axis] < shape[axis] or not left:
            break
    return Chunks(tuple(shape), tuple(block))


def about_a_second(module: GeneratedModule, driver: str, run: Run, iterations: int, has_rates: bool = False) -> int:
    """How many cases like one that took so many iterations, with sensitivities or not, are about a second of work.

    Counted, and not measured, so that the same sweep has the same chunks, and so the same results, on any day.
    """
    metadata: Any = module.metadata
    if metadata.task == Task.CONTROL:
        width = len(metadata.node) + len(metadata.interval)
        intervals = run.steps * metadata.bodies * metadata.phases
        seconds = CONTROL_RATE * (iterations + RATES * has_rates) * intervals * width**2
    elif metadata.task == Task.CONNECT:
        assert run.points is not None, "there are points to connect"
        seconds = CONNECT_RATE * max(iterations, 1) * run.steps * run.points.start.size**2
    else:
        seconds = SIMULATE_RATE * max(iterations, run.steps) * len(metadata.coordinates)
    return max(1, min(MOST, int(1.0 / (OVERHEAD + seconds * (1.0 if DRIVERS[driver].generated else SLOWER)))))


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
