"""Carry a spherical pendulum through a quarter turn, at constant height at both ends, with the least effort.

A unit mass on a rod of unit length, g = 9.81; two horizontal forces act on it. It rests at 45 degrees to the vertical
and is to be at rest at the same height, a quarter turn further, after one unit of time. `cartesian` describes it by
its place (x, y, z) with the rod as a holonomic constraint, `angles` by the angle theta to the vertical and the azimuth
phi: the two forms have the same optimum, which each approaches with order 2. Source of the method: Leyendecker,
Ober-Bloebaum, Marsden and Ortiz, Discrete mechanics and optimal control for constrained systems (2010).
"""

from typing import Literal

from sympy import Expr, cos, pi, sin, sqrt

from codegen import Control, controls, coordinates, parameters, time
from codegen.drawing import Arrow, Item, Mass, Rod, Trail


def seen(x: Expr, y: Expr, z: Expr) -> tuple[Expr, Expr]:
    """The plane point at which a point in space is drawn: y to the right, z upwards, x towards the beholder."""
    return y - x / 2, z - x / 3


def drawing(x: Expr, y: Expr, z: Expr, u1: Expr, u2: Expr) -> list[Item]:
    """The pendulum, its path with the shadow on the floor below, and the horizontal force."""
    bob, floor = seen(x, y, z), seen(x, y, -1.3)
    force = Arrow(bob, seen(u1 / 20, u2 / 20, 0), label="force")
    return [Trail(bob), Trail(floor, label="shadow of the path"), Rod((0, 0), bob), Mass(bob, 0.05), force]


def problem(form: Literal["cartesian", "angles"] = "cartesian") -> Control:
    u1, u2 = controls("u1 u2")
    t = time()
    (g,) = parameters(g=9.81)
    s = 1 / sqrt(2)

    if form == "angles":
        (theta, phi), (dtheta, dphi) = coordinates("theta phi")
        return Control(
            lagrangian=(dtheta**2 + sin(theta) ** 2 * dphi**2) / 2 + g * cos(theta),
            force={
                theta: cos(theta) * (u1 * cos(phi) + u2 * sin(phi)),
                phi: sin(theta) * (u2 * cos(phi) - u1 * sin(phi)),
            },
            cost=u1**2 + u2**2,
            duration=1,
            start={theta: pi / 4, phi: 0, dtheta: 0, dphi: 0},
            end={theta: pi / 4, phi: pi / 2, dtheta: 0, dphi: 0},
            guess={phi: pi * t / 2},
            steps=50,
            drawing=drawing(sin(theta) * cos(phi), sin(theta) * sin(phi), -cos(theta), u1, u2),
        )

    (x, y, z), (dx, dy, dz) = coordinates("x y z")
    return Control(
        lagrangian=(dx**2 + dy**2 + dz**2) / 2 - g * z,
        force={x: u1, y: u2},
        cost=u1**2 + u2**2,
        duration=1,
        start={x: s, y: 0, z: -s, dx: 0, dy: 0, dz: 0},
        end={x: 0, y: s, z: -s, dx: 0, dy: 0, dz: 0},
        constraint=[x**2 + y**2 + z**2 - 1],
        guess={x: s * cos(pi * t / 2), y: s * sin(pi * t / 2), z: -s},
        steps=50,
        drawing=drawing(x, y, z, u1, u2),
    )
