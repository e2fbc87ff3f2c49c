"""Let a handle turn about its middle axis of inertia in free flight: it turns over again and again.

The attitude is a rotation, and the motion follows Euler's equations: omega is an elliptic function of time. The angular
momentum in space is conserved to rounding. Source: Landau and Lifshitz (1976), Mechanics, section 37; Ashbaugh,
Chicone and Cushman (1991), The twisting tennis racket.
"""

from sympy import Expr, Matrix, diag, eye

from codegen import Simulate, rotation
from codegen.drawing import Item, Mass, Rod


def seen(place: Matrix) -> tuple[Expr, Expr]:
    """Return a place in the plane of the drawing, which is seen along (1, 2, 1)."""
    x, y, z = place
    return (2 * x - y) / 5**0.5, (-x - 2 * y + 5 * z) / 30**0.5


def problem() -> Simulate:
    R, omega = rotation("R")
    inertia = diag(3, 2, 1)
    ends = [seen(R @ Matrix(place)) for place in ((-1, 0, 0), (1, 0, 0), (0, 0, 0), (0, 0.7, 0))]
    drawing: list[Item] = [Rod(ends[0], ends[1]), Rod(ends[2], ends[3]), Mass(ends[3], 0.06)]
    return Simulate(
        lagrangian=omega.dot(inertia * omega) / 2,
        duration=40,
        start={R: eye(3), omega: (1e-3, 2, 0)},
        steps=2000,
        drawing=drawing,
    )
