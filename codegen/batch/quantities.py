"""What can vary in a sweep: which names mean something for a problem, and what a value of each is given to."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.batch.cases import Cases
from codegen.batch.layout import RATE, free_label
from codegen.errors import ArgumentError, NumericsError, clause
from codegen.solving.loading import Matrix, Vector, is_control
from codegen.solving.request import apart_from_delays, duration_arguments, parameter_arguments, prescribed_ends
from codegen.solving.results.control import control_result
from codegen.solving.results.result import ControlAttempt, Run
from codegen.solving.results.sensitivities import rates_at

STEPS, GUESS = "steps", "guess"
COUNTS = (STEPS, GUESS)
"""Kinds of quantities whose values are positive integers."""


@dataclass(frozen=True)
class Quantity:
    """A varied quantity: its name, the kind of thing it is, and what that is called where it is given.

    The kind is `parameter` (an argument of the module's functions), `boundary` (a prescribed value, whose key is the
    end and the name), `steps`, `guess` (of an optimisation: 1 is the problem's own, others are varied at random, seeded
    by their number), or `argument` (of problem(), a module for each value).
    """

    name: str
    kind: str
    key: str


def quantities(names: Iterable[str], module: Any, arguments: Sequence[str]) -> tuple[Quantity, ...]:
    """What names mean for a module whose problem has some arguments; ArgumentError lists those that are close."""
    known = {quantity.name: quantity for quantity in _known(module, arguments)}
    found = []
    for name in names:
        if name not in known:
            # Durations of which delays are parts have derivatives, and no other values.
            refused = {*duration_arguments(module)} - {*apart_from_delays(module)}
            offered = [word for word in known if word not in refused]
            close = difflib.get_close_matches(name, offered, 3, 0.5)
            nearest = f"did you mean {' or '.join(close)}? " if close else ""
            remedy = f"{nearest}{module.metadata.problem} has {', '.join(offered)}"
            raise ArgumentError(clause(f"{name} is nothing that can be varied"), clause(remedy))
        found.append(known[name])
    return tuple(found)


def _known(module: Any, arguments: Sequence[str]) -> list[Quantity]:
    """All that can vary; of the same name an argument of problem() comes last, and so counts.

    It may do more than set the parameter that is called like it.
    """
    own = [Quantity(name, "parameter", key) for name, key in parameter_arguments(module).items()]
    times = [Quantity(key, "parameter", key) for key in duration_arguments(module)]
    values = [Quantity(name, "boundary", " ".join(key)) for name, key in prescribed_ends(module).items()]
    given = [Quantity(name, "argument", name) for name in arguments]
    guesses = [Quantity(GUESS, GUESS, GUESS)] if is_control(module) else []
    return [Quantity(STEPS, STEPS, STEPS), *guesses, *times, *values, *own, *given]


def require_fitting(varied: Iterable[Quantity], cases: Cases) -> None:
    """Refuse words for numbers, and numbers of intervals that are none."""
    for quantity in varied:
        column = cases.columns[quantity.name]
        if quantity.kind != "argument" and column.dtype.kind == "U":
            row, word = next((row, word) for row, word in enumerate(column.tolist()) if not _is_number(word))
            finding = f"{cases.origin(row)}{quantity.name} takes numbers, not {word!r}"
            raise ArgumentError(clause(finding), "give finite numbers")
        if quantity.kind in COUNTS:
            counts = np.asarray(column, dtype=float)
            if not ((counts >= 1.0) & (counts == np.rint(counts)) & (counts < 1e12)).all():
                finding = f"{quantity.kind} has values that are no positive integers"
                raise NumericsError(finding, "give positive integers")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def as_argument(value: float | str) -> str:
    """A value as the text that `--set` takes; whole numbers fit arguments of either type."""
    if isinstance(value, str):
        return value
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(value)


def given_to(module_values: Mapping[Quantity, float]) -> dict[str, Any]:
    """The arguments of a module's functions for the values of a case."""
    given: dict[str, Any] = {}
    for quantity, value in module_values.items():
        if quantity.kind == "parameter":
            given[quantity.key] = value
        elif quantity.kind == "boundary":
            end, name = quantity.key.split(" ", 1)
            given.setdefault(end, {})[name] = value
    return given


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
