"""What stress expects of each task: what residuals may be, how failures are counted, which cases a problem has."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.drivers import DRIVERS
from codegen.runtime.search import callbacks
from codegen.solutions.result import Result
from codegen.solutions.simulate import rounding_level
from codegen.stress.cases import Case

_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Expectation:
    """What is special to a task where cases are made and measured.

    `tolerance` (module, case, result) is what residuals may be: the drivers' tolerances of 1e-8, or rounding where
    numbers are large. `failures` (result) is how often Newton's method failed, `drift` by which part energies may
    change, NaN where that says nothing. `has_guess` says whether a guess may be poor,
    `keeps_energy` whether an energy that is not finite has drifted.
    """

    tolerance: Callable[[Any, Case, Result], float]
    failures: Callable[[Result], int]
    drift: float
    has_guess: bool = False
    keeps_energy: bool = False


def _of_simulations(module: Any, case: Case, result: Result) -> float:
    """Equations of a variational step divide differences of positions by h; stiff springs pull rounded places back."""
    h = result.t[-1] / max(result.steps, 1)
    size = _largest(result.q, result.p)
    stiff = 10.0 * rounding_level(module, result.steps, result.q, result.p) if case.every == 1 else 0.0
    return max(1e-10, 1e3 * _EPS * size * max(1.0, 1.0 / h if h > 0.0 else 1.0), stiff)


def _of_optima(module: Any, case: Case, result: Result) -> float:
    scale = max(1.0, float(np.abs(callbacks.cost_gradient(module.make_grid(result.steps), result.unknowns)).max()))
    return max(1e-7 * scale, 1e3 * _EPS * _largest(result.unknowns, result.multipliers) * result.steps)


def _of_connections(module: Any, case: Case, result: Result) -> float:
    return max(1e-9, 1e3 * _EPS * _largest(result.q, result.p)) if DRIVERS[case.driver].generated else 1e-5


def _largest(*arrays: Any) -> float:
    return max((float(np.abs(a).max()) for a in arrays if a is not None and np.size(a)), default=1.0)


def _once(result: Result) -> int:
    """What ends at its first failure."""
    return int(not result.solved)


def _by_attempts(result: Result) -> int:
    return int(result.summary["attempts"]) - int(result.solved)


EXPECTATIONS = {
    "simulate": Expectation(_of_simulations, _once, drift=0.1, keeps_energy=True),
    "control": Expectation(_of_optima, _once, drift=math.nan, has_guess=True),
    "connect": Expectation(_of_connections, _by_attempts, drift=1.0),
}
"""A row for each task of `codegen.tasks`."""
