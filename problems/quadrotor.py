"""Fly a planar quadrotor sideways with the least effort.

Two rotors of mass m sit at the distance d to either side of the centre; u1 and u2 are their thrusts, at most 5 m g
either way. From hovering at x = 1 m the quadrotor is to hover at the origin after 1 s; the cost is the integral of
u1^2 + u2^2. Source: data of OptimTraj's quadRotor2d (Kelly, 2015), where the weight of both rotors pulls on the mass of
one; here the mass is 2 m.
"""

from sympy import Expr, cos, sin

from codegen import Control, controls, coordinates, parameters
from codegen.drawing import Arrow, Box, Trail


def problem() -> Control:
    (x, y, theta), (dx, dy, dtheta) = coordinates("x y theta")
    u1, u2 = controls("u1 u2")
    m, d, g, T = parameters(m=0.2, d=0.3, g=9.81, T=1)
    greatest = 5 * m * g

    def thrust(place: Expr, u: Expr) -> Arrow:
        rotor = x + place * cos(theta), y + place * sin(theta)
        return Arrow(rotor, (-u / (10 * m * g) * sin(theta), u / (10 * m * g) * cos(theta)), label="thrust")

    return Control(
        lagrangian=m * (dx**2 + dy**2 + d**2 * dtheta**2) - 2 * m * g * y,
        force={x: -(u1 + u2) * sin(theta), y: (u1 + u2) * cos(theta), theta: d * (u2 - u1)},
        cost=u1**2 + u2**2,
        duration=T,
        start={x: 1, y: 0, theta: 0, dx: 0, dy: 0, dtheta: 0},
        end={x: 0, y: 0, theta: 0, dx: 0, dy: 0, dtheta: 0},
        bounds={u1: (-greatest, greatest), u2: (-greatest, greatest)},
        guess={u1: m * g, u2: m * g},
        steps=50,
        drawing=[Trail((x, y)), Box((x, y), 2 * d, 0.03, theta), thrust(-d, u1), thrust(d, u2)],
    )
