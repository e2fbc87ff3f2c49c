"""Conditions that hold at every time; `transcribe.conditions.path_conditions` imposes them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from sympy import Expr

from codegen.author.symbols import ControlInput, Delayed, Time
from codegen.errors import DegenerateError, ExpressionError
from codegen.model.conditions.base import Kind, Latex, Points, Scope, dependent, is_constant
from codegen.model.definitions import Condition, Model
from codegen.model.relations import MOVING, STATIC


class Path(Kind):
    """Equations and inequalities between coordinates, rates, controls, time and parameters."""

    argument, field, words = "path", "path", "path conditions"
    scope: ClassVar[Scope] = {"path": (*MOVING, Delayed, ControlInput, Time, *STATIC)}

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        yield from model.path

    def require_regular(self, model: Model, points: Points) -> None:
        """Refuse conditions on nothing that moves, and equations that follow from each other."""
        symbols = (*model.coordinates, *model.rates, *model.controls)
        for condition in model.path:
            if is_constant(condition, symbols, points):
                raise ExpressionError(
                    f"path {condition} depends on no coordinate, rate or control",
                    "limit free parameters and the duration by bounds, or leave it out",
                )
        names = dependent([c for c in model.path if c.equality], symbols, points)
        if names:
            raise DegenerateError(f"the path conditions {names} depend on each other", "leave out one of them")

    def sentences(self, model: Model) -> list[str]:
        nodal = {True: "at the nodes", False: "at the nodes and on the intervals"}
        return [f"{c.name} {nodal[c.equality] if is_nodal(model, c) else 'on the intervals'}" for c in model.path]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if equations := tuple(("0", c.expression) for c in model.path if c.equality):
            yield "At every time", equations
        if inequalities := tuple((f"g_{i}", c.expression) for i, c in enumerate(model.path, 1) if not c.equality):
            yield "At every time, not positive", inequalities

    def when(self, latex: Latex) -> str:
        return r"\text{at every time}"


def is_nodal(model: Model, condition: Condition) -> bool:
    """Whether neither rates nor controls occur in a condition."""
    return not condition.expression.free_symbols & {*model.rates, *model.controls}


def nodal_conditions(model: Model, equality: bool) -> tuple[Condition, ...]:
    """The path equalities, or the path inequalities, in which neither rates nor controls occur."""
    return tuple(g for g in model.path if is_nodal(model, g) and g.equality == equality)
