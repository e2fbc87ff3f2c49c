"""What a check is: findings from a context, which is what was derived, and the module on disk.

Evaluation in high precision: functions of expressions, random points at which they have a value, differences.

Differences are taken of undifferentiated expressions in 120-digit arithmetic, so that they owe nothing to sympy's
differentiation and are right to about 40 digits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import mpmath
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.discretise.interval import LENGTHS, STEP
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.smoothness import expected_values
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.discretise.schemes.base import Scheme
from codegen.emit.naming import Choices
from codegen.emit.verify.comparison import GuessedPoints
from codegen.emit.verify.execution import Text
from codegen.emit.verify.kernels import guessed_points
from codegen.errors import NumericsError
from codegen.identifiers import plain
from codegen.symbolic.zeros import identically_zero

if TYPE_CHECKING:
    from rich.table import Table

_LEAST_STEPS = 8


@dataclass(frozen=True)
class Finding:
    """One piece of evidence: which check, about what, whether it holds, and the formula or number that says so.

    What does not apply to a problem, or could not be measured, has passed, but is no evidence; then `detail` says why.
    """

    check: str
    subject: str
    passed: bool
    detail: str
    applies: bool = True

    def __post_init__(self) -> None:
        """Say names as the problem's author wrote them."""
        object.__setattr__(self, "subject", plain(self.subject))
        object.__setattr__(self, "detail", plain(self.detail))


class Findings(tuple[Finding, ...]):
    """The findings of all checks in their order, which a notebook shows as a table."""

    __slots__ = ()

    @property
    def passed(self) -> bool:
        """Whether no check has failed."""
        return all(finding.passed for finding in self)

    @property
    def failed(self) -> tuple[Finding, ...]:
        """Those that have."""
        return tuple(finding for finding in self if not finding.passed)

    def _repr_html_(self) -> str:
        return findings_html(self)


def findings_table(findings: Sequence[Finding]) -> Table:
    """What was checked, of what, and with what outcome."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    silent = [finding for finding in findings if not finding.applies]
    unmeasured = sum(map(_is_unmeasured, silent))
    failed = sum(not finding.passed for finding in findings)
    passed = len(findings) - len(silent) - failed
    caption = f"{passed} passed, {failed} failed, {len(silent) - unmeasured} do not apply"
    caption += f", {unmeasured} not measured" if unmeasured else ""
    table = Table(box=box.SIMPLE_HEAD, caption=caption, caption_justify="left")
    for heading in ("check", "subject", "", "detail"):
        table.add_column(heading)
    for finding in findings:
        detail = finding.detail
        for words in () if finding.applies else ("does not apply: ", "not measured: "):
            detail = detail.removeprefix(words)
        table.add_row(escape(finding.check), escape(finding.subject), _verdict(finding), escape(detail))
    return table


def findings_html(findings: Sequence[Finding]) -> str:
    """Return the findings as a table in HTML, with the outcomes in words and not in colours alone."""
    from codegen.show.notebook_solution import table as html_table

    silent = sum(not finding.applies for finding in findings)
    failed = sum(not finding.passed for finding in findings)
    outcomes = {(True, True): "passed", (True, False): "FAILED"}
    rows = [(f.check, f.subject, outcomes.get((f.applies, f.passed), "does not apply"), f.detail) for f in findings]
    caption = f"{len(findings) - silent - failed} passed, {failed} failed, {silent} do not apply"
    return html_table(rows, ("check", "subject", "outcome", "detail"), caption)


def _is_unmeasured(finding: Finding) -> bool:
    return not finding.applies and finding.detail.startswith("not measured")


def _verdict(finding: Finding) -> str:
    """A check that says nothing about a problem has not passed."""
    if not finding.applies:
        return "[dim]not measured[/]" if _is_unmeasured(finding) else "[dim]does not apply[/]"
    return "[green]passed[/]" if finding.passed else "[bold red]FAILED[/]"


@dataclass(frozen=True)
class Context:
    """What checks read: the author's model, its discretisation, and the generated module as it lies on disk."""

    choices: Choices
    model: Model
    program: ControlProgram | StepProgram
    scheme: Scheme
    module: Any

    @property
    def control(self) -> ControlProgram:
        """The program of a control problem."""
        assert isinstance(self.program, ControlProgram), "the task is not control"
        return self.program

    @cached_property
    def solution(self) -> Any:
        """What the module's solver finds on the default number of intervals, but on eight at least."""
        return self.module.solve(max(_LEAST_STEPS, len(self.model.inner_times) + 1, self.model.steps))

    @cached_property
    def guessed(self) -> GuessedPoints | None:
        """Points near the guess of the module; none where a damaged module makes no guess."""
        program = self.control
        try:
            return guessed_points(program, Text(Path(self.module.__file__).read_text(encoding="utf-8")))
        except Exception:  # a damaged module may fail in any way
            return None


@dataclass(frozen=True)
class Check:
    """A kind of evidence: its name, and what finds it, which yields at least one finding also where it does not apply.

    A check that `runs_the_module` calls compiled code, or trusts tables of the module; else it looks at expressions
    alone. One of equations may be made `of_each_phase`, as if that were a problem of its own. `without` says for tasks
    and forms of dynamics that lack what it is about what that is; such problems are not given to it.
    """

    name: str
    findings: Callable[[Context], Iterable[Finding]]
    runs_the_module: bool = True
    of_each_phase: bool = False
    without: Mapping[str, str] = field(default_factory=dict)


def does_not_apply(check: str, reason: str) -> Finding:
    """The finding of a check that has nothing to say about a problem."""
    return Finding(check, "the whole problem", True, f"does not apply: {reason}", applies=False)


def not_measured(check: str, subject: str, reason: str) -> Finding:
    """The finding of a check that needs what is not there, as a solution where the solver found none."""
    return Finding(check, subject, True, f"not measured: {reason}", applies=False)


Range = tuple[float, float]
_SHARES = (0.0, 0.5, 1.0)
_ORDINARY = 1e-2, 1e2
"""Sizes between these are drawn about one, where all terms of an expression can be seen."""
_BESIDE = 0.02, 0.1
"""How far a range is extended: parts of a single value, and of the distance of two."""
_AT = re.compile(r"_(stage\d+(_k)?|k1?)$")


def own_ranges(model: Model, likely: Iterable[Mapping[Symbol, float]] = ()) -> dict[str, Range]:
    """The ranges of quantities whose sizes are not ordinary ones, by names.

    They are those of the guess, the values at the ends, the bounds and the defaults, and of points that are `likely`.
    """
    points = [expected_values(own, share) for own in model.phases or (model,) for share in _SHARES]
    found: dict[str, list[float]] = {}
    for point in (*points, *likely):
        for symbol, number in point.items():
            found.setdefault(symbol.name, []).append(number)
    ranges = {name: _extended(min(numbers), max(numbers)) for name, numbers in found.items()}
    least, greatest = _ORDINARY
    return {name: (a, b) for name, (a, b) in ranges.items() if max(-a, b) > greatest or 0 < max(-a, b) < least}


def range_of(symbol: Symbol, ranges: Mapping[str, Range]) -> Range | None:
    """The range of a symbol, or of the quantity whose value at a node or stage it holds; None where it is ordinary."""
    return ranges.get(symbol.name) or ranges.get(_AT.sub("", symbol.name))


def _extended(least: float, greatest: float) -> Range:
    alone, both = _BESIDE
    more = both * (greatest - least) or alone * abs(least)
    return least - more, greatest + more


Point: TypeAlias = Mapping[Symbol, float]
Function: TypeAlias = Callable[..., list[Any]]

DIGITS = 120
NOTHING = mpmath.mpf(10) ** -30
"""Below this fraction of the largest entry a difference counts as zero."""
_INCREMENT = mpmath.mpf(10) ** -40
_SEED = 20240229
_ATTEMPTS = 200


class NoPointError(NumericsError):
    """No point was found at which expressions have values, so that they cannot be compared with anything."""


def function_of(
    symbols: Sequence[Symbol], values: Sequence[Expr], assignments: Sequence[tuple[Symbol, Expr]] = ()
) -> Function:
    """A function of numbers of any precision, in the order of the symbols, that returns the values as a list.

    Values may read the symbols of assignments, which are made in order; written out, they could be far too long.
    """
    extra = {"Heaviside": lambda x: (1 + mpmath.sign(x)) / 2, "DiracDelta": lambda *_: mpmath.mpf(0)}
    parts = (lambda expressions: (list(assignments), expressions)) if assignments else True
    function = sympy.lambdify(list(symbols), list(values), modules=[extra, "mpmath"], cse=parts)
    return function  # type: ignore[no-any-return]


def symbols_of(values: Sequence[Expr], *more: Sequence[Symbol]) -> list[Symbol]:
    """The symbols of some expressions and further ones, each once, in an order that is the same in every run."""
    found = set().union(*(value.free_symbols for value in values), *map(set, more))
    return sorted(found, key=lambda symbol: symbol.name)


def random_points(
    values: Sequence[Expr],
    symbols: Sequence[Symbol],
    model: Model,
    count: int = 3,
    seed: int = _SEED,
    likely: Iterable[Point] = (),
    assignments: Sequence[tuple[Symbol, Expr]] = (),
) -> list[dict[Symbol, float]]:
    """Seeded random points at which all values are real and finite; parameters are drawn about their defaults.

    What the model, or a likely point, has of another size than one is drawn where it is there. Values may read
    `assignments`. Of the points that are `likely` those come first that have values, but one point at
    least is random. Raises NoPointError when hardly any point is in the domain of the expressions.
    """
    likely = list(likely)
    defaults, ranges = model.default_values, own_ranges(model, likely)
    elsewhere = [symbol for symbol in symbols if symbol not in defaults and symbol not in (STEP, *LENGTHS)]
    generator = np.random.default_rng(seed)
    function = function_of(symbols, values, assignments)
    points: list[dict[Symbol, float]] = []
    for point in likely:
        if len(points) < count - 1 and _has_value(function, [point[symbol] for symbol in symbols]):
            points.append({symbol: point[symbol] for symbol in symbols})
    for _ in range(_ATTEMPTS):
        drawn = {symbol: float(generator.uniform(0.4, 1.6)) for symbol in symbols}
        drawn |= {s: float(generator.uniform(*own)) for s in elsewhere if (own := range_of(s, ranges)) is not None}
        drawn |= {symbol: value * drawn[symbol] for symbol, value in defaults.items() if symbol in drawn and value}
        drawn |= {length: 0.25 * drawn[length] for length in (STEP, *LENGTHS) if length in drawn}
        if _has_value(function, [drawn[symbol] for symbol in symbols]):
            points.append(drawn)
        if len(points) == count:
            return points
    raise NoPointError("the expressions have no real value at random points", "give bounds or a guess of their sizes")


def _has_value(function: Function, numbers: Sequence[float]) -> bool:
    try:
        results = function(*map(mpmath.mpf, numbers))
        return all(math.isfinite(float(result)) for result in results)
    except (TypeError, ValueError, ArithmeticError):
        return False


def gradient(function: Function, numbers: Sequence[float], indices: Sequence[int]) -> list[Any]:
    """Forward differences of the first value of a function by the arguments at some indices."""
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        middle = at()
        return [(at(i) - middle) / _INCREMENT for i in indices]


def second_differences(
    function: Function, numbers: Sequence[float], pairs: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], Any]:
    """Second forward differences of the first value of a function by pairs of arguments.

    Of values as large as 1e200 it takes more digits to see the difference.
    """
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        more = max(0, int(mpmath.ceil(mpmath.log10(1 + abs(at())))))
    with mpmath.workdps(DIGITS + more):
        single = {i: at(i) for i in dict.fromkeys(index for pair in pairs for index in pair)}
        middle = at()
        return {(i, j): (at(i, j) - single[i] - single[j] + middle) / _INCREMENT**2 for i, j in pairs}


def directional(function: Function, numbers: Sequence[float], direction: Sequence[float]) -> list[Any]:
    """Second forward differences of the first value of a function by each of its first arguments and a direction.

    The direction has an entry for each of these arguments.
    """
    along = {i: mpmath.mpf(float(weight)) for i, weight in enumerate(direction) if weight}
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        ahead, middle = at(along=along), at()
        return [(at(i, along=along) - at(i) - ahead + middle) / _INCREMENT**2 for i in range(len(direction))]


def curved_beyond(
    function: Function, numbers: Sequence[float], indices: Sequence[int], pattern: Iterable[tuple[int, int]]
) -> set[tuple[int, int]]:
    """Pairs (row, column), row >= column, outside a pattern whose second difference does not vanish.

    A row is searched only if its second difference by a random combination of all columns outside the pattern does
    not vanish, so that the cost grows with the number of rows.
    """
    known, found = set(pattern), set[tuple[int, int]]()
    generator = np.random.default_rng(_SEED)
    inside = second_differences(function, numbers, sorted(known)).values()
    least = NOTHING * (max(map(abs, inside), default=0) or 1)
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        middle = at()
        for row in indices:
            columns = [c for c in indices if c <= row and (row, c) not in known]
            weights = {c: mpmath.mpf(float(generator.uniform(0.5, 1.5))) for c in columns}
            alone, beside = at(row), at(along=weights)
            if abs(at(row, along=weights) - alone - beside + middle) <= least * _INCREMENT**2:
                continue
            values = second_differences(function, numbers, [(row, c) for c in columns])
            found |= {pair for pair, value in values.items() if abs(value) > least}
    return found


def _shifted(function: Function, numbers: Sequence[float]) -> Callable[..., Any]:
    """The first value of a function at numbers that are incremented at the given indices, and along a direction."""

    def at(*indices: int, along: Mapping[int, Any] | None = None) -> Any:
        arguments = [mpmath.mpf(number) for number in numbers]
        for i in indices:
            arguments[i] += _INCREMENT
        for i, weight in (along or {}).items():
            arguments[i] += weight * _INCREMENT
        return function(*arguments)[0]

    return at


def vanishing(expression: Expr) -> str:
    """How it is known that an expression is zero everywhere, in words; empty when it is not."""
    return "proved symbolically" if identically_zero(expression) else ""


TOLERANCE = 1e-10
_ROUNDING = 1e-13


@dataclass
class Agreement:
    """The largest relative error seen so far, the name of its entry, and how many entries were compared."""

    check: str = "derivatives"
    error: float = 0.0
    name: str = ""
    entries: int = 0

    def compare(self, names: Sequence[str], emitted: Any, exact: Sequence[Any]) -> None:
        """Errors count relative to the entry, above the rounding of the largest entry beside it.

        An entry that vanishes beside the others has no digits to agree with: its error counts relative to the largest.
        Terms that cancel in it leave their rounding: up to 1.4e-11 of the largest in the interior angles of 4 to 7
        hovercraft.
        """
        assert len(names) == len(emitted) == len(exact)
        largest = max((abs(value) for value in exact), default=0)
        self.entries += len(names)
        for name, value, wanted in zip(names, emitted, exact, strict=True):
            excess = abs(mpmath.mpf(float(value)) - wanted) - _ROUNDING * largest
            size = abs(wanted) if abs(wanted) > NOTHING * largest else largest
            error = float(excess / size) if size else 0.0 if excess <= 0 else float("inf")
            if not error <= self.error:
                self.error, self.name = error if error == error else float("inf"), name

    def finding(self, subject: str, against: str) -> Finding:
        """Whether all values agree with what they were compared with, and which does not."""
        passed = self.error <= TOLERANCE
        detail = f"{self.entries} values agree with {against} to {TOLERANCE:g}"
        if not passed:
            detail = f"{self.name} differs from {against} by {self.error:.2g} of its value"
        return Finding(self.check, subject, passed, detail)
