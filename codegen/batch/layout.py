"""The names, dimensions and shapes of the arrays of a sweep, and the chunks of cases that are solved together.

Cases may differ in their number of intervals. With arguments of problem() they may differ in coordinates and controls.
Arrays have the size of the largest case; missing entries are NaN.

Chunks are blocks of cases that are solved in sequence and written together. The division into chunks does not depend on
the number of processes, so the results do not either.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, clause
from codegen.runtime.record import Form, Task
from codegen.solving.drivers import DRIVERS, task_of
from codegen.solving.loading import GeneratedModule, Matrix, few_steps, is_of_particles
from codegen.solving.results.motions import FIRST_TIMES, event_labels, particle_names
from codegen.solving.results.result import Run, component_names
from codegen.solving.results.segments import multiplier_names, segments_of

Rows = dict[str, NDArray[Any]]
"""The results of a chunk: arrays by name, with a row for each case in the order of the cases."""
KEPT = ("t", "q", "u", "event_counts", "event_times")
"""Arrays that are stored by default when all arrays would take too much space."""
FITS = 250_000_000  # bytes of all arrays, before compression, up to which all arrays are stored by default
NUMBERS = {"cost": "f8", "residual": "f8", "iterations": "i4", "seconds": "f8"}
JUMPS = {"improvement": "f8", "jump": "i4"}
"""Additional numbers of each case if jumps are detected: the reduction of the cost by a new start, and 1 at a jump."""
WORDS = ("status", "message")
COLUMNS = {
    "q": "coordinate", "p": "momentum", "u": "control", "multipliers": "multiplier",
    "event_counts": "event", "event_times": "event",
}  # fmt: skip
"""Name of the column dimension of each array with columns."""
_ALL = ("t", "q", "p", "u", "multipliers", "energy", "event_counts", "event_times")
_ROWS: Mapping[str | int, tuple[str, ...]] = {
    "node": ("node",), 1: ("interval",), "case": (), "occurrence": ("occurrence",)
}  # fmt: skip
"""The dimensions of rows of each kind; other numbers are those of the stages of an interval."""
RATE = "d_"  # prefix of the names of derivatives
BY = "by"  # name of the dimension of the quantities with respect to which derivatives are taken
_RATES = ("t", "q", "p", "u", "multipliers")  # arrays whose derivatives can be stored
RESERVED = frozenset(
    (
        *(*_ALL, *NUMBERS, *JUMPS, *WORDS, *COLUMNS.values(), "node", "interval", "stage", "case"),
        *(BY, f"{RATE}cost", f"{RATE}message", *(f"{RATE}{name}" for name in _RATES)),
    )
)
"""Names of variables and dimensions, which no varied quantity may have."""


@dataclass(frozen=True)
class Shapes:
    """The arrays of one module: the kind of their rows, and the names of their columns.

    `rows` maps an array to `node`, to `case` for one row, to `occurrence` for the first times of events, or to its
    number of rows on an interval. `parts` is the number of phases, each with
    all intervals; `segments` is the number of segments, which share the intervals. `every` is the number of steps
    between stored nodes, `steps` the problem's own number of steps. `free` names the free parameters, and `by` the
    quantities with respect to which derivatives are taken.
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
        """Return the number of intervals between stored nodes, for a number of time steps."""
        if self.segments:
            return self.segments * -(-steps // self.segments)
        return -(-self.parts * steps // self.every)


def shapes_of(module: Any, every: int, sensitivities: bool = False, particles: int = 0) -> Shapes:
    """Return the shapes of the arrays of a module, with the quantities of derivatives if `sensitivities` is set.

    A simulation stores every `every`-th step. `particles` is the number of particles of a module that connects points.
    """
    metadata, task = module.metadata, task_of(module)
    if task.name == "connect":
        own = {name: words for name, words in particle_names(metadata, particles).items() if words}
        return Shapes(dict.fromkeys(("t", "q", "p", "energy"), "node"), own, 1, 0, 1, metadata.steps)
    names, segments = component_names(metadata), segments_of(metadata)
    rows: dict[str, str | int] = {"t": "node", "q": "node", "p": "node"}
    columns = {name: names[name] for name in ("q", "p", "u") if names[name]}
    if task.name == "simulate":
        if metadata.form != Form.FIRST_ORDER:
            rows["energy"] = "node"
        if labels := event_labels(metadata):
            rows |= {"event_counts": "case", "event_times": "occurrence"}
            columns |= {"event_counts": labels, "event_times": labels}
        return Shapes(rows, columns, 1, 0, every, metadata.steps)
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
    """The stored arrays: their dimensions `dims` within a case, the `sizes` of dimensions, and the `names` of columns.

    `free` are free parameters, one number for each case. `left_out` are arrays that would take too much space.
    """

    dims: Mapping[str, tuple[str, ...]]
    sizes: Mapping[str, int]
    names: Mapping[str, tuple[str, ...]]
    has_jumps: bool = False
    free: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def numbers(self) -> dict[str, str]:
        """The names and types of the numbers of each case."""
        return {**NUMBERS, **(JUMPS if self.has_jumps else {}), **{free_label(name): "f8" for name in self.free}}

    @property
    def words(self) -> tuple[str, ...]:
        """The names of the texts of each case."""
        return (*WORDS, f"{RATE}message") if self.has_rates else WORDS

    @property
    def has_rates(self) -> bool:
        """True if derivatives are stored."""
        return BY in self.names

    @property
    def rates(self) -> tuple[str, ...]:
        """The arrays whose derivatives are stored."""
        return tuple(name for name in _RATES if f"{RATE}{name}" in self.dims)

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each array for one case."""
        return {name: tuple(self.sizes[dim] for dim in dims) for name, dims in self.dims.items()}

    @property
    def bytes(self) -> int:
        """Bytes of the arrays of one case before compression."""
        return 8 * sum(math.prod(shape) for shape in self.shapes.values())

    def placed(self, name: str, array: Matrix, columns: Sequence[str]) -> Matrix:
        """Return arrays (..,) of cases with these columns in the shape common to all cases; missing entries are NaN."""
        dims, shape = self.dims[name], self.shapes[name]
        if "stage" in dims:
            array = array.reshape(*array.shape[:-2], -1, self.sizes["stage"], array.shape[-1])
        names = self.names.get(dims[-1])
        if array.shape[-len(shape) :] == shape and names in (None, columns):
            return array
        cases = array.shape[: array.ndim - len(shape)]
        whole, (*inner, last) = np.full((*cases, *shape), np.nan), array.shape[len(cases) :]
        own = slice(last) if names is None else [names.index(column) for column in columns]
        whole[(..., *map(slice, inner), own)] = array
        return whole

    def placed_rates(self, name: str, rates: NDArray[np.float64], shapes: Shapes) -> NDArray[np.float64]:
        """Return derivatives (m, ...) with respect to the m quantities `shapes.by` in the shape common to all cases."""
        whole = np.full(self.shapes[name], np.nan)
        of = name.removeprefix(RATE)
        places = [self.names[BY].index(quantity) for quantity in shapes.by]
        whole[places] = self.placed(of, rates, shapes.columns.get(of, ())) if of in self.dims else rates
        return whole


def free_label(name: str) -> str:
    """Return the variable name of a free parameter, with an underscore if the name is reserved."""
    return f"{name}_" if name in RESERVED else name


def layout_of(shapes: Iterable[Shapes], steps: int | None, keep: Sequence[str] | None, cases: int) -> Layout:
    """Return the layout of the arrays to store for `cases` cases of modules with these shapes.

    `steps` is the largest number of steps, or None for each module's own number. `keep` names arrays, or is None for
    all that fit into FITS bytes. Raises ArgumentError for an array that is unknown or differs in kind between modules.
    """
    shapes = tuple(shapes)
    have = [name for name in _ALL if _row_kinds(shapes, name)]
    if keep is None:
        consistent = [name for name in have if name in KEPT or len(_row_kinds(shapes, name)) == 1]
        every = _layout_with(shapes, steps, consistent, have)
        if every.bytes * cases <= FITS:
            return every
        left_out = tuple(name for name in _ALL if name in every.dims and name not in KEPT)
        return replace(_layout_with(shapes, steps, [name for name in KEPT if name in have], have), left_out=left_out)
    return _layout_with(shapes, steps, keep, have)


def _layout_with(shapes: Sequence[Shapes], steps: int | None, keep: Sequence[str], have: Sequence[str]) -> Layout:
    """Return the layout of the arrays named in `keep`; `have` names all arrays of the modules."""
    by = tuple(dict.fromkeys(name for own in shapes for name in own.by))
    free = tuple(dict.fromkeys(name for own in shapes for name in own.free))
    rates = [name for name in _RATES if by and name in have and f"{RATE}{name}" in keep]
    known = [*have, *(f"{RATE}{name}" for name in _RATES if by and name in have)]
    for name in keep:
        if name not in known and name.startswith(RATE) and name.removeprefix(RATE) in _RATES and not by:
            raise ArgumentError(clause(f"--keep {name}: there are no derivatives"), "give --sensitivities as well")
        if name not in known:
            raise ArgumentError(clause(f"--keep {name}: there is no such array"), f"keep some of {', '.join(known)}")
    dims: dict[str, tuple[str, ...]] = {}
    names: dict[str, tuple[str, ...]] = {}
    intervals = max(own.intervals(steps or own.steps) for own in shapes)
    sizes = {"node": intervals + 1, "interval": intervals, "occurrence": FIRST_TIMES}
    for name in (name for name in have if name in keep or name in rates):
        rows = _row_kinds(shapes, name)
        if len(rows) > 1:
            raise ArgumentError(f"--keep {name}: some of the modules have it elsewhere than others", "leave it out")
        row = rows.pop()
        own_dims = _ROWS.get(row, ("interval", "stage"))
        sizes |= {"stage": int(row)} if "stage" in own_dims else {}
        dims[name] = own_dims
        if name in COLUMNS:
            column = COLUMNS[name]
            dims[name] = (*own_dims, column)
            names[column] = tuple(dict.fromkeys(word for own in shapes for word in own.columns.get(name, ())))
            sizes[column] = len(names[column])
    if by:
        names[BY], sizes[BY] = by, len(by)
        dims |= {f"{RATE}{name}": (BY,) for name in ("cost", *map(free_label, free))}
        dims |= {f"{RATE}{name}": (BY, *dims[name]) for name in rates}
    used = {dim for own_dims in dims.values() for dim in own_dims}
    return Layout(dims, {dim: size for dim, size in sizes.items() if dim in used}, names, free=free)


def _row_kinds(shapes: Iterable[Shapes], name: str) -> set[str | int]:
    """Return the different kinds of rows, as in `Shapes.rows`, of an array in the modules that have the array."""
    return {own.rows[name] for own in shapes if name in own.rows and (name not in COLUMNS or own.columns.get(name))}


MOST = 4096
"""Largest number of cases of a chunk; the time of the search for neighbours grows with its square."""
OVERHEAD = 3e-4  # seconds that a case takes in addition to its iterations, unless it is followed in an ensemble
CONTROL_RATE, SIMULATE_RATE, ENSEMBLE_RATE, CONNECT_RATE = 1.6e-8, 3e-7, 1e-7, 5e-9
"""Seconds per unit of work. The work of an optimisation is iterations * intervals * (unknowns of an interval)^2, of a
simulation steps * coordinates, and of connected particles iterations * steps * (all coordinates)^2.
"""
RATES = 5  # number of iterations that take as long as the sensitivities of a case
SLOWER = 50.0  # time of external drivers relative to generated solvers


@dataclass(frozen=True)
class Chunks:
    """The division of a grid of cases of a `shape` into blocks; blocks at the end of a dimension may be smaller."""

    shape: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of blocks along every dimension."""
        return tuple(-(-size // part) for size, part in zip(self.shape, self.block, strict=True))

    @property
    def number(self) -> int:
        """Number of blocks."""
        return math.prod(self.counts)

    def region(self, number: int) -> tuple[slice, ...]:
        """Return the slice of a block in each dimension; the last dimension of block numbers varies fastest."""
        place = np.unravel_index(number, self.counts)
        begins = (int(k) * part for k, part in zip(place, self.block, strict=True))
        return tuple(slice(begin, min(begin + part, size)) for begin, part, size in zip(begins, self.block, self.shape))

    def extent(self, number: int) -> tuple[int, ...]:
        """Return the shape of a block."""
        return tuple(part.stop - part.start for part in self.region(number))

    def cases(self, number: int) -> NDArray[np.intp]:
        """Return the indices (n,) of the cases of a block; the last dimension varies fastest."""
        parts = np.ix_(*(np.arange(part.start, part.stop) for part in self.region(number)))
        return np.asarray(np.ravel_multi_index(parts, self.shape)).ravel()


@dataclass(frozen=True, eq=False)
class Piece:
    """The data of a chunk for its worker: its number, its slices in the grid, and its n cases in their order.

    `columns` has the values (n,) of each quantity, `points` (n, quantities) the values scaled by their ranges.
    """

    number: int
    region: tuple[slice, ...]
    is_grid: bool
    columns: Mapping[str, NDArray[np.float64] | NDArray[np.str_]]
    points: NDArray[np.float64]

    @property
    def extent(self) -> tuple[int, ...]:
        """The shape of the block."""
        return tuple(part.stop - part.start for part in self.region)


def blocks_of(shape: Sequence[int], size: int, whole: Sequence[bool]) -> Chunks:
    """Return blocks of about `size` cases: whole rows of the last dimensions, then a part of one dimension.

    A dimension that is not `whole` is cut into single values, because its values belong to different modules.
    """
    block, remaining = [1] * len(shape), max(1, min(size, MOST))
    for axis in reversed(range(len(shape))):
        if not whole[axis]:
            continue
        block[axis] = min(shape[axis], remaining)
        remaining //= block[axis]
        if block[axis] < shape[axis] or not remaining:
            break
    return Chunks(tuple(shape), tuple(block))


def about_a_second(module: GeneratedModule, driver: str, run: Run, iterations: int, has_rates: bool = False) -> int:
    """Return the number of cases that take about a second, from the number of iterations of a typical case.

    The number follows from counts and not from measured times. So a sweep has the same chunks and results on every run.
    """
    metadata, is_generated, seconds = cast("Any", module.metadata), DRIVERS[driver].generated, OVERHEAD
    if metadata.task == Task.CONTROL:
        width = len(metadata.node) + len(metadata.interval)
        intervals = run.steps * metadata.bodies * metadata.phases
        seconds += CONTROL_RATE * (iterations + RATES * has_rates) * intervals * width**2
    elif metadata.task == Task.CONNECT:
        assert run.points is not None, "there are points to connect"
        seconds += CONNECT_RATE * max(iterations, 1) * run.steps * run.points.start.size**2
    else:
        is_ensemble, work = is_generated and not is_of_particles(module), max(iterations, run.steps)
        rate, seconds = (ENSEMBLE_RATE, 0.0) if is_ensemble else (SIMULATE_RATE, OVERHEAD)
        seconds += rate * work * len(metadata.coordinates)
    return max(1, min(MOST, int(1.0 / (seconds if is_generated else SLOWER * seconds))))


def serpentine(shape: Sequence[int]) -> NDArray[np.intp]:
    """Return the indices of all cases of a grid in an order in which successive cases are neighbours.

    Every other row is reversed, in all dimensions; in the indices the last dimension varies fastest.
    """
    order = np.zeros(1, dtype=np.intp)
    size = 1
    for length in reversed(shape):
        order = np.concatenate([k * size + (order if k % 2 == 0 else order[::-1]) for k in range(length)])
        size *= length
    return order


def nearest_chain(points: Matrix) -> NDArray[np.intp]:
    """Return an order (n,) of points (n, dimensions): the first point, then always the nearest remaining point."""
    number = len(points)
    order = np.zeros(number, dtype=np.intp)
    remaining, rest = np.arange(1, number), points[1:].copy()
    for k in range(1, number):
        nearest = int(np.argmin(((rest - points[order[k - 1]]) ** 2).sum(axis=1)))
        order[k] = remaining[nearest]
        # The last point replaces the removed one, so that no other point moves.
        remaining[nearest], rest[nearest] = remaining[-1], rest[-1]
        remaining, rest = remaining[:-1], rest[:-1]
    return order
