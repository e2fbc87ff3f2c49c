"""Glide a space shuttle back into the atmosphere such that it reaches the greatest latitude.

Feet, slugs, seconds and radians; the altitude is in units of 1e5 ft, the speed in units of 1e4 ft/s. The angle of
attack alpha and the bank angle are the controls, the flight time is free. With `heat_limit` the heating of the wing's
leading edge stays below that many BTU per square foot and second, 70 in the source; sweeps vary it by the parameter
heat_max of the module. Source: Betts, Practical Methods for Optimal Control, 3rd ed., example 6.1; PSOPT, example
"shuttle_reentry"; dymos, example "reentry".
"""

from sympy import Expr, cos, exp, pi, rad, sin, sqrt

from codegen import Control, controls, free_parameter, parameter, states


def problem(heat_limit: float = 0) -> Control:
    altitude, longitude, latitude, speed, gamma, psi = states("altitude longitude latitude speed gamma psi")
    alpha, bank = controls("alpha bank")
    T = free_parameter("T", 2000, lower=1)

    v, r = 1e4 * speed, 20902900 + 1e5 * altitude
    mass, gravity = 203000 / 32.174, 0.14076539e17 / r**2
    density = 0.002378 * exp(-1e5 * altitude / 23800)
    degrees = 180 / pi * alpha
    pressure = density * v**2 / 2 * 2690
    drag = pressure * (0.07854 - 0.0061592 * degrees + 6.21408e-4 * degrees**2)
    lift = pressure * (-0.20704 + 0.029244 * degrees)

    return Control(
        dynamics={
            altitude: v * sin(gamma) / 1e5,
            longitude: v * cos(gamma) * sin(psi) / (r * cos(latitude)),
            latitude: v * cos(gamma) * cos(psi) / r,
            speed: (-drag / mass - gravity * sin(gamma)) / 1e4,
            gamma: lift * cos(bank) / (mass * v) + cos(gamma) * (v / r - gravity / v),
            psi: lift * sin(bank) / (mass * v * cos(gamma))
            + v * cos(gamma) * sin(psi) * sin(latitude) / (r * cos(latitude)),
        },
        terminal_cost=-latitude,
        duration=T,
        start={altitude: 2.6, longitude: 0, latitude: 0, speed: 2.56, gamma: rad(-1), psi: pi / 2},
        end={altitude: 0.8, speed: 0.25, gamma: rad(-5)},
        bounds={
            altitude: (0, None),
            speed: (1e-4, None),
            latitude: (rad(-89), rad(89)),
            gamma: (rad(-89), rad(89)),
            alpha: (-pi / 2, pi / 2),
            bank: (rad(-89), rad(1)),
        },
        path=[heating(density, v, degrees) <= parameter("heat_max", heat_limit)] if heat_limit else [],
        guess={alpha: 0, bank: rad(1)},
        steps=200,
    )


def heating(density: Expr, v: Expr, degrees: Expr) -> Expr:
    """The heating rate of the wing's leading edge."""
    shape = 1.0672181 - 0.019213774 * degrees + 2.1286289e-4 * degrees**2 - 1.0117249e-6 * degrees**3
    return 17700 * sqrt(density) * (0.0001 * v) ** 3.07 * shape
