"""Path equalities that follow from the dynamics: what a first-order system conserves, said once more.

A motion of x' = f(x, u, t) keeps g(x, t) where dg/dx f + dg/dt vanishes identically, whatever the controls do: the norm
of a quaternion, or the radius of a circle. On the way g = 0 then says nothing, and its multipliers are not unique.
It holds by what it says at the start; and where the end gives all of its quantities, one of them follows from the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import sympy
from sympy import Symbol

from codegen import expressions
from codegen.differentiate.zeros import identically_zero
from codegen.model import Condition, Model
from codegen.transcribe.forms import occurring
from codegen.transcribe.path_conditions import given_at, nodal_conditions
from codegen.transcribe.program import ControlProgram


def conserved_path(model: Model) -> tuple[Condition, ...]:
    """The path equalities of first-order dynamics that are first integrals of them."""
    if model.form != "first-order" or model.bodies > 1:
        return ()
    periodic = {symbol for symbol, _ in model.periodic}
    equalities = nodal_conditions(model, equality=True)
    return tuple(g for g in equalities if not g.expression.free_symbols & periodic and _is_conserved(model, g))


def _is_conserved(model: Model, condition: Condition) -> bool:
    slopes = [sympy.diff(condition.expression, x) * f for x, f in zip(model.coordinates, model.dynamics, strict=True)]
    return identically_zero(sympy.Add(sympy.diff(condition.expression, model.time), *slopes))


def at_start_alone(model: Model, conserved: Sequence[Condition]) -> Model:
    """The model with these conditions at the start, unless all of their quantities are given there."""
    missing = (g for g in conserved if not given_at(model, model.start, g.expression))
    return replace(
        model,
        path=tuple(g for g in model.path if g not in conserved),
        start_conditions=(*model.start_conditions, *missing),
    )


def _numbers_at_end(model: Model) -> dict[Symbol, float]:
    """What is known in numbers at the end, at the default parameters."""
    assert model.end is not None, "a control problem has an end"
    values = dict(model.default_values)
    given = zip(model.coordinates, model.end.positions, strict=True)
    found = {x: expressions.rounded_at(value, values) for x, value in given if value is not None}
    found[model.time] = expressions.rounded_at(model.duration, values)
    return values | {symbol: number for symbol, number in found.items() if number is not None}


def with_conserved(program: ControlProgram, author: Model, conserved: Sequence[Condition]) -> ControlProgram:
    """The program that tells what it left out, without those values at the end that follow from the others."""
    names, end = [unknown.name for unknown in program.node], program.end
    assert author.end is not None, "a control problem has an end"
    numbers, chosen = _numbers_at_end(author), list[str]()
    for condition in conserved:
        if not given_at(author, author.end, condition.expression):
            continue
        slopes = {
            author.coordinates[i].name: sympy.diff(condition.expression, author.coordinates[i])
            for i in occurring(author.coordinates, condition.expression)
        }
        sizes = {
            x: abs(expressions.rounded_at(slope, numbers) or 0.0) for x, slope in slopes.items() if x not in chosen
        }
        if sizes and max(sizes.values()) > 0.0:
            chosen.append(max(sizes, key=lambda x: sizes[x]))
    places = {names.index(name) for name in chosen}
    end = replace(
        end,
        pins=tuple(pin for pin in end.pins if pin[0] not in places),
        dependent=(*end.dependent, *chosen),
    )
    return replace(program, end=end, conserved=tuple(condition.name for condition in conserved))
