"""The Lagrangian side: discrete Lagrangian, discrete forces and discrete cost of an interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.nodes import (
    FRACTION,
    STEP,
    PathValue,
    PolynomialMotion,
    Sites,
    StateValue,
    at_nodes,
    distinct,
    observed_at,
    sites,
    strictly_inside,
    substitute,
)
from codegen.expressions.tangents import gradient, variation
from codegen.model import Model
from codegen.schemes import Scheme
from codegen.schemes.base import DiscreteLagrangian

_LONG = 80
"""Operations from which on the variation of a discrete Lagrangian is taken as a whole."""


@dataclass(frozen=True)
class VariationalInterval:
    """Discrete Lagrangian Ld(q_k, q_k1), discrete forces f-, f+ and discrete cost Cd on one interval.

    `integrals` are the integrands of the model's conditions on integrals, integrated by the same rule as the cost;
    `observed` is what the model's measurements are of, at FRACTION of the interval.
    Where the motion of an interval is no straight line, Ld depends on the coordinates at `inner` points as well, one
    point after the other, at the fractions `inner_abscissae` of the step, and is stationary there up to `force_inner`.
    Then `slopes` holds the derivatives of Ld by the coordinates at the left node, at inner points, at the right node,
    made from those of L: to differentiate Ld itself would take long. And `impulse` is what an interval adds to the
    momenta, sum_i w_i h (L_q + f): the sum of all balances, in which velocities and their coefficients cancel.
    `inside` are the values of coordinates at inner points, and at quadrature points inside the interval.
    """

    q: Sites
    lagrangian: Expr
    force_minus: tuple[Expr, ...]
    force_plus: tuple[Expr, ...]
    cost: Expr
    path: tuple[PathValue, ...] = ()
    integrals: tuple[Expr, ...] = ()
    inner: tuple[Symbol, ...] = ()
    inner_abscissae: tuple[Expr, ...] = ()
    force_inner: tuple[Expr, ...] = ()
    slopes: tuple[Expr, ...] = ()
    impulse: tuple[Expr, ...] = ()
    observed: tuple[Expr, ...] = ()
    inside: tuple[StateValue, ...] = ()

    @property
    def left_momentum(self) -> tuple[Expr, ...]:
        """The forced discrete Legendre transform p_k = -D1 Ld - f-."""
        pairs = zip(self._derivatives(self.q.left), self.force_minus, strict=True)
        return tuple(-slope - f for slope, f in pairs)

    @property
    def right_momentum(self) -> tuple[Expr, ...]:
        """The forced discrete Legendre transform p_k1 = D2 Ld + f+."""
        pairs = zip(self._derivatives(self.q.right), self.force_plus, strict=True)
        return tuple(slope + f for slope, f in pairs)

    def _derivatives(self, coordinates: Sequence[Symbol]) -> list[Expr]:
        """The derivatives of Ld by coordinates at nodes or inner points."""
        if not self.slopes:
            return list(gradient(self.lagrangian, coordinates))
        known = dict(zip((*self.q.left, *self.inner, *self.q.right), self.slopes, strict=True))
        return [known[q] for q in coordinates]

    @property
    def inner_balance(self) -> tuple[Expr, ...]:
        """What vanishes at the inner points, the forced discrete Euler-Lagrange equations D_i Ld + f_i there."""
        pairs = zip(self._derivatives(self.inner), self.force_inner, strict=True)
        return tuple(slope + f for slope, f in pairs)

    def virtual_work(self, displacements: Sequence[Symbol], impulses: Sequence[Expr]) -> Expr:
        """The work of -p_k, p_k1, the inner balances and impulses along displacements of left, right, inner positions.

        A long Ld is differentiated in the direction of the displacements instead of by each coordinate: this keeps
        its structure, such as the speed of a body that many coordinates move.
        """
        if self.inner or self.lagrangian.count_ops() < _LONG:
            halves = (*(-p for p in self.left_momentum), *self.right_momentum, *self.inner_balance)
            work = (d * (half + impulse) for d, half, impulse in zip(displacements, halves, impulses, strict=True))
            return sum(work, sympy.S.Zero)
        along = variation(self.lagrangian, dict(zip((*self.q.left, *self.q.right), displacements, strict=True)))
        forces = zip(displacements, (*self.force_minus, *self.force_plus), impulses, strict=True)
        return along + sum((d * (f + impulse) for d, f, impulse in forces), sympy.S.Zero)


def variational_interval(model: Model, scheme: Scheme, controls: str = "interval") -> VariationalInterval:
    """Integrate L, the work of the forces and the cost over one interval by the scheme's quadrature rule.

    The virtual work of the forces, h sum_i w_i f(q_i, v_i, u) . dq_i with the variations dq_i of the quadrature points,
    is shared out between the ends and the inner points. With controls on nodes averages are taken: of the controls in
    the cost, and along straight lines of the forces of both nodes.
    """
    rule = scheme.discrete_lagrangian()
    q_sites = sites(model, model.coordinates, controls, len(rule.points))
    inner = [at_nodes(model.coordinates, f"_stage{i}") for i in range(1, len(rule.nodes) - 1)]
    motion = PolynomialMotion(STEP, rule.nodes, (q_sites.left, *inner, q_sites.right))

    def at(function: Expr, c: Expr, controls: Sequence[Expr]) -> Expr:
        return substitute(model, function, motion.position(c), motion.velocity(c), controls, c)

    def force_at(f: Expr, i: int, c: Expr) -> Expr:
        if q_sites.nodal and not inner:
            return (1 - c) * at(f, sympy.S.Zero, q_sites.left_controls) + c * at(f, sympy.S.One, q_sites.right_controls)
        return at(f, c, q_sites.controls_at(i, c))

    lagrangian = sympy.S.Zero
    integrands = (model.cost or sympy.S.Zero, *(integral.expression for integral in model.integrals))
    integrals = [sympy.S.Zero] * len(integrands)
    path: list[PathValue] = []
    evaluated = [
        StateValue(x, c, value)
        for c, point in zip(rule.nodes[1:-1], inner, strict=True)
        for x, value in zip(model.coordinates, point, strict=True)
    ]
    forces = [[sympy.S.Zero] * len(model.force) for _ in rule.nodes]
    for number, point in enumerate(rule.points):
        weight, c = STEP * point.weight, point.abscissa
        here = q_sites.controls_at(number, c)
        lagrangian += weight * at(model.function, c, here)
        integrals = [total + weight * at(f, c, here) for total, f in zip(integrals, integrands, strict=True)]
        path += [PathValue(g, c, at(g.expression, c, here)) for g in model.path]
        evaluated += [StateValue(x, c, v) for x, v in zip(model.coordinates, motion.position(c), strict=True)]
        for share, node in zip(motion.shares(c), forces, strict=True):
            for i, f in enumerate(model.force):
                node[i] += weight * share * force_at(f, number, c)
    minus, *between, plus = (tuple(node) for node in forces)
    slopes, impulse = (), ()
    if inner:
        slopes, impulse = _slopes_and_impulse(model, rule, motion, lambda f, i, c: at(f, c, q_sites.controls_at(i, c)))
    return VariationalInterval(
        q=q_sites,
        lagrangian=lagrangian,
        force_minus=minus,
        force_plus=plus,
        cost=integrals[0],
        path=distinct(path),
        integrals=tuple(integrals[1:]),
        inner=tuple(q for point in inner for q in point),
        inner_abscissae=tuple(c for c in rule.nodes[1:-1] for _ in model.coordinates),
        force_inner=tuple(f for node in between for f in node),
        slopes=slopes,
        impulse=impulse,
        observed=observed_at(model, motion.position(FRACTION), motion.velocity(FRACTION)) if model.observed else (),
        inside=strictly_inside(evaluated),
    )


def _slopes_and_impulse(
    model: Model, scheme: DiscreteLagrangian, motion: PolynomialMotion, at: Callable[[Expr, int, Expr], Expr]
) -> tuple[tuple[Expr, ...], tuple[Expr, ...]]:
    """The derivatives of Ld by each value of the motion, sum_i w_i (h l_j(c_i) L_q + l_j'(c_i) L_v) at points c_i.

    Second, sum_i w_i h (L_q + f).
    """
    slopes = [[sympy.S.Zero] * len(model.coordinates) for _ in scheme.nodes]
    impulse = [sympy.S.Zero] * len(model.coordinates)
    of_position, of_velocity = gradient(model.function, model.coordinates), gradient(model.function, model.rates)
    for number, point in enumerate(scheme.points):
        weight, c = point.weight, point.abscissa
        by_position = [at(slope, number, c) for slope in of_position]
        by_velocity = [at(slope, number, c) for slope in of_velocity]
        for node, share, rate in zip(slopes, motion.shares(c), motion.rates(c), strict=True):
            for i, (force, momentum) in enumerate(zip(by_position, by_velocity, strict=True)):
                node[i] += sympy.expand(weight * share) * STEP * force + sympy.expand(weight * rate) * momentum
        for i, (force, f) in enumerate(zip(by_position, model.force, strict=True)):
            impulse[i] += weight * STEP * (force + at(f, number, c))
    return tuple(slope for node in slopes for slope in node), tuple(impulse)
