"""One case on a loaded module: solve by the driver, evaluate the equations again, compare, find the stable limit."""

from __future__ import annotations

import time
from types import ModuleType
from typing import Any

import numpy as np

from codegen import solving
from codegen.author.points import PointSet
from codegen.solutions.result import Result
from codegen.stress.cases import Case, Measurement, Values
from codegen.stress.classify import EXPECTATIONS
from codegen.stress.references import REFERENCES, drift_scale
from codegen.stress.stability import stable_limit
from codegen.stress.systems import textbook_errors
from codegen.tasks import task_of


def measure(module: Any, case: Case) -> Measurement:
    """What happens when a case is solved; typed errors are passed on."""
    varied = with_values(module, case)
    begin = time.perf_counter()
    result = solving.solve(varied, case.driver, points=_points(case), **_options(module, case))
    seconds = time.perf_counter() - begin
    expected = EXPECTATIONS[result.task]
    error = REFERENCES[case.reference](varied, case, result) if case.reference and result.solved else float("nan")
    arrays = (result.q, result.p, result.u, result.unknowns)
    # The error of the cost that a doubled grid shows, relative to the cost.
    estimate = result.summary.get("cost_error_estimate", float("nan"))
    return Measurement(
        status=result.status,
        message=result.message,
        finite=(
            all(a is None or bool(np.isfinite(a).all()) for a in arrays)
            and (result.cost is None or bool(np.isfinite(result.cost)))
        ),
        error=error,
        announced=(estimate / abs(result.cost) if result.cost else estimate),
        residual=result.residual if result.stationarity is None else max(result.residual, result.stationarity),
        tolerance=expected.tolerance(varied, case, result),
        textbook=textbook_errors(varied, case, result) if case.textbook and result.solved else float("nan"),
        drift=_drift(case, result, expected.keeps_energy),
        stable_below=stable_limit(module, case) if case.limit else float("nan"),
        failures=expected.failures(result),
        iterations=result.iterations,
        seconds=seconds,
    )


def with_values(module: Any, case: Case) -> Any:
    """The same module, whose functions that make a grid or a case take the case's run-time values by default."""
    values = as_keywords(case.values)
    varied = ModuleType(module.__name__)
    vars(varied).update(vars(module))
    for name in ("make_grid", "solve", "nlp", "make_case"):
        original = getattr(module, name, None)
        if original is not None:
            setattr(varied, name, lambda *given, _call=original, **more: _call(*given, **{**values, **more}))
    if case.noise:
        # Functions that guess, with reproducible noise on every free primal unknown, relative to its size or to one.
        guessed, solved = varied.initial_guess, varied.solve

        def initial_guess(grid: Any) -> Any:
            free, guess = varied.primal_unknowns(grid), guessed(grid)
            size = np.maximum(1.0, np.abs(guess[free]))
            guess[free] += case.noise * size * np.random.default_rng(1).standard_normal(free.size)
            return guess

        def solve(steps: int, guess: Any = None, **more: Any) -> Any:
            start = initial_guess(varied.make_grid(steps)) if guess is None else guess
            return solved(steps=steps, guess=start, **more)

        vars(varied).update({"initial_guess": initial_guess, "solve": solve})
    return varied


def as_keywords(values: Values) -> dict[str, Any]:
    """Keyword arguments; what is a table of names and values becomes a dict, what is a table of numbers an array."""

    def plain(value: Any) -> Any:
        if not isinstance(value, tuple):
            return value
        is_table = bool(value) and all(isinstance(v, tuple) and len(v) == 2 and isinstance(v[0], str) for v in value)
        return as_keywords(value) if is_table else np.array(value, dtype=float)

    return {name: plain(value) for name, value in values}


def _options(module: Any, case: Case) -> dict[str, Any]:
    own = task_of(module).options & {"every", "doublings"}
    return {"steps": case.steps, **{name: getattr(case, name) for name in own}}


def _points(case: Case) -> PointSet | None:
    """Starts and targets, from rows (start, target) of either dimension."""
    if not case.points:
        return None
    table = np.array(case.points, dtype=float)
    half = table.shape[1] // 2
    return PointSet(table[:, :half], table[:, half:], np.zeros(len(table)))


def _drift(case: Case, result: Result, keeps_energy: bool) -> float:
    """Largest change of energy, relative to its scale; NaN where there is no energy."""
    if result.energy is None:
        return float("nan")
    energy = np.asarray(result.energy, dtype=float)
    scale = drift_scale(case, result)
    if keeps_energy and not np.isfinite(energy[1:]).all():
        return float("inf")
    return float(np.abs(energy - energy[0]).max() / scale) if scale > 0.0 else float("nan")
