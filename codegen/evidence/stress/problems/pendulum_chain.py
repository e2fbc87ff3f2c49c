"""Follow a chain of pendulums that falls from a horizontal start.

Point masses on massless rods of unit length, absolute angles, 0 when hanging. `heavy` is the mass of the first bob,
`light` the mass of the last bob; all others have unit mass. Source: Goldstein, Poole and Safko, Classical Mechanics
(2002), chapter 1, exercises. All quantities are nondimensional.
"""

from sympy import cos, pi, sin

from codegen import Simulate, coordinates, parameters


def problem(links: int = 2) -> Simulate:
    angles, rates = coordinates(" ".join(f"q{i}" for i in range(1, links + 1)))
    heavy, light, g = parameters(heavy=1, light=1, g=1)
    masses = [heavy, *[1] * (links - 2), light]
    lagrangian, height, forward, upward = 0, 0, 0, 0
    for mass, angle, rate in zip(masses, angles, rates, strict=True):
        height -= cos(angle)
        forward += cos(angle) * rate
        upward += sin(angle) * rate
        lagrangian += mass * (forward**2 + upward**2) / 2 - mass * g * height
    return Simulate(
        lagrangian=lagrangian,
        start=dict.fromkeys(angles, pi / 2) | dict.fromkeys(rates, 0),
        duration=10,
        steps=1000,
    )
