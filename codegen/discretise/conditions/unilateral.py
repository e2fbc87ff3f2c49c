"""Gaps g(q, t) >= 0 of control problems with unknown contact forces, as their author writes them.

The equations are in `codegen.discretise.contact`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import sympy
from sympy import Expr, S, Symbol

from codegen.discretise.conditions.base import ConditionKind, Latex, Points, Scope, is_constant, listed
from codegen.discretise.conditions.rolling import require_affine
from codegen.discretise.model.definitions import Bounds, Condition, Contact, Model
from codegen.discretise.model.relations import Entry, checked_sequence, entry_of, relation_entries
from codegen.errors import DegenerateError, ExpressionError
from codegen.problem.problem import Control
from codegen.problem.rotations import spheres_in
from codegen.problem.symbols import ControlInput, Coordinate, FreeParameter, Parameter, Time, Velocity
from codegen.symbolic import checks as expressions

MOST_SLIPS = 2
"""Largest number of sliding velocities of a contact: a surface in space has two tangents."""


class Unilateral(ConditionKind):
    """Gaps in coordinates and time, with contact forces along their gradients and friction along the surface."""

    argument, field, words = "unilateral", "contacts", "contact"
    scope: ClassVar[Scope] = {
        "unilateral": (Coordinate, Time, Parameter),
        "friction": (Parameter,),
        "slip": (Coordinate, Velocity, Time, Parameter),
    }
    remedies: ClassVar = {
        Velocity: "a gap is an expression of coordinates and time; limit velocities in path",
        ControlInput: "a gap is an expression of coordinates and time; limit controls by bounds or path",
        FreeParameter: "declare a parameter",
    }
    not_in_phases = (
        ExpressionError,
        "it has contact forces",
        "write one Control with unilateral, or phases with the forces as controls",
    )
    check = "contact"

    def written(self, control: Control) -> Iterator[Entry]:
        gaps = [*relation_entries(self.argument, control.unilateral)]
        yield from gaps
        for name, default in (("friction", 0), ("slip", ())):
            if not gaps and not _is_same(getattr(control, name), default):
                raise ExpressionError(f"{name} without unilateral", f"write unilateral=[gap >= 0], or leave {name} out")
        friction = control.friction
        if isinstance(friction, (list, tuple)):
            if len(friction) != len(gaps):
                raise ExpressionError(
                    f"friction has {len(friction)} values for {len(gaps)} gaps", "give one number, or one for each gap"
                )
        elif isinstance(friction, Mapping):
            raise ExpressionError("friction is a mapping", "give one number, or a list with one for each gap")
        else:
            friction = [friction] * len(gaps)
        slips = checked_sequence("slip", control.slip, "sliding velocity")
        if slips and len(slips) != len(gaps):
            raise ExpressionError(
                f"slip has {len(slips)} entries for {len(gaps)} gaps",
                "give the sliding velocity of each gap, () for a gap without friction",
            )
        for index, gap in enumerate(gaps):
            coefficient = entry_of("friction", f"friction of {gap.name}", friction[index])
            yield replace(coefficient, name=str(index))
            of_gap = slips[index] if slips else ()
            of_gap = of_gap if isinstance(of_gap, (list, tuple)) else (of_gap,)
            if len(of_gap) > MOST_SLIPS:
                raise ExpressionError(
                    f"slip of {gap.name} has {len(of_gap)} velocities", "give one in the plane, or two in space"
                )
            if coefficient.expression != 0 and not of_gap:
                raise ExpressionError(
                    f"{gap.name} has friction, and no sliding velocity",
                    "write slip=[velocity of the point of contact along the surface], one entry for each gap",
                )
            if coefficient.expression == 0 and of_gap:
                raise ExpressionError(
                    f"{gap.name} has a sliding velocity, and no friction", "write friction=mu, or leave slip out"
                )
            for value in of_gap:
                yield replace(entry_of("slip", f"slip of {gap.name}", value), name=str(index))

    def require_fitting(self, entry: Entry, control: Control, form: str) -> None:
        """Raise an error for an equation, and for arguments of Control that contact forces do not work with."""
        if form != "lagrangian":
            raise ExpressionError(f"{entry.what} with {form}", "give a Lagrangian, whose forces are those of contact")
        if entry.equality:
            raise ExpressionError(f"{entry.what} is no inequality", "write gap >= 0, or an equation in constraint")
        if control.bodies != 1:
            raise ExpressionError(f"{entry.what} with {control.bodies} bodies", "give each body coordinates of its own")
        if spheres := spheres_in(control.lagrangian):
            raise ExpressionError(f"{entry.what} with the rotation or direction {spheres[0].name}", "use angles")
        for name, words in (("constraint", "holonomic"), ("rolling", "rolling")):
            if getattr(control, name):
                raise ExpressionError(f"{entry.what} with a {words} constraint", "use generalised coordinates")
        if control.history:
            raise ExpressionError(f"{entry.what} with delays", "leave one of them out")
        for slip in (each for each in self.written(control) if each.role == "slip"):
            require_affine(slip, "write friction along a(q, t) v + b(q, t)")

    def conditions(self, entries: Sequence[Entry]) -> tuple[Contact, ...]:
        raise AssertionError("contacts have symbols, which `added` declares")

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """Return a model with contacts, and their forces as further controls; normal forces are not negative.

        Gaps of a simulation have impacts instead, see `codegen.discretise.model.events`.
        """
        gaps = [entry for entry in entries if entry.role == self.argument]
        if not gaps or model.task == "simulate":
            return model
        quantities = (*model.coordinates, *model.rates, *model.controls, *model.parameters, model.time)
        taken = {symbol.name for symbol in quantities}

        def symbol(name: str) -> Symbol:
            while name in taken:
                name += "_"
            taken.add(name)
            return Symbol(name, real=True)

        contacts = list[Contact]()
        for index, gap in enumerate(gaps):
            stem = gap.name.replace(" ", "_") if re.fullmatch(r"[A-Za-z][A-Za-z0-9_ ]*", gap.name) else str(index + 1)
            coefficient, *slips = (
                e.expression for e in entries if e.role in ("friction", "slip") and e.name == str(index)
            )
            numbers = [f"_{number}" for number in range(1, len(slips) + 1)] if len(slips) > 1 else [""] * len(slips)
            contacts.append(
                Contact(
                    gap.name,
                    -gap.expression,
                    coefficient,
                    tuple(slips),
                    symbol(f"normal_{stem}"),
                    tuple(symbol(f"friction_{stem}{number}") for number in numbers),
                )
            )
        forces = [force for contact in contacts for force in contact.forces]
        return replace(
            model,
            contacts=tuple(contacts),
            relaxation=symbol("relaxation"),
            controls=(*model.controls, *forces),
            bounds=(*model.bounds, *(Bounds(contact.normal, S.Zero, None) for contact in contacts)),
        )

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        for contact in model.contacts:
            yield f"gap {contact.name}", contact.expression
            yield from ((f"slip of {contact.name}", slip) for slip in contact.slips)

    def numbers(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ((f"friction of {contact.name}", contact.friction) for contact in model.contacts)

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        for contact in model.contacts:
            yield Condition(f"unilateral {contact.name}", -contact.expression, equality=False)

    def require_regular(self, model: Model, points: Points) -> None:
        """Raise an error for gaps without coordinates, slips without velocities, and negative friction."""
        for contact in model.contacts:
            if is_constant(Condition(contact.name, contact.expression), model.coordinates, points):
                raise ExpressionError(f"unilateral {contact.name} depends on no coordinate", "leave it out")
            number = expressions.rounded_at(contact.friction, model.default_values)
            if number is not None and number < 0.0:
                raise ExpressionError(f"friction of {contact.name} is {number:g}", "give a number that is not negative")
            for slip in contact.slips:
                if is_constant(Condition(contact.name, slip), model.rates, points):
                    raise DegenerateError(f"slip of {contact.name} depends on no velocity", "leave it out")

    def sentences(self, model: Model) -> list[str]:
        lines = [f"0 <= {c.normal}, {sympy.sstr(c.expression)} >= 0 at the next node" for c in model.contacts]
        lines += [
            f"{c.normal} ({sympy.sstr(c.expression)} at the next node) <= {model.relaxation}" for c in model.contacts
        ]
        return lines

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if model.contacts:
            yield "Gaps, with contact forces", tuple((c.name, c.expression) for c in model.contacts)

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        for relation in listed(control.unilateral):
            yield rf"&{latex.relation(relation)}\quad\text{{(contact)}}"


def _is_same(value: object, default: object) -> bool:
    """Return True if a value of an argument is its default; an empty list counts as an empty tuple."""
    return value == default or (isinstance(value, (list, tuple)) and len(value) == 0)
