"""Holonomic constraints c(q, t) = 0 of Lagrangian systems; `transcribe.conditions.holonomic` imposes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar

import sympy
from sympy import Expr

from codegen.author.problem import Control
from codegen.author.symbols import Coordinate, Parameter, Time
from codegen.errors import DegenerateError, ExpressionError
from codegen.model.conditions.base import Kind, Latex, Points, Scope, dependent, is_constant, listed
from codegen.model.definitions import Condition, Model
from codegen.model.relations import Entry, text

_COORDINATES = "use generalised coordinates in problems of phases"


class Holonomic(Kind):
    """Equations between coordinates and time, which forces along their normals enforce."""

    argument, field, words = "constraint", "holonomic", "holonomic constraints"
    scope: ClassVar[Scope] = {"constraint": (Coordinate, Time, Parameter)}
    not_in_phases = ExpressionError, "it has a holonomic constraint", _COORDINATES
    check = "holonomic drift"

    def require_fitting(self, entry: Entry, control: Control, form: str) -> None:
        if form != "lagrangian":
            raise ExpressionError(f"{entry.what} beside {form}", "give a Lagrangian, or write the condition in path")
        if not entry.equality:
            raise ExpressionError(f"{entry.what} is an inequality", "write it in path")

    def conditions(self, entries: Sequence[Entry]) -> tuple[Expr, ...]:
        return tuple(condition.expression for condition in super().conditions(entries))

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ((f"constraint {text(c)}", c) for c in model.holonomic)

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        """The constraints, and that their rates of change vanish, which follows from them."""
        for c in model.holonomic:
            yield Condition(f"constraint {text(c)} = 0", c)
            rate = sympy.Add(*(sympy.diff(c, q) * v for q, v in zip(model.coordinates, model.rates, strict=True)))
            yield Condition(f"the rate of constraint {text(c)} = 0", rate + sympy.diff(c, model.time))

    def require_regular(self, model: Model, points: Points) -> None:
        """Refuse constraints that depend on each other, or leave nothing to move."""
        named = [Condition(f"{text(c)} = 0", c) for c in model.holonomic]
        for condition in named:
            if is_constant(condition, model.coordinates, points):
                raise DegenerateError(f"constraint {condition} depends on no coordinate", "leave it out")
        names = dependent(named, model.coordinates, points)
        if names:
            raise DegenerateError(f"the constraints {names} depend on each other", "leave out one of them")
        if len(named) >= len(model.coordinates) > 0 and named:
            raise DegenerateError(
                f"{len(named)} constraints on {len(model.coordinates)} coordinates leave nothing to move",
                "leave out a constraint",
            )

    def sentences(self, model: Model) -> list[str]:
        return [f"{sympy.sstr(constraint)} = 0 at the nodes" for constraint in model.holonomic]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if model.holonomic:
            yield "Holonomic constraints", tuple(("0", constraint) for constraint in model.holonomic)

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        for constraint in listed(control.constraint):
            yield rf"0 &= {latex(constraint)}\quad\text{{(holonomic)}}"
