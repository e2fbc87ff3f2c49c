"""Conditions on integrals over the whole duration, such as a length or an amount of fuel.

With the scheme's own quadrature Gd of the integrand over an interval, as for the cost, the sum of all Gd equals a value
c, or stays below it. Neither a node nor an interval owns that equation: its multiplier is a shared unknown zeta, and
with it, for an inequality, a slack s >= 0. Every interval's l gains zeta Gd, and the end's share zeta (s - c).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sympy import Add, Expr, S, Symbol

from codegen.model import Model
from codegen.runtime.record import Kind, Meaning
from codegen.transcribe.conditions.ends import End
from codegen.transcribe.conditions.periodic import Own
from codegen.transcribe.names import Names
from codegen.transcribe.program import ControlProgram, IntegralEquation, Unknown


def integral_equations(model: Model, names: Names) -> tuple[IntegralEquation, ...]:
    """The equations of the conditions on integrals, with names for their unknowns."""
    equations = []
    for condition in model.integrals:
        multiplier = Symbol(names.numbered("zeta"), real=True)
        slack = None if condition.equality else Symbol(names.numbered("s"), real=True)
        equations.append(IntegralEquation(condition, multiplier, slack))
    return tuple(equations)


def own_unknowns(equations: Sequence[IntegralEquation]) -> tuple[Own, ...]:
    """The multipliers and slacks, of which every body has its own."""
    own = list[Own]()
    for equation in equations:
        name, symbol = equation.condition.name, equation.multiplier
        own.append(Own(Unknown(symbol.name, Meaning(Kind.INTEGRAL, name)), symbol, S.Zero))
        if (slack := equation.slack) is not None:
            own.append(Own(Unknown(slack.name, Meaning(Kind.INTEGRAL_SLACK, name), lower=S.Zero), slack, S.Zero))
    return tuple(own)


def interval_share(equations: Sequence[IntegralEquation], quadratures: Sequence[Expr]) -> Expr:
    """What an interval's l gains."""
    return Add(*(equation.multiplier * value for equation, value in zip(equations, quadratures, strict=True)))


def end_share(equations: Sequence[IntegralEquation]) -> End:
    """What the end gains."""
    return End(element=Add(*(equation.multiplier * equation.excess for equation in equations)))


def with_distinct_integral_names(programs: Sequence[ControlProgram], names: Names) -> list[ControlProgram]:
    """The programs of all phases, in which no two conditions on integrals have unknowns of one name."""
    return [_renamed(program, names) for program in programs]


def _renamed(program: ControlProgram, names: Names) -> ControlProgram:
    old = [own.symbol for own in own_unknowns(program.integrals)]
    new = {symbol: Symbol(names.numbered(symbol.name.rpartition("_")[0]), real=True) for symbol in old}

    def equation(found: IntegralEquation) -> IntegralEquation:
        return replace(found, multiplier=new[found.multiplier], slack=found.slack and new[found.slack])

    return replace(
        program,
        element=program.element.xreplace(new),
        end=replace(program.end, element=program.end.element.xreplace(new)),
        integrals=tuple(map(equation, program.integrals)),
    )
