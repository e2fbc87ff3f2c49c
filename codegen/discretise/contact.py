"""Contact-implicit optimal control: contact forces that are unknown in time and sequence.

The normal force n_k >= 0 is constant on an interval, and its impulse h n_k acts at the left node along the gradient of
the gap g. Forces f_k of friction act along the directions d of the sliding velocities
v_k = d.(q_{k+1} - q_k)/h + b. With the coefficient mu of friction, the equations of motion and the contact laws are

    D2 Ld(q_{k-1}, q_k) + D1 Ld(q_k, q_{k+1}) + f+_{k-1} + f-_k + h (n_k dg/dq + f_k.d)(q_k) = 0,
    n_k >= 0,   g(q_{k+1}) >= 0,   n_k g(q_{k+1}) = 0,
    |f_k| <= mu n_k,   f_k.v_k + mu n_k |v_k| = 0.

The gap is that of the next node, so that an interval in which a body lands absorbs its momentum: impacts are inelastic.
A force that were divided between both nodes would reverse the velocity after an impact. The last equation is Coulomb's
law: of all forces in the cone friction dissipates most. It never exceeds zero by itself, and |v| is the largest of v
and -v, so that two inequalities express it. In space the cone is the pyramid |f_1| + |f_2| <= mu n, with the largest
component of v in place of |v|. Source: Stewart and Trinkle (1996), An implicit time-stepping scheme for rigid body
dynamics with inelastic collisions and Coulomb friction; Posa, Cantu and Tedrake (2014), A direct method for trajectory
optimization of rigid bodies through contact; Manchester, Doshi, Wood and Kuindersma (2019), Contact-implicit trajectory
optimization using variational integrators.

At the end an impulse of the same kind acts if velocities are prescribed there. It does no work on the gap: n dg/dt = 0
with the velocity after the impact. The momenta of nodes are those before the impulse.

Products are not zero, but at most epsilon, the parameter `relaxation`, an energy. The search begins with a large
epsilon, which falls with the weight of its barrier, see `codegen.runtime.search.iterates`. Source: Scholtes (2001),
Convergence properties of a regularization scheme for mathematical programs with complementarity constraints.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import sympy
from sympy import Add, Expr, S, Symbol

from codegen.discretise.interval import STEP, PathValue, at_nodes
from codegen.discretise.model.definitions import Condition, Contact, Model, prescribed
from codegen.discretise.model.values import expected_values, values_at_guess
from codegen.discretise.program import Names, Unknown
from codegen.errors import BoundaryError
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic.checks import rounded_at, rounding_at
from codegen.symbolic.derivatives import gradient

LEAST = 1e-8
"""Least relaxation, relative to the energy of the motion."""
FASTER = 2.0
"""Largest velocity of a motion from rest to rest, relative to its mean, at least."""
CLOSED = 1e-9
"""Largest gap that counts as closed, relative to its terms."""
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Fractions of the duration at which the energy of the expected motion is estimated."""


def with_relaxation(model: Model) -> Model:
    """Return a model with the parameter `relaxation`, whose default is LEAST times an energy of the expected motion."""
    if model.relaxation is None:
        return model
    scale = 10.0 ** round(math.log10(_energy(model)))
    return replace(model, parameters=(*model.parameters, model.relaxation), defaults=(*model.defaults, LEAST * scale))


def _energy(model: Model) -> float:
    """Return an estimate of the energy of the motion: kinetic, potential, or the work of contact.

    Velocities are FASTER times those of the expected motion, which is often the straight line between both ends. The
    work is that of the force on a closed gap along the largest gap. If the gap stays closed, for example that of a foot
    under a leg, its largest term takes its place.
    """
    points = [{**values_at_guess(model), **expected_values(model, share)} for share in _SHARES]
    duration = points[-1][model.time]
    zeros = dict.fromkeys((*model.coordinates, *model.rates, *model.controls), 0.0)
    moves = {q: max(p.get(q, 0.0) for p in points) - min(p.get(q, 0.0) for p in points) for q in model.coordinates}
    speeds = {
        v: max(FASTER * moves[q] / duration, *(abs(p.get(v, 0.0)) for p in points))
        for q, v in zip(model.coordinates, model.rates, strict=True)
    }
    at_rest = [{**zeros, **p, **dict.fromkeys(model.rates, 0.0)} for p in points]

    def value(expression: Expr, point: Mapping[Symbol, float]) -> float:
        return rounded_at(expression, point) or 0.0

    first = value(model.function, at_rest[0])
    energies = [abs(value(model.function, {**p, **speeds}) - value(model.function, p)) for p in at_rest]
    energies += [abs(value(model.function, p) - first) for p in at_rest]
    for contact in model.contacts:
        sizes = [[value(term, p) for term in Add.make_args(contact.expression)] for p in at_rest]
        gap = max(abs(sum(terms)) for terms in sizes)
        if gap <= CLOSED * (largest := max(abs(term) for terms in sizes for term in terms)):
            gap = largest
        for p in at_rest:
            normal = [value(slope, p) for slope in gradient(contact.expression, model.coordinates)]
            force = [value(slope, p) for slope in gradient(model.function, model.coordinates)]
            squared = sum(n * n for n in normal)
            if squared > 0.0:
                energies.append(abs(sum(n * f for n, f in zip(normal, force, strict=True))) * gap / squared)
    return max(energies) or 1.0


def gaps(model: Model) -> tuple[Condition, ...]:
    """Return the gaps as inequalities."""
    return tuple(Condition(contact.name, -contact.expression, equality=False) for contact in model.contacts)


def touched(model: Model) -> tuple[set[int], ...]:
    """Return for each contact the indices of the coordinates on which its forces act."""
    return tuple(
        {i for row in _directions(model, contact) for i, entry in enumerate(row) if entry != 0}
        for contact in model.contacts
    )


def _directions(model: Model, contact: Contact) -> list[list[Expr]]:
    """Return the gradient of the gap, then the rows of the sliding velocities, in the symbols of the model."""
    at_rest = dict.fromkeys(model.rates, S.Zero)
    rows = [list(gradient(contact.expression, model.coordinates))]
    return rows + [[slope.xreplace(at_rest) for slope in gradient(slip, model.rates)] for slip in contact.slips]


def force(model: Model) -> list[Expr]:
    """Return the generalised contact forces of all coordinates, in the symbols of the model."""
    total = [S.Zero] * len(model.coordinates)
    for contact in model.contacts:
        for size, row in zip(contact.forces, _directions(model, contact), strict=True):
            total = [f + size * entry for f, entry in zip(total, row, strict=True)]
    return total


def impulses(model: Model) -> list[Expr]:
    """Return the impulses of the contact forces of an interval at its left node."""
    if not model.contacts:
        return [S.Zero] * len(model.coordinates)
    quantities = (*model.coordinates, *model.controls)
    left = dict(zip(quantities, at_nodes(quantities, "_k"), strict=True))
    return [STEP * f.xreplace(left) for f in force(model)]


@dataclass(frozen=True)
class _Law:
    """An inequality `value` <= 0 of a contact, with the kind of its multiplier."""

    kind: Kind
    name: str
    value: Expr


def _friction(contact: Contact, slips: Sequence[Expr], relaxation: Expr, scale: Expr) -> Iterator[_Law]:
    """Yield the laws of friction at the sliding velocities `slips`; the dissipation is least to relaxation / scale."""
    if not contact.slips:
        return
    largest = contact.friction * contact.normal
    for signs in product((1, -1), repeat=len(contact.tangential)):
        side = Add(*(sign * f for sign, f in zip(signs, contact.tangential, strict=True)))
        yield _Law(Kind.FRICTION, contact.name, side - largest)
    power = Add(*(f * v for f, v in zip(contact.tangential, slips, strict=True)))
    for v in slips:
        for sign in (1, -1):
            excess = scale * (power + sign * largest * v)
            yield _Law(Kind.COMPLEMENTARITY, f"friction of {contact.name}", excess - relaxation)


def laws(model: Model) -> tuple[PathValue, ...]:
    """Return the inequalities of all contacts on an interval, with gaps at its right node."""
    pairs = list(zip(at_nodes(model.coordinates, "_k"), at_nodes(model.coordinates, "_k1"), strict=True))
    left = dict(zip(model.coordinates, (a for a, _ in pairs), strict=True))
    sliding = left | dict(zip(model.rates, ((b - a) / STEP for a, b in pairs), strict=True))
    right: dict[Symbol, Expr] = dict(zip(model.coordinates, (b for _, b in pairs), strict=True))
    right[model.time] = model.time + STEP
    controls = dict(zip(model.controls, at_nodes(model.controls, "_k"), strict=True))
    values = list[PathValue]()
    for contact in model.contacts:
        assert model.relaxation is not None, "contacts have a relaxation"
        gap, epsilon = contact.expression.subs(right, simultaneous=True), model.relaxation
        slips = [slip.xreplace(sliding) for slip in contact.slips]
        of_contact = [
            _Law(Kind.GAP, contact.name, -gap),
            _Law(Kind.COMPLEMENTARITY, contact.name, contact.normal * gap - epsilon),
            *_friction(contact, slips, epsilon, model.duration),
        ]
        for law in of_contact:
            condition = Condition(law.name, law.value, equality=False)
            values.append(PathValue(condition, S.One, law.value.xreplace(controls), law.kind))
    return tuple(values)


@dataclass(frozen=True)
class EndImpulse:
    """The impulses of contact at the end: unknowns, the sum of generalised impulses, and their laws.

    The symbols of the expressions are those of the model, and the names of the unknowns.
    """

    unknowns: tuple[Unknown, ...] = ()
    impulses: tuple[Expr, ...] = ()
    conditions: tuple[Condition, ...] = ()


def end_impulse(model: Model, matched: set[int], values: Mapping[Symbol, Expr], names: Names) -> EndImpulse:
    """Return the impulses of contacts at the end, for the gaps that may be closed there.

    `matched` are the indices of the coordinates whose discrete momenta match velocities at the end. Only gaps that
    depend on them have impulses. `values` maps symbols of boundary values to values. If the prescribed values at the
    end make a gap positive, the gap is open and has no impulse.
    """
    numbers = values_at_guess(model)
    numbers |= {s: value for s, x in values.items() if (value := rounded_at(x, numbers)) is not None}

    def may_close(contact: Contact) -> bool:
        gap = contact.expression.xreplace({**prescribed(model, "end"), model.time: model.duration})
        number = rounded_at(gap, numbers)
        return number is None or number <= rounding_at(gap, numbers)

    pairs = zip(model.contacts, touched(model), strict=True)
    contacts = [c for c, indices in pairs if indices & matched and may_close(c)]
    if not contacts:
        return EndImpulse()
    assert model.relaxation is not None, "contacts have a relaxation"
    forces = [f for contact in contacts for f in contact.forces]
    ends = {f: Symbol(names.named("end", f), real=True) for f in forces}
    conditions = [Condition(f"{c.normal} >= 0", -c.normal, equality=False) for c in contacts]
    for contact in contacts:
        pairs = zip(model.coordinates, model.rates, strict=True)
        rate = Add(
            sympy.diff(contact.expression, model.time), *(sympy.diff(contact.expression, q) * v for q, v in pairs)
        )
        work = contact.normal * rate
        products = (contact.normal * contact.expression / model.duration, work, -work)
        for each in products:
            conditions.append(
                Condition(f"the complementarity of {contact.name}", each - model.relaxation, equality=False)
            )
        for law in _friction(contact, contact.slips, model.relaxation, S.One):
            conditions.append(Condition(f"friction of {contact.name}", law.value, equality=False))
    of_contacts = replace(model, contacts=tuple(contacts))
    return EndImpulse(
        tuple(Unknown(ends[f].name, Meaning(Kind.END_IMPULSE, f.name)) for f in forces),
        tuple(f.xreplace(ends) for f in force(of_contacts)),
        tuple(replace(c, expression=c.expression.xreplace(ends)) for c in conditions),
    )


def require_matched_start(model: Model, matched: set[int]) -> None:
    """Raise BoundaryError if the start leaves a velocity free on which contact forces act."""
    for contact, indices in zip(model.contacts, touched(model), strict=True):
        free = [model.rates[i] for i in sorted(indices - matched)]
        if free:
            raise BoundaryError(
                f"start leaves {free[0]} free, and the contact {contact.name} acts on it",
                f"give {free[0]} in start, or list {free[0]} in periodic",
            )
