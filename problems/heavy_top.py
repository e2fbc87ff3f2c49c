"""Let a heavy symmetric top spin about its tip: its axis nods between two angles while it turns about the vertical.

The attitude is a rotation. Energy, and the angular momenta about the vertical and about the axis of the top, are
constants of the motion. Source: Goldstein, Poole and Safko (2002), Classical mechanics, section 5.7.
"""

from sympy import Matrix, diag

from codegen import Simulate, parameters, rotation
from codegen.drawing import Mass, Rod, Trail


def problem() -> Simulate:
    R, omega = rotation("R")
    m, g, length, spin = parameters(m=1, g=9.81, length=1, spin=30)
    inertia = diag(1.2, 1.2, 0.3)
    top = R @ Matrix([0, 0, length])
    return Simulate(
        lagrangian=omega.dot(inertia * omega) / 2 - m * g * top[2],
        duration=6,
        start={R: ([1, 0, 0], 0.5), omega: (0, 0, spin)},
        steps=2000,
        drawing=[Trail(top), Rod((0, 0, 0), top), Mass(top, 0.06)],
    )
