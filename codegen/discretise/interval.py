"""The expressions of one time interval for a model and a scheme.

On the Lagrangian side these are the discrete Lagrangian, the discrete forces and the discrete cost. On the Hamiltonian
side, and for first-order systems, they are the equations of one step and the discrete cost. On both sides path
conditions hold at the points where the scheme evaluates the dynamics. Values at the left and right node have the
suffixes `_k` and `_k1`; h is the length of the interval and t the time at its left end.

Measurements need the motion at any fraction of an interval. For a scheme in states the motion is the polynomial through
the values at both nodes, with the number of derivatives there that the scheme declares. Without derivatives it is a
straight line of order two, the collocation polynomial of the midpoint rule. With first derivatives it is a cubic of
order four, as in Hermite-Simpson; for the trapezoidal rule the cubic is a parabola. With second derivatives the order
is six. A discrete Lagrangian has its own polynomial (`PolynomialMotion`). Source: Hairer, Norsett and Wanner (1993),
Solving ordinary differential equations I, II.6.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import sympy
from sympy import Dummy, Expr, Rational, S, Symbol

from codegen.discretise.model.definitions import Condition, Model
from codegen.discretise.schemes.base import Scheme
from codegen.runtime.record import Kind
from codegen.symbolic.derivatives import gradient, variation

_ABSCISSA = Symbol("abscissa", real=True)
"""The variable of basis polynomials: the fraction of a step."""


@dataclass(frozen=True)
class PolynomialMotion:
    """The Lagrange polynomial in time through the `values` of the coordinates at the fractions `nodes` of a step."""

    step: Symbol
    nodes: tuple[Expr, ...]
    values: tuple[tuple[Symbol, ...], ...]

    def shares(self, c: Expr) -> list[Expr]:
        """Return the basis polynomials at the fraction c, which are the weights of the values in the position."""
        if len(self.nodes) == 2:
            return [1 - c, c]
        return [sympy.expand(basis.subs(_ABSCISSA, c)) for basis in self._basis()]

    def rates(self, c: Expr) -> list[Expr]:
        """Return the derivatives of the basis polynomials at the fraction c."""
        return [sympy.expand(sympy.diff(basis, _ABSCISSA).subs(_ABSCISSA, c)) for basis in self._basis()]

    def position(self, c: Expr) -> list[Expr]:
        """Return the coordinates at the fraction c; polynomials of degree 2 or more use differences of values."""
        if len(self.nodes) == 2:
            return [between(left, right, c) for left, right in zip(*self.values, strict=True)]
        positions = []
        for first, *others in zip(*self.values, strict=True):
            terms = (share * (q - first) for share, q in zip(self.shares(c)[1:], others, strict=True) if share != 0)
            positions.append(first + sum(terms, sympy.S.Zero))
        return positions

    def velocity(self, c: Expr) -> list[Expr]:
        """Return the velocities at the fraction c, in differences of values, so that no digits cancel."""
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
"""The lengths of the two substeps in the base scheme of a composition, if they differ."""


@dataclass(frozen=True)
class Sites:
    """Symbols for the values of quantities at the two ends of an interval, and for the controls on the interval.

    With controls at nodes `left_controls` and `right_controls` differ, else both are the controls of the interval.
    `stage_controls` are the controls at each point of the scheme, if controls belong to stages. `controlled` says what
    controls belong to, as in `ControlProgram`.
    """

    left: tuple[Symbol, ...]
    right: tuple[Symbol, ...]
    left_controls: tuple[Symbol, ...]
    right_controls: tuple[Symbol, ...]
    stage_controls: tuple[tuple[Symbol, ...], ...] = ()
    controlled: str = "interval"

    @property
    def of_interval(self) -> tuple[Symbol, ...]:
        """The controls of an interval, stage by stage."""
        return tuple(u for stage in self.stage_controls or (self.left_controls,) for u in stage)

    def controls_at(self, point: int, c: Expr) -> list[Expr]:
        """Return the controls at the point of the scheme with the index `point` and the abscissa c.

        These are the controls of the stage or interval, or lie on the line between the controls of both nodes.
        """
        if self.stage_controls:
            return list(self.stage_controls[point])
        return [between(a, b, c) for a, b in zip(self.left_controls, self.right_controls, strict=True)]

    @property
    def nodal(self) -> bool:
        """True if controls belong to nodes."""
        return self.left_controls != self.right_controls


@dataclass(frozen=True)
class PathValue:
    """The value of a path condition, a bound of a state or a contact law, at an abscissa in [0, 1] of an interval.

    `kind` is the kind of the multiplier.
    """

    condition: Condition
    abscissa: Expr
    value: Expr
    kind: Kind = Kind.PATH


@dataclass(frozen=True)
class StateValue:
    """The value of a coordinate or rate inside an interval: a stage, or a point where the scheme evaluates the field.

    The abscissa lies strictly between 0 and 1, because nodes have the values at the ends of an interval.
    """

    quantity: Symbol
    abscissa: Expr
    value: Expr


def repeated(scheme: Scheme) -> tuple[tuple[Symbol, ...], Scheme]:
    """Return the symbols of the lengths in a step, and the scheme of the step: for a composition, of its base."""
    count = len(scheme.parts[0]) if scheme.parts else 1
    lengths = (STEP,) if count == 1 else LENGTHS[:count]
    return lengths, scheme.part(lengths, STEP)


def at_nodes(symbols: Iterable[Symbol], suffix: str) -> tuple[Symbol, ...]:
    """Return the symbols for the values of quantities at a node (`r` -> `r_k`)."""
    return tuple(Symbol(f"{symbol.name}{suffix}", real=True) for symbol in symbols)


def sites(model: Model, quantities: Sequence[Symbol], controls: str, points: int) -> Sites:
    """Return symbols for quantities at both nodes, and for controls; `points` is the number of points of the scheme."""
    left_u = at_nodes(model.controls, "_k")
    right_u = at_nodes(model.controls, "_k1") if controls in ("linear", "nodal") else left_u
    numbers = range(1, points + 1) if controls == "stages" else ()
    stages = tuple(at_nodes(model.controls, f"_stage{i}_k") for i in numbers)
    controlled = controls if model.controls else "interval"
    return Sites(at_nodes(quantities, "_k"), at_nodes(quantities, "_k1"), left_u, right_u, stages, controlled)


def distinct(values: Sequence[PathValue]) -> tuple[PathValue, ...]:
    """Return each condition once if it has the same value at several points, like a bound on a control."""
    first: dict[tuple[str, Expr], PathValue] = {}
    for value in values:
        first.setdefault((value.condition.name, value.value), value)
    return tuple(first.values())


def strictly_inside(values: Iterable[StateValue]) -> tuple[StateValue, ...]:
    """Return each value inside an interval once; some compositions have values outside."""
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
    """Return the states at FRACTION, by interpolation with time derivatives of order 1 to `derivatives` at both nodes.

    The first derivative is the `field`; `abscissae` belong to controls at stages.
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
    """Return the controls at the fraction c of an interval, and their derivatives with respect to c.

    The polynomial through the controls at stages gives their values; of two stages at one time the first one counts.
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
    """Return the observed expressions at FRACTION, where coordinates and rates have the values position and rate."""
    return tuple(substitute(model, o.expression, position, rate, model.controls, FRACTION) for o in model.observed)


_LONG = 80
"""Least number of operations of a discrete Lagrangian that is differentiated in the direction of displacements."""


@dataclass(frozen=True)
class VariationalInterval:
    """Discrete Lagrangian Ld(q_k, q_k1), discrete forces f-, f+ and discrete cost Cd on one interval.

    `integrals` are the integral constraints' integrands, integrated by the same rule as the cost. `observed` are the
    quantities of the measurements at FRACTION of the interval. Where the motion of an interval is no straight line, Ld
    also depends on the coordinates at `inner` points, point after point, at the fractions `inner_abscissae` of the
    step. There Ld is stationary up to `force_inner`. Then `slopes` are the derivatives of Ld with respect to the
    coordinates at the left node, at inner points and at the right node. They are made from the derivatives of L,
    because the differentiation of Ld is slow. `impulse` is the gain of momentum on an interval, sum_i w_i h (L_q + f):
    the sum of all balances, in which velocities and their coefficients cancel. `inside` are the values of coordinates
    at inner points, and at quadrature points inside the interval.
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
        return tuple(-d - f for d, f in zip(self._derivatives(self.q.left), self.force_minus, strict=True))

    @property
    def right_momentum(self) -> tuple[Expr, ...]:
        """The forced discrete Legendre transform p_k1 = D2 Ld + f+."""
        return tuple(d + f for d, f in zip(self._derivatives(self.q.right), self.force_plus, strict=True))

    def _derivatives(self, coordinates: Sequence[Symbol]) -> list[Expr]:
        """Return the derivatives of Ld with respect to coordinates at nodes or inner points."""
        if not self.slopes:
            return list(gradient(self.lagrangian, coordinates))
        known = dict(zip((*self.q.left, *self.inner, *self.q.right), self.slopes, strict=True))
        return [known[q] for q in coordinates]

    @property
    def inner_balance(self) -> tuple[Expr, ...]:
        """The forced discrete Euler-Lagrange equations D_i Ld + f_i at the inner points."""
        return tuple(d + f for d, f in zip(self._derivatives(self.inner), self.force_inner, strict=True))

    def virtual_work(self, displacements: Sequence[Symbol], impulses: Sequence[Expr]) -> Expr:
        """Return the work of -p_k, p_k1, inner balances and `impulses` along left, right and inner displacements.

        A long Ld is differentiated in the direction of the displacements, not with respect to each coordinate. This
        keeps common terms, such as the speed of a body that depends on many coordinates.
        """
        if self.inner or self.lagrangian.count_ops() < _LONG:
            halves = (*(-p for p in self.left_momentum), *self.right_momentum, *self.inner_balance)
            work = (d * (half + impulse) for d, half, impulse in zip(displacements, halves, impulses, strict=True))
            return sum(work, sympy.S.Zero)
        along = variation(self.lagrangian, dict(zip((*self.q.left, *self.q.right), displacements, strict=True)))
        forces = zip(displacements, (*self.force_minus, *self.force_plus), impulses, strict=True)
        return along + sum((d * (f + impulse) for d, f, impulse in forces), sympy.S.Zero)


def variational_interval(model: Model, scheme: Scheme, controls: str = "interval") -> VariationalInterval:
    """Return L, the work of the forces and the cost, integrated over one interval by the scheme's quadrature rule.

    The virtual work of the forces, h sum_i w_i f(q_i, v_i, u) . dq_i with the variations dq_i of the quadrature points,
    is divided between the ends and the inner points. Controls at nodes are interpolated linearly. With nodal controls
    on a straight line, not the controls but the forces of both nodes are interpolated (except in the cost).
    """
    rule = scheme.discrete_lagrangian()
    q_sites = sites(model, model.coordinates, controls, len(rule.points))
    inner = [at_nodes(model.coordinates, f"_stage{i}") for i in range(1, len(rule.nodes) - 1)]
    motion = PolynomialMotion(STEP, rule.nodes, (q_sites.left, *inner, q_sites.right))

    position, velocity = cache(motion.position), cache(motion.velocity)

    def at(function: Expr, c: Expr, controls: Sequence[Expr]) -> Expr:
        return substitute(model, function, position(c), velocity(c), controls, c) if function != 0 else S.Zero

    def force_at(f: Expr, i: int, c: Expr) -> Expr:
        if q_sites.controlled == "nodal" and not inner:
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
        # Derivatives of Ld with respect to value j, sum_i w_i (h l_j(c_i) L_q + l_j'(c_i) L_v), and the impulse.
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

    The equations for the stages come first, then those for coordinates and momenta. A first-order system has no
    momenta. `integrals` are the integral constraints' integrands, integrated like the cost. `observed` are the
    quantities of the measurements at FRACTION of the interval. `inside` are the values of states at inner stages, and
    where an implicit scheme evaluates the dynamics inside the interval.
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
    """Return the equations of a scheme's `Step`; equations for inner states come first.

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
    """Return stages and equations without stages at which no field is evaluated, as in the trapezoidal rule.

    The sum of the adjacent steps does not contain such a stage, because one step ends where the next begins. Stages
    with symbols in `read` (cost, integrals and path conditions) remain.
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
