"""Sensitivities in a sweep: what is kept of each case, and the tangent along which a neighbour begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.interfaces import Matrix, Vector
from codegen.solutions.control import control_result
from codegen.solutions.result import ControlAttempt, Run
from codegen.solutions.sensitivities import rates_at
from codegen.sweeping.layout import RATE, free_label
from codegen.sweeping.quantities import Quantity


@dataclass(frozen=True, eq=False)
class Tangent:
    """How the unknowns (n,) of a solution follow varied quantities: `rates` (m, n), where these have `values` (m,)."""

    quantities: tuple[Quantity, ...]
    values: Vector
    rates: Matrix

    def move(self, values: Mapping[Quantity, float]) -> Vector:
        """By how much the unknowns of a case with other values differ, (n,), to first order."""
        steps = np.array([values[own] for own in self.quantities]) - self.values
        return np.asarray(steps @ self.rates)


@dataclass(frozen=True, eq=False)
class CaseRates:
    """Derivatives of a case by all m quantities, by the names of a data set: `arrays` (m, ...), and what is to be said.

    Where there are none `message` says why; it also tells those that may be one-sided or inaccurate. There is no
    `tangent` where some varied quantity has no derivatives.
    """

    message: str = ""
    arrays: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    tangent: Tangent | None = None


@dataclass(frozen=True)
class Wanted:
    """Which derivatives a sweep wants: those of the cost and of free parameters, of `arrays`, and `tangents`.

    Quantities that vary follow no others.
    """

    varied: tuple[Quantity, ...]
    arrays: Sequence[str]
    tangents: bool

    def of_solution(
        self, module: Any, driver: str, run: Run, attempt: ControlAttempt, values: Mapping[Quantity, float]
    ) -> CaseRates:
        """Those of a case that is solved; `module` has its values."""
        names = module.metadata.sensitivities
        given = [own.name for own in self.varied if own.name in names]
        try:
            rates = rates_at(module, run.steps, attempt.unknowns, given)
        except (ValueError, ArithmeticError) as error:  # a derivative that is infinite where the solution is not
            return CaseRates(f"no sensitivities: {error.args[-1] if error.args else type(error).__name__}")
        message = "; ".join(rates.sensitivities.notes)
        if rates.sensitivities.reason:
            return CaseRates(message)
        arrays = {
            f"{RATE}cost": rates.sensitivities.costs,
            **{f"{RATE}{free_label(name)}": by for name, by in rates.free.items()},
        }
        if self.arrays:
            found = rates.derivatives(control_result(module, driver, run, attempt))
            arrays |= {f"{RATE}{name}": np.stack([getattr(by, name) for by in found]) for name in self.arrays}
        tangent = None
        if self.tangents and len(given) == len(values):
            rows = [names.index(own.name) for own in values]
            tangent = Tangent(tuple(values), np.array([*values.values()]), rates.found.unknowns[rows])
        return CaseRates(message, arrays, tangent)
