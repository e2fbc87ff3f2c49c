"""Conditions at inner times, imposed at the nodes there, all on one chain of intervals.

A condition g = 0 has a multiplier y on the node, and g <= 0 a slack s >= 0 beside it. Which nodes are at inner times is
known when the module is run: every node has these unknowns, and numbers m, which are one where they mean something,

    l gains m y g + (1 - m) y^2/2    or    m y (g + s) + (1 - m) (y^2 + s^2)/2

at the left node of each interval, so that they vanish at other nodes. Conditions that differ in numbers alone are one
expression, whose numbers belong to the node as m does, and different ones at different times share their multiplier.
Neither the code nor the time of a build grows with the number of times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from sympy import Expr, Rational, S, Symbol

from codegen.expressions import checks
from codegen.model import InnerCondition, Model
from codegen.runtime.record import Kind, Meaning
from codegen.transcribe.conditions.common_forms import Form, common_forms
from codegen.transcribe.conditions.free_times import Clock, with_given_times
from codegen.transcribe.conditions.path_conditions import NodalTerms
from codegen.transcribe.names import Names, symbols
from codegen.transcribe.program import InnerTimes, Unknown

_TRIALS = 30
"""Points of each size at which an expression is tried."""


@dataclass(frozen=True)
class InnerTerms:
    """The unknowns of nodes with their share of l; and the times, where indices count these unknowns from zero."""

    nodal: NodalTerms
    times: InnerTimes


def inner_terms(
    original: Model, at_left: Callable[[Expr], Expr], names: Names, clock: Clock | None = None
) -> InnerTerms:
    """Impose the conditions of a model; `at_left` writes an expression in the symbols of an interval's left node.

    With a `clock` the times are free.
    """
    if not original.inner_conditions:
        return InnerTerms(NodalTerms(), InnerTimes())
    model = with_given_times(original, clock)
    lanes = _lanes(model.inner_conditions)
    table = _Table(model, names, clock)
    unknowns, element = list[Unknown](), S.Zero if clock is None else clock.share(table.is_inner)
    found, multipliers = dict[int, list[int]](), list[tuple[str, int, int]]()
    for lane in lanes:
        first = len(unknowns)
        unknowns.append(Unknown(names.numbered("nu"), Meaning(Kind.INNER_CONDITION)))
        slack = S.Zero
        if any(not c.equality for c in lane):
            unknowns.append(Unknown(names.numbered("s"), Meaning(Kind.INNER_SLACK), lower=S.Zero))
            (slack,) = symbols([unknowns[-1].name], "_k")
        (multiplier,) = symbols([unknowns[first].name], "_k")
        element += table.share(lane, multiplier, slack, at_left)
        for c in lane:
            found.setdefault(c.number, []).extend([first] if c.equality else [first, first + 1])
            multipliers.append((c.name, c.number, first))
    pins = tuple(unknown.name for unknown in unknowns)
    times = range(len(model.inner_times))
    return InnerTerms(
        NodalTerms(tuple(unknowns), element, pins, pins),
        InnerTimes(
            times=_times(model, clock),
            symbols=tuple(table.rows),
            numbers=tuple(tuple(row.get(time, S.Zero) for time in times) for row in table.rows.values()),
            unknowns=tuple(range(len(unknowns))),
            present=tuple(tuple(i in found.get(time, []) for i in range(len(unknowns))) for time in times),
            multipliers=tuple(sorted(multipliers, key=lambda entry: entry[1:])),
            windows=tuple(
                (number, inner.earliest, inner.latest)
                for number, inner in enumerate(model.inner_times)
                if inner.earliest is not None or inner.latest is not None
            ),
            scales=() if clock is None else clock.scales,
        ),
    )


def _times(model: Model, clock: Clock | None) -> tuple[Expr, ...]:
    """Where inner times are: times, or where these are free parts of the chain, as many intervals between any two."""
    count = len(model.inner_times) + 1
    if clock is not None:
        return tuple(Rational(i, count) for i in range(1, count))
    return tuple(inner.time for inner in model.inner_times if inner.time is not None)


def _lanes(conditions: Sequence[InnerCondition]) -> list[list[InnerCondition]]:
    """The conditions in groups that share a multiplier, at most one of each time, so that few have slacks."""
    at: dict[int, list[InnerCondition]] = {}
    for condition in conditions:
        at.setdefault(condition.number, []).append(condition)
    count = max(map(len, at.values()))
    lanes: list[list[InnerCondition]] = [[] for _ in range(count)]
    for there in at.values():
        equations = [c for c in there if c.equality]
        for lane, condition in zip(lanes, equations, strict=False):
            lane.append(condition)
        for lane, condition in zip(reversed(lanes), (c for c in there if not c.equality), strict=False):
            lane.append(condition)
    return lanes


def _regular_point(expression: Expr, moving: Sequence[Symbol], values: Mapping[Symbol, float]) -> dict[Symbol, Expr]:
    """Values of the moving symbols at which an expression and its first two derivatives have values; or none at all."""
    slopes = [sympy.diff(expression, x) for x in moving]
    wanted = [expression, *slopes, *(sympy.diff(slope, x) for slope in slopes for x in moving)]
    generator = np.random.default_rng(7)
    for size in np.repeat((1.0, 10.0, 0.1, 100.0), _TRIALS):
        drawn = size * generator.uniform(-0.3, 1.0, len(moving))
        point = {x: Rational(str(round(float(number), 3))) for x, number in zip(moving, drawn, strict=True)}
        at = {**values, **{x: float(number) for x, number in point.items()}}
        if all(checks.rounded_at(value, at) is not None for value in wanted):
            return point
    return {}


class _Table:
    """The numbers that nodes have, a row for each of their symbols: the number of a time, and its value there."""

    def __init__(self, model: Model, names: Names, clock: Clock | None) -> None:
        self._model, self._names = model, names
        self._moving = {*model.coordinates, *model.rates, *(free.symbol for free in model.free_parameters)}
        self._at_node: dict[Symbol, Expr] = {}
        if clock is not None:
            self._moving.add(clock.symbol)
            self._at_node = {clock.symbol: symbols([clock.time], "_k")[0]}
        self.rows: dict[Symbol, dict[int, Expr]] = {}

    @property
    def is_inner(self) -> Symbol:
        """One at a node at an inner time, and zero elsewhere."""
        return self._symbol(dict.fromkeys(range(len(self._model.inner_times)), S.One))

    def share(
        self, lane: Sequence[InnerCondition], multiplier: Symbol, slack: Expr, at_left: Callable[[Expr], Expr]
    ) -> Expr:
        """What l gains by conditions that have their multiplier, and perhaps a slack, in common."""
        element, present, slacked = S.Zero, S.Zero, S.Zero
        for equality in (True, False):
            alike = [c for c in lane if c.equality == equality]
            for form in common_forms([self._at_its_time(c) for c in alike], self._moving):
                members = {alike[i].number: values for i, values in form.members.items()}
                here = self._symbol(dict.fromkeys(members, S.One))
                columns = [{time: values[i] for time, values in members.items()} for i in range(len(form.places))]
                numbers = dict(zip(form.places, (self._symbol(column) for column in columns), strict=True))
                value = self._defined_everywhere(form, numbers, here)
                element += here * multiplier * (at_left(value).xreplace(self._at_node) + (0 if equality else slack))
                present, slacked = present + here, slacked + (0 if equality else here)
        absent = multiplier**2 + slack**2 - present * multiplier**2 - slacked * slack**2
        return element + sympy.expand(absent / 2)

    def _defined_everywhere(self, form: Form, numbers: Mapping[Symbol, Symbol], here: Symbol) -> Expr:
        """The expression of a form in numbers of the node, with slopes at other nodes as well, where it has no meaning.

        A distance has none at zero, a root none below it; there it is taken at a point where it has: zero times what is
        infinite is no number.
        """
        moving = sorted(form.expression.free_symbols & self._moving, key=str)
        if form.expression.is_polynomial(*moving, *numbers):
            return form.expression.xreplace(numbers)
        first = dict(zip(numbers, next(iter(form.members.values())), strict=True))
        point = _regular_point(form.expression.xreplace(first), moving, self._model.default_values)
        elsewhere = {x: here * x + (1 - here) * value for x, value in point.items()}
        elsewhere |= {place: symbol + (1 - here) * first[place] for place, symbol in numbers.items()}
        return form.expression.xreplace(elsewhere)

    def _at_its_time(self, condition: InnerCondition) -> Expr:
        time = self._model.inner_times[condition.number].time
        return condition.expression if time is None else condition.expression.xreplace({self._model.time: time})

    def _symbol(self, row: Mapping[int, Expr]) -> Symbol:
        """A new symbol for a number of nodes, or the one that has these numbers already."""
        for symbol, known in self.rows.items():
            if known == row:
                return symbol
        symbol = Symbol(self._names.numbered("at"), real=True)
        self.rows[symbol] = dict(row)
        return symbol
