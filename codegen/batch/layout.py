"""What the arrays of a sweep are called, which dimensions they have, and where the numbers of one case belong.

Cases may differ in their number of intervals, and in coordinates and controls where an argument of problem() decides:
arrays are as large as the largest, names stand at the same place in all, and what a case lacks is NaN.

Chunks: blocks of cases that are solved one after the other, and written as a whole.

They belong to the sweep and not to who solves it: results are the same however many processes share the work.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, clause
from codegen.runtime.record import Task
from codegen.solving.drivers import DRIVERS
from codegen.solving.loading import GeneratedModule, Matrix, few_steps
from codegen.solving.results.motions import particle_names
from codegen.solving.results.result import Run, component_names
from codegen.solving.results.segments import multiplier_names, segments_of
from codegen.solving.tasks import task_of

KEPT = ("t", "q", "u")
"""What is kept of each case where nothing is said, and all arrays would be too much."""
FITS = 250_000_000
"""So many bytes of all cases together are not too much, counted before a file compresses them."""
NUMBERS = {"cost": "f8", "residual": "f8", "iterations": "i4", "seconds": "f8"}
JUMPS = {"improvement": "f8", "jump": "i4"}
"""What there is beside where jumps of the cost are looked for: what was won by them, and whether one is left."""
WORDS = ("status", "message")
_COLUMNS = {"q": "coordinate", "p": "momentum", "u": "control", "multipliers": "multiplier"}
"""The dimension of the columns of an array; others have none."""
_ALL = ("t", "q", "p", "u", "multipliers", "energy")
RATE = "d_"
"""What names of derivatives begin with, before that of what they are of."""
BY = "by"
"""The dimension of the quantities by which there are derivatives."""
_RATES = ("t", "q", "p", "u", "multipliers")
"""Arrays that have derivatives."""
RESERVED = frozenset(
    (
        *(*_ALL, *NUMBERS, *JUMPS, *WORDS, *_COLUMNS.values(), "node", "interval", "stage", "case"),
        *(BY, f"{RATE}cost", f"{RATE}message", *(f"{RATE}{name}" for name in _RATES)),
    )
)
"""Names of variables and dimensions, which no varied quantity may have."""


@dataclass(frozen=True)
class Shapes:
    """The arrays of one module: what their rows belong to, and the names of their columns.

    `rows` maps an array to `node`, or to the number of its rows on an interval; `parts` is the number of phases, each
    of which has all intervals that are asked for, and `segments` that of segments, which share them; `steps` are those
    of the problem itself. `free` are free parameters, and `by` is what there are derivatives by, if they are wanted.
    """

    rows: Mapping[str, str | int]
    columns: Mapping[str, tuple[str, ...]]
    parts: int
    segments: int
    every: int
    steps: int
    free: tuple[str, ...] = ()
    by: tuple[str, ...] = ()

    def intervals(self, steps: int) -> int:
        """The number of intervals between the nodes that are stored."""
        if self.segments:
            return self.segments * -(-steps // self.segments)
        return self.parts * (steps // self.every)


def shapes_of(module: Any, every: int, sensitivities: bool = False, particles: int = 0) -> Shapes:
    """The arrays of a module, read from it without solving; with derivatives, if `sensitivities` are wanted.

    `particles` are those that are connected.
    """
    metadata, task = module.metadata, task_of(module)
    if task.name == "connect":
        own = {name: words for name, words in particle_names(metadata, particles).items() if words}
        return Shapes(dict.fromkeys(("t", "q", "p", "energy"), "node"), own, 1, 0, 1, metadata.steps)
    names, segments = component_names(metadata), segments_of(metadata)
    rows: dict[str, str | int] = {"t": "node", "q": "node", "p": "node"}
    columns = {name: names[name] for name in ("q", "p", "u") if names[name]}
    if task.name == "simulate":
        return Shapes({**rows, "energy": "node"}, columns, 1, 0, every, metadata.steps)
    grid = module.make_grid(few_steps(module, 4))
    arrays = module.unpack(grid, module.initial_guess(grid))
    nodes, bodies = len(arrays[0]), metadata.bodies
    for name, array in zip(("u", "multipliers"), arrays[3:5], strict=True):
        rows[name] = "node" if len(array) == nodes else len(array) // (nodes - 1)
    labels = tuple(multiplier_names(metadata, arrays[4].shape[1] // bodies))
    columns["multipliers"] = labels if bodies == 1 else tuple(f"{one}_{k}" for k in range(bodies) for one in labels)
    if segments is not None:
        columns = {name: segments.columns(own)[0] for name, own in columns.items()}
    number = segments.number if segments else 0
    return Shapes(
        rows, columns, metadata.phases, number, 1, metadata.steps * max(1, number),
        tuple(metadata.free_parameters), tuple(metadata.sensitivities) if sensitivities else (),
    )  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """The arrays of all cases: their dimensions beside those of cases, the sizes of these, and the names of columns.

    `free` are free parameters, which are numbers of each case; `left_out` are arrays for which all cases are too many.
    """

    dims: Mapping[str, tuple[str, ...]]
    sizes: Mapping[str, int]
    names: Mapping[str, tuple[str, ...]]
    has_jumps: bool = False
    free: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def numbers(self) -> dict[str, str]:
        """The numbers of each case and their kinds."""
        return {**NUMBERS, **(JUMPS if self.has_jumps else {}), **{free_label(name): "f8" for name in self.free}}

    @property
    def words(self) -> tuple[str, ...]:
        """The texts of each case."""
        return (*WORDS, f"{RATE}message") if self.has_rates else WORDS

    @property
    def has_rates(self) -> bool:
        """Whether there are derivatives."""
        return BY in self.names

    @property
    def rates(self) -> tuple[str, ...]:
        """The arrays of which derivatives are kept."""
        return tuple(name for name in _RATES if f"{RATE}{name}" in self.dims)

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each array for one case."""
        return {name: tuple(self.sizes[dim] for dim in dims) for name, dims in self.dims.items()}

    @property
    def bytes(self) -> int:
        """What the arrays of one case take before they are compressed."""
        return 8 * sum(math.prod(shape) for shape in self.shapes.values())

    def placed(self, name: str, array: Matrix, columns: Sequence[str]) -> Matrix:
        """The numbers of a case in the shape of its array, NaN where it has none."""
        dims = self.dims[name]
        if "stage" in dims:
            array = array.reshape(-1, self.sizes["stage"], array.shape[1])
        if array.shape == self.shapes[name] and (array.ndim == 1 or columns == self.names[dims[-1]]):
            return array
        whole = np.full(self.shapes[name], np.nan)
        if array.ndim == 1:
            whole[: array.size] = array
        else:
            own = [self.names[dims[-1]].index(column) for column in columns]
            whole[: len(array), ..., own] = array
        return whole

    def placed_rates(self, name: str, rates: NDArray[np.float64], shapes: Shapes) -> NDArray[np.float64]:
        """Derivatives (m, ...) of a case by the quantities of its module in the shape of their array."""
        whole = np.full(self.shapes[name], np.nan)
        of = name.removeprefix(RATE)
        columns = shapes.columns.get(of, ())
        for quantity, row in zip(shapes.by, rates, strict=True):
            place = self.names[BY].index(quantity)
            whole[place] = self.placed(of, row, columns) if of in self.dims else row
        return whole


def free_label(name: str) -> str:
    """What the variable of a free parameter is called: with an underscore, if it has the name of another one."""
    return f"{name}_" if name in RESERVED else name


def layout_of(shapes: Iterable[Shapes], steps: int | None, keep: Sequence[str] | None, cases: int) -> Layout:
    """The arrays that are kept of so many cases of some modules, of at most so many intervals, or of each module's own.

    Without a word, None, all that fit are. Raises ArgumentError where a name is that of no array, or where arrays of
    the modules do not fit together.
    """
    shapes = tuple(shapes)
    have = [name for name in _ALL if any(name in own.rows and _has(own, name) for own in shapes)]
    if keep is None:
        every = _laid(shapes, steps, [name for name in have if name in KEPT or _is_one(shapes, name)], have)
        if every.bytes * cases <= FITS:
            return every
        left_out = tuple(name for name in _ALL if name in every.dims and name not in KEPT)
        return replace(_laid(shapes, steps, [name for name in KEPT if name in have], have), left_out=left_out)
    return _laid(shapes, steps, keep, have)


def _is_one(shapes: Iterable[Shapes], name: str) -> bool:
    return len({own.rows[name] for own in shapes if name in own.rows and _has(own, name)}) == 1


def _laid(shapes: Sequence[Shapes], steps: int | None, keep: Sequence[str], have: Sequence[str]) -> Layout:
    """The layout of arrays with these names, of those that the modules have."""
    by = tuple(dict.fromkeys(name for own in shapes for name in own.by))
    free = tuple(dict.fromkeys(name for own in shapes for name in own.free))
    rates = [name for name in _RATES if by and name in have and f"{RATE}{name}" in keep]
    keep = _required(keep, [*have, *(f"{RATE}{name}" for name in _RATES if by and name in have)], by)
    dims: dict[str, tuple[str, ...]] = {}
    names: dict[str, tuple[str, ...]] = {}
    intervals = max(own.intervals(steps or own.steps) for own in shapes)
    sizes = {"node": intervals + 1, "interval": intervals}
    for name in (name for name in have if name in keep or name in rates):
        rows = {own.rows[name] for own in shapes if name in own.rows and _has(own, name)}
        if len(rows) > 1:
            raise ArgumentError(f"--keep {name}: some of the modules have it elsewhere than others", "leave it out")
        row = rows.pop()
        own_dims = ("node",) if row == "node" else ("interval",) if row == 1 else ("interval", "stage")
        sizes |= {"stage": int(row)} if "stage" in own_dims else {}
        dims[name] = own_dims
        if name in _COLUMNS:
            column = _COLUMNS[name]
            dims[name] = (*own_dims, column)
            names[column] = tuple(dict.fromkeys(word for own in shapes for word in own.columns.get(name, ())))
            sizes[column] = len(names[column])
    if by:
        names[BY], sizes[BY] = by, len(by)
        dims |= {f"{RATE}{name}": (BY,) for name in ("cost", *map(free_label, free))}
        dims |= {f"{RATE}{name}": (BY, *dims[name]) for name in rates}
    used = {dim for own_dims in dims.values() for dim in own_dims}
    return Layout(dims, {dim: size for dim, size in sizes.items() if dim in used}, names, free=free)


def _required(keep: Sequence[str], have: Sequence[str], by: Sequence[str]) -> Sequence[str]:
    """The names of arrays to be kept; ArgumentError where one is none."""
    for name in keep:
        if name in have:
            continue
        if name.startswith(RATE) and name.removeprefix(RATE) in _RATES and not by:
            raise ArgumentError(clause(f"--keep {name}: there are no derivatives"), "give --sensitivities as well")
        raise ArgumentError(clause(f"--keep {name}: there is no such array"), f"keep some of {', '.join(have)}")
    return keep


def _has(own: Shapes, name: str) -> bool:
    return name not in _COLUMNS or bool(own.columns.get(name))


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
