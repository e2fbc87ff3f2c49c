"""Steer a cubic system between two given states in a long time, most of which it spends near rest.

x' = -x^3 + u from 1 to 3/2, cost x^2 + u^2. Source: Betts, Practical Methods for Optimal Control (2010), example 10.7.
All quantities are nondimensional.
"""

from codegen import Control, control, parameters, states


def problem() -> Control:
    (x,) = states("x")
    u = control("u")
    T, begin, goal = parameters(T=10, begin=1, goal=1.5)
    return Control(
        dynamics={x: -(x**3) + u},
        cost=x**2 + u**2,
        duration=T,
        start={x: begin},
        end={x: goal},
        guess={x: 0},
        steps=100,
    )
