"""What is asked of a sweep, and what is refused about it whatever the problem is.

What can vary in a sweep: which names mean something for a problem, and what a value of each is given to.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.batch import cases as reading
from codegen.batch.cases import NUMBER, Cases, require_method, samples
from codegen.batch.executors import team_size
from codegen.batch.executors.chunks import counted
from codegen.batch.layout import RATE, free_label
from codegen.errors import ArgumentError, NumericsError, clause
from codegen.solving.interfaces import Matrix, Vector, is_control
from codegen.solving.request import Request
from codegen.solving.results.control import control_result
from codegen.solving.results.output import require_folder
from codegen.solving.results.overrides import (
    apart_from_delays,
    duration_arguments,
    parameter_arguments,
    prescribed_ends,
)
from codegen.solving.results.result import ControlAttempt, Run
from codegen.solving.results.sensitivities import rates_at

if TYPE_CHECKING:
    from codegen.solving.interfaces import GeneratedModule

STORES, FILES = (".zarr",), (".nc",)
OPTIONS = (
    "driver", "arguments", "scheme", "formulation", "controls", "steps", "every", "tolerance", "max_iterations",
    "time_limit", "scaling", "sensitivities", "points",
)  # fmt: skip
"""Options of a solve that all cases share."""


@dataclass(frozen=True, eq=False)
class SweepRequest:
    """The solve that all cases share, the cases and where they come from, and what becomes of the results.

    `keep` are names of arrays, all that fit where it is None; `chunk` is the number of cases of a chunk, about a second
    of work where it is None; `cluster` is the address of a
    scheduler of dask, a client of one, "local", or None.
    """

    solve: Request
    cases: Cases
    origin: str
    out: Path | None
    resume: bool
    keep: Sequence[str] | None
    workers: int
    warm_starts: bool
    chunk: int | None
    cluster: Any

    @property
    def is_store(self) -> bool:
        """Whether results go to a zarr store as they come."""
        return self.out is not None and self.out.suffix in STORES


def sweep_request(
    problem: Path | str | GeneratedModule,
    vary: Mapping[str, Any] | None = None,
    *,
    zipped: Sequence[Sequence[str]] = (),
    samples: Mapping[str, Any] | None = None,
    cases: Any = None,
    method: str = "random",
    seed: int = 0,
    out: Path | str | None = None,
    resume: bool = False,
    keep: Sequence[str] | None = None,
    workers: int | None = None,
    warm_starts: bool = False,
    chunk: int | None = None,
    cluster: Any = None,
    **options: Any,
) -> SweepRequest:
    """The request that these arguments make; see `codegen.sweep`, whose arguments they are.

    Raises ArgumentError for what does not exist or does not fit together, and NumericsError for unusable numbers.
    """
    _require_known(options)
    if "formulation" in options:
        options["method"] = options.pop("formulation")
    if not isinstance(out, str | PathLike | None):
        raise ArgumentError(f"--out {clause(repr(out))} is no path", 'give one, such as "sweep.zarr"')
    place = None if out is None else Path(out)
    if place is not None:
        _require_place(place, resume)
    elif resume:
        raise ArgumentError("--resume without --out", "name the store to go on with")
    solve = Request(problem, **options)
    made, origin = _cases(vary, zipped, samples, cases, method, seed)
    if keep is not None and (isinstance(keep, str) or not all(isinstance(name, str) for name in keep)):
        raise ArgumentError(f"--keep {clause(repr(keep))}", 'give names of arrays, such as ("q", "u")')
    if chunk is not None and (isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1):
        raise NumericsError(f"--chunk {clause(repr(chunk))}", "give a positive integer")
    used = team_size(workers, cluster)
    kept = None if keep is None else tuple(dict.fromkeys(keep))
    return SweepRequest(solve, made, origin, place, resume, kept, used, warm_starts, chunk, cluster)


def _require_known(options: Iterable[str]) -> None:
    for name in options:
        if name not in OPTIONS:
            close = difflib.get_close_matches(name, OPTIONS, 1)
            remedy = f"did you mean {close[0]}?" if close else f"use some of {', '.join(OPTIONS)}"
            raise ArgumentError(f"codegen.sweep has no option {clause(name)}", remedy)


def _require_place(out: Path, resume: bool) -> None:
    """Refuse a place that cannot be written to, or that something is at already."""
    if out.suffix not in STORES + FILES:
        raise ArgumentError(f"--out {out}: unknown kind of file", "let it end in .zarr or .nc")
    require_folder(out.absolute().parent, "--out")
    if resume and out.suffix in FILES:
        raise ArgumentError(f"--resume: {out} is written at the end, as a whole", "let --out end in .zarr")
    if out.exists() and not resume:
        remedy = "choose another name" if out.suffix in FILES else "choose another name, or --resume to go on with it"
        raise ArgumentError(f"--out {out} is there already", remedy)


def _cases(
    vary: Mapping[str, Any] | None,
    zipped: Sequence[Sequence[str]],
    distributions: Mapping[str, Any] | None,
    given: Any,
    method: str,
    seed: int,
) -> tuple[Cases, str]:
    """The cases, and in a few words where they come from."""
    require_method(method)
    is_number = isinstance(given, int) and not isinstance(given, bool)
    if zipped and not vary:
        raise ArgumentError("--zip without --vary", "name what varies together by --vary")
    if sum(map(bool, (vary, distributions, given is not None and not is_number))) > 1:
        raise ArgumentError("cases are given in several ways", "give --vary, or --sample, or --cases FILE")
    if is_number and not distributions:
        raise ArgumentError(f"{given} cases of what?", "give distributions, as --sample 'm=normal(100, 5)'")
    if vary:
        return reading.grid(_named(vary, "vary"), zipped), "grid"
    if distributions:
        number = NUMBER if given is None else given
        made = samples(_named(distributions, "samples"), number, method, seed)
        return made, f"{counted(number, f'{method} sample')}, seed {seed}"
    if given is None:
        raise ArgumentError("nothing varies", "give --vary, --sample or --cases, as --vary r1=5.5:6.5:101")
    return reading.table(given), "table"


def _named(given: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(given, Mapping) or not all(isinstance(key, str) for key in given):
        raise ArgumentError(f"{name} is {clause(repr(given))}", 'give names and values, such as {"r1": [5.5, 6, 6.5]}')
    return given


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
