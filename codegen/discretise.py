"""Problem x scheme -> the expressions of one time interval.

On the Lagrangian side these are the discrete Lagrangian, the discrete forces and the discrete cost; on the
Hamiltonian side the equations of one step and the discrete cost. Values at the left and right node carry the
suffixes `_k` and `_k1`; h is the length of the interval and t the time at its left end.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.model import Model
from codegen.schemes import DiscreteLagrangian, OneStep

STEP = Symbol("h", positive=True)
"""The length h of an interval."""


@dataclass(frozen=True)
class Sites:
    """Symbols for the values of quantities at the two ends of an interval, and of controls on it.

    With nodal controls `left_controls` and `right_controls` differ, else both are the interval's own.
    """

    left: tuple[Symbol, ...]
    right: tuple[Symbol, ...]
    left_controls: tuple[Symbol, ...]
    right_controls: tuple[Symbol, ...]

    @property
    def nodal(self) -> bool:
        """Whether controls live on nodes."""
        return self.left_controls != self.right_controls


@dataclass(frozen=True)
class VariationalInterval:
    """Discrete Lagrangian Ld(q_k, q_k1), discrete forces f-, f+ and discrete cost Cd on one interval."""

    q: Sites
    lagrangian: Expr
    force_minus: tuple[Expr, ...]
    force_plus: tuple[Expr, ...]
    cost: Expr

    @property
    def left_momentum(self) -> tuple[Expr, ...]:
        """The forced discrete Legendre transform p_k = -D1 Ld - f-."""
        pairs = zip(self.q.left, self.force_minus, strict=True)
        return tuple(-sympy.diff(self.lagrangian, q) - f for q, f in pairs)

    @property
    def right_momentum(self) -> tuple[Expr, ...]:
        """The forced discrete Legendre transform p_k1 = D2 Ld + f+."""
        pairs = zip(self.q.right, self.force_plus, strict=True)
        return tuple(sympy.diff(self.lagrangian, q) + f for q, f in pairs)


@dataclass(frozen=True)
class OneStepInterval:
    """Equations of one step in (q_k, p_k), inner stages and (q_k1, p_k1), each an expression that must vanish.

    The equations for the stages come first, then those of the coordinates, then those of the momenta.
    """

    q: Sites
    p: Sites
    stages: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    cost: Expr


def at_nodes(symbols: Iterable[Symbol], suffix: str) -> tuple[Symbol, ...]:
    """The symbols that hold the values of quantities at a node (`r` -> `r_k`)."""
    return tuple(Symbol(f"{symbol.name}{suffix}", real=True) for symbol in symbols)


def sites(model: Model, quantities: Sequence[Symbol], nodal_controls: bool) -> Sites:
    """Symbols for quantities at both nodes and for the controls of an interval."""
    left_u = at_nodes(model.controls, "_k")
    right_u = at_nodes(model.controls, "_k1") if nodal_controls else left_u
    return Sites(at_nodes(quantities, "_k"), at_nodes(quantities, "_k1"), left_u, right_u)


def variational_interval(model: Model, scheme: DiscreteLagrangian, nodal_controls: bool = False) -> VariationalInterval:
    """Integrate L, the work of the forces and the cost over one interval by the scheme's quadrature rule.

    The forces follow from f- . dq_k + f+ . dq_k1 = h sum_i w_i f(q_i, v, u) . ((1 - c_i) dq_k + c_i dq_k1). With
    controls on nodes the thesis's averages are taken: of the forces of both nodes, and of the controls in the cost.
    """
    places = sites(model, model.coordinates, nodal_controls)
    velocity = [(right - left) / STEP for left, right in zip(places.left, places.right, strict=True)]

    def at(function: Expr, c: Expr, controls: Sequence[Expr]) -> Expr:
        position = [_between(left, right, c) for left, right in zip(places.left, places.right, strict=True)]
        return _substitute(model, function, position, velocity, controls, c)

    def force_at(f: Expr, c: Expr) -> Expr:
        if places.nodal:
            return (1 - c) * at(f, sympy.S.Zero, places.left_controls) + c * at(f, sympy.S.One, places.right_controls)
        return at(f, c, places.left_controls)

    lagrangian, cost = sympy.S.Zero, sympy.S.Zero
    minus, plus = [sympy.S.Zero] * len(model.force), [sympy.S.Zero] * len(model.force)
    for point in scheme.points:
        weight, c = STEP * point.weight, point.place
        mean_controls = [_between(a, b, c) for a, b in zip(places.left_controls, places.right_controls, strict=True)]
        lagrangian += weight * at(model.function, c, mean_controls)
        cost += weight * at(model.cost or sympy.S.Zero, c, mean_controls)
        for i, f in enumerate(model.force):
            minus[i] += weight * (1 - c) * force_at(f, c)
            plus[i] += weight * c * force_at(f, c)
    return VariationalInterval(places, lagrangian, tuple(minus), tuple(plus), cost)


def one_step_interval(model: Model, scheme: OneStep, nodal_controls: bool = False) -> OneStepInterval:
    """Write the equations of one step of a composition scheme for forced Hamilton's equations (Model of form H)."""
    q_sites = sites(model, model.coordinates, nodal_controls)
    p_sites = sites(model, model.rates, nodal_controls)
    q_field = [sympy.diff(model.function, p) for p in model.rates]
    p_field = [f - sympy.diff(model.function, q) for q, f in zip(model.coordinates, model.force, strict=True)]

    ends = [(q_sites.left, p_sites.left)]
    for index in range(1, len(scheme.substeps)):
        ends.append((at_nodes(model.coordinates, f"_stage{index}"), at_nodes(model.rates, f"_stage{index}")))
    ends.append((q_sites.right, p_sites.right))

    equations: list[Expr] = []
    cost, elapsed = sympy.S.Zero, sympy.S.Zero
    for substep, (q0, p0), (q1, p1) in zip(scheme.substeps, ends[:-1], ends[1:], strict=True):
        a, b, fraction = substep.position, substep.momentum, STEP * substep.fraction
        position = [_between(left, right, a) for left, right in zip(q0, q1, strict=True)]
        momentum = [_between(left, right, b) for left, right in zip(p0, p1, strict=True)]
        c = elapsed + a * substep.fraction
        controls = [_between(u0, u1, c) for u0, u1 in zip(q_sites.left_controls, q_sites.right_controls, strict=True)]

        functions = (*q_field, *p_field, model.cost or sympy.S.Zero)
        *rates, cost_rate = (_substitute(model, f, position, momentum, controls, c) for f in functions)
        pairs = zip((*q0, *p0), (*q1, *p1), rates, strict=True)
        equations += [right - left - fraction * rate for left, right, rate in pairs]
        cost += fraction * cost_rate
        elapsed += substep.fraction
    stages = tuple(symbol for q, p in ends[1:-1] for symbol in (*q, *p))
    return OneStepInterval(q_sites, p_sites, stages, tuple(equations), cost)


def _between(left: Expr, right: Expr, c: Expr) -> Expr:
    if left == right:
        return left
    if c == sympy.Rational(1, 2):
        return (left + right) / 2
    return (1 - c) * left + c * right


def _substitute(
    model: Model, function: Expr, position: Sequence[Expr], rate: Sequence[Expr], controls: Sequence[Expr], c: Expr
) -> Expr:
    """The value of a function of (q, rates, u, t) at a point of the interval, c being its place in [0, 1]."""
    values = dict(zip(model.coordinates, position, strict=True))
    values |= dict(zip(model.rates, rate, strict=True))
    values |= dict(zip(model.controls, controls, strict=True))
    values[model.time] = model.time + c * STEP
    return sympy.sympify(function).subs(values, simultaneous=True)
