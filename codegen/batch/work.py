"""The modules of a sweep, and its work: a worker solves the cases of a chunk and stores their results as rows.

Each combination of values of varied arguments of problem() has its own module, derived and compiled once. The work is
small and is pickled once for each worker; after that workers receive chunks.
"""

from __future__ import annotations

import hashlib
import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from codegen.batch.case import NOT_BUILT, Attempt, Continuation, Start, Variant, Varied, failed
from codegen.batch.cases import Cases, rows_of
from codegen.batch.executors import LOST, Abandoned, Done, Tally
from codegen.batch.jumps import Grid, Neighbours, along_dimensions, improved, is_better, scattered
from codegen.batch.layout import (
    JUMPS,
    RATE,
    WORDS,
    Chunks,
    Layout,
    Piece,
    Rows,
    free_label,
    nearest_chain,
    serpentine,
    shapes_of,
)
from codegen.batch.motions import require_motions
from codegen.batch.request import GUESS, STEPS, Quantity, Wanted, as_argument, quantities, require_fitting
from codegen.errors import ArgumentError, CodegenError
from codegen.files import alone, write_text
from codegen.solving import loading
from codegen.solving.api import Made, module_of, points_of
from codegen.solving.compiler import workers_folder
from codegen.solving.drivers import DRIVERS
from codegen.solving.loading import is_simulation
from codegen.solving.machine_code import processes
from codegen.solving.machine_code.processes import Target, compiled_note, target
from codegen.solving.progress import Working
from codegen.solving.request import Request, require_apart_from_arrays, require_apart_from_delays
from codegen.solving.results.result import Run
from codegen.solving.results.sensitivities import UNSOLVED, require_sensitive

if TYPE_CHECKING:
    from codegen.batch.store import Store
    from codegen.problem.points import PointSet
    from codegen.solving.loading import GeneratedModule

MOST_MODULES = 100
"""Largest number of modules of a sweep: each takes seconds to derive and compile."""
APART = 1e6  # artificial distance between cases of different modules or guesses, relative to the ranges of quantities


@dataclass(frozen=True, eq=False)
class Modules:
    """The modules (`variants`) by the texts of the arguments of problem() that vary, and messages for the user.

    `first` is the first module that could be derived; `points` are the points of particles to connect, or None.
    """

    quantities: tuple[Quantity, ...]
    variants: dict[tuple[str, ...], Variant]
    first: GeneratedModule
    messages: tuple[str, ...]
    points: PointSet | None = None


def modules_of(request: Request, cases: Cases, working: Working) -> Modules:
    """Derive all modules of the cases, check names and values, compile, and return the modules.

    A combination of arguments that cannot be derived becomes a variant without a module; if all fail, the first error
    is raised. Raises ArgumentError for unknown names, and for a value that an argument does not take.
    """
    derived: dict[tuple[str, ...], Made] = {}
    errors: dict[tuple[str, ...], CodegenError] = {}
    varied: tuple[Quantity, ...] = ()
    names, combinations = ((), [()]) if request.is_built else _combinations(request, cases)
    for number, key in enumerate(combinations, start=1):
        count = f" (module {number} of {len(combinations)})" if len(combinations) > 1 else ""
        try:
            made = module_of(request, working, f"Deriving{count}", dict(zip(names, key, strict=True)))
        except ArgumentError:
            raise
        except CodegenError as error:
            errors[key] = error
            continue
        varied = _checked_quantities(request, cases, made.module, names)
        derived[key] = made
    if not derived:
        raise next(iter(errors.values()))
    # All cases must connect the same points.
    points, *others = (points_of(request, made.module) for made in derived.values())
    for other in others:
        if points is not None and other is not None and not np.array_equal(points.table, other.table):
            raise ArgumentError("the points differ among values of an argument", "sweep over each value by itself")
    messages, particles = list[str](), 0 if points is None else len(points.start)
    variants = {key: Variant(None, None, str(error)) for key, error in errors.items()}
    for key, made in derived.items():
        if DRIVERS[request.driver].generated:
            messages += made.require(working)[1]
        file = made.path or getattr(made.module, "__file__", None)
        shapes = shapes_of(made.module, request.every, request.sensitivities, particles)
        variants[key] = Variant(Path(file), shapes) if file else Variant(None, shapes, unfiled=made.module)
    ordered = {key: variants[key] for key in combinations}
    return Modules(varied, ordered, next(iter(derived.values())).module, tuple(messages), points)


def _combinations(request: Request, cases: Cases) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the names of the arguments of problem() that vary, and all combinations of their texts in the cases."""
    names = tuple(name for name in cases.columns if name in request.source.arguments)
    if twice := next((name for name in names if name in request.arguments), None):
        raise ArgumentError(f"{twice} varies and is given by --set", "leave one of them out")
    groups = [[name for name in names if cases.axes[name] == axis] for axis in sorted({cases.axes[n] for n in names})]
    texts = {name: [as_argument(value) for value in cases.columns[name].tolist()] for name in names}
    along = [dict.fromkeys(zip(*(texts[name] for name in group), strict=True)) for group in groups]
    if (number := math.prod(map(len, along))) > MOST_MODULES:
        finding = f"{' and '.join(names)} of problem() would need {number} modules, one for each value"
        raise ArgumentError(finding, f"take at most {MOST_MODULES} values, or vary parameters of the module")
    order = [name for group in groups for name in group]
    combinations = []
    for parts in product(*along):
        values = dict(zip(order, (text for part in parts for text in part), strict=True))
        combinations.append(tuple(values[name] for name in names))
    return names, combinations


def _checked_quantities(
    request: Request, cases: Cases, module: GeneratedModule, arguments: Sequence[str]
) -> tuple[Quantity, ...]:
    """Return the quantities that vary; raises an error if options, names or values do not fit the module."""
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


@dataclass(frozen=True, eq=False)
class Work:
    """The data that the solves of all chunks need.

    `run` are the options of all solves. `steps` is the largest number of steps, or None for each module's own number.
    `variants` has the modules by the texts of the varied arguments of problem(). `is_on_device` is True if a GPU solves
    batches.
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
    sink: Store | None = None
    is_on_device: bool = False

    @cached_property
    def numeric(self) -> tuple[Quantity, ...]:
        """The quantities whose values a module takes; the others are arguments of problem()."""
        return tuple(quantity for quantity in self.quantities if quantity.kind != "argument")

    @property
    def is_compiled(self) -> bool:
        """True if all cases are solved in batches or followed as ensembles, without derivatives and warm starts."""
        varied = [self._varied(variant) for variant in self.variants.values()]
        is_single = self.warm_starts or self.layout.has_rates
        return all(own is None or own.is_ensemble or (own.is_batched and not is_single) for own in varied)

    def require_on_device(self) -> None:
        """Raise an error unless a GPU can solve the cases."""
        if not self.is_compiled:
            finding = "a GPU solves simulations, and optimal control without warm starts and sensitivities, by newton"
            raise ArgumentError(f"--executor cuda: {finding}", "leave --executor out")
        for variant in self.variants.values():
            if (module := variant.load()) is not None and is_simulation(module):
                require_motions(module, is_on_device=True)

    def piece(self, number: int) -> Piece:
        """Return the data of a chunk that a worker needs in addition to the work."""
        indices = self.chunks.cases(number)
        columns, points = self.cases.chosen(indices), self.cases.points(indices)
        return Piece(number, self.chunks.region(number), self.cases.is_grid, columns, points)

    def parcel(self) -> Parcel:
        """Return the work without its cases, for other machines; raises ArgumentError for a module without a file."""
        if any(variant.unfiled for variant in self.variants.values()):
            remedy = "build it, and give its path"
            raise ArgumentError("a module that is in no file cannot be sent to a cluster", remedy)
        bare = replace(self, cases=Cases((), (), {}, {}), chunks=Chunks((), ()))
        texts = {
            key: variant.path.read_text(encoding="utf-8")
            for key, variant in self.variants.items()
            if variant.path is not None and variant.shapes is not None
        }
        return Parcel(bare, texts, target(), () if self.sink is None else self.sink.mark())

    def returned(self, number: int, done: Done) -> Done:
        """Write the rows that a worker returned to the sink, if there is one; return the result without these rows."""
        if done.rows is None or self.sink is None:
            return done
        self.sink.write(self.chunks.region(number), done.rows)
        return replace(done, rows=None)

    def loaded(self) -> Work:
        """Load every module in this process, and return the work."""
        for variant in self.variants.values():
            variant.load()
        return self

    def lost(self, number: int, reason: str) -> Done:
        """Return the result of a chunk whose workers were lost; `reason` becomes the message of its cases."""
        rows = self._empty_rows(math.prod(self.chunks.extent(number)))
        rows["status"][:], rows["message"][:] = LOST, reason
        return self._finished(self.chunks.region(number), rows)

    def tried(self, variant: Variant, index: int) -> Done:
        """Return the result of a case by the module of a variant, without storing the result."""
        if not DRIVERS[self.driver].generated:  # external drivers call other functions of the module
            varied = self._varied(variant)
            assert varied is not None, "a case that is solved has a module"
            varied.task.warm_up(varied.module, varied.run.steps)
        single = Chunks(self.cases.shape, (1,) * len(self.cases.shape))
        work = replace(self, quantities=self.numeric, variants={(): variant}, chunks=single, sink=None)
        return work.solve(work.piece(index))

    def solve(self, piece: Piece, is_wanted: Callable[[], bool] = lambda: True) -> Done:
        """Solve the cases of a chunk; simulations are followed as ensembles, others are solved by `_solve_along_path`.

        The rows are written to the sink, or returned without a sink. Raises Abandoned once `is_wanted` returns False.
        """
        number = len(piece.points)
        rows, others, groups = self._empty_rows(number), list[int](), dict[tuple[tuple[str, ...], float], list[int]]()
        arguments = [piece.columns[own.name].tolist() for own in self.quantities if own.kind == "argument"]
        keys = [tuple(map(as_argument, words)) for words in zip(*arguments, strict=True)] or [()] * number
        steps = next((piece.columns[own.name].tolist() for own in self.quantities if own.kind == STEPS), [0.0] * number)
        for index, group in enumerate(zip(keys, steps, strict=True)):
            groups.setdefault(group, []).append(index)
        for (key, _), indices in groups.items():
            varied = self._varied(self.variants[key])
            if varied is not None and varied.is_ensemble:
                self._follow(varied, self.variants[key], piece, np.array(indices), rows, is_wanted)
            else:
                others += indices
        if others:
            self._solve_along_path(piece, keys, groups, others, rows, is_wanted)
        return self._finished(piece.region, rows)

    def _follow(
        self, varied: Varied, variant: Variant, piece: Piece, places: NDArray[np.intp], rows: Rows,
        is_wanted: Callable[[], bool],
    ) -> None:  # fmt: skip
        """Follow the motions of the cases with these indices, and write their rows."""
        assert variant.shapes is not None, "motions have a module"
        begin = time.perf_counter()
        columns = {own: np.asarray(piece.columns[own.name], float)[places] for own in self.numeric}
        motions = varied.follow(columns, places.size, is_wanted)
        for name in (*WORDS, "residual", "iterations"):
            rows[name][places] = getattr(motions, name)
        solved = slice(None) if motions.solved.all() else np.flatnonzero(motions.solved)
        for name in self.layout.dims:
            if (array := getattr(motions, name)) is not None:
                names = variant.shapes.columns.get(name, ())
                rows[name][places[solved]] = self.layout.placed(name, array[solved], names)
        rows["seconds"][places] = (time.perf_counter() - begin) / places.size

    def _solve_along_path(
        self,
        piece: Piece,
        keys: Sequence[tuple[str, ...]],
        groups: Mapping[tuple[tuple[str, ...], float], list[int]],
        others: Sequence[int],
        rows: Rows,
        is_wanted: Callable[[], bool],
    ) -> None:
        """Solve the cases `others` along a path through neighbours, and cases at jumps of the cost again.

        Cases of one group in `groups` have the same module, from `keys`, and the same number of steps.
        """
        values = [{own: float(row[own.name]) for own in self.numeric} for row in rows_of(piece.columns)]
        guesses = [own for own in self.quantities if own.kind == GUESS]
        # Cases of one family may start from each other: they have the same module and the same guess.
        labels = [(key, *(of_case[own] for own in guesses)) for key, of_case in zip(keys, values, strict=True)]
        numbers = {label: number for number, label in enumerate(dict.fromkeys(labels))}
        families = np.array([numbers[label] for label in labels])
        modules = {key: self._varied(self.variants[key]) for key in dict.fromkeys(keys)}
        first = dict[int, Callable[[], Attempt]]()  # attempts from the problem's own guess, by one call for each group
        for (key, _), indices in groups.items():
            varied = modules[key]
            if not self.warm_starts and varied is not None and varied.is_batched:
                found = varied.solve_batch([values[index] for index in indices], is_wanted)
                first |= dict(zip(indices, found, strict=True))

        def attempt(index: int, start: Start | None) -> Attempt:
            if not is_wanted():
                raise Abandoned
            module = modules[keys[index]]
            if module is None:
                return failed(NOT_BUILT, self.variants[keys[index]].message)
            if start is None and index in first:
                return first.pop(index)()
            return module.solve(values[index], start)

        def attempt_in_rows(index: int, start: Start | None) -> Attempt:
            # Store the arrays at once: other cases start from the unknowns alone, and the allocation of thousands of
            # arrays takes longer than their computation.
            result = attempt(index, start)
            self._write_arrays(rows, index, self.variants[keys[index]], result)
            return result.without_arrays()

        attempts: list[list[Attempt]] = [[]] * len(values)
        continuation = Continuation(piece.points, families, self.warm_starts)
        if piece.is_grid:
            order = serpentine(piece.extent)
        else:
            order = nearest_chain(np.column_stack([piece.points, APART * families]))
        for index in order[np.isin(order, others)].tolist():
            if modules[keys[index]] is None:
                attempts[index] = [attempt(index, None)]
            else:
                attempts[index] = continuation.solve(index, partial(attempt_in_rows, index))
        if self.layout.has_jumps:
            neighbours: Neighbours
            if piece.is_grid:  # a block of a grid has one module
                neighbours = Grid(piece.extent, tuple(along_dimensions(piece.points, piece.extent)))
            else:
                solved = np.array([own[-1].is_start and np.isfinite(own[-1].cost) for own in attempts])
                neighbours = scattered(piece.points, families, solved)
            for index in self._improve(neighbours, attempts, rows, attempt):
                self._write_arrays(rows, index, self.variants[keys[index]], attempts[index][-1])
        for index in others:
            own, outcome = attempts[index], attempts[index][-1]
            rows["status"][index], rows["message"][index] = outcome.outline.status, outcome.outline.message
            rows["residual"][index] = outcome.outline.residual
            rows["iterations"][index] = sum(one.iterations for one in own)
            rows["seconds"][index] = sum(one.seconds for one in own)
            if outcome.is_solved:
                rows["cost"][index] = outcome.cost

    def _improve(
        self,
        neighbours: Neighbours,
        attempts: list[list[Attempt]],
        rows: Rows,
        attempt: Callable[[int, Start], Attempt],
    ) -> list[int]:
        """Solve the worse case of each jump from the better case; update attempts and rows, return improved cases."""
        outcomes = [own[-1] for own in attempts]
        further = improved(outcomes, neighbours, lambda index, solution: attempt(index, Start(solution)))
        for index, more in further.items():
            best = outcomes[index]
            for one in more:
                best = one if is_better(one, best) else best
            rest = [own for own in (*attempts[index], *more) if own is not best]
            attempts[index] = [*rest, best]
        costs = np.array([own[-1].cost for own in attempts])
        rows["improvement"][:] = np.array([outcome.cost for outcome in outcomes]) - costs
        rows["jump"][:] = 0
        rows["jump"][[worse for worse, _ in neighbours.jumps(costs, certain=True)]] = 1
        return [index for index in further if attempts[index][-1] is not outcomes[index]]

    def _varied(self, variant: Variant) -> Varied | None:
        if variant.shapes is None:
            return None
        run = replace(self.run, steps=self.steps or variant.shapes.steps)
        wanted = Wanted(self.numeric, self.layout.rates, self.warm_starts) if variant.shapes.by else None
        return Varied(variant.load(), self.driver, run, wanted, self.is_on_device)

    def _write_arrays(self, rows: Rows, index: int, variant: Variant, outcome: Attempt) -> None:
        """Write the arrays and derivatives of a solution into the row `index`."""
        if not outcome.is_solved:
            return
        shapes, outline = variant.shapes, outcome.outline
        assert shapes is not None, "a case that is solved has a module"
        for name in self.layout.dims:
            if name in outline.arrays:
                rows[name][index] = self.layout.placed(name, outline.arrays[name], shapes.columns.get(name, ()))
        for name, value in outline.free.items():
            rows[free_label(name)][index] = value
        if outcome.rates is not None:
            rows[f"{RATE}message"][index] = outcome.rates.message
            for name in self.layout.dims:
                if name.startswith(RATE):
                    array = outcome.rates.arrays.get(name)
                    rows[name][index] = np.nan if array is None else self.layout.placed_rates(name, array, shapes)

    def _finished(self, region: tuple[slice, ...], rows: Rows) -> Done:
        """Write the rows to the sink and return their tally; without a sink the rows are returned, too."""
        counts = (int((rows[name] > 0).sum()) if name in rows else 0 for name in JUMPS)
        seconds = float(np.nansum(rows["seconds"]))
        tally = Tally.of(rows["status"].tolist(), rows["message"].tolist(), seconds, *counts)
        extent = tuple(part.stop - part.start for part in region)
        shaped = {name: array.reshape(*extent, *array.shape[1:]) for name, array in rows.items()}
        if self.sink is None:
            return Done(tally, shaped)
        self.sink.write(region, shaped)
        return Done(tally, None)

    def _empty_rows(self, number: int) -> Rows:
        """Return the rows of a number of cases without results."""
        rows: Rows = {name: np.full((number, *self.layout.shapes[name]), np.nan) for name in self.layout.dims}
        for name, kind in self.layout.numbers.items():
            rows[name] = np.full(number, -1 if kind == "i4" else np.nan, kind)
        rows |= {name: np.full(number, "", object) for name in self.layout.words}
        if self.layout.has_rates:
            rows[f"{RATE}message"][:] = f"no sensitivities: {UNSOLVED}"
        return rows


@dataclass(frozen=True, eq=False)
class Parcel:
    """Work without cases for other machines, with module texts, the machine of their origin, and the sink's mark."""

    work: Work
    texts: dict[tuple[str, ...], str]
    origin: Target
    mark: tuple[int, ...]

    def unpacked(self) -> tuple[Work, tuple[str, ...]]:
        """Return the work, ready to solve on this machine, and notes about the machine.

        Modules are compiled for this machine. If the machine cannot access the store, the work has no sink, and the
        rows are returned to the client.
        """
        local, notes, variants = target(), [], dict(self.work.variants)
        machine = f"{platform.node()}-{local.processor}-{local.features}-numba-{local.numba}-python-{local.python}"
        for key, text in self.texts.items():
            path = variants[key].path
            assert path is not None, "a module with a text has a file name"
            if local != self.origin or not _has_text(path, text):  # several machines may share a disk
                path = workers_folder() / machine / hashlib.sha256(text.encode()).hexdigest()[:20] / path.name
            seconds = 0.0
            with alone(workers_folder(), str(path)):
                if not _has_text(path, text):
                    path.parent.mkdir(parents=True, exist_ok=True)
                    write_text(path, text)
                if DRIVERS[self.work.driver].generated:
                    seconds, _ = processes.require(path, loading.load(path), False, lambda what: nullcontext())
            if seconds > 0.0:
                notes.append(compiled_note(path.stem, self.origin, "the sweep"))
            variants[key] = replace(variants[key], path=path)
        sink = self.work.sink
        has_store = sink is not None and bool(self.mark) and sink.mark() == self.mark
        return replace(self.work, variants=variants, sink=sink if has_store else None).loaded(), tuple(notes)


def _has_text(path: Path, text: str) -> bool:
    """Return True if a file can be read and has this text."""
    try:
        return path.read_text(encoding="utf-8") == text
    except (OSError, UnicodeDecodeError):
        return False
