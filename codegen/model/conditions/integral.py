"""Conditions on integrals over the whole duration, such as a length; `transcribe.conditions.integrals` imposes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar

from sympy import Expr, sstr

from codegen.author.problem import Control
from codegen.author.symbols import ControlInput, Delayed, Time
from codegen.errors import ExpressionError
from codegen.expressions import checks as expressions
from codegen.model.conditions.base import Kind, Latex, Scope
from codegen.model.definitions import Integral, Model
from codegen.model.relations import MOVING, STATIC, Entry, named_relations, sides


class Integrals(Kind):
    """Relations between an integrand and the value of its integral."""

    argument, field, words = "integral", "integrals", "conditions on integrals"
    check = "integrals"
    scope: ClassVar[Scope] = {"integral": (*MOVING, Delayed, ControlInput, Time, *STATIC), "integral value": STATIC}

    def written(self, control: Control) -> Iterator[Entry]:
        """Each as an integrand and as the value that its integral has or does not exceed."""
        given = named_relations(self.argument, getattr(control, self.argument))
        for entry, (_, written) in zip(super().written(control), given, strict=True):
            integrand, limit = _sides(written, entry.what)
            yield replace(entry, expression=integrand)
            yield replace(entry, role=f"{self.argument} value", what=f"value of {entry.what}", expression=limit)

    def conditions(self, entries: Sequence[Entry]) -> tuple[Integral, ...]:
        integrands, limits = ([e for e in entries if e.role == role] for role in self.scope)
        return tuple(
            Integral(entry.name, entry.expression, entry.equality, limit.expression)
            for entry, limit in zip(integrands, limits, strict=True)
        )

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        for i in model.integrals:
            yield from ((f"the integrand of {i}", i.expression), (f"the value of {i}", i.value))

    def sentences(self, model: Model) -> list[str]:
        return [
            f"sum of Gd_{number} {'=' if i.equality else '<='} {sstr(i.value)} ({i})"
            for number, i in enumerate(model.integrals, start=1)
        ]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        for number, i in enumerate(model.integrals, start=1):
            heading = f"Integral over [0, T] that {'equals' if i.equality else 'is at most'} c_{number}"
            yield heading, ((f"rate G_{number}", i.expression), (f"c_{number}", i.value))

    def when(self, latex: Latex) -> str:
        return rf"\text{{for the integral over }} [{latex.first}, {latex.last}]"


def _sides(value: Any, what: str) -> tuple[Expr, Expr]:
    """The integrand, and what its integral equals or does not exceed, with the signs that say so.

    The integrand is the side that moves. ExpressionError unless that is one side alone.
    """
    left, right, sign = sides(value)
    left, right = (expressions.checked(side, what) for side in (left, right))
    moves = [any(isinstance(s, (*MOVING, ControlInput, Time)) for s in side.free_symbols) for side in (left, right)]
    if all(moves):
        raise ExpressionError(
            f"both sides of {what} move", "write the integrand on one side, its integral's value on the other"
        )
    if not any(moves):
        raise ExpressionError(
            f"{what} has no integrand, since nothing in it moves", "write Eq(integrand, value), or leave it out"
        )
    integrand, limit = (left, right) if moves[0] else (right, left)
    at_least = (sign == ">=") == moves[0] and sign != "="
    return (-integrand, -limit) if at_least else (integrand, limit)
