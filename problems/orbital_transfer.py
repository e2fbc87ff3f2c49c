"""Transfer a satellite between two coplanar circular orbits with the least effort.

The satellite (mass m) circles the Earth (gravitational parameter GM) at radius r0 and is to circle it at radius r1
after the given number of revolutions. Its engine acts along the direction of increasing angle; the cost is the
integral of the squared thrust. Source: after Junge, Marsden and Ober-Bloebaum (2005), Discrete mechanics and optimal
control, IFAC Proceedings 38; Ober-Bloebaum, Junge and Marsden (2011), Discrete mechanics and optimal control: an
analysis, ESAIM: COCV 17. All quantities are nondimensional.
"""

from sympy import cos, pi, sin, sqrt

from codegen import Control, control, coordinates, parameters
from codegen.drawing import Arrow, Circle, Mass, Trail


def problem(revolutions: float = 1) -> Control:
    (r, phi), (dr, dphi) = coordinates("r phi")
    u = control("u")
    m, GM, r0, r1, p = parameters(m=100, GM=0.40038, r0=5, r1=6, revolutions=revolutions)

    place = r * cos(phi), r * sin(phi)
    thrust = Arrow(place, (-50 * u * sin(phi), 50 * u * cos(phi)), label="thrust")
    orbits = [Circle((0, 0), r0, label="first orbit"), Circle((0, 0), r1, label="last orbit")]
    return Control(
        lagrangian=m / 2 * (dr**2 + r**2 * dphi**2) + GM * m / r,
        force={phi: r * u},
        cost=u**2,
        duration=pi * p * (sqrt(r0**3 / GM) + sqrt(r1**3 / GM)),
        start={r: r0, phi: 0, dr: 0, dphi: sqrt(GM / r0**3)},
        end={r: r1, phi: 2 * pi * p, dr: 0, dphi: sqrt(GM / r1**3)},
        steps=100,
        drawing=[Mass((0, 0), 1, label="earth"), *orbits, Trail(place, label="transfer"), Mass(place, 0.2), thrust],
    )
