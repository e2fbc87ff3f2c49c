"""Bring a unit mass to rest such that the integral of the square of its place is least.

The force is bounded by 1 and chatters: the optimal control jumps infinitely often before the arrival, at times that
form a geometric sequence. Source: Fuller (1960); CTDirect, test problem "fuller", by Bocop.
"""

from codegen import Control, control, states


def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    return Control(
        dynamics={x: v, v: u},
        cost=x**2,
        duration=3.5,
        start={x: 0, v: 1},
        end={x: 0, v: 0},
        bounds={u: (-1, 1)},
        steps=500,
    )
