"""The request of a sweep with all checks that need no module, and the quantities that can vary."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.batch.cases import NUMBER, Cases, grid, require_sampling, table
from codegen.batch.cases import samples as sampled
from codegen.batch.executors import counted, team_size
from codegen.batch.layout import RATE, free_label
from codegen.batch.results import CUDA, THREADS, require_place
from codegen.errors import ArgumentError, NumericsError, clause, is_count, nearest
from codegen.solving.loading import Matrix, Vector, is_control
from codegen.solving.request import Request, apart_from_delays, duration_arguments, parameter_arguments, prescribed_ends
from codegen.solving.results.control import control_result
from codegen.solving.results.output import require_folder
from codegen.solving.results.result import ControlAttempt, Run
from codegen.solving.results.sensitivities import rates_at

if TYPE_CHECKING:
    from codegen.solving.loading import ControlModule, GeneratedModule

STORES, FILES = (".zarr",), (".nc",)
OPTIONS = (
    "driver", "arguments", "scheme", "method", "controls", "steps", "every", "tolerance", "max_iterations",
    "time_limit", "scaling", "sensitivities", "points",
)  # fmt: skip
"""Options of a solve that all cases share."""


@dataclass(frozen=True, eq=False)
class SweepRequest:
    """The options of a sweep: the solve that all cases share, the cases and a text about their origin, and the storage.

    `keep` names the arrays to store, or is None for all that fit. `chunk` is the number of cases of a chunk, or None
    for about a second of work. `cluster` is the address of a scheduler of dask, a client, "local", or None.
    `is_on_device` is True if a GPU solves the cases.
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
    cluster: object
    is_on_device: bool


def sweep_request(
    problem: Path | str | GeneratedModule,
    vary: Mapping[str, object] | None = None,
    *,
    zipped: Sequence[Sequence[str]] = (),
    samples: Mapping[str, object] | None = None,
    cases: object = None,
    sampling: str = "random",
    seed: int = 0,
    out: Path | str | None = None,
    resume: bool = False,
    keep: Sequence[str] | None = None,
    workers: int | None = None,
    warm_starts: bool = False,
    chunk: int | None = None,
    cluster: object = None,
    executor: str = THREADS,
    **options: Any,
) -> SweepRequest:
    """Check the arguments of `codegen.sweep` and return them as a request.

    Raises ArgumentError for arguments that do not exist or do not fit together, NumericsError for unusable numbers.
    """
    for name in options:
        if name not in OPTIONS:
            remedy = nearest(name, OPTIONS, f"use some of {', '.join(OPTIONS)}")
            raise ArgumentError(f"codegen.sweep has no option {clause(name)}", remedy)
    if not isinstance(out, str | PathLike | None):
        raise ArgumentError(f"--out {clause(repr(out))} is no path", 'give one, such as "sweep.zarr"')
    path = None if out is None else Path(out)
    if path is None and resume:
        raise ArgumentError("--resume without --out", "name the store to go on with")
    if path is not None:
        if path.suffix not in STORES + FILES:
            raise ArgumentError(f"--out {path}: unknown kind of file", "let it end in .zarr or .nc")
        require_folder(path.absolute().parent, "--out")
        if resume and path.suffix in FILES:
            raise ArgumentError(f"--resume: {path} is written in one piece at the end", "let --out end in .zarr")
        if path.exists() and not resume:
            another = "choose another name" + ("" if path.suffix in FILES else ", or --resume to go on with it")
            raise ArgumentError(f"--out {path} is there already", another)
    solve = Request(problem, **options)
    require_sampling(sampling)
    is_number = isinstance(cases, int) and not isinstance(cases, bool)
    if zipped and not vary:
        raise ArgumentError("--zip without --vary", "name what varies together by --vary")
    if sum(map(bool, (vary, samples, cases is not None and not is_number))) > 1:
        raise ArgumentError("cases are given in several ways", "give --vary, or --sample, or --cases FILE")
    if is_number and not samples:
        raise ArgumentError(f"{cases} cases of what?", "give distributions, as --sample 'm=normal(100, 5)'")
    for name, values in (("vary", vary), ("samples", samples)):
        if values and not (isinstance(values, Mapping) and all(isinstance(key, str) for key in values)):
            finding = f"{name} is {clause(repr(values))}"
            raise ArgumentError(finding, 'give names and values, such as {"r1": [5.5, 6, 6.5]}')
    if vary:
        all_cases, origin = grid(vary, zipped), "grid"
    elif samples:
        number = cases if isinstance(cases, int) else NUMBER
        all_cases = sampled(samples, number, sampling, seed)
        origin = f"{counted(number, f'{sampling} sample')}, seed {seed}"
    elif cases is None:
        raise ArgumentError("nothing varies", "give --vary, --sample or --cases, as --vary r1=5.5:6.5:101")
    else:
        all_cases, origin = table(cases), "table"
    if keep is not None and (isinstance(keep, str) or not all(isinstance(name, str) for name in keep)):
        raise ArgumentError(f"--keep {clause(repr(keep))}", 'give names of arrays, such as ("q", "u")')
    if chunk is not None and not is_count(chunk):
        raise NumericsError(f"--chunk {clause(repr(chunk))}", "give a positive integer")
    is_on_device = require_place(executor)
    if is_on_device and (workers is not None or cluster is not None):
        raise ArgumentError(f"--executor {CUDA} with --workers or --cluster", "leave these out")
    processes = 1 if is_on_device else team_size(workers, cluster)
    kept = None if keep is None else tuple(dict.fromkeys(keep))
    return SweepRequest(
        solve, all_cases, origin, path, resume, kept, processes, warm_starts, chunk, cluster, is_on_device
    )


STEPS, GUESS = "steps", "guess"
COUNTS = (STEPS, GUESS)  # kinds of quantities with positive integers as values


@dataclass(frozen=True)
class Quantity:
    """A varied quantity: its name, its kind, and its key in the functions of the module.

    The kind is `parameter` (an argument of the module's functions), `boundary` (a prescribed value, with end and name
    as key), `steps`, `guess` (the initial guess of an optimisation: 1 is the problem's own, larger numbers seed random
    variations), or `argument` (of problem(), with a module for each value).
    """

    name: str
    kind: str
    key: str


def quantities(names: Collection[str], module: GeneratedModule, arguments: Sequence[str]) -> tuple[Quantity, ...]:
    """Return the quantities with these names; `arguments` are the names of the arguments of problem().

    Raises ArgumentError, with similar names, for an unknown name.
    """
    # An argument of problem() comes last and replaces a parameter of the same name, because it may do more.
    candidates = [
        Quantity(STEPS, STEPS, STEPS),
        *([Quantity(GUESS, GUESS, GUESS)] if is_control(module) else []),
        *(Quantity(key, "parameter", key) for key in duration_arguments(module)),
        *(Quantity(name, "boundary", " ".join(key)) for name, key in prescribed_ends(module).items()),
        *(Quantity(name, "parameter", key) for name, key in parameter_arguments(module).items()),
        *(Quantity(name, "argument", name) for name in arguments),
    ]
    by_name = {quantity.name: quantity for quantity in candidates}
    for name in names:
        if name not in by_name:
            # The duration of a problem with delays has derivatives but cannot vary.
            refused = {*duration_arguments(module)} - {*apart_from_delays(module)}
            offered = [word for word in by_name if word not in refused]
            remedy = f"{nearest(name, offered, '', 3, 0.5)} {module.metadata.problem} has {', '.join(offered)}"
            raise ArgumentError(clause(f"{name} is nothing that can be varied"), clause(remedy.strip()))
    return tuple(by_name[name] for name in names)


def require_fitting(varied: Iterable[Quantity], cases: Cases) -> None:
    """Raise an error for texts where numbers are needed, and for counts that are no positive integers."""
    for quantity in varied:
        column = cases.columns[quantity.name]
        if quantity.kind != "argument" and column.dtype.kind == "U":
            words = column.tolist()
            row, word = next(((row, word) for row, word in enumerate(words) if not _is_number(word)), (0, words[0]))
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
    """Return a value as a text for `--set`; whole numbers have no decimal point, which fits both int and float."""
    if isinstance(value, str):
        return value
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(value)


def given_to(module_values: Mapping[Quantity, Any]) -> dict[str, Any]:
    """Return the keyword arguments of a module's functions that set the parameters and boundary values of a case.

    Arrays in place of numbers give the arguments of many cases.
    """
    arguments, ends = dict[str, Any](), dict[str, dict[str, Any]]()
    for quantity, value in module_values.items():
        if quantity.kind == "parameter":
            arguments[quantity.key] = value
        elif quantity.kind == "boundary":
            end, name = quantity.key.split(" ", 1)
            ends.setdefault(end, {})[name] = value
    return {**arguments, **ends}


@dataclass(frozen=True, eq=False)
class Tangent:
    """The derivatives `rates` (m, n) of n unknowns with respect to m varied quantities, at their `values` (m,)."""

    quantities: tuple[Quantity, ...]
    values: Vector
    rates: Matrix

    def move(self, values: Mapping[Quantity, float]) -> Vector:
        """Return the first-order change (n,) of the unknowns for other values of the quantities."""
        steps = np.array([values[own] for own in self.quantities]) - self.values
        return np.asarray(steps @ self.rates)


@dataclass(frozen=True, eq=False)
class CaseRates:
    """The derivatives of a case with respect to m quantities: `arrays` (m, ...) by their names in the data set.

    The message gives the reason if there are no derivatives, and names one-sided or inaccurate derivatives. `tangent`
    is None if it was not requested, or if there are no derivatives with respect to a varied quantity.
    """

    message: str = ""
    arrays: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    tangent: Tangent | None = None


@dataclass(frozen=True)
class Wanted:
    """The requested derivatives: of the cost, of free parameters, of `arrays`, and, with `tangents`, of the unknowns.

    The `varied` quantities stay fixed when other quantities change, even if formulas relate them.
    """

    varied: tuple[Quantity, ...]
    arrays: Sequence[str]
    tangents: bool

    def of_solution(
        self, module: ControlModule, driver: str, run: Run, attempt: ControlAttempt, values: Mapping[Quantity, float]
    ) -> CaseRates:
        """Return the derivatives of a solved case; `module` already has the values of the case."""
        names = module.metadata.sensitivities or ()
        fixed = [own.name for own in self.varied if own.name in names]
        try:
            rates = rates_at(module, run.steps, attempt.unknowns, fixed)
        except (ValueError, ArithmeticError) as error:  # a derivative can be infinite at a finite solution
            return CaseRates(f"no sensitivities: {error.args[-1] if error.args else type(error).__name__}")
        message = "; ".join(rates.sensitivities.notes)
        if rates.sensitivities.reason:
            return CaseRates(message)
        arrays = {
            f"{RATE}cost": rates.sensitivities.costs,
            **{f"{RATE}{free_label(name)}": by for name, by in rates.free.items()},
        }
        if self.arrays:
            derivatives = rates.derivatives(control_result(module, driver, run, attempt))
            arrays |= {f"{RATE}{name}": np.stack([getattr(by, name) for by in derivatives]) for name in self.arrays}
        tangent = None
        if self.tangents and len(fixed) == len(values):
            rows = [names.index(own.name) for own in values]
            tangent = Tangent(tuple(values), np.array([*values.values()]), rates.found.unknowns[rows])
        return CaseRates(message, arrays, tangent)
