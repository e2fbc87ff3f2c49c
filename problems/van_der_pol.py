"""Damp a van der Pol oscillator with a bounded input.

x1' = (1 - x2^2) x1 - x2 + u, x2' = x1, from (0, 1); the cost is the integral of x1^2 + x2^2 + u^2 over 5 time units,
and -0.3 <= u <= 1. Source: Vassiliadis, Computational solution of dynamic optimization problems (1993); data and
published value J = 2.867259538 of the PROPT user's guide (2009), "Van der Pol oscillator". All quantities are
nondimensional.
"""

from codegen import Control, control, parameters, states


def problem() -> Control:
    x1, x2 = states("x1 x2")
    u = control("u")
    T, least, greatest = parameters(T=5, least=-0.3, greatest=1)

    return Control(
        dynamics={x1: (1 - x2**2) * x1 - x2 + u, x2: x1},
        cost=x1**2 + x2**2 + u**2,
        duration=T,
        start={x1: 0, x2: 1},
        end={},
        bounds={u: (least, greatest)},
        steps=100,
    )
