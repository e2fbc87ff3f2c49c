"""Steer a thrust of constant size such that a height of 5 is reached, at a horizontal speed of 45, in the least time.

The point mass starts from rest; the acceleration of size 100 has the angle u. Where it arrives horizontally is free.
The tangent of the optimal angle is linear in time. Source: Bryson and Ho, Applied Optimal Control (1975), section 2.4;
Betts, Practical Methods for Optimal Control, 3rd ed., example 10.73; COPS 3.0, "particle steering"; PSOPT, example
"lts".
"""

from sympy import cos, pi, sin

from codegen import Control, control, free_parameter, states


def problem() -> Control:
    x, y, p, q = states("x y p q")
    u = control("u")
    T = free_parameter("T", 1, lower=0)
    return Control(
        dynamics={x: p, y: q, p: 100 * cos(u), q: 100 * sin(u)},
        terminal_cost=T,
        duration=T,
        start={x: 0, y: 0, p: 0, q: 0},
        end={y: 5, p: 45, q: 0},
        bounds={u: (-pi / 2, pi / 2)},
        steps=500,
    )
