"""One solve of one case: the module with the values of the case, a run of the driver, and the verdict outside it.

Starts along a path through cases: where one from a case's own guess fails, or before it, from solved neighbours. On a
straight part of the path a start follows the secant through the last two solutions, and where derivatives of the last
one are known the parabola that has its tangent there; elsewhere it follows this tangent. On a grid of cases secant and
tangent are off by the square of their distance, the parabola by its cube. Source: Allgower and Georg (1990), Numerical
continuation methods, chapters 2 and 6.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors.chunks import LOST, SOLVED
from codegen.batch.layout import Shapes
from codegen.batch.request import GUESS, STEPS, CaseRates, Quantity, Wanted, given_to
from codegen.errors import CodegenError, one_line
from codegen.solving.drivers import find
from codegen.solving.interfaces import Matrix, Vector, is_connect
from codegen.solving.request import with_arguments
from codegen.solving.results.result import STATUSES, Outline, Run
from codegen.solving.results.segments import segments_of
from codegen.solving.run import transferred
from codegen.solving.tasks import task_of
from codegen.solving.warm_start import varied as varied_guess

OTHERS = 3
"""How many neighbours are tried after the problem's own guess."""
FARTHEST = 2.0
"""How far a secant is followed, in parts of the distance of the two solutions that it goes through."""
STRAIGHT = 1e-6
"""What part of a move may lie beside the direction of the one before."""


Found = TypeVar("Found", bound="Attempted")


class Attempted(Protocol):
    """What an attempt leaves: whether it is a solution that others may start from."""

    @property
    def is_start(self) -> bool:
        """Whether it is."""

    @property
    def has_tangent(self) -> bool:
        """Whether it is known how it follows what varies."""

    def without_tangent(self: Found) -> Found:
        """The same without this knowledge, which takes memory."""


@dataclass(frozen=True)
class Start(Generic[Found]):
    """A solution to start from, moved by so many times its difference from another one, along its tangent, or both."""

    solution: Found
    before: Found | None = None
    factor: float = 0.0
    is_along_tangent: bool = False

    @property
    def is_moved(self) -> bool:
        """Whether it is not the solution itself."""
        return self.is_along_tangent or self.before is not None


class Continuation(Generic[Found]):
    """The solutions of a chunk so far, and where the next case begins.

    `points` (n, quantities) are the cases in parts of each quantity's range, `families` (n,) tells which of them have
    the same module: only these start from each other. Where starts are `warm` the last neighbour comes before the
    problem's own guess.
    """

    def __init__(self, points: Matrix, families: NDArray[np.intp], warm: bool) -> None:
        self._points, self._families, self._warm = points, families, warm
        self._coordinates: list[list[float]] = points.tolist()  # of single points, for which arrays are slow
        self._solved: dict[int, Found] = {}
        self._path: dict[int, list[int]] = {}

    def solve(self, index: int, attempt: Callable[[Start[Found] | None], Found]) -> list[Found]:
        """The attempts at a case, the last of which is its outcome: the first that is solved, else from its own guess.

        `attempt` is given what to start from, or None for the problem's own guess.
        """
        attempts: list[Found] = []
        own: Found | None = None
        for start in self._starts(index):
            found = attempt(start)
            attempts.append(found)
            if found.is_start:
                path = self._path.setdefault(int(self._families[index]), [])
                if path:
                    self._solved[path[-1]] = self._solved[path[-1]].without_tangent()
                path.append(index)
                self._solved[index] = found
                return [*attempts[:-1], found.without_tangent()]
            own = found if start is None else own
        assert own is not None, "a case is tried from its own guess in any case"
        return [*(found for found in attempts if found is not own), own]

    def _starts(self, index: int) -> Iterator[Start[Found] | None]:
        family = int(self._families[index])
        path = self._path.get(family, [])
        first = self._first(index, path) if self._warm else None
        if first is not None:
            yield first
        yield None
        others = path[:-1] if first is not None and not first.is_moved else path
        for other in self._nearest(index, others):
            yield Start(self._solved[other])

    def _first(self, index: int, path: Sequence[int]) -> Start[Found] | None:
        """The last solution, moved along its tangent, and by the secant through the last two if the case lies there."""
        if not path:
            return None
        last = self._solved[path[-1]]
        if len(path) == 1:
            return Start(last, is_along_tangent=last.has_tangent)
        began, ended, wanted = (self._coordinates[k] for k in (path[-2], path[-1], index))
        one = [b - a for a, b in zip(began, ended, strict=True)]
        two = [b - a for a, b in zip(ended, wanted, strict=True)]
        square = sum(a * a for a in one)
        factor = sum(a * b for a, b in zip(one, two, strict=True)) / square if square > 0.0 else 0.0
        beside = sum((b - factor * a) ** 2 for a, b in zip(one, two, strict=True))
        if abs(factor) > FARTHEST or not beside <= STRAIGHT**2 * sum(b * b for b in two):
            return Start(last, is_along_tangent=last.has_tangent)
        return Start(last, self._solved[path[-2]], factor, last.has_tangent)

    def _nearest(self, index: int, others: Sequence[int]) -> list[int]:
        if not others:
            return []
        distances = ((self._points[others] - self._points[index]) ** 2).sum(axis=1)
        return [others[k] for k in np.argsort(distances, kind="stable")[:OTHERS]]


UNUSABLE, NOT_BUILT = "unusable", "not built"
OF_SWEEPS = {
    UNUSABLE: "a number of the case cannot be used, as a duration that is negative",
    NOT_BUILT: "the module of the case could not be derived",
    LOST: "process after process ended while it solved the case's chunk",
}
"""Statuses that single solves do not have: there they are errors."""
MEANINGS = {**STATUSES, **OF_SWEEPS}


@dataclass(frozen=True)
class Variant:
    """The module of some values of arguments of problem(): its file, or none for a loaded module, and its arrays.

    Where it could not be derived there are no arrays, and a message instead.
    """

    path: Path | None
    shapes: Shapes | None
    message: str = ""


@dataclass(frozen=True)
class Attempt:
    """One solve of a case, on so many intervals of each phase or segment; its derivatives, where they are wanted."""

    outline: Outline
    steps: int
    iterations: int
    seconds: float
    rates: CaseRates | None = None

    def without_arrays(self) -> Attempt:
        """The same, which lets go of its arrays and keeps what others need to start from it."""
        self.outline.arrays.clear()  # a copy without them would take a hundredth of a solve
        return self if self.rates is None else replace(self, rates=CaseRates(tangent=self.rates.tangent))

    def without_tangent(self) -> Attempt:
        """The same, of which nobody will begin along its tangent."""
        return replace(self, rates=None) if self.has_tangent else self

    @property
    def has_tangent(self) -> bool:
        """Whether neighbours may start along a tangent."""
        return self.rates is not None and self.rates.tangent is not None

    @property
    def is_solved(self) -> bool:
        """Whether it is a solution."""
        return self.outline.status == SOLVED

    @property
    def cost(self) -> float:
        """What it costs, NaN where it is no solution or costs nothing."""
        return math.nan if self.outline.cost is None or not self.is_solved else self.outline.cost

    @property
    def is_start(self) -> bool:
        """Whether neighbours may start from it."""
        return self.is_solved and self.outline.unknowns is not None


def failed(status: str, message: str) -> Attempt:
    """An attempt that came to nothing."""
    return Attempt(Outline(status, one_line(message), None, math.nan, {}, None), 0, 0, 0.0)


def not_built(variant: Variant) -> Attempt:
    """The attempt at a case that has no module."""
    return failed(NOT_BUILT, variant.message)


class Varied:
    """A module whose parameters have other values from case to case, and the run of a driver that all cases share.

    `wanted` are derivatives, if there are to be some.
    """

    def __init__(self, module: Any, driver: str, run: Run, wanted: Wanted | None = None) -> None:
        self.module, self.driver, self.run, self.wanted = module, driver, run, wanted
        self.task = task_of(module)
        self.function = find(driver).function(self.task.name)
        self._own = with_arguments(module)

    def given(self, values: Mapping[Quantity, float]) -> Any:
        """The module with the values of a case, until those of the next one are given."""
        given = given_to(values)
        if is_connect(self.module):
            return with_arguments(self.module, **given)
        self._own.make_grid = _Remembered(partial(self.module.make_grid, **given))  # the guess and the verdict ask
        self._own.solve = partial(self.module.solve, **given)
        if hasattr(self.module, "nlp"):
            self._own.nlp = partial(self.module.nlp, **given)
        return self._own


class _Remembered:
    """A function of hashable arguments that remembers its last value: made for each case, and cheaper than a cache."""

    __slots__ = ("_arguments", "_function", "_value")

    def __init__(self, function: Any) -> None:
        self._function, self._value = function, None
        self._arguments: tuple[Any, Any] | None = None

    def __call__(self, *positional: Any, **named: Any) -> Any:
        """The value, computed where the arguments are not those of the last call."""
        if self._arguments != (positional, named):
            self._arguments, self._value = (positional, named), self._function(*positional, **named)
        return self._value


def solve_case(varied: Varied, values: Mapping[Quantity, float], start: Start[Attempt] | None) -> Attempt:
    """Solve a case from neighbours' solutions, or from the problem's own guess; what is unusable is a status.

    Every equation is evaluated again outside the driver before a case is solved.
    """
    own, outline = varied.given(values), varied.task.outline
    steps = steps_of(own, next((int(v) for quantity, v in values.items() if quantity.kind == STEPS), varied.run.steps))
    try:
        begin = time.perf_counter()
        run = _run(varied, own, steps, start, values)
        attempt = varied.function(own, run)
        seconds = time.perf_counter() - begin
        found = Attempt(outline(own, varied.driver, run, attempt), steps, attempt.iterations, seconds)
    except CodegenError as error:
        return failed(UNUSABLE, str(error))
    except (ValueError, ArithmeticError) as error:  # modules know nothing of errors of this package
        reason = error.args[-1] if error.args else type(error).__name__
        return failed(UNUSABLE, f"{UNUSABLE}: {reason} ({_told(values)})")
    if varied.wanted is None or not found.is_solved:
        return found
    return replace(found, rates=varied.wanted.of_solution(own, varied.driver, run, attempt, values))


def _told(values: Mapping[Quantity, float]) -> str:
    return ", ".join(f"{quantity.name} = {value:g}" for quantity, value in values.items())


def _run(varied: Varied, own: Any, steps: int, start: Start[Attempt] | None, values: Mapping[Quantity, float]) -> Run:
    """The run of a case; of an optimisation the guess is made here, for the driver and the verdict."""
    if start is not None:
        return replace(varied.run, steps=steps, guess=_unknowns(own, steps, start, values))
    if varied.task.name != "control":
        return replace(varied.run, steps=steps)
    number = next((int(value) for quantity, value in values.items() if quantity.kind == GUESS), 1)
    guess = own.initial_guess(own.make_grid(steps)) if number == 1 else varied_guess(own, steps, number - 1)
    return replace(varied.run, steps=steps, guess=guess, near=False)


def _unknowns(module: Any, steps: int, start: Start[Attempt], values: Mapping[Quantity, float]) -> Vector:
    """The vector of unknowns to start from, on so many intervals; see `codegen.batch.case`."""
    unknowns, rates = start.solution.outline.unknowns, start.solution.rates
    assert unknowns is not None, "only solutions with unknowns are starts"
    if start.solution.steps != steps:
        return transferred(module, unknowns, steps)
    move = rates.tangent.move(values) if start.is_along_tangent and rates is not None and rates.tangent else None
    if start.before is None or start.before.steps != steps:
        return unknowns if move is None else np.asarray(unknowns + move)
    assert start.before.outline.unknowns is not None, "only solutions with unknowns are starts"
    difference, factor = unknowns - start.before.outline.unknowns, start.factor
    if move is None:
        return unknowns + factor * difference
    return np.asarray(unknowns + (1.0 + factor) * move - factor**2 * difference)


def steps_of(module: Any, steps: int) -> int:
    """The number of intervals of each segment where the motion was cut into several."""
    segments = segments_of(module.metadata)
    return segments.steps(steps) if segments else steps
