"""Raise a satellite from one circular orbit to another in `turns` mean revolutions by tangential thrust.

Mass m, gravitational parameter GM, radii r0 and r1; the cost is the integral of the squared thrust. The parameters may
be in any system of units: the solution in other units is known. Source: Junge, Marsden and Ober-Bloebaum, Discrete
mechanics and optimal control (2005).
"""

from sympy import pi, sqrt

from codegen import Control, control, coordinates, parameters


def problem() -> Control:
    (r, phi), (dr, dphi) = coordinates("r phi")
    u = control("u")
    m, GM, r0, r1, turns = parameters(m=1, GM=1, r0=1, r1=1.2, turns=1)
    return Control(
        lagrangian=m / 2 * (dr**2 + r**2 * dphi**2) + GM * m / r,
        force={phi: r * u},
        cost=u**2,
        duration=pi * turns * (sqrt(r0**3 / GM) + sqrt(r1**3 / GM)),
        start={r: r0, phi: 0, dr: 0, dphi: sqrt(GM / r0**3)},
        end={r: r1, phi: 2 * pi * turns, dr: 0, dphi: sqrt(GM / r1**3)},
        steps=50,
    )
