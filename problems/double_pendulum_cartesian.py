"""Let a double pendulum swing, in Cartesian coordinates with two rods as holonomic constraints.

Two unit masses hang on rods of unit length, g = 9.81; both rods are horizontal at the start, at rest. `cartesian`
describes the masses by their places (x1, y1) and (x2, y2), `angles` by the angles a and b of the rods to the vertical:
both are the same chaotic motion. The place and the velocity of each mass satisfy the constraints to rounding after
every step (RATTLE), and the energy has no drift. Source: Hairer, Lubich and Wanner (2006), Geometric numerical
integration, sections VII.1.3 and VII.1.4.
"""

from typing import Literal

from sympy import Expr, cos, pi, sin

from codegen import Simulate, coordinates, parameters
from codegen.drawing import Item, Mass, Rod, Trail


def drawing(first: tuple[Expr, Expr], second: tuple[Expr, Expr]) -> list[Item]:
    """Both rods with their masses, and the path of the second mass."""
    return [Trail(second), Rod((0, 0), first), Rod(first, second), Mass(first, 0.06), Mass(second, 0.06)]


def problem(form: Literal["cartesian", "angles"] = "cartesian") -> Simulate:
    (g,) = parameters(g=9.81)
    if form == "angles":
        (a, b), (da, db) = coordinates("a b")
        first = sin(a), -cos(a)
        return Simulate(
            lagrangian=da**2 + db**2 / 2 + da * db * cos(a - b) + g * (2 * cos(a) + cos(b)),
            duration=5,
            start={a: pi / 2, b: pi / 2, da: 0, db: 0},
            steps=1000,
            drawing=drawing(first, (first[0] + sin(b), first[1] - cos(b))),
        )
    (x1, y1, x2, y2), (dx1, dy1, dx2, dy2) = coordinates("x1 y1 x2 y2")
    return Simulate(
        lagrangian=(dx1**2 + dy1**2 + dx2**2 + dy2**2) / 2 - g * (y1 + y2),
        constraint=[x1**2 + y1**2 - 1, (x2 - x1) ** 2 + (y2 - y1) ** 2 - 1],
        duration=5,
        start={x1: 1, y1: 0, x2: 2, y2: 0, dx1: 0, dy1: 0, dx2: 0, dy2: 0},
        steps=1000,
        drawing=drawing((x1, y1), (x2, y2)),
    )
