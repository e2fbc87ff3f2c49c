"""Problem x scheme -> the expressions of one time interval.

On the Lagrangian side these are the discrete Lagrangian, the discrete forces and the discrete cost. On the Hamiltonian
side, and for first-order systems, they are the equations of one step and the discrete cost. On both sides path
conditions hold at the points where the scheme evaluates the dynamics. Values at the left and right node have the
suffixes `_k` and `_k1`; h is the length of the interval and t the time at its left end.

Measurements need the motion at any fraction of an interval. For a scheme in states this is the polynomial with the
values, and as many derivatives as the scheme declares, at both nodes. Without derivatives it is a straight line, of
order two, the collocation polynomial of the midpoint rule. With first derivatives it is a cubic, of order four, as in
Hermite-Simpson and, where it is a parabola, of the trapezoidal rule. With second derivatives it has order six. A
discrete Lagrangian has its own polynomial (`PolynomialMotion`). Source: Hairer, Norsett and Wanner (1993), Solving
ordinary differential equations I, II.6.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import sympy
from sympy import Dummy, Expr, Rational, S, Symbol

from codegen.discretise.model.definitions import Condition, Model
from codegen.discretise.schemes.base import Scheme
from codegen.symbolic.derivatives import gradient, variation

_ABSCISSA = Symbol("abscissa", real=True)
"""The fraction of a step, in basis polynomials."""


@dataclass(frozen=True)
class PolynomialMotion:
    """The polynomial in time, in Lagrange's form, through `values` of the coordinates at the `nodes`."""

    step: Symbol
    nodes: tuple[Expr, ...]
    values: tuple[tuple[Symbol, ...], ...]

    def shares(self, c: Expr) -> list[Expr]:
        """Return the basis polynomials at c, the coefficients of the values in the position."""
        if len(self.nodes) == 2:
            return [1 - c, c]
        return [sympy.expand(basis.subs(_ABSCISSA, c)) for basis in self._basis()]

    def rates(self, c: Expr) -> list[Expr]:
        """Return the derivatives of the basis polynomials at c."""
        return [sympy.expand(sympy.diff(basis, _ABSCISSA).subs(_ABSCISSA, c)) for basis in self._basis()]

    def position(self, c: Expr) -> list[Expr]:
        """Return the coordinates at c; except on a straight line, in differences from the first value."""
        if len(self.nodes) == 2:
            return [between(left, right, c) for left, right in zip(*self.values, strict=True)]
        positions = []
        for first, *others in zip(*self.values, strict=True):
            terms = (share * (q - first) for share, q in zip(self.shares(c)[1:], others, strict=True) if share != 0)
            positions.append(first + sum(terms, sympy.S.Zero))
        return positions

    def velocity(self, c: Expr) -> list[Expr]:
        """Return the derivative by time at c, in differences from the first value, so that no digits cancel."""
        if len(self.nodes) == 2:
            return [(right - left) / self.step for left, right in zip(*self.values, strict=True)]
        velocities = []
        for first, *others in zip(*self.values, strict=True):
            terms = (rate * ((q - first) / self.step) for rate, q in zip(self.rates(c)[1:], others, strict=True))
            velocities.append(sum(terms, sympy.S.Zero))
        return velocities

    def _basis(self) -> list[Expr]:
        return [
            sympy.prod([(_ABSCISSA - other) / (node - other) for other in self.nodes if other != node])
            for node in self.nodes
        ]


def between(left: Expr, right: Expr, c: Expr) -> Expr:
    """Return the point at the fraction c of the line from left to right."""
    if left == right:
        return left
    if c == sympy.Rational(1, 2):
        return (left + right) / 2
    return (1 - c) * left + c * right


STEP = Symbol("h", positive=True)
"""The length h of an interval."""
LENGTHS = tuple(Symbol(f"h_{i}", positive=True) for i in (1, 2))
"""The lengths of the two substeps of a composition's base, where they differ."""


@dataclass(frozen=True)
class Sites:
    """Symbols for the values of quantities at the two ends of an interval, and of controls on it.

    With nodal controls `left_controls` and `right_controls` differ, else both are the interval's own. Controls at
    stages have values of their own at each of the scheme's points, in order, and the interval has no others.
    """

    left: tuple[Symbol, ...]
    right: tuple[Symbol, ...]
    left_controls: tuple[Symbol, ...]
    right_controls: tuple[Symbol, ...]
    stage_controls: tuple[tuple[Symbol, ...], ...] = ()

    @property
    def of_interval(self) -> tuple[Symbol, ...]:
        """Return the controls of an interval, stage by stage."""
        return tuple(u for stage in self.stage_controls or (self.left_controls,) for u in stage)

    def controls_at(self, point: int, c: Expr) -> list[Expr]:
        """Return the controls at a point of the scheme, whose abscissa in the step is c.

        They are the point's own, or the interval's, or on the line between the controls of both nodes.
        """
        if self.stage_controls:
            return list(self.stage_controls[point])
        return [between(a, b, c) for a, b in zip(self.left_controls, self.right_controls, strict=True)]

    @property
    def nodal(self) -> bool:
        """Return True if controls belong to nodes."""
        return self.left_controls != self.right_controls


@dataclass(frozen=True)
class PathValue:
    """A path condition, or the bound of a state, at one point of an interval, whose abscissa `c` lies in [0, 1]."""

    condition: Condition
    abscissa: Expr
    value: Expr
    is_bound: bool = False


@dataclass(frozen=True)
class StateValue:
    """The value of a coordinate or rate inside an interval: an unknown of the interval, or where a field is evaluated.

    The abscissa lies strictly between 0 and 1. At the ends of an interval the nodes have the values.
    """

    quantity: Symbol
    abscissa: Expr
    value: Expr


def repeated(scheme: Scheme) -> tuple[tuple[Symbol, ...], Scheme]:
    """Return the symbols of lengths in a step, and its scheme: the base of a composition, or the scheme itself."""
    count = len(scheme.parts[0]) if scheme.parts else 1
    lengths = (STEP,) if count == 1 else LENGTHS[:count]
    return lengths, scheme.part(lengths, STEP)


def at_nodes(symbols: Iterable[Symbol], suffix: str) -> tuple[Symbol, ...]:
    """Return the symbols for the values of quantities at a node (`r` -> `r_k`)."""
    return tuple(Symbol(f"{symbol.name}{suffix}", real=True) for symbol in symbols)


def sites(model: Model, quantities: Sequence[Symbol], controls: str, points: int) -> Sites:
    """Return symbols for quantities at both nodes and for the controls of an interval with some points of a scheme."""
    left_u = at_nodes(model.controls, "_k")
    right_u = at_nodes(model.controls, "_k1") if controls == "nodal" else left_u
    numbers = range(1, points + 1) if controls == "stages" else ()
    stages = tuple(at_nodes(model.controls, f"_stage{i}_k") for i in numbers)
    return Sites(at_nodes(quantities, "_k"), at_nodes(quantities, "_k1"), left_u, right_u, stages)


def distinct(values: Sequence[PathValue]) -> tuple[PathValue, ...]:
    """Return each condition once, where it has the same value at several points, as a bound on a control has."""
    first: dict[tuple[str, Expr], PathValue] = {}
    for value in values:
        first.setdefault((value.condition.name, value.value), value)
    return tuple(first.values())


def strictly_inside(values: Iterable[StateValue]) -> tuple[StateValue, ...]:
    """Return each value once, without those at the ends of an interval or outside it, as in some compositions."""
    return tuple(dict.fromkeys(v for v in values if v.abscissa.is_positive and (1 - v.abscissa).is_positive))


def substitute(
    model: Model, function: Expr, position: Sequence[Expr], rate: Sequence[Expr], controls: Sequence[Expr], c: Expr
) -> Expr:
    """Return the value of a function of (q, rates, u, t) at a point of the interval with the abscissa c in [0, 1]."""
    values = dict(zip(model.coordinates, position, strict=True))
    values |= dict(zip(model.rates, rate, strict=True))
    values |= dict(zip(model.controls, controls, strict=True))
    values[model.time] = model.time + sympy.expand(c * STEP)
    return sympy.sympify(function).xreplace(values)


FRACTION = Symbol("fraction", nonnegative=True)
"""The fraction of an interval at which the motion is evaluated."""
_HALF = Rational(1, 2)
_POLYNOMIALS: dict[int, tuple[Expr, tuple[Expr, ...], tuple[Expr, ...]]] = {
    0: (FRACTION, (), ()),
    1: (
        FRACTION**2 * (3 - 2 * FRACTION),
        (FRACTION * (1 - FRACTION) ** 2,),
        (-(FRACTION**2) * (1 - FRACTION),),
    ),
    2: (
        FRACTION**3 * (10 - 15 * FRACTION + 6 * FRACTION**2),
        (FRACTION * (1 - FRACTION) ** 3 * (1 + 3 * FRACTION), _HALF * FRACTION**2 * (1 - FRACTION) ** 3),
        (-(FRACTION**3) * (1 - FRACTION) * (4 - 3 * FRACTION), _HALF * FRACTION**3 * (1 - FRACTION) ** 2),
    ),
}
"""Hermite's polynomials on [0, 1], by the number of derivatives at each node.

The first one multiplies the change of the value, the others the derivatives at the left and the right node.
"""


def continued(
    model: Model, derivatives: int, q: Sites, p: Sites, field: Sequence[Expr], abscissae: Sequence[Expr]
) -> list[Expr]:
    """Return the states at FRACTION, from time derivatives at both nodes, the first of which is the `field`.

    Without `derivatives`, controls have no effect. `abscissae` belong to controls at stages.
    """
    control_rates = [Dummy(f"rate of {u}", real=True) for u in model.controls]
    functions = [tuple(field)][:derivatives]
    if derivatives > 1:
        # The time derivative of the field along the motion.
        symbols = (model.time, *model.coordinates, *model.rates, *model.controls)
        rates = dict(zip(symbols, (S.One, *field, *control_rates), strict=True))
        functions.append(tuple(sympy.Add(*(sympy.diff(f, x) * rate for x, rate in rates.items())) for f in field))
    change, *shares = _POLYNOMIALS[derivatives]
    nodes = ((q.left, p.left, S.Zero), (q.right, p.right, S.One))
    states = [x0 + change * (x1 - x0) for x0, x1 in zip((*q.left, *p.left), (*q.right, *p.right), strict=True)]
    for (position, rate, c), polynomials in zip(nodes, shares, strict=True):
        controls, slopes = _controls(q, abscissae, c)
        values = {symbol: slope / STEP for symbol, slope in zip(control_rates, slopes, strict=True)}
        for power, (polynomial, of_order) in enumerate(zip(polynomials, functions, strict=True), start=1):
            for i, f in enumerate(of_order):
                at_node = substitute(model, f, position, rate, controls, c).xreplace(values)
                states[i] += STEP**power * polynomial * at_node
    return states


def _controls(sites: Sites, abscissae: Sequence[Expr], c: Expr) -> tuple[list[Expr], list[Expr]]:
    """Return the controls at the fraction c of an interval, and their derivatives by it.

    Controls at stages are on the polynomial through them; of two stages at one time the first one counts.
    """
    if not sites.stage_controls:
        slopes = [b - a for a, b in zip(sites.left_controls, sites.right_controls, strict=True)]
        return [a + c * slope for a, slope in zip(sites.left_controls, slopes, strict=True)], slopes
    at_abscissae = dict(reversed(list(zip(abscissae, sites.stage_controls, strict=True))))
    values = [
        sympy.interpolate([(at, controls[j]) for at, controls in at_abscissae.items()], FRACTION)
        for j in range(len(sites.stage_controls[0]))
    ]
    slopes = [sympy.diff(value, FRACTION).subs(FRACTION, c) for value in values]
    return [value.subs(FRACTION, c) for value in values], slopes


def observed_at(model: Model, position: Sequence[Expr], rate: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return the observed expressions, where coordinates and rates at FRACTION have these values."""
    return tuple(substitute(model, o.expression, position, rate, model.controls, FRACTION) for o in model.observed)


_LONG = 80
"""Least number of operations of a discrete Lagrangian whose variation is taken as a whole."""


@dataclass(frozen=True)
class VariationalInterval:
    """Discrete Lagrangian Ld(q_k, q_k1), discrete forces f-, f+ and discrete cost Cd on one interval.

    `integrals` are the integrands of the model's conditions on integrals, integrated by the same rule as the cost.
    `observed` are the quantities of the model's measurements, at FRACTION of the interval. Where the motion of an
    interval is no straight line, Ld depends also on the coordinates at `inner` points, one point after the other, at
    the fractions `inner_abscissae` of the step, and is stationary there up to `force_inner`. Then `slopes` holds the
    derivatives of Ld by the coordinates at the left node, at inner points and at the right node, made from the
    derivatives of L: the differentiation of Ld itself would take long. `impulse` is the gain of momentum on an
    interval, sum_i w_i h (L_q + f): the sum of all balances, in which velocities and their coefficients cancel.
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
        """Return the forced discrete Legendre transform p_k = -D1 Ld - f-."""
        return tuple(-d - f for d, f in zip(self._derivatives(self.q.left), self.force_minus, strict=True))

    @property
    def right_momentum(self) -> tuple[Expr, ...]:
        """Return the forced discrete Legendre transform p_k1 = D2 Ld + f+."""
        return tuple(d + f for d, f in zip(self._derivatives(self.q.right), self.force_plus, strict=True))

    def _derivatives(self, coordinates: Sequence[Symbol]) -> list[Expr]:
        """Return the derivatives of Ld by coordinates at nodes or inner points."""
        if not self.slopes:
            return list(gradient(self.lagrangian, coordinates))
        known = dict(zip((*self.q.left, *self.inner, *self.q.right), self.slopes, strict=True))
        return [known[q] for q in coordinates]

    @property
    def inner_balance(self) -> tuple[Expr, ...]:
        """Return the forced discrete Euler-Lagrange equations D_i Ld + f_i at the inner points."""
        return tuple(d + f for d, f in zip(self._derivatives(self.inner), self.force_inner, strict=True))

    def virtual_work(self, displacements: Sequence[Symbol], impulses: Sequence[Expr]) -> Expr:
        """Return the work of -p_k, p_k1, inner balances and impulses along left, right and inner displacements.

        A long Ld is differentiated in the direction of the displacements instead of by each coordinate. This keeps
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
    slopes = [[sympy.S.Zero] * len(model.coordinates) for _ in rule.nodes]
    impulse = [sympy.S.Zero] * len(model.coordinates)
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
        if not inner:
            continue
        # Derivatives of Ld by each value of the motion, sum_i w_i (h l_j(c_i) L_q + l_j'(c_i) L_v), and the impulse.
        by_position = [at(slope, c, here) for slope in gradient(model.function, model.coordinates)]
        by_velocity = [at(slope, c, here) for slope in gradient(model.function, model.rates)]
        for node, share, rate in zip(slopes, motion.shares(c), motion.rates(c), strict=True):
            for i, (force, momentum) in enumerate(zip(by_position, by_velocity, strict=True)):
                node[i] += sympy.expand(point.weight * share) * STEP * force
                node[i] += sympy.expand(point.weight * rate) * momentum
        for i, (force, f) in enumerate(zip(by_position, model.force, strict=True)):
            impulse[i] += point.weight * STEP * (force + at(f, c, here))
    minus, *between, plus = (tuple(node) for node in forces)
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
        slopes=tuple(slope for node in slopes for slope in node) if inner else (),
        impulse=tuple(impulse) if inner else (),
        observed=observed_at(model, motion.position(FRACTION), motion.velocity(FRACTION)) if model.observed else (),
        inside=strictly_inside(evaluated),
    )


@dataclass(frozen=True)
class OneStepInterval:
    """Equations of one step in (q_k, p_k), inner stages and (q_k1, p_k1), each an expression that must vanish.

    The equations for the stages come first, then the coordinates, then the momenta. A first-order
    system has no momenta. `integrals` are the integrands of the model's conditions on integrals, integrated like the
    cost. `observed` are the quantities of the model's measurements, at FRACTION of the interval. `inside` are the
    values of states where an implicit scheme evaluates the dynamics inside the interval, and of the inner stages.
    """

    q: Sites
    p: Sites
    stages: tuple[Symbol, ...]
    equations: tuple[Expr, ...]
    cost: Expr
    path: tuple[PathValue, ...] = ()
    integrals: tuple[Expr, ...] = ()
    observed: tuple[Expr, ...] = ()
    inside: tuple[StateValue, ...] = ()


def one_step_interval(model: Model, scheme: Scheme, controls: str = "interval") -> OneStepInterval:
    """Write the equations of a scheme's `Step`, those that lead to inner states first.

    The model is of Hamiltonian form, with forced Hamilton's equations, or of first-order form x' = f(x, u, t). The cost
    is integrated like a further state, so that it has the scheme's order.
    """
    step, states, dimension = scheme.step(), (*model.coordinates, *model.rates), len(model.coordinates)
    q_sites = sites(model, model.coordinates, controls, len(step.points))
    p_sites = sites(model, model.rates, controls, len(step.points))
    inner = (at_nodes(states, f"_stage{n}") for n in range(1, len(step.abscissae)))
    values = [(*q_sites.left, *p_sites.left), *inner, (*q_sites.right, *p_sites.right)]

    integrands = (model.cost or sympy.S.Zero, *(integral.expression for integral in model.integrals))
    motion = model.dynamics
    if model.form != "first-order":
        forced = zip(gradient(model.function, model.coordinates), model.force, strict=True)
        motion = (*gradient(model.function, model.rates), *(f - slope for slope, f in forced))
    field = (*motion, *integrands)
    rates, integrals, path = list[list[Expr]](), [sympy.S.Zero] * len(integrands), list[PathValue]()
    evaluated, elapsed = list[StateValue](), (sympy.S.Zero, *step.abscissae)
    for i, point in enumerate(step.points):
        shares = [point.position] * dimension + [point.momentum] * len(model.rates)
        state = [_sum((share, values[n][x]) for n, share in of_x) for x, of_x in enumerate(shares)]
        for x, of_x in enumerate(shares):
            evaluated += [StateValue(states[x], elapsed[n], values[n][x]) for n, _ in of_x]
            evaluated.append(StateValue(states[x], _sum((share, elapsed[n]) for n, share in of_x), state[x]))
        at = (state[:dimension], state[dimension:], q_sites.controls_at(i, point.abscissa), point.abscissa)
        at_point = [substitute(model, f, *at) for f in field]
        rates.append(at_point[: len(states)])
        densities = zip(integrals, at_point[len(states) :], strict=True)
        integrals = [total + STEP * point.weight * density for total, density in densities]
        path += [PathValue(g, point.abscissa, substitute(model, g.expression, *at)) for g in model.path]

    unknowns, equations = list[Symbol](), list[Expr]()
    for n, of_kind in enumerate(zip(step.positions, step.momenta, strict=True), start=1):
        for x, value in enumerate(values[n]):
            if update := of_kind[x >= dimension]:
                rate = _sum(zip(update.weights, (own[x] for own in rates), strict=True))
                unknowns.append(value)
                equations.append(value - values[update.begin][x] - STEP * update.fraction * rate)
    stages = unknowns[: -len(states)]
    if step.is_chain:
        read = {symbol for value in (*integrals, *(g.value for g in path)) for symbol in value.free_symbols}
        stages, equations = _without_idle_stages(values[1:-1], equations, read)
    cost, *others = integrals
    observed = ()
    if model.observed:
        abscissae = [point.abscissa for point in step.points]
        inner_states = continued(model, scheme.dense_derivatives, q_sites, p_sites, motion, abscissae)
        observed = observed_at(model, inner_states[:dimension], inner_states[dimension:])
    inside = () if step.is_explicit else strictly_inside(evaluated)
    return OneStepInterval(
        q_sites, p_sites, tuple(stages), tuple(equations), cost, distinct(path), tuple(others), observed, inside
    )


def _sum(terms: Iterable[tuple[Expr, Expr]]) -> Expr:
    return sum((factor * value for factor, value in terms if factor != 0), sympy.S.Zero)


def _without_idle_stages(
    stages: Sequence[tuple[Symbol, ...]], equations: Sequence[Expr], read: Collection[Symbol]
) -> tuple[list[Symbol], list[Expr]]:
    """Drop each stage at which no field is evaluated, as in the trapezoidal rule, by adding the adjacent steps.

    The sum is free of such a stage because one step ends where the next begins. Stages in cost, integrals or path
    conditions (`read`) stay.
    """
    size = len(stages[0]) if stages else len(equations)
    kept, steps = list[Symbol](), [list(equations[i : i + size]) for i in range(0, len(equations), size)]
    joined = [steps[0]]
    for stage, step in zip(stages, steps[1:], strict=True):
        # A step is linear in its ends unless its field is evaluated there.
        sums = [before + after for before, after in zip(joined[-1], step, strict=True)]
        if any(x in read for x in stage) or any(total.has(*stage) for total in sums):
            kept += stage
            joined.append(step)
        else:
            joined[-1] = sums
    return kept, [equation for step in joined for equation in step]
