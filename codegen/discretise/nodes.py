"""The two nodes of an interval: symbols and values there, controls between them, values at points inside.

The motion inside an interval, at any fraction of it, as the scheme continues it there. For a scheme in states that is
the polynomial with their values, and as many derivatives as the scheme says, at both nodes. Without derivatives it is a
straight line, of order two, the collocation polynomial of the midpoint rule; with first ones a cubic, of order four,
that of Hermite-Simpson and, where it is a parabola, of the trapezoidal rule; with second ones too it has order six. A
discrete Lagrangian has a polynomial of its own (`between`). Source: Hairer, Norsett and Wanner
(1993), Solving ordinary differential equations I, II.6.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import sympy
from sympy import Dummy, Expr, Rational, S, Symbol

from codegen.model import Condition, Model
from codegen.schemes import Scheme

_ABSCISSA = Symbol("abscissa", real=True)
"""The fraction of a step, in basis polynomials."""


@dataclass(frozen=True)
class PolynomialMotion:
    """The polynomial in time, in Lagrange's form, through `values` of the coordinates at the `nodes`."""

    step: Symbol
    nodes: tuple[Expr, ...]
    values: tuple[tuple[Symbol, ...], ...]

    def shares(self, c: Expr) -> list[Expr]:
        """The basis polynomials at c, with which the values enter the position."""
        if len(self.nodes) == 2:
            return [1 - c, c]
        return [sympy.expand(basis.subs(_ABSCISSA, c)) for basis in self._basis()]

    def rates(self, c: Expr) -> list[Expr]:
        """The derivatives of the basis polynomials at c."""
        return [sympy.expand(sympy.diff(basis, _ABSCISSA).subs(_ABSCISSA, c)) for basis in self._basis()]

    def position(self, c: Expr) -> list[Expr]:
        """The coordinates at c; but on a straight line written in differences from the first value."""
        if len(self.nodes) == 2:
            return [between(left, right, c) for left, right in zip(*self.values, strict=True)]
        positions = []
        for first, *others in zip(*self.values, strict=True):
            terms = (share * (q - first) for share, q in zip(self.shares(c)[1:], others, strict=True) if share != 0)
            positions.append(first + sum(terms, sympy.S.Zero))
        return positions

    def velocity(self, c: Expr) -> list[Expr]:
        """The derivative by time at c, written in differences from the first value, of which no digits cancel."""
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
    """The point at the fraction c of the line from left to right."""
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
    stages have values of their own at each of the scheme's points, in order, and none of the interval.
    """

    left: tuple[Symbol, ...]
    right: tuple[Symbol, ...]
    left_controls: tuple[Symbol, ...]
    right_controls: tuple[Symbol, ...]
    stage_controls: tuple[tuple[Symbol, ...], ...] = ()

    @property
    def of_interval(self) -> tuple[Symbol, ...]:
        """The controls that an interval has, stage by stage."""
        return tuple(u for stage in self.stage_controls for u in stage) if self.stage_controls else self.left_controls

    @property
    def controlled(self) -> str:
        """Where controls live: interval, nodal or stages."""
        return "stages" if self.stage_controls else "nodal" if self.nodal else "interval"

    def controls_at(self, point: int, c: Expr) -> list[Expr]:
        """The controls at a point of the scheme, c being its abscissa in the step.

        They are the point's own, or the interval's, or on the line between those of both nodes.
        """
        if self.stage_controls:
            return list(self.stage_controls[point])
        return [between(a, b, c) for a, b in zip(self.left_controls, self.right_controls, strict=True)]

    @property
    def nodal(self) -> bool:
        """Whether controls live on nodes."""
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
    """What a step repeats, and the symbols for lengths in it: a composition's base, or the scheme with h alone."""
    count = len(scheme.parts[0]) if scheme.parts else 1
    lengths = (STEP,) if count == 1 else LENGTHS[:count]
    return lengths, scheme.part(lengths, STEP)


def at_nodes(symbols: Iterable[Symbol], suffix: str) -> tuple[Symbol, ...]:
    """The symbols that hold the values of quantities at a node (`r` -> `r_k`)."""
    return tuple(Symbol(f"{symbol.name}{suffix}", real=True) for symbol in symbols)


def sites(model: Model, quantities: Sequence[Symbol], controls: str, points: int) -> Sites:
    """Symbols for quantities at both nodes and for the controls of an interval on which a scheme has some points."""
    left_u = at_nodes(model.controls, "_k")
    right_u = at_nodes(model.controls, "_k1") if controls == "nodal" else left_u
    stages = tuple(at_stage(model.controls, i) for i in range(1, points + 1)) if controls == "stages" else ()
    return Sites(at_nodes(quantities, "_k"), at_nodes(quantities, "_k1"), left_u, right_u, stages)


def at_stage(controls: Iterable[Symbol], number: int) -> tuple[Symbol, ...]:
    """The symbols of controls at a point of an interval, counted from one (`u` -> `u_stage1_k`)."""
    return at_nodes(at_nodes(controls, f"_stage{number}"), "_k")


def distinct(values: Sequence[PathValue]) -> tuple[PathValue, ...]:
    """Each condition once, where it has the same value at several points, as a bound on an interval's control has."""
    first: dict[tuple[str, Expr], PathValue] = {}
    for value in values:
        first.setdefault((value.condition.name, value.value), value)
    return tuple(first.values())


def strictly_inside(values: Iterable[StateValue]) -> tuple[StateValue, ...]:
    """Each value once, without those at the ends of an interval or outside it, where some compositions lead."""
    return tuple(dict.fromkeys(v for v in values if v.abscissa.is_positive and (1 - v.abscissa).is_positive))


def substitute(
    model: Model, function: Expr, position: Sequence[Expr], rate: Sequence[Expr], controls: Sequence[Expr], c: Expr
) -> Expr:
    """The value of a function of (q, rates, u, t) at a point of the interval, c being its abscissa in [0, 1]."""
    values = dict(zip(model.coordinates, position, strict=True))
    values |= dict(zip(model.rates, rate, strict=True))
    values |= dict(zip(model.controls, controls, strict=True))
    values[model.time] = model.time + sympy.expand(c * STEP)
    return sympy.sympify(function).xreplace(values)


FRACTION = Symbol("fraction", nonnegative=True)
"""The fraction of an interval at which the motion is wanted."""
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
"""By the number of derivatives at each node: what multiplies the change of value, and the derivatives at both nodes.

These are Hermite's polynomials on [0, 1].
"""


def continued(
    model: Model, derivatives: int, q: Sites, p: Sites, field: Sequence[Expr], abscissae: Sequence[Expr]
) -> list[Expr]:
    """The states at FRACTION, from so many `derivatives` by time at both nodes, the first of which is the `field`.

    Where there are none, controls do not matter. `abscissae` are those of controls at stages.
    """
    turning = [Dummy(f"rate of {u}", real=True) for u in model.controls]
    of_order = [tuple(field)][:derivatives]
    if derivatives > 1:
        of_order.append(tuple(_along_motion(f, model, field, turning) for f in field))
    change, *shares = _POLYNOMIALS[derivatives]
    nodes = ((q.left, p.left, S.Zero), (q.right, p.right, S.One))
    found = [x0 + change * (x1 - x0) for x0, x1 in zip((*q.left, *p.left), (*q.right, *p.right), strict=True)]
    for (position, rate, c), polynomials in zip(nodes, shares, strict=True):
        controls, slopes = _controls(q, abscissae, c)
        rates = {symbol: slope / STEP for symbol, slope in zip(turning, slopes, strict=True)}
        for power, (polynomial, functions) in enumerate(zip(polynomials, of_order, strict=True), start=1):
            for i, f in enumerate(functions):
                there = substitute(model, f, position, rate, controls, c).xreplace(rates)
                found[i] += STEP**power * polynomial * there
    return found


def _along_motion(f: Expr, model: Model, field: Sequence[Expr], turning: Sequence[Symbol]) -> Expr:
    """The derivative by time of a function along the motion, on which controls change at the rates `turning`."""
    symbols = (model.time, *model.coordinates, *model.rates, *model.controls)
    rates = (S.One, *field, *turning)
    return sympy.Add(*(sympy.diff(f, symbol) * rate for symbol, rate in zip(symbols, rates, strict=True)))


def _controls(sites: Sites, abscissae: Sequence[Expr], c: Expr) -> tuple[list[Expr], list[Expr]]:
    """The controls at the fraction c of an interval, and their derivatives by it.

    Controls at stages are on the polynomial through them; where two stages are at one time, the first of both is.
    """
    if not sites.stage_controls:
        slopes = [b - a for a, b in zip(sites.left_controls, sites.right_controls, strict=True)]
        return [a + c * slope for a, slope in zip(sites.left_controls, slopes, strict=True)], slopes
    own = dict(reversed(list(zip(abscissae, sites.stage_controls, strict=True))))
    values = [
        sympy.interpolate([(at, controls[j]) for at, controls in own.items()], FRACTION)
        for j in range(len(sites.stage_controls[0]))
    ]
    slopes = [sympy.diff(value, FRACTION).subs(FRACTION, c) for value in values]
    return [value.subs(FRACTION, c) for value in values], slopes


def observed_at(model: Model, position: Sequence[Expr], rate: Sequence[Expr]) -> tuple[Expr, ...]:
    """What measurements are of, where coordinates and rates at FRACTION have these values."""
    return tuple(substitute(model, o.expression, position, rate, model.controls, FRACTION) for o in model.observed)
