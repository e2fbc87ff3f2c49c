"""Problem x scheme -> the expressions of one time interval.

On the Lagrangian side these are the discrete Lagrangian, the discrete forces and the discrete cost; on the
Hamiltonian side, and for first-order systems, the equations of one step and the discrete cost; on both sides the
path conditions at the points where the scheme evaluates the dynamics. Values at the left and right node carry the
suffixes `_k` and `_k1`; h is the length of the interval and t the time at its left end.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.model import Condition, Model
from codegen.schemes import DiscreteLagrangian, OneStep

STEP = Symbol("h", positive=True)
"""The length h of an interval."""
_LONG = 80
"""Operations from which on the variation of a discrete Lagrangian is taken as a whole."""


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
class PathValue:
    """A path condition at one point of an interval, whose place `c` lies in [0, 1]."""

    condition: Condition
    place: Expr
    value: Expr


@dataclass(frozen=True)
class VariationalInterval:
    """Discrete Lagrangian Ld(q_k, q_k1), discrete forces f-, f+ and discrete cost Cd on one interval."""

    q: Sites
    lagrangian: Expr
    force_minus: tuple[Expr, ...]
    force_plus: tuple[Expr, ...]
    cost: Expr
    path: tuple[PathValue, ...] = ()

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

    def virtual_work(self, displacements: Sequence[Symbol], impulses: Sequence[Expr]) -> Expr:
        """The work of -p_k, p_k1 and further impulses along displacements of the left, then of the right coordinates.

        A long Ld is differentiated in the direction of the displacements instead of by each coordinate: this keeps
        its structure, such as the speed of a body that many coordinates move.
        """
        if self.lagrangian.count_ops() < _LONG:
            halves = (*(-p for p in self.left_momentum), *self.right_momentum)
            work = (d * (half + impulse) for d, half, impulse in zip(displacements, halves, impulses, strict=True))
            return sum(work, sympy.S.Zero)
        amount = sympy.Dummy("amount", real=True)
        coordinates = (*self.q.left, *self.q.right)
        displaced = {q: q + amount * d for q, d in zip(coordinates, displacements, strict=True)}
        variation = sympy.diff(self.lagrangian.xreplace(displaced), amount).xreplace({amount: sympy.S.Zero})
        forces = zip(displacements, (*self.force_minus, *self.force_plus), impulses, strict=True)
        return variation + sum((d * (f + impulse) for d, f, impulse in forces), sympy.S.Zero)


@dataclass(frozen=True)
class OneStepInterval:
    """Equations of one step in (q_k, p_k), inner stages and (q_k1, p_k1), each an expression that must vanish.

    The equations for the stages come first, then those of the coordinates, then those of the momenta. A first-order
    system has no momenta.
    """

    q: Sites
    p: Sites
    stages: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    cost: Expr
    path: tuple[PathValue, ...] = ()


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
    path: list[PathValue] = []
    minus, plus = [sympy.S.Zero] * len(model.force), [sympy.S.Zero] * len(model.force)
    for point in scheme.points:
        weight, c = STEP * point.weight, point.place
        mean_controls = [_between(a, b, c) for a, b in zip(places.left_controls, places.right_controls, strict=True)]
        lagrangian += weight * at(model.function, c, mean_controls)
        cost += weight * at(model.cost or sympy.S.Zero, c, mean_controls)
        path += [PathValue(g, c, at(g.expression, c, mean_controls)) for g in model.path]
        for i, f in enumerate(model.force):
            minus[i] += weight * (1 - c) * force_at(f, c)
            plus[i] += weight * c * force_at(f, c)
    return VariationalInterval(places, lagrangian, tuple(minus), tuple(plus), cost, _distinct(path))


def one_step_interval(model: Model, scheme: OneStep, nodal_controls: bool = False) -> OneStepInterval:
    """Write the equations of one step of a composition scheme.

    The model is of Hamiltonian form, with forced Hamilton's equations, or of first-order form x' = f(x, u, t).
    """
    q_sites = sites(model, model.coordinates, nodal_controls)
    p_sites = sites(model, model.rates, nodal_controls)
    ends = [(*q_sites.left, *p_sites.left)]
    for index in range(1, len(scheme.substeps)):
        ends.append(at_nodes((*model.coordinates, *model.rates), f"_stage{index}"))
    ends.append((*q_sites.right, *p_sites.right))

    field = (*_vector_field(model), model.cost or sympy.S.Zero)
    dimension = len(model.coordinates)
    equations: list[Expr] = []
    path: list[PathValue] = []
    cost, elapsed = sympy.S.Zero, sympy.S.Zero
    for substep, x0, x1 in zip(scheme.substeps, ends[:-1], ends[1:], strict=True):
        a, b, fraction = substep.position, substep.momentum, STEP * substep.fraction
        position = [_between(left, right, a) for left, right in zip(x0[:dimension], x1[:dimension], strict=True)]
        momentum = [_between(left, right, b) for left, right in zip(x0[dimension:], x1[dimension:], strict=True)]
        c = elapsed + a * substep.fraction
        controls = [_between(u0, u1, c) for u0, u1 in zip(q_sites.left_controls, q_sites.right_controls, strict=True)]

        *rates, cost_rate = (_substitute(model, f, position, momentum, controls, c) for f in field)
        equations += [right - left - fraction * rate for left, right, rate in zip(x0, x1, rates, strict=True)]
        cost += fraction * cost_rate
        path += [PathValue(g, c, _substitute(model, g.expression, position, momentum, controls, c)) for g in model.path]
        elapsed += substep.fraction
    stages, kept = _without_idle_stages(ends[1:-1], equations)
    return OneStepInterval(q_sites, p_sites, stages, kept, cost, _distinct(path))


def _vector_field(model: Model) -> tuple[Expr, ...]:
    """The right-hand sides of Hamilton's equations with forces, or of a first-order system."""
    if model.form == "first-order":
        return model.dynamics
    return (
        *(sympy.diff(model.function, p) for p in model.rates),
        *(f - sympy.diff(model.function, q) for q, f in zip(model.coordinates, model.force, strict=True)),
    )


def _without_idle_stages(
    stages: Sequence[tuple[Symbol, ...]], equations: Sequence[Expr]
) -> tuple[tuple[Symbol, ...], tuple[Expr, ...]]:
    """Drop each stage at which no field is evaluated, as in the trapezoidal rule, by adding the steps beside it.

    The sum is free of such a stage because one step ends where the next begins.
    """
    size = len(stages[0]) if stages else len(equations)
    kept, steps = list[Symbol](), [list(equations[i : i + size]) for i in range(0, len(equations), size)]
    joined = [steps[0]]
    for stage, step in zip(stages, steps[1:], strict=True):
        # A step is linear in its ends unless its field is evaluated there.
        sums = [before + after for before, after in zip(joined[-1], step, strict=True)]
        if any(total.has(*stage) for total in sums):
            kept += stage
            joined.append(step)
        else:
            joined[-1] = sums
    return tuple(kept), tuple(equation for step in joined for equation in step)


def _distinct(values: Sequence[PathValue]) -> tuple[PathValue, ...]:
    """Each condition once, where it has the same value at several points, as a bound on an interval's control has."""
    first: dict[tuple[str, Expr], PathValue] = {}
    for value in values:
        first.setdefault((value.condition.name, value.value), value)
    return tuple(first.values())


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
    return sympy.sympify(function).xreplace(values)
