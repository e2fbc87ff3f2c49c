"""Bring a group of hovercraft into a regular polygon with the least effort.

Each craft (mass m, moment of inertia J) has a place (x, y) and a heading theta; the forces f1, along the heading, and
f2, across it, act at the distance r from the centre of mass. The craft start at rest side by side on the x axis. After
one unit of time they are to be at rest, heading upwards, at the corners of a regular polygon with sides R and centre
(Mx, My), the first at the height of the centre. The cost is the integral of all squared forces. Source: after Junge,
Marsden and Ober-Bloebaum (2005), Discrete mechanics and optimal control, IFAC Proceedings 38. All quantities are
nondimensional.

`minimal` gives each of the polygon's degrees of freedom one condition; `redundant` prescribes all interior angles as
well, of which some follow from others for more than 3 craft. Reference values, N = 20: 1053.518828 for 3 craft,
1821.353364 for 5.
"""

from typing import Literal

from sympy import Expr, acos, cos, pi, sin, sqrt

from codegen import Control, body_number, controls, coordinates, parameters, time
from codegen.drawing import Arrow, Circle, Mark, Mass, Trail


def problem(craft: int = 3, conditions: Literal["minimal", "redundant"] = "minimal") -> Control:
    (x, y, theta), (dx, dy, dtheta) = coordinates("x y theta")
    f1, f2 = controls("f1 f2")
    body, t = body_number(), time()
    r, m, J, R, Mx, My = parameters(r=0.2, m=1, J=0.1, R=1, Mx=2, My=2)

    def corner(i: int) -> tuple[Expr, Expr]:
        return x.of(i % craft), y.of(i % craft)

    def squared_distance(a: tuple[Expr, Expr], b: tuple[Expr, Expr]) -> Expr:
        return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2

    def angle(i: int) -> Expr:
        (xa, ya), (xi, yi), (xb, yb) = corner(i - 1), corner(i), corner(i + 1)
        lengths = squared_distance((xa, ya), (xi, yi)) * squared_distance((xb, yb), (xi, yi))
        return acos(((xa - xi) * (xb - xi) + (ya - yi) * (yb - yi)) / sqrt(lengths))

    radius = R / (2 * sin(pi / craft))
    sides = [squared_distance(corner(i), corner(i + 1)) - R**2 for i in range(craft)]
    centre = [sum(x.of(i) for i in range(craft)) / craft - Mx, sum(y.of(i) for i in range(craft)) / craft - My]
    shape = [squared_distance(corner(i), (Mx, My)) - radius**2 for i in range(craft - 3)]
    if conditions == "redundant" and craft > 3:
        shape = [angle(i) - pi * (craft - 2) / craft for i in range(craft)]

    start_x, corner_angle = 1 + 2 * body / (craft - 1), pi + 2 * pi * body / craft
    target = [Circle((Mx, My), radius, label="final circle"), Mark((Mx, My))]
    heading = Arrow((x, y), (cos(theta) / 3, sin(theta) / 3), label="heading")
    return Control(
        lagrangian=m / 2 * (dx**2 + dy**2) + J / 2 * dtheta**2,
        force={x: cos(theta) * f1 - sin(theta) * f2, y: sin(theta) * f1 + cos(theta) * f2, theta: -r * f2},
        cost=f1**2 + f2**2,
        duration=1,
        start={x: start_x, y: 0, theta: 0, dx: 0, dy: 0, dtheta: 0},
        end={theta: pi / 2, dx: 0, dy: 0, dtheta: 0},
        end_conditions=[*sides, *centre, y.of(0) - My, *shape],
        bodies=craft,
        guess={
            x: (1 - t) * start_x + t * (Mx + radius * cos(corner_angle)),
            y: t * (My + radius * sin(corner_angle)),
            f1: 1,
            f2: 1,
        },
        steps=20,
        drawing=[*target, Trail((x, y)), Mass((x, y), 0.06), heading],
    )
