"""Let a handle turn about its middle axis of inertia in free flight: it turns over again and again.

The attitude is a rotation, and the motion follows Euler's equations: omega is an elliptic function of time. The angular
momentum in space is conserved to rounding. Source: Landau and Lifshitz (1976), Mechanics, section 37; Ashbaugh,
Chicone and Cushman (1991), The twisting tennis racket.
"""

from sympy import Matrix, diag, eye

from codegen import Simulate, rotation
from codegen.drawing import Mass, Rod, Trail


def problem() -> Simulate:
    R, omega = rotation("R")
    inertia = diag(3, 2, 1)
    bar, stem = (R @ Matrix(place) for place in ((1, 0, 0), (0, 0.7, 0)))
    return Simulate(
        lagrangian=omega.dot(inertia * omega) / 2,
        duration=40,
        start={R: eye(3), omega: (1e-3, 2, 0)},
        steps=2000,
        drawing=[Trail(bar), Rod(-bar, bar), Rod((0, 0, 0), stem), Mass(stem, 0.06)],
    )
