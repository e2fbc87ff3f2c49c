"""The solve of one case of a sweep, and the choice of its initial guess.

A case is solved from the problem's own guess and, if this fails, from solutions of neighbouring cases. With warm starts
the solution of the last solved case comes first. On a straight part of the path through the cases this guess
extrapolates the last two solutions along their secant. With derivatives of the last solution, the guess follows the
parabola with this tangent, or on a curved path the tangent. On a grid the errors of secant and tangent are of second
order in the distance of the cases, and the error of the parabola is of third order. Source: Allgower and Georg (1990),
Numerical continuation methods, chapters 2 and 6.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors import LOST, SOLVED
from codegen.batch.layout import Shapes
from codegen.batch.motions import Motions, empty_motions
from codegen.batch.optima import Solutions, empty_solutions
from codegen.batch.request import GUESS, STEPS, CaseRates, Quantity, Wanted, given_to
from codegen.batch.results import UNUSABLE, Limits, unusable_message
from codegen.errors import CodegenError, one_line
from codegen.runtime.search.problem import ControlProblem
from codegen.runtime.stepping.problem import StepProblem
from codegen.solving import loading
from codegen.solving.drivers import find, task_of
from codegen.solving.drivers.newton import TOLERANCE
from codegen.solving.loading import ControlModule, GeneratedModule, Matrix, Vector, is_connect
from codegen.solving.request import with_arguments
from codegen.solving.results.control import outline_of_optimum
from codegen.solving.results.result import STATUSES, ControlAttempt, Outline, Run
from codegen.solving.results.segments import segments_of
from codegen.solving.warm_start import transferred
from codegen.solving.warm_start import varied as varied_guess

OTHERS = 3  # number of neighbouring solutions that are tried after the problem's own guess
FARTHEST = 2.0  # largest extrapolation along a secant, relative to the distance between its two cases
STRAIGHT = 1e-6  # largest relative deviation of a step from the direction of the previous one on a straight path


@dataclass(frozen=True)
class Start:
    """A start from a solution, moved by `factor` times its difference from `before`, along its tangent, or both."""

    solution: Attempt
    before: Attempt | None = None
    factor: float = 0.0
    is_along_tangent: bool = False


class Continuation:
    """The solutions of a chunk so far, and the choice of the starts for the next case.

    `points` (n, quantities) are the n cases, scaled by the range of each quantity. `families` (n,) has equal numbers
    for cases with the same module and guess: only such cases start from each other. With `warm` starts the last
    solution is tried before the problem's own guess.
    """

    def __init__(self, points: Matrix, families: NDArray[np.intp], warm: bool) -> None:
        self._points, self._families, self._warm = points, families, warm
        self._coordinates: list[list[float]] = points.tolist()  # faster than arrays for single points
        self._solved: dict[int, Attempt] = {}
        self._path: dict[int, list[int]] = {}

    def solve(self, index: int, attempt: Callable[[Start | None], Attempt]) -> list[Attempt]:
        """Solve a case from one start after the other and return all attempts; the last attempt is the outcome.

        The outcome is the first solved attempt, else the attempt from the problem's own guess. `attempt` solves the
        case from its argument, or from the problem's own guess if the argument is None.
        """
        attempts: list[Attempt] = []
        from_guess: Attempt | None = None
        for start in self._starts(index):
            result = attempt(start)
            attempts.append(result)
            if result.is_start:
                path = self._path.setdefault(int(self._families[index]), [])
                if path:
                    self._solved[path[-1]] = self._solved[path[-1]].without_tangent()
                path.append(index)
                self._solved[index] = result
                return [*attempts[:-1], result.without_tangent()]
            from_guess = result if start is None else from_guess
        assert from_guess is not None, "every case is tried from its own guess"
        return [*(result for result in attempts if result is not from_guess), from_guess]

    def _starts(self, index: int) -> Iterator[Start | None]:
        path = self._path.get(int(self._families[index]), [])
        first = self._first(index, path) if self._warm else None
        if first is not None:
            yield first
        yield None
        is_moved = first is None or first.is_along_tangent or first.before is not None
        others = path if is_moved else path[:-1]
        if others:
            distances = ((self._points[others] - self._points[index]) ** 2).sum(axis=1)
            for k in np.argsort(distances, kind="stable")[:OTHERS]:
                yield Start(self._solved[others[k]])

    def _first(self, index: int, path: Sequence[int]) -> Start | None:
        """Return the start from the last solution on the path, extrapolated if possible; None for an empty path."""
        if not path:
            return None
        last = self._solved[path[-1]]
        if len(path) == 1:
            return Start(last, is_along_tangent=last.has_tangent)
        before, present, target = (self._coordinates[k] for k in (path[-2], path[-1], index))
        one = [b - a for a, b in zip(before, present, strict=True)]
        two = [b - a for a, b in zip(present, target, strict=True)]
        square = sum(a * a for a in one)
        factor = sum(a * b for a, b in zip(one, two, strict=True)) / square if square > 0.0 else 0.0
        deviation = sum((b - factor * a) ** 2 for a, b in zip(one, two, strict=True))
        if abs(factor) > FARTHEST or not deviation <= STRAIGHT**2 * sum(b * b for b in two):
            return Start(last, is_along_tangent=last.has_tangent)
        return Start(last, self._solved[path[-2]], factor, last.has_tangent)


NOT_BUILT = "not built"
OF_SWEEPS = {
    UNUSABLE: "a number of the case cannot be used, as a duration that is negative",
    NOT_BUILT: "the module of the case could not be derived",
    LOST: "process after process ended while it solved the case's chunk",
}
"""Statuses of cases whose single solve would raise an error, and their meanings."""
MEANINGS = {**STATUSES, **OF_SWEEPS}


@dataclass(frozen=True)
class Variant:
    """The module for one combination of arguments of problem(): its file, or a module without a file, and its arrays.

    `shapes` is None if the module could not be derived; then `message` gives the reason.
    """

    path: Path | None
    shapes: Shapes | None
    message: str = ""
    unfiled: GeneratedModule | None = None

    def load(self) -> GeneratedModule | None:
        """Return the module, loaded in this process; None if it could not be derived."""
        return self.unfiled if self.path is None else loading.load(self.path)


@dataclass(frozen=True)
class Attempt:
    """The result of a solve on `steps` intervals of each phase or segment; `rates` has the requested derivatives."""

    outline: Outline
    steps: int
    iterations: int
    seconds: float
    rates: CaseRates | None = None

    def without_arrays(self) -> Attempt:
        """Delete the arrays, and return the attempt with the unknowns and the tangent for starts of other cases."""
        self.outline.arrays.clear()  # a copy would take a hundredth of the time of a solve
        return self if self.rates is None else replace(self, rates=CaseRates(tangent=self.rates.tangent))

    def without_tangent(self) -> Attempt:
        """Return the attempt without derivatives if it has a tangent, else unchanged."""
        return replace(self, rates=None) if self.has_tangent else self

    @property
    def has_tangent(self) -> bool:
        """True if the derivatives for a start along the tangent exist."""
        return self.rates is not None and self.rates.tangent is not None

    @property
    def is_solved(self) -> bool:
        """True if the attempt is a solution."""
        return self.outline.status == SOLVED

    @property
    def cost(self) -> float:
        """The cost, NaN if the attempt is no solution or has no cost."""
        return math.nan if self.outline.cost is None or not self.is_solved else self.outline.cost

    @property
    def is_start(self) -> bool:
        """True if other cases can start from the attempt."""
        return self.is_solved and self.outline.unknowns is not None


def failed(status: str, message: str) -> Attempt:
    """Return an attempt with this status and message, and without a solution."""
    return Attempt(Outline(status, one_line(message), None, math.nan, {}, None), 0, 0, 0.0)


def unusable(error: Exception, values: Mapping[Quantity, float]) -> Attempt:
    """Return the attempt at a case whose numbers raise an error."""
    return failed(UNUSABLE, unusable_message(error, {quantity.name: value for quantity, value in values.items()}))


class Varied:
    """A module whose parameter overrides change from case to case, its driver, and the options `run` of each solve.

    `wanted` are the requested derivatives, or None. `is_on_device` is True if a GPU solves batches.
    """

    def __init__(
        self, module: Any, driver: str, run: Run, wanted: Wanted | None = None, is_on_device: bool = False
    ) -> None:
        self.module, self.driver, self.run, self.wanted = module, driver, run, wanted
        self.task, self._module = task_of(module), with_arguments(module)
        self._function = find(driver).function(self.task.name)
        problem = getattr(module, "problem", None) if driver == "newton" else None
        # `solve_batch` solves optimisations, and `follow` simulations but of particles, both by the generated solver.
        self.is_batched, self.is_ensemble = isinstance(problem, ControlProblem), isinstance(problem, StepProblem)
        self._limits = Limits(run.tolerance, run.max_iterations, run.time_limit, run.scaling, False, is_on_device)

    def steps_of(self, values: Mapping[Quantity, float]) -> int:
        """Return the number of intervals of a case, in each phase or segment."""
        steps = int(next((value for own, value in values.items() if own.kind == STEPS), self.run.steps))
        segments = segments_of(self.module.metadata)
        return segments.steps(steps) if segments else steps

    def follow(self, columns: Mapping[Quantity, Vector], number: int, is_wanted: Callable[[], bool]) -> Motions:
        """Return the motions of `number` cases, whose quantities have the values (number,) in `columns`."""
        steps = self.steps_of({own: column[0] for own, column in columns.items()})
        motions = empty_motions(self.module, columns, steps, self.run.every, self._limits, number)
        motions.fill(slice(0, number), is_wanted)
        return motions

    def solve_batch(
        self, cases: Sequence[Mapping[Quantity, float]], is_wanted: Callable[[], bool]
    ) -> list[Callable[[], Attempt]]:
        """Solve cases with as many steps from their own guesses; return functions that make the attempts.

        The seconds of a case are its part of the time of all. Raises Abandoned once `is_wanted` returns False.
        """
        steps, number = self.steps_of(cases[0]), len(cases)
        guesses = [self._guess(steps, values) for values in cases]
        columns = {own: np.array([values[own] for values in cases]) for own in cases[0]}
        solutions, begin = (
            empty_solutions(self.module, columns, steps, self._limits, number, guesses),
            time.perf_counter(),
        )
        solutions.fill(slice(0, number), is_wanted)
        seconds = (time.perf_counter() - begin) / number
        return [partial(self._attempt_of, values, solutions, case, seconds) for case, values in enumerate(cases)]

    def solve(self, values: Mapping[Quantity, float], start: Start | None) -> Attempt:
        """Solve a case from `start`, or from the problem's own guess if `start` is None, and return the attempt.

        Unusable values give the status UNUSABLE. A case is solved only if all equations hold, evaluated outside the
        driver.
        """
        module, run = self.given(values), replace(self.run, steps=self.steps_of(values))
        try:
            begin = time.perf_counter()
            if start is not None:
                run = replace(run, guess=unknowns_of(module, run.steps, start, values))
            elif self.task.name == "control":  # the driver and the evaluation outside it share the guess
                guess = self._guess(run.steps, values)
                own = module.initial_guess(module.make_grid(run.steps)) if guess is None else guess
                run = replace(run, guess=own, near=False)
            result = self._function(module, run)
            return self._evaluated(module, run, result, values, time.perf_counter() - begin)
        except CodegenError as error:
            return failed(UNUSABLE, str(error))
        except (ValueError, ArithmeticError) as error:  # generated modules raise built-in exceptions
            return unusable(error, values)

    def given(self, values: Mapping[Quantity, float]) -> Any:
        """Return the module with the values of a case as parameter overrides; the next call replaces these values."""
        arguments = given_to(values)
        if is_connect(self.module):
            return with_arguments(self.module, **arguments)
        # The guess, the driver and the evaluation outside the driver use the same grid.
        self._module.make_grid = lru_cache(maxsize=1)(partial(self.module.make_grid, **arguments))
        self._module.solve = partial(self.module.solve, **arguments)
        if hasattr(self.module, "nlp"):
            self._module.nlp = partial(self.module.nlp, **arguments)
        return self._module

    def _guess(self, steps: int, values: Mapping[Quantity, float]) -> Vector | None:
        """Return the guess of a case, or None for the problem's own."""
        number = int(next((value for own, value in values.items() if own.kind == GUESS), 1))
        return None if number == 1 else varied_guess(self.given(values), steps, number - 1)

    def _attempt_of(self, values: Mapping[Quantity, float], all_cases: Solutions, case: int, seconds: float) -> Attempt:
        """Return the attempt at a case of Solutions, which have evaluated the optimum outside the search."""
        found, steps = all_cases.optimum(case), all_cases.steps
        if found.status == UNUSABLE:
            return failed(UNUSABLE, found.message)
        if found.status == SOLVED and self.wanted is None and segments_of(self.module.metadata) is None:
            outline = outline_of_optimum(self.module, all_cases.grid(case), found)
            return Attempt(outline, steps, found.iterations, seconds)
        run = replace(self.run, steps=steps)
        tolerance = TOLERANCE if run.tolerance is None else run.tolerance
        own = ControlAttempt(found.status, found.message, found.iterations, found.unknowns, tolerance, generated=True)
        return self._evaluated(self.given(values), run, own, values, seconds)

    def _evaluated(
        self, module: Any, run: Run, result: Any, values: Mapping[Quantity, float], seconds: float
    ) -> Attempt:
        """Return the attempt of a result of the driver, with the requested derivatives."""
        attempt = Attempt(self.task.outline(module, self.driver, run, result), run.steps, result.iterations, seconds)
        if self.wanted is None or not attempt.is_solved:
            return attempt
        return replace(attempt, rates=self.wanted.of_solution(module, self.driver, run, result, values))


def unknowns_of(module: ControlModule, steps: int, start: Start, values: Mapping[Quantity, float]) -> Vector:
    """Return the initial guess (n,) of a start for `steps` intervals; see the docstring of this module."""
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
