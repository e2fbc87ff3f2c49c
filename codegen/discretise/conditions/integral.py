"""Conditions on integrals over the whole duration, such as a length or an amount of fuel.

Gd is the scheme's quadrature of the integrand over an interval, as for the cost. The sum of all Gd equals a value c, or
does not exceed it. The equation belongs to no node and no interval: its multiplier zeta and the slack s >= 0 of an
inequality are linking variables. In the Lagrangian of the optimisation problem, the contribution l of every interval
gains zeta Gd, and the contribution of the end gains zeta (s - c).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import ClassVar

from sympy import Add, Expr, S, Symbol, sstr

from codegen.discretise.conditions.base import ConditionKind, Latex, Scope
from codegen.discretise.conditions.ends import End
from codegen.discretise.conditions.periodic import Own
from codegen.discretise.model.definitions import Integral, Model
from codegen.discretise.model.relations import MOVING, STATIC, Entry, named_relations, sides
from codegen.discretise.program import ControlProgram, IntegralEquation, Names, Unknown
from codegen.errors import ExpressionError
from codegen.problem.problem import Control
from codegen.problem.symbols import ControlInput, Delayed, Time
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic import checks as expressions


class Integrals(ConditionKind):
    """Equations and inequalities between the integral of an expression and a value."""

    argument, field, words = "integral", "integrals", "conditions on integrals"
    check = "integrals"
    scope: ClassVar[Scope] = {"integral": (*MOVING, Delayed, ControlInput, Time, *STATIC), "integral value": STATIC}

    def written(self, control: Control) -> Iterator[Entry]:
        """Yield each integrand, followed by the value or the upper limit of its integral."""
        given = named_relations(self.argument, getattr(control, self.argument))
        for entry, (_, written) in zip(super().written(control), given, strict=True):
            left, right, sign = sides(written)
            left, right = (expressions.checked(side, entry.what) for side in (left, right))
            moves = [
                any(isinstance(s, (*MOVING, ControlInput, Time)) for s in side.free_symbols) for side in (left, right)
            ]
            if all(moves):
                raise ExpressionError(
                    f"both sides of {entry.what} move",
                    "write the integrand on one side, its integral's value on the other",
                )
            if not any(moves):
                raise ExpressionError(
                    f"{entry.what} has no integrand, since nothing in it moves",
                    "write Eq(integrand, value), or leave it out",
                )
            integrand, limit = (left, right) if moves[0] else (right, left)
            at_least = (sign == ">=") == moves[0] and sign != "="
            integrand, limit = (-integrand, -limit) if at_least else (integrand, limit)
            if limit == 0 and (integrand.is_nonnegative or (sign == "=" and integrand.is_nonpositive)):
                raise ExpressionError(
                    f"{entry.what} has an integrand of one sign, whose integral is 0 only if it vanishes at all times",
                    "write Eq(integrand, value) or integrand <= value, or a path condition",
                )
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


def integral_equations(model: Model, names: Names) -> tuple[IntegralEquation, ...]:
    """Return the equations of the integral constraints, with new symbols for multipliers and slacks."""
    equations = []
    for condition in model.integrals:
        multiplier = Symbol(names.numbered("zeta"), real=True)
        slack = None if condition.equality else Symbol(names.numbered("s"), real=True)
        equations.append(IntegralEquation(condition, multiplier, slack))
    return tuple(equations)


def own_unknowns(equations: Sequence[IntegralEquation]) -> tuple[Own, ...]:
    """Return the multipliers and slacks as linking variables, of which every body has its own."""
    own = list[Own]()
    for equation in equations:
        name, symbol = equation.condition.name, equation.multiplier
        own.append(Own(Unknown(symbol.name, Meaning(Kind.INTEGRAL, name)), symbol, S.Zero))
        if (slack := equation.slack) is not None:
            own.append(Own(Unknown(slack.name, Meaning(Kind.INTEGRAL_SLACK, name), lower=S.Zero), slack, S.Zero))
    return tuple(own)


def end_share(equations: Sequence[IntegralEquation]) -> End:
    """Return the terms zeta (s - c) that the end of the motion adds to the Lagrangian."""
    return End(element=Add(*(equation.multiplier * equation.excess for equation in equations)))


def with_distinct_integral_names(programs: Sequence[ControlProgram], names: Names) -> list[ControlProgram]:
    """Return the programs of phases with new names for unknowns of integral constraints, different in each phase."""
    renamed = []
    for program in programs:
        old = [own.symbol for own in own_unknowns(program.integrals)]
        new = {symbol: Symbol(names.numbered(symbol.name.rpartition("_")[0]), real=True) for symbol in old}
        integrals = (
            replace(each, multiplier=new[each.multiplier], slack=each.slack and new[each.slack])
            for each in program.integrals
        )
        end = replace(program.end, element=program.end.element.xreplace(new))
        element = program.element.xreplace(new)
        renamed.append(replace(program, element=element, end=end, integrals=tuple(integrals)))
    return renamed
