"""Several first guesses: a nonlinear problem has local optima, and points near which its equations cannot be satisfied.

The first guess is the problem's own. To each further one smooth curves are added, sums of a few sines that vanish at
both ends with random amplitudes, one curve for each quantity. They are seeded: the same call gives the same guesses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from codegen.interfaces import ControlModule, Vector
from codegen.runtime.search.cascade import varied_guess
from codegen.solutions.result import Result

SAME = 1e-6
"""The relative difference up to which two costs belong to one optimum."""


def varied(module: ControlModule, steps: int, seed: int) -> Vector:
    """The problem's own guess on N = `steps` intervals with a random smooth curve added to every quantity."""
    grid = module.make_grid(steps)
    guess: Vector = varied_guess(grid, module.initial_guess(grid), seed)
    return guess


def best_of(solve: Callable[[Vector | None], Result], module: ControlModule, steps: int, starts: int) -> Result:
    """Solve from `starts` guesses; the solution of least cost, or the first failure where nothing is solved.

    Every guess has a line in `attempts`. The summary gains how many guesses were solved, and how many of them ended in
    the optimum that is returned.
    """
    results = [solve(None), *(solve(varied(module, steps, seed)) for seed in range(1, starts))]
    solved = [result for result in results if result.solved and result.cost is not None]
    best = min(solved, key=_cost, default=results[0])
    alike = sum(abs(_cost(result) - _cost(best)) <= SAME * max(1.0, abs(_cost(best))) for result in solved)
    return replace(
        best,
        attempts=tuple(_line(number, result) for number, result in enumerate(results, start=1)),
        summary={**best.summary, "guesses": starts, "guesses_solved": len(solved), "guesses_with_this_cost": alike},
    )


def _cost(result: Result) -> float:
    return float("inf") if result.cost is None else result.cost


def _line(number: int, result: Result) -> str:
    origin = "the problem's own" if number == 1 else "varied"
    cost = f", cost {result.cost:.9g}" if result.solved and result.cost is not None else ""
    return f"guess {number} ({origin}): {result.status}, {result.iterations} iterations{cost}"
