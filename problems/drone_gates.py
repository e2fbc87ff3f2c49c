"""Fly a drone through gates and home again, soon and with little effort (an example of this project's own).

A point of unit mass in a vertical plane has a thrust (a, b) of limited size, weight g, and linear drag. Through two
gates it flies at a point; the third is a slit between two heights, and opens at a certain time only. When it is at
which gate is to be found, along with the motion: the times are free, but in the order of the gates.
"""

from sympy import Eq

from codegen import Control, Waypoint, controls, free_parameter, parameters, states


def problem() -> Control:
    x, z, v, w = states("x z v w")
    a, b = controls("a b")
    T = free_parameter("T", 6, lower=1)
    thrust, g, drag, opening, effort = parameters(thrust=16.0, g=9.81, drag=0.3, opening=4.2, effort=0.002)
    return Control(
        dynamics={x: v, z: w, v: a - drag * v, w: b - drag * w - g},
        cost=effort * (a**2 + b**2),
        terminal_cost=T,
        duration=T,
        steps=120,
        start={x: 0, z: 0, v: 0, w: 0},
        end={x: 0, z: 0, v: 0, w: 0},
        path={"thrust": a**2 + b**2 <= thrust**2},
        waypoints=[
            [Eq(x, 4), Eq(z, 3)],
            [Eq(x, 9), Eq(z, 0)],
            Waypoint([Eq(x, 6), z >= 4, z <= 5], window=(opening, None)),
        ],
        guess={b: g},
    )
