"""Steer an integrator through a given point on its way, with the least sum of squares of state and control.

At t = 0.75, which becomes a node, x = 0.9. Source: PSOPT, example "interior_point"; the optimum consists of hyperbolic
functions.
"""

from sympy import Eq

from codegen import Control, control, state


def problem() -> Control:
    x, u = state("x"), control("u")
    return Control(
        dynamics={x: u},
        cost=x**2 + u**2,
        duration=1,
        steps=400,
        start={x: 1},
        end={x: 0.75},
        at={0.75: [Eq(x, 0.9)]},
    )
