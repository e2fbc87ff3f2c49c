"""The motion inside an interval, at any fraction of it, as the scheme continues it there.

For a scheme in states that is the polynomial with their values, and as many derivatives as the scheme says, at both
nodes. Without derivatives it is a straight line, of order two, the collocation polynomial of the midpoint rule; with
first ones a cubic, of order four, that of Hermite-Simpson and, where it is a parabola, of the trapezoidal rule; with
second ones too it has order six. A discrete Lagrangian has a polynomial of its own
(`codegen.discretise.nodes`). Source: Hairer, Norsett and Wanner (1993), Solving ordinary differential equations
I, II.6.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy
from sympy import Dummy, Expr, Rational, S, Symbol

from codegen.discretise.nodes import STEP, Sites, substitute
from codegen.model import Model

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
