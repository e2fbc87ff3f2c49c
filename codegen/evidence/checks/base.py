"""The interface of a check, and the numerical tools that checks share.

A check reads a `Context`: the author's model, the derived program, and the generated module on disk. It yields
findings, which `findings_table` and `not_applicable` show.

The numerical tools evaluate expressions in high precision at random points where all expressions have finite values.
Derivatives are differences of undifferentiated expressions in 120-digit arithmetic. They do not depend on sympy's
differentiation and are correct to about 40 digits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, TypeAlias

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from codegen.discretise.interval import LENGTHS, STEP
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.values import expected_values
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.discretise.schemes.base import Scheme
from codegen.emit.naming import Choices
from codegen.emit.verify.comparison import GuessedPoints
from codegen.emit.verify.execution import Text
from codegen.emit.verify.kernels import guessed_points
from codegen.errors import NumericsError
from codegen.identifiers import plain
from codegen.solving.loading import ControlSolution

if TYPE_CHECKING:
    from rich.table import Table

_LEAST_STEPS = 8
DOES_NOT_APPLY = "does not apply"  # the outcome of a check that does not apply to a problem


@dataclass(frozen=True)
class Finding:
    """One piece of evidence.

    Parameters
    ----------
    check : str
        Name of the check.
    subject : str
        The kernel, equation or quantity that was examined.
    passed : bool
        False if the check failed. True also for a check that does not apply or was not measured.
    detail : str
        The formula or number that supports the outcome, or the reason why there is no evidence.
    applies : bool
        False if the finding is no evidence.
    measured : bool
        False if the check applies, but could not be evaluated.
    """

    check: str
    subject: str
    passed: bool
    detail: str
    applies: bool = True
    measured: bool = True

    def __post_init__(self) -> None:
        """Replace internal names in both texts by the author's names."""
        object.__setattr__(self, "subject", plain(self.subject))
        object.__setattr__(self, "detail", plain(self.detail))

    @staticmethod
    def decided(check: str, subject: str, passed: object, right: str, wrong: str) -> Finding:
        """Return the finding with the text `right` if the check has passed, and with the text `wrong` otherwise."""
        return Finding(check, subject, bool(passed), right if passed else wrong)

    @property
    def outcome(self) -> str:
        """The outcome in words."""
        if not self.measured:
            return "not measured"
        if not self.applies:
            return DOES_NOT_APPLY
        return "passed" if self.passed else "FAILED"


class Findings(tuple[Finding, ...]):
    """The findings of all checks in the order of the registry. A notebook shows them as a table."""

    __slots__ = ()

    @property
    def passed(self) -> bool:
        """True if no check has failed."""
        return all(finding.passed for finding in self)

    @property
    def failed(self) -> tuple[Finding, ...]:
        """The findings of checks that have failed."""
        return tuple(finding for finding in self if not finding.passed)

    def _repr_html_(self) -> str:
        """Return all findings as a table in HTML. Outcomes are words, because colours alone are not accessible."""
        from codegen.show.notebook import table as html_table

        rows = [(finding.check, finding.subject, finding.outcome, finding.detail) for finding in self]
        return html_table(rows, ("check", "subject", "outcome", "detail"), verdict(self))


def verdict(findings: Sequence[Finding]) -> str:
    """Return one line of text with the number of findings of each outcome."""
    outcomes = [finding.outcome for finding in findings]
    passed, unmeasured = outcomes.count("passed"), outcomes.count("not measured")
    text = f"{passed} {'check' if passed == 1 else 'checks'} passed, {outcomes.count('FAILED')} failed, "
    text += f"{outcomes.count(DOES_NOT_APPLY)} do not apply"
    return text + (f", {unmeasured} not measured" if unmeasured else "")


def findings_table(findings: Sequence[Finding]) -> Table:
    """Return a table for the terminal, as wide as the terminal, of all findings of checks that apply."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    styles = {"passed": "green", "FAILED": "bold red"}
    table = Table(box=box.SIMPLE_HEAD, expand=True, pad_edge=False)
    table.add_column("", max_width=len("measured"))
    table.add_column("check", ratio=2)
    table.add_column("detail", ratio=3)
    for finding in findings:
        outcome = finding.outcome
        if outcome == DOES_NOT_APPLY:
            continue
        detail = finding.detail if finding.applies else finding.detail.removeprefix(f"{outcome}: ")
        styled = f"[{styles.get(outcome, 'dim')}]{outcome}[/]"
        table.add_row(styled, f"[cyan]{escape(finding.check)}:[/] {escape(finding.subject)}", escape(detail))
    return table


def not_applicable(findings: Sequence[Finding]) -> str:
    """Return one line of text with the names of all checks that do not apply, or ""."""
    names = dict.fromkeys(finding.check for finding in findings if finding.outcome == DOES_NOT_APPLY)
    return f"not applicable: {', '.join(names)}" if names else ""


@dataclass(frozen=True)
class Context:
    """The input of a check: the author's model, its discretisation, and the generated module on disk.

    `program` is the discretised problem. `written` is the object that the author's function problem() returned.
    `steps` is the number of intervals to solve on, by default the problem's own.
    """

    choices: Choices
    model: Model
    program: ControlProgram | StepProgram
    scheme: Scheme
    module: ModuleType
    written: object = None
    steps: int | None = None

    @property
    def control(self) -> ControlProgram:
        """The program of a control problem."""
        assert isinstance(self.program, ControlProgram), "the task is not control"
        return self.program

    @cached_property
    def solution(self) -> ControlSolution:
        """The module's solution on at least eight intervals. For a simulation, attributes of optima are missing."""
        solution: ControlSolution = self.module.solve(
            max(_LEAST_STEPS, len(self.model.inner_times) + 1, self.steps or self.model.steps)
        )
        return solution

    @cached_property
    def guessed(self) -> GuessedPoints | None:
        """Points near the initial guess of the module; None if the module is damaged and has no guess."""
        program = self.control
        try:
            return guessed_points(program, Text(Path(str(self.module.__file__)).read_text(encoding="utf-8")))
        except Exception:  # a damaged module may fail in any way
            return None


@dataclass(frozen=True)
class Check:
    """A kind of evidence: its name, and a function that yields at least one finding.

    A check with `runs_the_module` calls compiled code or trusts tables of the module; other checks read expressions
    alone. A check `of_each_phase` treats every phase as a separate problem. `without` maps a task ("simulate") or a
    form ("first-order") to the reason why the check does not apply to such problems. `of_solution` is the subject, such
    as "all constraints", of a check that needs a solution.
    """

    name: str
    findings: Callable[[Context], Iterable[Finding]]
    runs_the_module: bool = True
    of_each_phase: bool = False
    without: Mapping[str, str] = field(default_factory=dict)
    of_solution: str = ""


def does_not_apply(check: str, reason: str) -> Finding:
    """Return the finding of a check that does not apply to a problem."""
    return Finding(check, "the whole problem", True, f"{DOES_NOT_APPLY}: {reason}", applies=False)


def not_measured(check: str, subject: str, reason: str) -> Finding:
    """Return the finding of a check that lacks its input, for example a solution."""
    return Finding(check, subject, True, f"not measured: {reason}", applies=False, measured=False)


Range = tuple[float, float]
_SHARES = (0.0, 0.5, 1.0)
_ORDINARY = 1e-2, 1e2
"""Quantities between these magnitudes get random values near one, where no term of an expression is negligible."""
_BESIDE = 0.02, 0.1
"""Margin of a range, as a fraction of its only value, or as a fraction of the distance between its extreme values."""
_AT = re.compile(r"_(stage\d+(_k)?|k1?)$")


def own_ranges(model: Model, likely: Iterable[Mapping[Symbol, float]] = ()) -> dict[str, Range]:
    """Return the range (least, greatest) of each quantity whose magnitude is far from one, by name.

    The ranges cover the initial guess, the boundary values, the bounds, the defaults, and the points `likely`.
    """
    points = [expected_values(phase, share) for phase in model.phases or (model,) for share in _SHARES]
    values: dict[str, list[float]] = {}
    for point in (*points, *likely):
        for symbol, number in point.items():
            values.setdefault(symbol.name, []).append(number)
    (small, large), (alone, both), ranges = _ORDINARY, _BESIDE, dict[str, Range]()
    for name, numbers in values.items():
        least, greatest = min(numbers), max(numbers)
        margin = both * (greatest - least) or alone * abs(least)
        least, greatest = least - margin, greatest + margin
        if max(-least, greatest) > large or 0 < max(-least, greatest) < small:
            ranges[name] = least, greatest
    return ranges


def range_of(symbol: Symbol, ranges: Mapping[str, Range]) -> Range | None:
    """Return the range of a symbol, else of its quantity (for x_k or x_stage1 the range of x), else None."""
    return ranges.get(symbol.name) or ranges.get(_AT.sub("", symbol.name))


Point: TypeAlias = Mapping[Symbol, float]
Emitted: TypeAlias = Sequence[float] | NDArray[np.float64]
Numbers: TypeAlias = list[mpmath.mpf]
Function: TypeAlias = Callable[..., Numbers]

DIGITS = 120
NOTHING = mpmath.mpf(10) ** -30  # a difference below this fraction of the largest entry counts as zero
_INCREMENT = mpmath.mpf(10) ** -40
_SEED = 20240229
_ATTEMPTS = 200


class NoPointError(NumericsError):
    """The error if expressions have no finite values at random points, so that they cannot be compared."""


def function_of(
    symbols: Sequence[Symbol], values: Sequence[Expr], assignments: Sequence[tuple[Symbol, Expr]] = ()
) -> Function:
    """Return a function that takes numbers for `symbols`, of any precision, and returns the list of `values`.

    Values may contain the symbols of `assignments`, which are evaluated first and in order. Substitution instead
    could make the expressions far too long.
    """
    extra = {"Heaviside": lambda x: (1 + mpmath.sign(x)) / 2, "DiracDelta": lambda *_: mpmath.mpf(0)}
    parts = (lambda expressions: (list(assignments), expressions)) if assignments else True
    function = sympy.lambdify(list(symbols), list(values), modules=[extra, "mpmath"], cse=parts)
    return function  # type: ignore[no-any-return]


def random_points(
    values: Sequence[Expr],
    symbols: Sequence[Symbol],
    model: Model,
    count: int = 3,
    seed: int = _SEED,
    likely: Iterable[Point] = (),
    assignments: Sequence[tuple[Symbol, Expr]] = (),
) -> list[dict[Symbol, float]]:
    """Return `count` points, as numbers by symbol, at which all `values` are real and finite. The seed is fixed.

    Parameters are drawn near their defaults, and quantities of extreme magnitude from their range in the model and in
    `likely`. Values may contain the symbols of `assignments`. Points of `likely` with finite values come first, but at
    least one point is random.

    Raises
    ------
    NoPointError
        If too few points are in the domain of the expressions.
    """
    likely = list(likely)
    defaults, ranges = model.default_values, own_ranges(model, likely)
    ranged = {s: limits for s in symbols if (limits := range_of(s, ranges)) is not None}
    ranged = {s: limits for s, limits in ranged.items() if s not in defaults and s not in (STEP, *LENGTHS)}
    generator = np.random.default_rng(seed)
    function = function_of(symbols, values, assignments)

    def has_value(point: Point) -> bool:
        try:
            return all(math.isfinite(float(result)) for result in function(*(mpmath.mpf(point[s]) for s in symbols)))
        except (TypeError, ValueError, ArithmeticError):
            return False

    points: list[dict[Symbol, float]] = []
    for point in likely:
        if len(points) < count - 1 and has_value(point):
            points.append({symbol: point[symbol] for symbol in symbols})
    for _ in range(_ATTEMPTS):
        drawn = {symbol: float(generator.uniform(0.4, 1.6)) for symbol in symbols}
        drawn |= {symbol: float(generator.uniform(*limits)) for symbol, limits in ranged.items()}
        drawn |= {symbol: value * drawn[symbol] for symbol, value in defaults.items() if symbol in drawn and value}
        drawn |= {length: 0.25 * drawn[length] for length in (STEP, *LENGTHS) if length in drawn}
        if has_value(drawn):
            points.append(drawn)
        if len(points) == count:
            return points
    raise NoPointError("the expressions have no real value at random points", "give bounds or a guess of their sizes")


def gradient(function: Function, numbers: Sequence[float], indices: Sequence[int]) -> Numbers:
    """Return forward differences of the first value of a function with respect to the arguments `indices`."""
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        middle = at()
        return [(at(i) - middle) / _INCREMENT for i in indices]


def second_differences(
    function: Function, numbers: Sequence[float], pairs: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], mpmath.mpf]:
    """Return second forward differences of the first value of a function with respect to pairs of arguments.

    Large values, such as 1e200, need additional digits, or their differences would be lost.
    """
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        more = max(0, int(mpmath.ceil(mpmath.log10(1 + abs(at())))))
    with mpmath.workdps(DIGITS + more):
        single = {i: at(i) for i in dict.fromkeys(index for pair in pairs for index in pair)}
        middle = at()
        return {(i, j): (at(i, j) - single[i] - single[j] + middle) / _INCREMENT**2 for i, j in pairs}


def directional(function: Function, numbers: Sequence[float], direction: Sequence[float]) -> Numbers:
    """Return the product of the Hessian of the first value and a direction, by second forward differences.

    `direction` has one entry for each of the first arguments. The other arguments stay fixed.
    """
    along = {i: mpmath.mpf(float(weight)) for i, weight in enumerate(direction) if weight}
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        ahead, middle = at(along=along), at()
        return [(at(i, along=along) - at(i) - ahead + middle) / _INCREMENT**2 for i in range(len(direction))]


def curved_beyond(
    function: Function, numbers: Sequence[float], indices: Sequence[int], pattern: Iterable[tuple[int, int]]
) -> set[tuple[int, int]]:
    """Return the nonzero entries (row, column), row >= column, of the Hessian of the first value outside a pattern.

    `indices` are the arguments to search. A row is searched only if its second difference along a random combination of
    all columns outside the pattern does not vanish. So the cost grows with the number of rows.
    """
    inside, outside = set(pattern), set[tuple[int, int]]()
    generator = np.random.default_rng(_SEED)
    largest = max(map(abs, second_differences(function, numbers, sorted(inside)).values()), default=0)
    least = NOTHING * (largest or 1)
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        middle = at()
        for row in indices:
            columns = [c for c in indices if c <= row and (row, c) not in inside]
            weights = {c: mpmath.mpf(float(generator.uniform(0.5, 1.5))) for c in columns}
            if abs(at(row, along=weights) - at(row) - at(along=weights) + middle) <= least * _INCREMENT**2:
                continue
            values = second_differences(function, numbers, [(row, c) for c in columns])
            outside |= {pair for pair, value in values.items() if abs(value) > least}
    return outside


def _shifted(function: Function, numbers: Sequence[float]) -> Callable[..., mpmath.mpf]:
    """Return the function at(i, j, along=d): the first value after increments of arguments i and j and along d."""

    def at(*indices: int, along: Mapping[int, mpmath.mpf] | None = None) -> mpmath.mpf:
        arguments = [mpmath.mpf(number) for number in numbers]
        for i in indices:
            arguments[i] += _INCREMENT
        for i, weight in (along or {}).items():
            arguments[i] += weight * _INCREMENT
        return function(*arguments)[0]

    return at


TOLERANCE = 1e-10
_ROUNDING = 1e-13


@dataclass
class Agreement:
    """The largest relative error of all compared entries, the name of its entry, and the number of entries."""

    check: str = "derivatives"
    error: float = 0.0
    name: str = ""
    entries: int = 0

    def compare(self, names: Sequence[str], emitted: Emitted, exact: Sequence[mpmath.mpf]) -> None:
        """Compare entries. Errors are relative to the exact entry, less the rounding error of the largest entry.

        The error of an entry that vanishes is relative to the largest entry. Terms that cancel in such an entry leave
        rounding errors: up to 1.4e-11 of the largest entry in the interior angles of 4 to 7 hovercraft.
        """
        assert len(names) == len(emitted) == len(exact)
        largest = max((abs(value) for value in exact), default=0)
        self.entries += len(names)
        for name, value, expected in zip(names, emitted, exact, strict=True):
            excess = abs(mpmath.mpf(float(value)) - expected) - _ROUNDING * largest
            size = abs(expected) if abs(expected) > NOTHING * largest else largest
            error = float(excess / size) if size else 0.0 if excess <= 0 else float("inf")
            if not error <= self.error:
                self.error, self.name = error if error == error else float("inf"), name

    def finding(self, subject: str, against: str) -> Finding:
        """Return the finding on a subject: agreement with the reference `against`, or the entry that differs most."""
        right = f"{self.entries} values agree with {against} to {TOLERANCE:g}"
        wrong = f"{self.name} differs from {against} by {self.error:.2g} of its value"
        return Finding.decided(self.check, subject, self.error <= TOLERANCE, right, wrong)
