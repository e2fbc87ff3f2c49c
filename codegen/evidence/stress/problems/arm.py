"""Swing a pendulum by a torque from rest at one angle to rest at another in a given time.

Unit mass and length, gravity g; the cost is the integral of the squared torque. Large turns pass through the upright
position. If both angles are the same equilibrium, no torque is needed. All quantities are nondimensional.
"""

from sympy import cos

from codegen import Control, control, coordinate, parameters


def problem() -> Control:
    q, dq = coordinate("q")
    u = control("u")
    g, T, begin, goal = parameters(g=1, T=1, begin=0, goal=1)
    return Control(
        lagrangian=dq**2 / 2 + g * cos(q),
        force={q: u},
        cost=u**2,
        duration=T,
        start={q: begin, dq: 0},
        end={q: goal, dq: 0},
        steps=50,
    )
