"""Optima of many cases of one module, a block of cases for each call of the compiled batch.

A block is solved without the lock of the Python interpreter, see `codegen.runtime.search.batch`. Several threads that
solve a block each work side by side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from codegen.batch.executors.chunks import Abandoned
from codegen.runtime.search.batch import Optimum, solve_grids
from codegen.runtime.search.solution import Log
from codegen.solving.drivers.newton import TOLERANCE
from codegen.solving.loading import ControlModule, Vector

BLOCK = 100_000
"""Number of unknowns in a block, which takes tens of milliseconds; the Python code between blocks takes less."""
MOST_ITERATIONS = 3000
"""Default limit of iterations, as for `solve` of a generated module."""


@dataclass(frozen=True)
class Limits:
    """The options of the searches of all cases: see `codegen.solve`; None stands for the default."""

    tolerance: float | None = None
    max_iterations: int | None = None
    time_limit: float = math.inf
    scaling: str = "auto"
    is_warm: bool = False


def optima(
    module: ControlModule, steps: int, arguments: Sequence[Mapping[str, Any]], guesses: Sequence[Vector | None],
    limits: Limits, is_wanted: Callable[[], bool],
) -> Iterator[list[Optimum | Exception]]:  # fmt: skip
    """Yield, block by block, the optimum of each case, or the error of a case whose numbers cannot be used.

    `arguments` are keyword arguments of `make_grid` of the module. A guess that is None is the problem's own. Raises
    Abandoned once `is_wanted` returns False.
    """
    grids, starts, results = list[Any](), list[Vector](), list[Optimum | Exception | None]()
    for own, guess in zip(arguments, guesses, strict=True):
        try:
            grid = module.make_grid(steps, **own)
            start = module.initial_guess(grid) if guess is None else module.with_pinned_values(grid, guess)
        except (ValueError, ArithmeticError) as error:  # generated modules raise built-in exceptions
            results.append(error)
            continue
        results.append(None)
        grids.append(grid)
        starts.append(start)
        if len(grids) * start.size >= BLOCK:
            yield _solved(grids, starts, results, limits, is_wanted)
            grids, starts, results = [], [], []
    if results:
        yield _solved(grids, starts, results, limits, is_wanted)


def _solved(
    grids: list[Any], starts: list[Vector], results: list[Optimum | Exception | None], limits: Limits,
    is_wanted: Callable[[], bool],
) -> list[Optimum | Exception]:  # fmt: skip
    """Return `results` with the optimum on the next grid in place of each None."""

    def log() -> Log:
        if not is_wanted():
            raise Abandoned
        return Log(limits.time_limit)

    tolerance, most = limits.tolerance or TOLERANCE, limits.max_iterations or MOST_ITERATIONS
    found = iter(solve_grids(grids, starts, tolerance, most, limits.is_warm, limits.scaling, log) if grids else ())
    return [next(found) if result is None else result for result in results]
