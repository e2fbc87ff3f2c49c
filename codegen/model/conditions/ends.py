"""Conditions on coordinates and rates at one end, beside values that are given there; at the end, also between bodies.

`transcribe.conditions.ends` imposes them, those between bodies `transcribe.conditions.shared`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import sympy
from sympy import Expr

from codegen.author.bodies import require_single_bodies
from codegen.author.symbols import ControlInput, EndValue, Time
from codegen.errors import BoundaryError
from codegen.expressions import checks as expressions
from codegen.expressions.terms import distinct
from codegen.model.conditions.base import Kind, Latex, Points, Remedies, Scope, conditions_of, dependent, is_constant
from codegen.model.definitions import Condition, Model, prescribed
from codegen.model.relations import MOVING, STATIC, Entry

_DURATION = "time is the duration there, so write its expression"
_CONTROLS = "limit controls by bounds or path, or make the control a state"


class AtStart(Kind):
    """Equations and inequalities at the start."""

    argument = field = "start_conditions"
    words, end = "conditions at its ends", "start"
    scope: ClassVar[Scope] = {"start_conditions": (*MOVING, *STATIC)}
    remedies: ClassVar[Remedies] = {Time: "time is zero there", ControlInput: _CONTROLS}

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        yield from self.of_model(model) if end == self.end else ()

    def require_regular(self, model: Model, points: Points) -> None:
        """Equations have to determine something that no value there has fixed already."""
        conditions: tuple[Condition, ...] = self.of_model(model)
        own = tuple(free.symbol for free in model.free_parameters)
        for condition in conditions:
            symbols = (*model.coordinates, *model.rates, *(own if model.bodies == 1 else ()))
            if is_constant(condition, symbols, points):
                raise BoundaryError(
                    f"{self.argument} {condition} depends on no coordinate or rate", "correct it, or leave it out"
                )
        fixed = prescribed(model, self.end)
        unknown = [s for s in (*model.coordinates, *model.rates, *own) if s not in fixed]
        equations = [condition for condition in conditions if condition.equality]
        likely = _with_values(fixed, points)
        for condition in equations:
            if is_constant(condition, unknown, likely):
                raise BoundaryError(
                    f"{self.argument} {condition} ties only values that {self.end} fixes already",
                    "leave it out, or let one of the values be free",
                )
        names = dependent(equations, unknown, likely)
        if names:
            raise BoundaryError(f"the {self.argument} {names} depend on each other", "leave out one of them")

    def when(self, latex: Latex) -> str:
        return rf"\text{{at }} t = {latex.first if self.end == 'start' else latex.last}"


class AtEnd(AtStart):
    """Equations and inequalities at the end, and equations there between bodies, which are `couplings` of the model."""

    argument = field = "end_conditions"
    end = "end"
    scope: ClassVar[Scope] = {"end_conditions": (*MOVING, EndValue, *STATIC)}
    remedies: ClassVar[Remedies] = {Time: _DURATION, ControlInput: _CONTROLS}

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """Those with values of single bodies couple these; the others hold for every body by itself.

        Raises BoundaryError for a coupling that is an inequality, ExpressionError for one that does not tell whose
        coordinate it means.
        """
        values, moving = {value.symbol for value in model.end_values}, {*model.coordinates, *model.rates}
        own = [entry for entry in entries if entry.role == self.argument]
        couplings = [entry for entry in own if entry.expression.free_symbols & values]
        for entry in couplings:
            symbols = entry.expression.free_symbols
            if not entry.equality:
                raise BoundaryError(f"{entry.what} couples bodies by an inequality", "couple them by equations only")
            require_single_bodies(entry.what, symbols & values, symbols & moving)
        model = super().added(model, [entry for entry in own if not entry.expression.free_symbols & values])
        return replace(model, couplings=conditions_of(couplings, self.argument))

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Couplings that are alike but for the bodies are tried once."""
        yield from super().values(model)
        yield from ((c.name, c.expression) for c in _distinct(model))

    def require_regular(self, model: Model, points: Points) -> None:
        """Refuse couplings in which bodies cancel, too."""
        super().require_regular(model, points)
        for condition in _distinct(model):
            if is_constant(condition, [value.symbol for value in model.end_values], points):
                raise BoundaryError(
                    f"{self.argument} {condition} couples nothing, since its bodies cancel", "leave it out"
                )


def _distinct(model: Model) -> list[Condition]:
    indices = distinct([c.expression for c in model.couplings], [value.symbol for value in model.end_values])
    return [model.couplings[index] for index in indices]


def _with_values(fixed: Mapping[sympy.Symbol, Expr], points: Points) -> Points:
    """The points with the prescribed values in them, which depend on nothing that the points differ in."""
    numbers = {symbol: expressions.rounded_at(value, points[0]) for symbol, value in fixed.items()}
    known = {symbol: number for symbol, number in numbers.items() if number is not None}
    return [{**point, **known} for point in points]
