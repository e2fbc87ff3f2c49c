"""Problem x scheme -> the expressions of one time interval.

On the Lagrangian side these are the discrete Lagrangian, the discrete forces and the discrete cost; on the
Hamiltonian side, and for first-order systems, the equations of one step and the discrete cost; on both sides the
path conditions at the points where the scheme evaluates the dynamics. Values at the left and right node carry the
suffixes `_k` and `_k1`; h is the length of the interval and t the time at its left end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.polynomials import PolynomialMotion, between
from codegen.expressions.tangents import gradient, variation
from codegen.model import Condition, Model
from codegen.schemes import Composition, DiscreteLagrangian, OfSteps, RungeKutta

STEP = Symbol("h", positive=True)
"""The length h of an interval."""
LENGTHS = tuple(Symbol(f"h_{i}", positive=True) for i in (1, 2))
"""The lengths of the two substeps of a composition's base, where they differ."""
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
    """Discrete Lagrangian Ld(q_k, q_k1), discrete forces f-, f+ and discrete cost Cd on one interval.

    Where the motion of an interval is no straight line, Ld depends on the coordinates at `inner` points as well, one
    point after the other, at the fractions `inner_places` of the step, and is stationary there up to `force_inner`.
    Then `slopes` holds the derivatives of Ld by the coordinates at the left node, at inner points, at the right node,
    made from those of L: to differentiate Ld itself would take long. And `impulse` is what an interval adds to the
    momenta, sum_i w_i h (L_q + f): the sum of all balances, in which velocities and their coefficients cancel.
    """

    q: Sites
    lagrangian: Expr
    force_minus: tuple[Expr, ...]
    force_plus: tuple[Expr, ...]
    cost: Expr
    path: tuple[PathValue, ...] = ()
    inner: tuple[Symbol, ...] = ()
    inner_places: tuple[Expr, ...] = ()
    force_inner: tuple[Expr, ...] = ()
    slopes: tuple[Expr, ...] = ()
    impulse: tuple[Expr, ...] = ()

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
        """The work of -p_k, p_k1, the inner balances and impulses along displacements of left, right, inner places.

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


def step_lengths(scheme: Composition) -> tuple[Symbol, ...]:
    """The symbols for the lengths of one step of a composition's base."""
    count = len(scheme.fractions[0])
    return (STEP,) if count == 1 else LENGTHS[:count]


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

    The virtual work of the forces, h sum_i w_i f(q_i, v_i, u) . dq_i with the variations dq_i of the quadrature points,
    is shared out between the ends and the inner points. With controls on nodes the thesis's averages are taken: of the
    controls in the cost, and along straight lines of the forces of both nodes.
    """
    places = sites(model, model.coordinates, nodal_controls)
    inner = [at_nodes(model.coordinates, f"_stage{i}") for i in range(1, len(scheme.nodes) - 1)]
    motion = PolynomialMotion(STEP, scheme.nodes, (places.left, *inner, places.right))

    def at(function: Expr, c: Expr, controls: Sequence[Expr]) -> Expr:
        return _substitute(model, function, motion.position(c), motion.velocity(c), controls, c)

    def force_at(f: Expr, c: Expr) -> Expr:
        if places.nodal and not inner:
            return (1 - c) * at(f, sympy.S.Zero, places.left_controls) + c * at(f, sympy.S.One, places.right_controls)
        return at(f, c, _mean_controls(places, c))

    lagrangian, cost = sympy.S.Zero, sympy.S.Zero
    path: list[PathValue] = []
    forces = [[sympy.S.Zero] * len(model.force) for _ in scheme.nodes]
    for point in scheme.points:
        weight, c = STEP * point.weight, point.place
        controls = _mean_controls(places, c)
        lagrangian += weight * at(model.function, c, controls)
        cost += weight * at(model.cost or sympy.S.Zero, c, controls)
        path += [PathValue(g, c, at(g.expression, c, controls)) for g in model.path]
        for share, node in zip(motion.shares(c), forces, strict=True):
            for i, f in enumerate(model.force):
                node[i] += weight * share * force_at(f, c)
    minus, *between, plus = (tuple(node) for node in forces)
    slopes, impulse = (), ()
    if inner:
        slopes, impulse = _slopes_and_impulse(model, scheme, motion, lambda f, c: at(f, c, _mean_controls(places, c)))
    return VariationalInterval(
        q=places,
        lagrangian=lagrangian,
        force_minus=minus,
        force_plus=plus,
        cost=cost,
        path=_distinct(path),
        inner=tuple(q for point in inner for q in point),
        inner_places=tuple(c for c in scheme.nodes[1:-1] for _ in model.coordinates),
        force_inner=tuple(f for node in between for f in node),
        slopes=slopes,
        impulse=impulse,
    )


def _slopes_and_impulse(
    model: Model,
    scheme: DiscreteLagrangian,
    motion: PolynomialMotion,
    at: Callable[[Expr, Expr], Expr],
) -> tuple[tuple[Expr, ...], tuple[Expr, ...]]:
    """The derivatives of Ld by each value of the motion, sum_i w_i (h l_j(c_i) L_q + l_j'(c_i) L_v) at points c_i.

    Second, sum_i w_i h (L_q + f).
    """
    slopes = [[sympy.S.Zero] * len(model.coordinates) for _ in scheme.nodes]
    impulse = [sympy.S.Zero] * len(model.coordinates)
    of_position, of_velocity = gradient(model.function, model.coordinates), gradient(model.function, model.rates)
    for point in scheme.points:
        weight, c = point.weight, point.place
        by_position = [at(slope, c) for slope in of_position]
        by_velocity = [at(slope, c) for slope in of_velocity]
        for node, share, rate in zip(slopes, motion.shares(c), motion.rates(c), strict=True):
            for i, (force, momentum) in enumerate(zip(by_position, by_velocity, strict=True)):
                node[i] += sympy.expand(weight * share) * STEP * force + sympy.expand(weight * rate) * momentum
        for i, (force, f) in enumerate(zip(by_position, model.force, strict=True)):
            impulse[i] += weight * STEP * (force + at(f, c))
    return tuple(slope for node in slopes for slope in node), tuple(impulse)


def one_step_interval(model: Model, scheme: OfSteps, nodal_controls: bool = False) -> OneStepInterval:
    """Write the equations of one step of a chain of substeps, of a Runge-Kutta method or of a composition.

    The model is of Hamiltonian form, with forced Hamilton's equations, or of first-order form x' = f(x, u, t). The cost
    is integrated like a further state, so that it has the scheme's order.
    """
    if isinstance(scheme, RungeKutta):
        return _runge_kutta_interval(model, scheme, nodal_controls)
    if isinstance(scheme, Composition):
        scheme = scheme.written_out()
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
        position = [between(left, right, a) for left, right in zip(x0[:dimension], x1[:dimension], strict=True)]
        momentum = [between(left, right, b) for left, right in zip(x0[dimension:], x1[dimension:], strict=True)]
        c = elapsed + a * substep.fraction
        controls = _mean_controls(q_sites, c)

        *rates, cost_rate = (_substitute(model, f, position, momentum, controls, c) for f in field)
        equations += [right - left - fraction * rate for left, right, rate in zip(x0, x1, rates, strict=True)]
        cost += fraction * cost_rate
        path += [PathValue(g, c, _substitute(model, g.expression, position, momentum, controls, c)) for g in model.path]
        elapsed = sympy.expand(elapsed + substep.fraction)
    stages, kept = _without_idle_stages(ends[1:-1], equations)
    return OneStepInterval(q_sites, p_sites, stages, kept, cost, _distinct(path))


def _runge_kutta_interval(model: Model, scheme: RungeKutta, nodal_controls: bool) -> OneStepInterval:
    """The stages of a Runge-Kutta method, of which those that a state equals are not unknown, and the right node."""
    q_sites = sites(model, model.coordinates, nodal_controls)
    p_sites = sites(model, model.rates, nodal_controls)
    left, right = (*q_sites.left, *p_sites.left), (*q_sites.right, *p_sites.right)
    dimension, states = len(model.coordinates), (*model.coordinates, *model.rates)
    points = [_stage_values(scheme, i, dimension, states, left, right) for i in range(len(scheme.weights))]

    rates, cost, path = list[list[Expr]](), sympy.S.Zero, list[PathValue]()
    for c, weight, point in zip(scheme.places, scheme.weights, points, strict=True):
        position, momentum, controls = point[:dimension], point[dimension:], _mean_controls(q_sites, c)
        rates.append([_substitute(model, f, position, momentum, controls, c) for f in _vector_field(model)])
        cost += STEP * weight * _substitute(model, model.cost or sympy.S.Zero, position, momentum, controls, c)
        path += [PathValue(g, c, _substitute(model, g.expression, position, momentum, controls, c)) for g in model.path]

    def step(row: Sequence[Expr], x: int) -> Expr:
        return STEP * sum((a * rate[x] for a, rate in zip(row, rates, strict=True)), sympy.S.Zero)

    stages, equations = list[Symbol](), list[Expr]()
    for i, point in enumerate(points):
        for x, value in enumerate(point):
            if value not in (left[x], right[x]):
                stages.append(value)
                equations.append(value - left[x] - step(_row(scheme, i, x < dimension), x))
    equations += [end - begin - step(scheme.weights, x) for x, (begin, end) in enumerate(zip(left, right, strict=True))]
    return OneStepInterval(q_sites, p_sites, tuple(stages), tuple(equations), cost, _distinct(path))


def _row(scheme: RungeKutta, stage: int, of_coordinates: bool) -> tuple[Expr, ...]:
    return (scheme.positions if of_coordinates else scheme.momenta)[stage]


def _stage_values(
    scheme: RungeKutta,
    i: int,
    dimension: int,
    states: Sequence[Symbol],
    left: Sequence[Symbol],
    right: Sequence[Symbol],
) -> list[Symbol]:
    """The symbols of a stage: those of a node where the table says that it is one."""
    values = list(at_nodes(states, f"_stage{i + 1}"))
    for x in range(len(states)):
        row = _row(scheme, i, x < dimension)
        if not any(row):
            values[x] = left[x]
        elif row == scheme.weights:
            values[x] = right[x]
    return values


def _vector_field(model: Model) -> tuple[Expr, ...]:
    """The right-hand sides of Hamilton's equations with forces, or of a first-order system."""
    if model.form == "first-order":
        return model.dynamics
    return (
        *gradient(model.function, model.rates),
        *(f - slope for slope, f in zip(gradient(model.function, model.coordinates), model.force, strict=True)),
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


def _mean_controls(places: Sites, c: Expr) -> list[Expr]:
    """The controls at a fraction of the step: the interval's own, or the line between those of both nodes."""
    return [between(a, b, c) for a, b in zip(places.left_controls, places.right_controls, strict=True)]


def _substitute(
    model: Model, function: Expr, position: Sequence[Expr], rate: Sequence[Expr], controls: Sequence[Expr], c: Expr
) -> Expr:
    """The value of a function of (q, rates, u, t) at a point of the interval, c being its place in [0, 1]."""
    values = dict(zip(model.coordinates, position, strict=True))
    values |= dict(zip(model.rates, rate, strict=True))
    values |= dict(zip(model.controls, controls, strict=True))
    values[model.time] = model.time + sympy.expand(c * STEP)
    return sympy.sympify(function).xreplace(values)
