"""Events and gaps at the left node of a step: values, rates along the motion, and the change of the state.

A function e of the state has the rate de/dt along the motion. For a Lagrangian, with M = d2L/dv2,

    de/dt = e_q v + e_t + (M^-1 e_v) . (L_q + f - L_vq v - L_vt + C^T kappa),

where kappa are the forces of holonomic constraints, whose second time derivatives vanish, and C are their gradients.

An impact at g(q, t) = 0, with the normal G = dg/dq, the restitution c and the rate dg/dt = G v + g_t, is the event with
the derived change

    p+ = p - (1 + c) (dg/dt) / (G M^-1 G^T) G^T,

so that dg/dt changes to -c dg/dt, and the momentum along the surface is continuous. Source: Fetecau, Marsden, Ortiz and
West (2003), Nonsmooth Lagrangian mechanics and variational collision integrators, SIAM J. Applied Dynamical Systems 2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import sympy
from sympy import Add, Expr, S, Symbol

from codegen.discretise.model.definitions import Model
from codegen.discretise.model.legendre import solve_blocks
from codegen.errors import ExpressionError
from codegen.runtime.record import EventAction
from codegen.symbolic.derivatives import gradient
from codegen.symbolic.graph import Assignment


@dataclass(frozen=True)
class EventAtNode:
    """An event at the left node: value, rate, and the sum `scale` of the moduli of the terms of the value.

    `after` is the state after an event that changes it.
    """

    name: str
    action: EventAction
    direction: int
    value: Expr
    rate: Expr
    scale: Expr
    after: tuple[Expr, ...] = ()

    @property
    def row(self) -> tuple[Expr, ...]:
        """The value, the rate and the scale, a row of the array that the kernel of events fills."""
        return self.value, self.rate, self.scale


@dataclass(frozen=True)
class GapAtNode(EventAtNode):
    """A gap at the left node; `normal` is G, and `response` is M^-1 G^T, the velocity that an impulse G^T causes.

    `acceleration` is the second time derivative of the gap without contact forces. The terms of the rate of the gap
    have the size `speed`.
    """

    acceleration: Expr = S.Zero
    restitution: Expr = S.One
    speed: Expr = S.Zero
    normal: tuple[Expr, ...] = ()
    response: tuple[Expr, ...] = ()

    @property
    def contact(self) -> tuple[Expr, ...]:
        """Acceleration, restitution, size of the rate, normal and response."""
        return (self.acceleration, self.restitution, self.speed, *self.normal, *self.response)


@dataclass(frozen=True)
class Found:
    """The events and gaps of a model at the left node, and assignments that they read besides those of the state."""

    events: tuple[EventAtNode, ...] = ()
    gaps: tuple[GapAtNode, ...] = ()
    assignments: tuple[Assignment, ...] = ()


NONE = Found()
"""No events and no gaps."""


class Rates:
    """The rates of functions along the motion of a model, whose rates have the values `velocities` at the left node.

    `velocities` and `left` are the rates in terms of the state at the left node, and the symbols of this state.
    `constraint_rates` are the time derivatives of holonomic constraints, and the rolling constraints. The assignments
    that determine the forces of constraints are named by `new_name`. `linear` has assignments and velocities of a large
    mass matrix that is not inverted, as functions of the left node.
    """

    def __init__(
        self,
        model: Model,
        left: Sequence[Symbol],
        velocities: Sequence[Expr],
        constraint_rates: Sequence[Expr],
        new_name: Callable[[str], str],
        linear: tuple[Sequence[Assignment], Sequence[Expr]] | None = None,
    ) -> None:
        self.model, self.left, self.linear, self.constraint_rates = model, tuple(left), linear, constraint_rates
        self.new_name = new_name
        self.at_left: dict[Symbol, Expr] = dict(zip(model.coordinates, left, strict=False))
        self.assignments: list[Assignment] = []
        if constraint_rates:  # constraint forces contain the velocities many times
            velocities = [self._assigned("rate", v) for v in velocities]
        self.at_left |= dict(zip(model.rates, velocities, strict=True))
        if model.form == "lagrangian":
            slopes = gradient(model.function, model.rates)
            self.mass = sympy.Matrix([[p.diff(v) for v in model.rates] for p in slopes])
            forces = zip(slopes, model.coordinates, model.force, strict=True)
            moving = list(zip(model.coordinates, model.rates, strict=True))
            load = [
                model.function.diff(q) + f - Add(*(p.diff(r) * v for r, v in moving)) - p.diff(model.time)
                for p, q, f in forces
            ]
            self.load = [self.node(each) for each in load]
            if constraint_rates:
                self.load = [self._assigned("load", each) for each in self.load]

    def node(self, expression: Expr) -> Expr:
        """Return an expression of the model in the symbols of the left node."""
        return expression.xreplace(self.at_left)

    def rate(self, e: Expr) -> Expr:
        """Return the rate of a function, at the left node."""
        is_moved = self.model.form == "lagrangian" and bool(e.free_symbols & {*self.model.rates})
        return self._rate(e, self.normal_forces if is_moved else None)

    def _rate(self, e: Expr, forces: Sequence[Expr] | None) -> Expr:
        """Return the rate of a function under `forces` of constraints, at the left node."""
        model = self.model
        by_position = gradient(e, model.coordinates)
        total = e.diff(model.time)
        if model.form == "first-order":
            return self.node(Add(total, *(s * f for s, f in zip(by_position, model.dynamics, strict=True))))
        by_rate = gradient(e, model.rates)
        if model.form == "hamiltonian":
            velocities, slopes = gradient(model.function, model.rates), gradient(model.function, model.coordinates)
            total += Add(*(s * v for s, v in zip(by_position, velocities, strict=True)))
            changes = zip(by_rate, model.force, slopes, strict=True)
            return self.node(total + Add(*(s * (f - slope) for s, f, slope in changes)))
        total = self.node(total + Add(*(s * v for s, v in zip(by_position, model.rates, strict=True))))
        if any(by_rate):
            response = self.response([self.node(s) for s in by_rate])
            loads = zip(response, self.load, forces or [S.Zero] * len(response), strict=True)
            total += Add(*(y * (load + force) for y, load, force in loads))
        return total

    @cached_property
    def normal_forces(self) -> list[Expr]:
        """The forces C^T kappa of holonomic and rolling constraints, at the left node."""
        model = self.model
        if not self.constraint_rates:
            return [S.Zero] * len(model.coordinates)
        slopes = [[self.node(slope) for slope in gradient(rate, model.rates)] for rate in self.constraint_rates]
        responses = [[self._assigned("response", y) for y in self.response(row)] for row in slopes]
        matrix = sympy.Matrix([[Add(*map(sympy.Mul, a, b)) for b in responses] for a in slopes])
        kappa = self._solution(matrix, [-self._rate(rate, None) for rate in self.constraint_rates])
        return [Add(*(k * row[i] for k, row in zip(kappa, slopes, strict=True))) for i in range(len(model.coordinates))]

    def _solution(self, matrix: sympy.Matrix, right: Sequence[Expr]) -> list[Expr]:
        """Return the solution of a symmetric positive definite system, by assignments of its factorisation L D L^T."""
        pivots, factors, solution = list[Expr](), dict[tuple[int, int], Expr](), list[Expr]()
        for i in range(len(right)):
            column = dict[int, Expr]()
            for j in range(i):
                products = (column[k] * factors[j, k] for k in range(j))
                column[j] = self._assigned("C", Add(matrix[i, j], *(-each for each in products)))
                factors[i, j] = self._assigned("L", column[j] / pivots[j])
            pivots.append(self._assigned("D", Add(matrix[i, i], *(-column[j] * factors[i, j] for j in range(i)))))
            solution.append(self._assigned("z", Add(right[i], *(-factors[i, j] * solution[j] for j in range(i)))))
        for i in reversed(range(len(right))):
            later = (-factors[j, i] * solution[j] for j in range(i + 1, len(right)))
            solution[i] = self._assigned("kappa", Add(solution[i] / pivots[i], *later))
        return solution

    def _assigned(self, stem: str, value: Expr) -> Expr:
        """Return a new symbol to which a value is assigned, or the value itself if it is a number or a symbol."""
        if value.is_Number or value.is_Symbol:
            return value
        symbol = Symbol(self.new_name(stem), real=True)
        self.assignments.append((symbol, value))
        return symbol

    def response(self, impulse: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return M^-1 times an impulse, an expression at the left node."""
        model = self.model
        if model.form == "hamiltonian":
            velocities = gradient(model.function, model.rates)
            return tuple(
                Add(*(self.node(v.diff(p)) * i for p, i in zip(model.rates, impulse, strict=True))) for v in velocities
            )
        if self.linear is None:
            return solve_blocks(self.mass.applyfunc(self.node), impulse)
        return tuple(
            a - b for a, b in zip(self._velocities(impulse), self._velocities([S.Zero] * len(impulse)), strict=True)
        )

    def _velocities(self, momenta: Sequence[Expr]) -> list[Expr]:
        """Return the velocities of other momenta, which a sequence of assignments determines."""
        assert self.linear is not None
        assignments, velocities = self.linear
        count, number = len(self.model.coordinates), len(self.assignments)
        changed: dict[Symbol, Expr] = dict(zip(self.left[count:], momenta, strict=True))
        for symbol, value in assignments:
            renamed = Symbol(f"{symbol.name}_{number}")
            self.assignments.append((renamed, value.xreplace(changed)))
            changed[symbol] = renamed
        return [velocity.xreplace(changed) for velocity in velocities]


def at_node(model: Model, rates: Rates) -> Found:
    """Return the events and the gaps of a model at the left node.

    Raise ExpressionError for gaps if the kinetic energy is not quadratic in the velocities or momenta.
    """
    left, node = rates.left, rates.node
    events = list[EventAtNode]()
    for event in model.events:
        after = list[Expr]()
        if event.changes:
            changes = dict(event.changes)
            after = [node(changes.get(q, q)) for q in model.coordinates]
            momenta = gradient(model.function, model.rates) if model.form == "lagrangian" else model.rates
            for value, unchanged in zip(momenta, left[len(model.coordinates) :], strict=False):
                is_changed = bool(value.free_symbols & set(changes))
                after.append(node(value.xreplace(changes)) if is_changed else unchanged)
        value = event.expression
        events.append(
            EventAtNode(
                event.name, event.action, event.direction, node(value), rates.rate(value), node(_scale(value)),
                tuple(after),
            )
        )  # fmt: skip
    gaps = list[GapAtNode]()
    for gap in model.gaps:
        hessian = rates.mass if model.form == "lagrangian" else sympy.hessian(model.function, model.rates)
        if sympy.expand(hessian).has(*model.rates):
            listed = ", ".join(map(str, model.rates))
            raise ExpressionError(
                f"unilateral {gap.name} with a {model.form} that is not quadratic in {listed}",
                "leave the gap out, or write the impact as an event with its change",
            )
        velocities = model.rates if model.form == "lagrangian" else gradient(model.function, model.rates)
        slopes, value = gradient(gap.expression, model.coordinates), gap.expression
        terms = [value.diff(model.time), *(s * v for s, v in zip(slopes, velocities, strict=True))]
        speed = Add(*terms)
        normal = tuple(map(node, slopes))
        gaps.append(
            GapAtNode(
                gap.name, EventAction.IMPACT, -1, node(value), node(speed), node(_scale(value)),
                acceleration=rates.rate(speed), restitution=gap.restitution, normal=normal,
                response=rates.response(normal), speed=node(Add(*map(sympy.Abs, terms))),
            )
        )  # fmt: skip
    return Found(tuple(events), tuple(gaps), tuple(rates.assignments))


def _scale(expression: Expr) -> Expr:
    return Add(*(sympy.Abs(term) for term in Add.make_args(expression)))
