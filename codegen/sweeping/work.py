"""The work of a sweep: solving the cases of one chunk, in whatever process, and what becomes of their numbers.

It can be pickled, and is small: an engine sends it to its workers once, and then the numbers of chunks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from codegen import loading
from codegen.solutions.result import Run
from codegen.sweeping.case import Attempt, Variant, Varied, not_built, solve_case
from codegen.sweeping.cases import Cases
from codegen.sweeping.chunks import Chunks
from codegen.sweeping.continuation import Continuation, Start
from codegen.sweeping.layout import NUMBERS, WORDS, Layout
from codegen.sweeping.order import nearest_chain, serpentine
from codegen.sweeping.quantities import Quantity, as_argument
from codegen.sweeping.statuses import LOST, Tally

Rows = dict[str, NDArray[Any]]
"""Arrays by name, with a row for each case of a chunk in the order in which cases are counted."""
APART = 1e6
"""How far cases of different modules are from each other, in parts of ranges."""


class Sink(Protocol):
    """Where the rows of a chunk go in the process that has made them."""

    def write(self, region: tuple[slice, ...], rows: Rows) -> None:
        """Write the rows of a chunk to its place among the cases."""


@dataclass(frozen=True)
class Done:
    """A chunk that is finished: how its cases ended, and its rows where no sink has taken them."""

    tally: Tally
    rows: Rows | None


class Abandoned(Exception):
    """Nobody wants the chunk any longer."""


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

    def __call__(self, number: int, is_wanted: Callable[[], bool] = lambda: True) -> Done:
        """Solve the cases of a chunk, along a path through neighbours.

        Raises Abandoned as soon as it is no longer wanted.
        """
        indices = self.chunks.cases(number)
        values = self.cases.values(indices)
        keys = [self._key(of_case) for of_case in values]
        families = np.unique(np.array([list(self.variants).index(key) for key in keys]), return_inverse=True)[1]
        points = self.cases.points(indices)
        continuation = Continuation[Attempt](points, families, self.warm_starts)
        rows = self._empty_rows(len(indices))
        modules = {key: self._varied(self.variants[key]) for key in dict.fromkeys(keys)}
        for place in self._order(number, points, families):
            if not is_wanted():
                raise Abandoned
            variant, module = self.variants[keys[place]], modules[keys[place]]
            attempts = self._attempts(place, module, variant, values[place], continuation)
            self._fill(rows, place, variant, attempts)
        return self._finished(number, rows)

    def lost(self, number: int, reason: str) -> Done:
        """A chunk of which nothing came."""
        rows = self._empty_rows(len(self.chunks.cases(number)))
        rows["status"][:], rows["message"][:] = LOST, reason
        return self._finished(number, rows)

    def loaded(self) -> Work:
        """The same; every module is loaded in this process from now on."""
        for variant in self.variants.values():
            self._module(variant)
        return self

    def tried(self, variant: Variant, index: int) -> Attempt:
        """A solve of a case by some module, from the problem's own guess, of which nothing is kept."""
        varied = self._varied(variant)
        assert varied is not None, "what is solved has a module"
        if self.driver != "newton":  # the others call what this one does not
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
        return Varied(self._module(variant), self.driver, run)

    def _order(self, number: int, points: NDArray[np.float64], families: NDArray[np.intp]) -> NDArray[np.intp]:
        if self.cases.is_grid:
            return serpentine(self.chunks.extent(number))
        return nearest_chain(np.column_stack([points, APART * families]))

    def _attempts(
        self,
        place: int,
        module: Varied | None,
        variant: Variant,
        values: Mapping[str, Any],
        continuation: Continuation[Attempt],
    ) -> Sequence[Attempt]:
        if module is None:
            return [not_built(variant)]
        given = self._given(values)

        def attempt(start: Start[Attempt] | None) -> Attempt:
            return solve_case(module, given, start)

        return continuation.solve(place, attempt)

    def _fill(self, rows: Rows, place: int, variant: Variant, attempts: Sequence[Attempt]) -> None:
        """Put the outcome of a case, the last attempt, into its row; iterations and seconds are those of all."""
        outcome = attempts[-1]
        outline = outcome.outline
        rows["status"][place], rows["message"][place] = outline.status, outline.message
        rows["residual"][place] = outline.residual
        rows["iterations"][place] = sum(attempt.iterations for attempt in attempts)
        rows["seconds"][place] = sum(attempt.seconds for attempt in attempts)
        if not outcome.is_solved:
            return
        rows["cost"][place] = np.nan if outline.cost is None else outline.cost
        assert variant.shapes is not None, "what is solved has a module"
        for name in self.layout.dims:
            if name in outline.arrays:
                columns = variant.shapes.columns.get(name, ())
                rows[name][place] = self.layout.placed(name, outline.arrays[name], columns)

    def _finished(self, number: int, rows: Rows) -> Done:
        """A chunk whose rows are where they belong."""
        statuses = rows["status"].tolist()
        messages = dict(zip(reversed(statuses), reversed(rows["message"].tolist())))  # the first of each
        tally = Tally(Counter(statuses), messages, float(np.nansum(rows["seconds"])))
        extent = self.chunks.extent(number)
        shaped = {name: array.reshape(*extent, *array.shape[1:]) for name, array in rows.items()}
        if self.sink is None:
            return Done(tally, shaped)
        self.sink.write(self.chunks.region(number), shaped)
        return Done(tally, None)

    def _empty_rows(self, number: int) -> Rows:
        """Rows of cases that are not solved."""
        rows: Rows = {name: np.full((number, *self.layout.shapes[name]), np.nan) for name in self.layout.dims}
        rows |= {name: np.full(number, -1 if kind == "i4" else np.nan, kind) for name, kind in NUMBERS.items()}
        return rows | {name: np.full(number, "", object) for name in WORDS}
