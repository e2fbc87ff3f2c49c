"""Rolling constraints A(q, t) v + b(q, t) = 0 of Lagrangian systems, by the discrete Lagrange-d'Alembert principle.

The constraints are affine in the velocities and need not be integrable. Their forces A^T kappa do no work on virtual
displacements with A dq = 0. A discrete motion satisfies, at inner nodes and on intervals,

    D2 Ld(q_{k-1}, q_k) + D1 Ld(q_k, q_{k+1}) + f+_{k-1} + f-_k + h A(q_k)^T kappa_k = 0,
    sum_i w_i (A(q_i, t_i) v_i + b(q_i, t_i)) = 0

with the points and weights of the scheme's quadrature. The midpoint rule has A((q_k + q_k1)/2) (q_k1 - q_k)/h + b = 0,
the trapezoidal rule has the mean of A at both nodes. Source: Cortes and Martinez (2001), Non-holonomic integrators,
Nonlinearity 14, section 3; McLachlan and Perlmutter (2006), Integrators for nonholonomic mechanical systems, section 4.

As for holonomic constraints, the force acts at both nodes of an interval, each during half a step. The momentum between
two intervals is not determined by the motion of the nodes. It is chosen so that the velocity v_k of p_k satisfies the
constraint A(q_k) v_k + b = 0. A motion of simulations and of optimal control is the same.

In optimal control kappa_k is a primal unknown of a node. zeta_k1 is the multiplier of the constraint on the interval
that ends in node k1, so that zeta is zero at the start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

import sympy
from sympy import Expr, S, Symbol

from codegen.discretise.conditions.base import (
    ConditionKind,
    Latex,
    Points,
    Scope,
    conditions_of,
    dependent,
    is_constant,
    listed,
)
from codegen.discretise.interval import STEP, PolynomialMotion, at_nodes, substitute
from codegen.discretise.model.definitions import Condition, Model, prescribed
from codegen.discretise.model.relations import Entry, relation_entries, text
from codegen.discretise.schemes.base import Scheme
from codegen.errors import BoundaryError, DegenerateError, ExpressionError
from codegen.problem.problem import Control, Simulate
from codegen.problem.symbols import ControlInput, Coordinate, FreeParameter, Parameter, Time, Velocity
from codegen.symbolic import checks as expressions
from codegen.symbolic.derivatives import gradient
from codegen.symbolic.zeros import identically_zero


class Rolling(ConditionKind):
    """Equations that are affine in the velocities, with the forces of Lagrange and d'Alembert."""

    argument, field, words = "rolling", "rolling", "rolling constraints"
    scope: ClassVar[Scope] = {"rolling": (Coordinate, Velocity, Time, Parameter)}
    remedies: ClassVar = {
        ControlInput: "write it in path, with the force as a further control",
        FreeParameter: "declare a parameter",
    }
    check = "rolling constraints"

    def written(self, control: Control | Simulate) -> Iterator[Entry]:
        return relation_entries(self.argument, control.rolling)

    def require_fitting(self, entry: Entry, control: Control | Simulate, form: str) -> None:
        """Raise ExpressionError unless the entry is an equation of a Lagrangian system, affine in the velocities."""
        if form != "lagrangian":
            raise ExpressionError(f"{entry.what} with {form}", "give a Lagrangian, and the velocities of coordinates")
        if not entry.equality:
            raise ExpressionError(f"{entry.what} is an inequality", "give an equation")
        velocities = sorted((s for s in entry.expression.free_symbols if isinstance(s, Velocity)), key=str)
        slopes = [sympy.diff(entry.expression, v) for v in velocities]
        if all(identically_zero(slope) for slope in slopes):
            remedy = "write it in constraint, whose force acts along its gradient"
            raise ExpressionError(f"{entry.what} has no velocity", remedy)
        require_affine(entry, "write a(q, t) v + b(q, t) = 0, as the principle of Lagrange and d'Alembert requires")

    def conditions(self, entries: Sequence[Entry]) -> tuple[Expr, ...]:
        return tuple(condition.expression for condition in conditions_of(entries, self.argument))

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ((f"rolling {text(c)}", c) for c in model.rolling)

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        for number, c in enumerate(model.rolling, 1):
            equation = f"rolling {text(c)} = 0"
            yield Condition(equation if len(equation) <= _LONGEST else f"equation {number} of rolling", c)

    def require_regular(self, model: Model, points: Points) -> None:
        """Raise DegenerateError for constraints that depend on each other or leave nothing to move.

        Rates of holonomic constraints are equations between velocities as well.
        """
        named = [Condition(f"{text(c)} = 0", c) for c in model.rolling]
        for condition in named:
            if is_constant(condition, model.rates, points):
                raise DegenerateError(f"rolling {condition} depends on no velocity", "leave it out")
        holonomic = [
            Condition(f"d/dt ({text(c)}) = 0", sympy.Matrix([c]).jacobian(model.coordinates).dot(model.rates))
            for c in (model.holonomic if named else ())
        ]
        if named and (names := dependent([*holonomic, *named], model.rates, points)):
            raise DegenerateError(f"the constraints {names} depend on each other", "leave out one of them")
        if named and len(holonomic) + len(named) >= len(model.coordinates):
            raise DegenerateError(
                f"{len(holonomic) + len(named)} constraints on {len(model.coordinates)} coordinates leave nothing to"
                " move",
                "leave out a constraint",
            )
        for end in ("start", "end") if model.task == "control" else ():
            _require_consistent(model, end)

    def sentences(self, model: Model) -> list[str]:
        return [f"{sympy.sstr(c)} = 0 as mean of every interval, and at the ends" for c in model.rolling]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if model.rolling:
            yield "Rolling constraints", tuple(("0", c) for c in model.rolling)

    def displayed(self, control: Control | Simulate, latex: Latex) -> Iterator[str]:
        for constraint in listed(control.rolling):
            yield rf"0 &= {latex(constraint)}\quad\text{{(rolling)}}"


def _require_consistent(model: Model, end: str) -> None:
    """Raise BoundaryError if prescribed values at an end satisfy a constraint only at the default parameters.

    The force of the constraint would absorb the momentum across the constraint, and no equation would fail.
    """
    fixed = {**prescribed(model, end), model.time: S.Zero if end == "start" else model.duration}
    for constraint in model.rolling:
        if not constraint.free_symbols <= {*fixed, *model.parameters}:
            continue
        value = constraint.subs(fixed, simultaneous=True)
        defaults = {**dict(zip(model.parameters, model.defaults, strict=True)), model.body: 0.0}

        def is_violated(numbers: Mapping[Symbol | None, float], value: Expr = value) -> bool:
            excess = expressions.rounded_at(value, numbers)
            return excess is not None and abs(excess) > expressions.rounding_at(value, numbers)

        if is_violated(defaults):
            continue  # an error without mention of parameters follows
        for parameter in sorted(value.free_symbols & {*model.parameters}, key=str):
            for factor in _CHANGES:
                if is_violated({**defaults, parameter: factor * (defaults[parameter] or 1.0)}):
                    raise BoundaryError(
                        f"{end} violates rolling {text(constraint)} = 0 for other values of {parameter}",
                        f"write velocities in {parameter}, or leave out a velocity, which the constraint determines",
                    )


def require_affine(entry: Entry, remedy: str) -> None:
    """Raise ExpressionError with the remedy unless an expression is affine in the velocities."""
    velocities = sorted((s for s in entry.expression.free_symbols if isinstance(s, Velocity)), key=str)
    for v in velocities:
        slope = sympy.diff(entry.expression, v)
        for w in velocities:
            if slope.has(w) and not identically_zero(sympy.diff(slope, w)):
                product = f"{v} twice" if v == w else f"{v} and {w}"
                raise ExpressionError(
                    f"{entry.what} is not linear in the velocities: its derivative by {product} is not zero", remedy
                )


_LONGEST = 60
"""Largest number of characters of an equation in a message. An equation of a rotation has thousands."""
_CHANGES = (1.07, 0.85)
"""Factors of the default values of parameters at which boundary values are tested."""


def coefficients(model: Model, constraint: Expr) -> list[Expr]:
    """Return the row A of a rolling constraint A v + b, along which its force acts."""
    at_rest = dict.fromkeys(model.rates, S.Zero)
    return [slope.xreplace(at_rest) for slope in gradient(constraint, model.rates)]


def discrete(model: Model, scheme: Scheme) -> list[Expr]:
    """Return the mean of each rolling constraint on an interval, a function of q_k, q_k1, t and h.

    The motion of the interval is a straight line, which `holonomic.require_no_inner_points` ensures.
    """
    rule = scheme.discrete_lagrangian()
    sides = at_nodes(model.coordinates, "_k"), at_nodes(model.coordinates, "_k1")
    motion = PolynomialMotion(STEP, rule.nodes, sides)

    def mean(constraint: Expr) -> Expr:
        along = ((p.weight, p.abscissa, motion.position(p.abscissa), motion.velocity(p.abscissa)) for p in rule.points)
        return sympy.Add(*(w * substitute(model, constraint, q, v, model.controls, c) for w, c, q, v in along))

    return [mean(constraint) for constraint in model.rolling]
