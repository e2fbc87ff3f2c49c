"""Holonomic constraints c(q, t) = 0 of Lagrangian systems by discrete multipliers, in the augmented form.

The discrete Lagrangian gains h/2 (kappa_k . c(q_k) + kappa_k1 . c(q_k1)), so that with G = dc/dq the equations of
motion of an inner node read

    D2 Ld(q_{k-1}, q_k) + D1 Ld(q_k, q_{k+1}) + f+_{k-1} + f-_k + h G(q_k)^T kappa_k = 0,    c(q_k) = 0:

+G^T kappa is the force of the constraint. kappa_k is a primal unknown of the optimisation problem, eta_k the
multiplier of c(q_k) = 0. The ends have half the force. Source: Wendlandt and Marsden (1997), section 4; Marsden and
West (2001), section 3.4; Leyendecker, Ober-Bloebaum, Marsden and Ortiz (2010), Discrete mechanics and optimal control
for constrained systems (DMOCC), section 3.

The number of equations at an end. A momentum is matched if the discrete momentum must equal the momentum of a velocity.
Matched momenta determine kappa along the normals of the constraint, so that a prescribed full velocity does not
over-determine the end. Without a matched momentum kappa has no meaning and is zero. If only some velocities of a
constraint's coordinates are prescribed, the others are unknowns of the end. All their momenta are matched, and the
velocity is tangential, G v + dc/dt = 0, with the partial derivative with respect to time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

import sympy
from sympy import Expr, S, Symbol

from codegen.discretise.conditions import rolling
from codegen.discretise.conditions.base import (
    ConditionKind,
    Latex,
    Points,
    Remedies,
    Scope,
    conditions_of,
    dependent,
    is_constant,
    listed,
)
from codegen.discretise.conditions.path import NodalTerms, nodal_equalities
from codegen.discretise.interval import STEP, at_nodes
from codegen.discretise.model.definitions import Boundary, Condition, Model
from codegen.discretise.model.guesses import at_guess, coordinate_guess
from codegen.discretise.model.relations import Entry, relation_entries, text
from codegen.discretise.program import Equation, HoldingForces, Names, Unknown, occurring, symbols
from codegen.discretise.schemes.base import Scheme
from codegen.errors import ArgumentError, DegenerateError, ExpressionError, SchemeError
from codegen.problem.problem import Control, Simulate
from codegen.problem.rotations import squared_length
from codegen.problem.symbols import Coordinate, Parameter, Time, Velocity
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic.derivatives import gradient, partials


class Holonomic(ConditionKind):
    """Equations between coordinates and time, which constraint forces along their gradients enforce."""

    argument, field, words = "constraint", "holonomic", "holonomic constraints"
    scope: ClassVar[Scope] = {"constraint": (Coordinate, Time, Parameter)}
    remedies: ClassVar[Remedies] = {Velocity: "write an equation between velocities in rolling"}
    check = "holonomic drift"

    def written(self, control: Control | Simulate) -> Iterator[Entry]:
        return relation_entries(self.argument, control.constraint)

    def require_fitting(self, entry: Entry, control: Control | Simulate, form: str) -> None:
        has_path = isinstance(control, Control)
        if form != "lagrangian":
            remedy = "give a Lagrangian" + (", or write the condition in path" if has_path else "")
            raise ExpressionError(f"{entry.what} beside {form}", remedy)
        if not entry.equality:
            remedy = "write it in path" if has_path else "give an equation between coordinates"
            raise ExpressionError(f"{entry.what} is an inequality", remedy)

    def conditions(self, entries: Sequence[Entry]) -> tuple[Expr, ...]:
        return tuple(condition.expression for condition in conditions_of(entries, self.argument))

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ((f"constraint {text(c)}", c) for c in model.holonomic)

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        """Yield the constraints and their time derivatives, which vanish too."""
        for c, rate in zip(model.holonomic, rates(model), strict=True):
            yield Condition(f"constraint {text(c)} = 0", c)
            yield Condition(f"the rate of constraint {text(c)} = 0", rate)

    def require_regular(self, model: Model, points: Points) -> None:
        """Raise an error for constant or dependent constraints, and for as many constraints as coordinates."""
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

    def displayed(self, control: Control | Simulate, latex: Latex) -> Iterator[str]:
        for constraint in listed(control.constraint):
            yield rf"0 &= {latex(constraint)}\quad\text{{(holonomic)}}"


class Constraints:
    """The constraints of a model with the forces kappa of every node; in control problems also eta and zeta.

    Holonomic constraints come first, then rolling constraints.
    """

    def __init__(self, model: Model, names: Names) -> None:
        """Name the forces; the attribute `touched` has the indices of the coordinates on which each force acts."""
        self.model, self.names = model, names
        self.rows = tuple(rolling.coefficients(model, c) for c in model.rolling)
        self.touched = tuple(occurring(model.coordinates, c) for c in model.holonomic)
        self.touched += tuple({i for i, entry in enumerate(row) if entry != 0} for row in self.rows)
        self.kappa = tuple(
            Unknown(names.numbered("kappa"), Meaning(Kind.NORMAL_FORCE, str(c)))
            for c in (*model.holonomic, *model.rolling)
        )

    @property
    def along(self) -> list[Expr]:
        """The forces G^T kappa of all constraints; rolling constraints have A in place of the gradient G."""
        kappa = [Symbol(unknown.name, real=True) for unknown in self.kappa]
        potential = sympy.Add(*(k * c for k, c in zip(kappa, self.model.holonomic, strict=False)))
        slopes = partials(potential, self.model.coordinates)
        forces = [slopes.get(q, S.Zero) for q in self.model.coordinates]
        for k, row in zip(kappa[len(self.model.holonomic) :], self.rows, strict=True):
            forces = [force + k * entry for force, entry in zip(forces, row, strict=True)]
        return forces

    def force(self, suffix: str) -> list[Expr]:
        """Return the impulse h/2 G^T kappa of the constraint force at the left (`_k`) or right (`_k1`) node."""
        of_node = (*self.model.coordinates, *(Symbol(unknown.name, real=True) for unknown in self.kappa))
        substitution = dict(zip(of_node, at_nodes(of_node, suffix), strict=True))
        if suffix == "_k1":
            substitution[self.model.time] = self.model.time + STEP
        return [(STEP * force / 2).xreplace(substitution) for force in self.along]

    def nodal_terms(
        self, matched: tuple[set[int], set[int]], by_pi: tuple[set[int], set[int]], scheme: Scheme
    ) -> NodalTerms:
        """Return the unknowns of nodes for the forces kappa of all constraints, and their share of the Lagrangian.

        `matched` has, for the start and for the end, the indices of coordinates whose momenta match velocities. `by_pi`
        has those whose momenta equal the unknowns pi of a periodic motion. The kappa of a constraint is zero at an end
        without any of these coordinates. If both ends have the same pi, only the sum of both kappa acts, and the kappa
        of the end is zero.
        """
        pairs = list(zip(self.kappa, self.touched, strict=True))
        conditions = [Condition(str(c), c) for c in self.model.holonomic]
        eta = nodal_equalities(self.model, conditions, "eta", self.names, Kind.CONSTRAINT)
        zeta = tuple(Unknown(self.names.numbered("zeta"), Meaning(Kind.ROLLING, str(c))) for c in self.model.rolling)
        means = rolling.discrete(self.model, scheme) if zeta else []
        multipliers = [unknown.name for unknown in zeta]
        return NodalTerms(
            unknowns=(*self.kappa, *eta.unknowns, *zeta),
            element=sum((y * c for y, c in zip(symbols(multipliers, "_k1"), means, strict=True)), eta.element),
            start_pins=(*eta.start_pins, *(k.name for k, t in pairs if not t & (matched[0] | by_pi[0])), *multipliers),
            end_pins=(*eta.end_pins, *(k.name for k, t in pairs if not t & matched[1] or t & by_pi[1])),
            equations=(
                *eta.equations,
                *(Equation(mean, condition=u.meaning.subject) for u, mean in zip(zeta, means, strict=True)),
            ),
            holding=self._holding(),
        )

    def _holding(self) -> tuple[HoldingForces, ...]:
        """Return the guess of the forces at the guess of the motion; () if no other force acts on the coordinates.

        From forces of zero, a linear equation of motion may have no solution: a load without tension in its rope cannot
        be moved sideways by the rope. The length of a quaternion needs no force, since no force acts along it.
        """
        model = self.model
        lengths = [squared_length(rotation) - 1 for rotation in model.rotations]
        chosen = [i for i, c in enumerate((*model.holonomic, *model.rolling)) if c not in lengths]
        touched = sorted(set[int]().union(*(self.touched[i] for i in chosen)))
        rows = [[sympy.diff(c, q) for q in model.coordinates] for c in model.holonomic]
        rows += [[*row] for row in self.rows]
        at_rest = dict.fromkeys(model.rates, S.Zero)
        guess = dict(zip(model.coordinates, coordinate_guess(model), strict=True))
        guess |= {u: dict(model.guess).get(u, S.Zero) for u in model.controls}

        def guessed(expression: Expr) -> Expr:
            value = at_guess(model, expression.subs(at_rest).subs(guess, simultaneous=True))
            return S.Zero if value.has(S.NaN, S.ComplexInfinity, S.Infinity, S.NegativeInfinity) else value

        slopes = gradient(model.function, model.coordinates)
        forces = tuple(guessed(slopes[i] + model.force[i]) for i in touched)
        if not any(forces):
            return ()
        return (HoldingForces((*chosen,), forces, tuple(tuple(guessed(rows[i][j]) for j in touched) for i in chosen)),)

    def tangency(self, boundary: Boundary, matched: set[int], values: Mapping[Symbol, Expr]) -> tuple[Condition, ...]:
        """Return dc/dt = 0 at an end for constraints with matched velocities, unless prescribed values imply it.

        `values` maps the symbols of boundary values to the values. A prescribed velocity of zero is tangential if time
        does not occur. Other prescribed velocities need no condition if the coordinates of the constraint are known:
        at least as many constraints as free coordinates must depend on no other free coordinate.
        """
        conditions, time = [], self.model.time
        for constraint, touched in zip(self.model.holonomic, self.touched, strict=False):
            if not touched & matched:
                continue
            free = {i for i in touched if boundary.positions[i] is None}
            others = [{i for i in t if boundary.positions[i] is None} for t in self.touched]
            are_positions_known = len(free) <= sum(bool(other) and other <= free for other in others)
            are_rates_fixed = all(boundary.rates[i] is not None for i in touched)
            at_rest = (
                are_rates_fixed
                and not constraint.has(time)
                and all(values.get(boundary.rates[i]) == 0 for i in touched)
            )
            if (are_rates_fixed and are_positions_known) or at_rest:
                continue
            row = sum(
                (sympy.diff(constraint, self.model.coordinates[i]) * self.model.rates[i] for i in sorted(touched)),
                sympy.diff(constraint, time),
            )
            conditions.append(Condition(f"velocity along the constraint {constraint}", row))
        of_rolling = zip(self.model.rolling, self.touched[len(self.model.holonomic) :], strict=True)
        for constraint, touched in (pair for pair in of_rolling if pair[1] & matched):
            fixed = [boundary.rates[i] for i in touched]
            at_rest = constraint.xreplace(dict.fromkeys(self.model.rates, S.Zero))
            rests = at_rest == 0 and all(v is not None and values.get(v) == 0 for v in fixed)
            positions = [boundary.positions[i] for i in occurring(self.model.coordinates, constraint)]
            if not rests and (None in fixed or None in positions):
                conditions.append(Condition(f"rolling {constraint} = 0", constraint))
        return tuple(conditions)


def rates(model: Model) -> tuple[Expr, ...]:
    """Return the time derivatives G v + dc/dt of the constraints, in the coordinates and velocities of the model."""
    moving = dict(zip(model.coordinates, model.rates, strict=model.form != "first-order"))
    return tuple(
        sympy.Add(sympy.diff(c, model.time), *(slope * moving[q] for q, slope in partials(c, moving).items()))
        for c in model.holonomic
    )


def require_no_inner_points(model: Model, inner: Sequence[Symbol], scheme: str) -> None:
    """Raise SchemeError if a scheme with inner points is to discretise a model with constraints."""
    if inner and model.contacts:
        raise SchemeError(
            f"scheme {scheme!r} has inner points, where gaps and contact forces are not imposed",
            "use midpoint, trapezoidal or rectangle",
        )
    if inner and (model.holonomic or model.rolling):
        words = "holonomic" if model.holonomic else "rolling"
        raise SchemeError(
            f"scheme {scheme!r} has inner points, where {words} constraints are not imposed",
            "use midpoint or trapezoidal" + (", or suzuki-4-of-trapezoidal" if model.task == "simulate" else ""),
        )


def refuse(model: Model, method: str) -> None:
    """Raise ArgumentError for a model with constraints: the method has no discrete constraint forces."""
    if model.contacts:
        finding = f"the {method} method has no contact forces, and {model.contacts[0].name} is a gap"
        raise ArgumentError(finding, "use --method variational")
    kinds = (("holonomic", model.holonomic, ", or generalised coordinates"), ("rolling", model.rolling, ""))
    for words, constraints, alternative in kinds:
        if constraints:
            raise ArgumentError(
                f"the {method} method has no {words} constraints, and {text(constraints[0])} = 0 is one",
                f"use --method variational{alternative}",
            )
