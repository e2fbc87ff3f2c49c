"""The work of a sweep: solving the cases of one chunk, in whatever process, and what becomes of their numbers.

It can be pickled, and is small: an executor sends it to its workers once, and then the numbers of chunks.

The modules of a sweep: one for each combination of arguments of problem() that vary, derived and compiled once.
"""

from __future__ import annotations

import hashlib
import math
import platform
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from codegen.batch.case import Attempt, Continuation, Start, Variant, Varied, not_built, solve_case
from codegen.batch.cases import Cases, rows_of
from codegen.batch.executors import Working
from codegen.batch.executors.chunks import (
    LOST,
    Abandoned,
    Done,
    Tally,
    Target,
    alone,
    compiled_note,
    target,
    workers_folder,
)
from codegen.batch.jumps import Grid, Neighbours, along_dimensions, improved, is_better, scattered
from codegen.batch.layout import (
    JUMPS,
    RATE,
    Chunks,
    Layout,
    Piece,
    Shapes,
    free_label,
    nearest_chain,
    serpentine,
    shapes_of,
)
from codegen.batch.request import GUESS, STEPS, CaseRates, Quantity, Wanted, as_argument, quantities, require_fitting
from codegen.errors import ArgumentError, CodegenError
from codegen.files import write_text
from codegen.solving import compiler, loading
from codegen.solving.drivers import DRIVERS
from codegen.solving.machine_code import ahead_of_time
from codegen.solving.outcome import points_of
from codegen.solving.request import Request
from codegen.solving.results.overrides import require_apart_from_arrays, require_apart_from_delays
from codegen.solving.results.result import Run
from codegen.solving.results.sensitivities import UNSOLVED, require_sensitive

if TYPE_CHECKING:
    from codegen.problem.points import PointSet


@dataclass(frozen=True, eq=False)
class Texts:
    """The texts of modules by their variants, and the machine that they come from."""

    texts: dict[tuple[str, ...], str]
    origin: Target

    def placed(
        self, variants: Mapping[tuple[str, ...], Variant], driver: str
    ) -> tuple[dict[tuple[str, ...], Variant], tuple[str, ...]]:
        """The variants where this machine has their modules, compiled for it, and what is to be said of it."""
        here, notes, found = target(), [], dict(variants)
        for key, text in self.texts.items():
            variant = variants[key]
            assert variant.path is not None, "what has a text has a name"
            path = variant.path if self._is_here(variant.path, text, here) else _place(variant.path.name, text, here)
            if _compiled(path, text, driver):
                notes.append(compiled_note(path.stem, here, self.origin, "the sweep"))
            found[key] = replace(variant, path=path)
        return found, tuple(notes)

    def _is_here(self, path: Path, text: str, here: Target) -> bool:
        """Whether the module is there in the same place, and its machine code, if there is some, fits."""
        try:
            return here == self.origin and path.read_text(encoding="utf-8") == text
        except (OSError, UnicodeDecodeError):
            return False


def _place(name: str, text: str, here: Target) -> Path:
    """Where this machine keeps a module; several may share a disk."""
    machine = f"{platform.node()}-{here.processor}-{here.features}-numba-{here.numba}-python-{here.python}"
    return workers_folder() / machine / hashlib.sha256(text.encode()).hexdigest()[:20] / name


def _compiled(path: Path, text: str, driver: str) -> bool:
    """Have a module where it belongs, with its machine code; whether it was this process that had to compile it."""
    with alone(str(path)):
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, text)
        if not DRIVERS[driver].generated:
            return False
        seconds, _ = ahead_of_time.require(path, loading.load(path), False, lambda what: nullcontext())
        return seconds > 0.0


Rows = dict[str, NDArray[Any]]
"""Arrays by name, with a row for each case of a chunk in the order in which cases are counted."""
APART = 1e6
"""How far cases of different modules are from each other, in parts of ranges."""


class Sink(Protocol):
    """Where the rows of a chunk go in the process that has made them."""

    def write(self, region: tuple[slice, ...], rows: Rows) -> None:
        """Write the rows of a chunk to its place among the cases."""

    def mark(self) -> tuple[int, ...]:
        """What only this place has; another machine where it is the same can write to it as well."""


@dataclass(frozen=True, eq=False)
class Work:
    """All that solving any chunk needs; `run` holds what all cases share, but for `steps`, None for a module's own.

    `variants` are the modules, by the texts of the arguments of problem() that vary; `module` is one in no file.
    """

    driver: str
    run: Run
    steps: int | None
    cases: Cases
    quantities: tuple[Quantity, ...]
    variants: Mapping[tuple[str, ...], Variant]
    layout: Layout
    chunks: Chunks
    warm_starts: bool
    sink: Sink | None = None
    module: Any = None

    def piece(self, number: int) -> Piece:
        """What solving a chunk needs beside the work; it is as small as the chunk."""
        indices = self.chunks.cases(number)
        columns, points = self.cases.chosen(indices), self.cases.points(indices)
        return Piece(number, self.chunks.region(number), self.cases.is_grid, columns, points)

    def parcel(self) -> Parcel:
        """What is to be sent, whose size does not depend on the number of cases: workers are given each piece.

        ArgumentError where a module is in no file.
        """
        if self.module is not None:
            remedy = "build it, and give its path"
            raise ArgumentError("a module that is in no file cannot be sent to a cluster", remedy)
        bare = replace(self, cases=Cases((), (), {}, {}), chunks=Chunks((), ()))
        # The texts of what is in files.
        variants = self.variants
        texts = {
            key: variant.path.read_text(encoding="utf-8")
            for key, variant in variants.items()
            if variant.path is not None and variant.shapes is not None
        }
        return Parcel(bare, Texts(texts, target()), () if self.sink is None else self.sink.mark())

    def returned(self, number: int, done: Done) -> Done:
        """Write the rows of a worker who does not see the sink."""
        if done.rows is None or self.sink is None:
            return done
        self.sink.write(self.chunks.region(number), done.rows)
        return replace(done, rows=None)

    def solve(self, piece: Piece, is_wanted: Callable[[], bool] = lambda: True) -> Done:
        """Solve the cases of a chunk, along a path through neighbours, and again where their cost jumps.

        Raises Abandoned as soon as it is no longer wanted.
        """
        values = rows_of(piece.columns)
        keys = [self._key(of_case) for of_case in values]
        families = self._families(keys, values)
        continuation = Continuation[Attempt](piece.points, families, self.warm_starts)
        modules = {key: self._varied(self.variants[key]) for key in dict.fromkeys(keys)}
        given = [self._given(of_case) for of_case in values]

        def attempt(index: int, start: Start[Attempt] | None) -> Attempt:
            if not is_wanted():
                raise Abandoned
            module = modules[keys[index]]
            return not_built(self.variants[keys[index]]) if module is None else solve_case(module, given[index], start)

        def noted(index: int, start: Start[Attempt] | None) -> Attempt:
            # What is solved is the outcome. Rows have its arrays at once, and others may start from its unknowns alone:
            # thousands of arrays that are kept take longer to get than to compute.
            found = attempt(index, start)
            self._place(rows, index, self.variants[keys[index]], found)
            return found.without_arrays()

        rows = self._empty_rows(len(values))
        attempts: list[list[Attempt]] = [[]] * len(values)
        for index in self._order(piece, families).tolist():
            if modules[keys[index]] is None:
                attempts[index] = [attempt(index, None)]
            else:
                attempts[index] = continuation.solve(index, partial(noted, index))
        if self.layout.has_jumps:
            neighbours = self._neighbours(piece, families, [own[-1] for own in attempts])
            for index in self._improve(neighbours, attempts, rows, attempt):
                self._place(rows, index, self.variants[keys[index]], attempts[index][-1])
        for index, own in enumerate(attempts):
            self._tell(rows, index, own)
        return self._finished(piece.region, rows)

    def _families(self, keys: Sequence[tuple[str, ...]], values: Sequence[Mapping[str, Any]]) -> NDArray[np.intp]:
        """Which cases may start from each other (n,): those of a module, and of a guess where these vary."""
        guesses = [own.name for own in self.quantities if own.kind == GUESS]
        families = [(key, *(of_case[name] for name in guesses)) for key, of_case in zip(keys, values, strict=True)]
        known = {family: number for number, family in enumerate(dict.fromkeys(families))}
        return np.array([known[family] for family in families])

    def _neighbours(self, piece: Piece, families: NDArray[np.intp], outcomes: Sequence[Attempt]) -> Neighbours:
        """Which cases of a chunk are neighbours; blocks of grids have one module."""
        if piece.is_grid:
            return Grid(piece.extent, tuple(along_dimensions(piece.points, piece.extent)))
        return scattered(piece.points, families, np.array([own.is_start and np.isfinite(own.cost) for own in outcomes]))

    def _improve(
        self,
        neighbours: Neighbours,
        attempts: list[list[Attempt]],
        rows: Rows,
        attempt: Callable[[int, Start[Attempt]], Attempt],
    ) -> list[int]:
        """Begin what is on the worse side of a jump from the better one, and say what it won; the cases that did."""
        outcomes = [own[-1] for own in attempts]
        found = improved(outcomes, neighbours, lambda index, solution: attempt(index, Start(solution)))
        for index, more in found.items():
            kept = outcomes[index]
            for one in more:
                kept = one if is_better(one, kept) else kept
            rest = [own for own in (*attempts[index], *more) if own is not kept]
            attempts[index] = [*rest, kept]
        costs = np.array([own[-1].cost for own in attempts])
        rows["improvement"][:] = np.array([outcome.cost for outcome in outcomes]) - costs
        rows["jump"][:] = 0
        rows["jump"][[worse for worse, _ in neighbours.jumps(costs, certain=True)]] = 1
        return [index for index in found if attempts[index][-1] is not outcomes[index]]

    def lost(self, number: int, reason: str) -> Done:
        """A chunk of which nothing came."""
        rows = self._empty_rows(math.prod(self.chunks.extent(number)))
        rows["status"][:], rows["message"][:] = LOST, reason
        return self._finished(self.chunks.region(number), rows)

    def loaded(self) -> Work:
        """The same; every module is loaded in this process from now on."""
        for variant in self.variants.values():
            self._module(variant)
        return self

    def tried(self, variant: Variant, index: int) -> Attempt:
        """A solve of a case by some module, from the problem's own guess, of which nothing is kept."""
        varied = self._varied(variant)
        assert varied is not None, "what is solved has a module"
        if not DRIVERS[self.driver].generated:  # the others call what this one does not
            varied.task.touch(varied.module, varied.run.steps)
        return solve_case(varied, self._given(self.cases.values(np.array([index]))[0]), None)

    def _given(self, values: Mapping[str, Any]) -> dict[Quantity, float]:
        return {own: values[own.name] for own in self.quantities if own.kind != "argument"}

    def _key(self, values: Mapping[str, float | str]) -> tuple[str, ...]:
        return tuple(as_argument(values[own.name]) for own in self.quantities if own.kind == "argument")

    def _module(self, variant: Variant) -> Any:
        if variant.shapes is None:
            return None
        return self.module if variant.path is None else loading.load(variant.path)

    def _varied(self, variant: Variant) -> Varied | None:
        if variant.shapes is None:
            return None
        run = replace(self.run, steps=self.steps or variant.shapes.steps)
        return Varied(self._module(variant), self.driver, run, self._wanted(variant))

    def _wanted(self, variant: Variant) -> Wanted | None:
        if variant.shapes is None or not variant.shapes.by:
            return None
        varied = tuple(own for own in self.quantities if own.kind != "argument")
        return Wanted(varied, self.layout.rates, self.warm_starts)

    def _order(self, piece: Piece, families: NDArray[np.intp]) -> NDArray[np.intp]:
        if piece.is_grid:
            return serpentine(piece.extent)
        return nearest_chain(np.column_stack([piece.points, APART * families]))

    def _tell(self, rows: Rows, index: int, attempts: Sequence[Attempt]) -> None:
        """Put how a case ended, the last attempt, into its row; iterations and seconds are those of all."""
        outcome = attempts[-1]
        outline = outcome.outline
        rows["status"][index], rows["message"][index] = outline.status, outline.message
        rows["residual"][index] = outline.residual
        rows["iterations"][index] = sum(attempt.iterations for attempt in attempts)
        rows["seconds"][index] = sum(attempt.seconds for attempt in attempts)
        if outcome.is_solved:
            rows["cost"][index] = np.nan if outline.cost is None else outline.cost

    def _place(self, rows: Rows, index: int, variant: Variant, outcome: Attempt) -> None:
        """Put the arrays of a solution into its row."""
        if not outcome.is_solved:
            return
        shapes, outline = variant.shapes, outcome.outline
        assert shapes is not None, "what is solved has a module"
        for name in self.layout.dims:
            if name in outline.arrays:
                rows[name][index] = self.layout.placed(name, outline.arrays[name], shapes.columns.get(name, ()))
        for name, value in outline.free.items():
            rows[free_label(name)][index] = value
        if outcome.rates is not None:
            self._place_rates(rows, index, shapes, outcome.rates)

    def _place_rates(self, rows: Rows, index: int, shapes: Shapes, found: CaseRates) -> None:
        """Put the derivatives of a solution into its row, where there are some, and what is to be said of them."""
        rows[f"{RATE}message"][index] = found.message
        for name in self.layout.dims:
            if name.startswith(RATE):
                array = found.arrays.get(name)
                rows[name][index] = np.nan if array is None else self.layout.placed_rates(name, array, shapes)

    def _finished(self, region: tuple[slice, ...], rows: Rows) -> Done:
        """A chunk whose rows are where they belong."""
        statuses = rows["status"].tolist()
        messages = dict(zip(reversed(statuses), reversed(rows["message"].tolist())))  # the first of each
        won, jumps = (int((rows[name] > 0).sum()) if name in rows else 0 for name in JUMPS)
        tally = Tally(Counter(statuses), messages, float(np.nansum(rows["seconds"])), won, jumps)
        extent = tuple(part.stop - part.start for part in region)
        shaped = {name: array.reshape(*extent, *array.shape[1:]) for name, array in rows.items()}
        if self.sink is None:
            return Done(tally, shaped)
        self.sink.write(region, shaped)
        return Done(tally, None)

    def _empty_rows(self, number: int) -> Rows:
        """Rows of cases that are not solved."""
        rows: Rows = {name: np.full((number, *self.layout.shapes[name]), np.nan) for name in self.layout.dims}
        for name, kind in self.layout.numbers.items():
            rows[name] = np.full(number, -1 if kind == "i4" else np.nan, kind)
        rows |= {name: np.full(number, "", object) for name in self.layout.words}
        if self.layout.has_rates:
            rows[f"{RATE}message"][:] = f"no sensitivities: {UNSOLVED}"
        return rows


@dataclass(frozen=True, eq=False)
class Parcel:
    """Work without its cases, the texts of its modules, and what tells whether another machine sees its sink."""

    work: Work
    texts: Texts
    mark: tuple[int, ...]

    def unpacked(self) -> tuple[Work, tuple[str, ...]]:
        """The work, ready to solve here, and what is to be said of this machine.

        Where it does not see the store of the work it has none: rows are to be sent back.
        """
        variants, notes = self.texts.placed(self.work.variants, self.work.driver)
        sink = self.work.sink
        sees = sink is not None and bool(self.mark) and sink.mark() == self.mark
        return replace(self.work, variants=variants, sink=sink if sees else None).loaded(), notes


MOST = 100
"""The most modules of a sweep: each takes seconds to derive and compile."""


@dataclass(frozen=True, eq=False)
class Modules:
    """The modules by the texts of the arguments that vary, what varies beside, and lines to be said.

    `first` is the first module that could be derived; `points` are those to be connected, if any are.
    """

    arguments: tuple[str, ...]
    quantities: tuple[Quantity, ...]
    variants: dict[tuple[str, ...], Variant]
    first: Any
    said: tuple[str, ...]
    points: PointSet | None = None

    @property
    def texts(self) -> Iterator[bytes]:
        """What stands in their files."""
        for variant in self.variants.values():
            path = variant.path or getattr(self.first, "__file__", None)
            yield variant.message.encode() if path is None else Path(path).read_bytes()


def modules_of(request: Request, cases: Cases, working: Working) -> Modules:
    """Derive and compile what the cases need; nothing is compiled before all names and values are known to fit.

    A combination that cannot be derived is a variant without a module, unless none can. Raises ArgumentError for a
    value that an argument does not take, and for names that mean nothing.
    """
    if request.is_built:
        return _built(request, cases)
    known = request.source.arguments
    names = tuple(name for name in cases.columns if name in known)
    if twice := next((name for name in names if name in request.arguments), None):
        raise ArgumentError(f"{twice} varies and is given by --set", "leave one of them out")
    combinations = _combinations(names, cases)
    derived, errors = dict[tuple[str, ...], tuple[Any, compiler.Build]](), dict[tuple[str, ...], CodegenError]()
    varied: tuple[Quantity, ...] = ()
    for number, key in enumerate(combinations, start=1):
        count = f" (module {number} of {len(combinations)})" if len(combinations) > 1 else ""
        try:
            with _own_words(), working(f"Deriving{count}"):
                module, made = _derived(request, dict(zip(names, key, strict=True)))
        except ArgumentError:
            raise
        except CodegenError as error:
            errors[key] = error
            continue
        varied = _fitting(request, cases, module, names)
        derived[key] = module, made
    if not derived:
        raise next(iter(errors.values()))
    points, said = _points(request, [module for module, _ in derived.values()]), list[str]()
    for module, made in derived.values():
        if DRIVERS[request.driver].generated:
            said += ahead_of_time.require(made.path, module, made.written, working)[1]
    variants = {
        key: Variant(derived[key][1].path, _shapes(request, derived[key][0], points))
        if key in derived
        else Variant(None, None, str(errors[key]))
        for key in combinations
    }
    return Modules(names, varied, variants, next(iter(derived.values()))[0], tuple(said), points)


def _points(request: Request, modules: Sequence[Any]) -> PointSet | None:
    """The points that all cases connect; ArgumentError where an argument of problem() decides on them."""
    first, *others = (points_of(request, module) for module in modules)
    for other in others:
        if first is not None and other is not None and not np.array_equal(first.table, other.table):
            raise ArgumentError("the points differ among values of an argument", "sweep over each value by itself")
    return first


def _shapes(request: Request, module: Any, points: PointSet | None) -> Shapes:
    return shapes_of(module, request.every, request.sensitivities, 0 if points is None else len(points.start))


def _derived(request: Request, arguments: dict[str, str]) -> tuple[Any, compiler.Build]:
    """A module, loaded, and where it is."""
    made = compiler.build(
        request.source, {**request.arguments, **arguments}, scheme=request.scheme, method=request.method,
        controls=request.controls, sensitivities=request.sensitivities,
    )  # fmt: skip
    return loading.load(made.path), made


def _fitting(request: Request, cases: Cases, module: Any, arguments: Sequence[str]) -> tuple[Quantity, ...]:
    """What varies, if a module can be swept, takes all options, and names and values mean something to it."""
    request.driver_for(module)
    if request.sensitivities:
        require_sensitive(module)
    others = [name for name in cases.columns if name not in arguments]
    require_apart_from_delays(module, others)
    require_apart_from_arrays(module, others)
    varied = quantities(cases.columns, module, arguments)
    require_fitting(varied, cases)
    if request.steps is not None and any(quantity.kind == STEPS for quantity in varied):
        raise ArgumentError("steps vary and are given by --steps", "leave one of them out")
    return varied


def _built(request: Request, cases: Cases) -> Modules:
    """The one module that there is already."""
    module: Any = request.problem
    if isinstance(request.problem, str | Path):
        module = loading.load(request.problem)
    varied = _fitting(request, cases, module, ())
    file = getattr(module, "__file__", None)
    points = _points(request, [module])
    variant = Variant(Path(file) if file else None, _shapes(request, module, points))
    return Modules((), varied, {(): variant}, module, (), points)


def _combinations(names: Sequence[str], cases: Cases) -> list[tuple[str, ...]]:
    """The texts of arguments that occur together."""
    axes = sorted({cases.axes[name] for name in names})
    own = [[name for name in names if cases.axes[name] == axis] for axis in axes]
    texts = {name: [as_argument(value) for value in cases.columns[name].tolist()] for name in names}
    along = [dict.fromkeys(zip(*(texts[name] for name in group), strict=True)) for group in own]
    order = [name for group in own for name in group]
    number = 1
    for rows in along:
        number *= len(rows)
    if number > MOST:
        finding = f"{' and '.join(names)} of problem() would need {number} modules, one for each value"
        raise ArgumentError(finding, f"take at most {MOST} values, or vary parameters of the module")
    found = []
    for parts in product(*along):
        values = dict(zip(order, (text for part in parts for text in part), strict=True))
        found.append(tuple(values[name] for name in names))
    return found


@contextmanager
def _own_words() -> Iterator[None]:
    """Errors that name the options of a sweep, where `--method` is that of samples."""
    try:
        yield
    except CodegenError as error:
        parts = (text.replace("--method", "--formulation") for text in (error.finding, error.remedy))
        raise type(error)(*parts) from error
