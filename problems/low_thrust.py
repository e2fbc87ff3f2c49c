"""Bring a spacecraft with a weak engine to the largest possible circular orbit in a given time.

The spacecraft starts on a circular orbit of radius 1; its engine has the thrust 0.1405 or less, in any direction of the
plane, and burns 0.0749 of the initial mass in a unit of time. w1 and w2 are the parts of the full thrust along the
radius and across it. Source: Moyer and Pinkham (1964); Bryson and Ho, Applied Optimal Control (1975), section 2.5,
journey of 193 days from the earth's orbit to that of Mars. Lengths, masses and times are scaled such that radius, mass
and gravitational parameter are 1 at the start. The largest radius is 1.5252777 in the limit.
"""

from sympy import Eq, cos, pi, sin

from codegen import Control, controls, coordinates, parameters, time
from codegen.drawing import Arrow, Circle, Mass, Trail


def problem() -> Control:
    (r, phi), (dr, dphi) = coordinates("r phi")
    w1, w2 = controls("w1 w2")
    t = time()
    thrust, flow, T = parameters(thrust=0.1405, flow=0.0749, T=3.32)
    acceleration, s = thrust / (1 - flow * t), t / T

    sun = [Mass((0, 0), 0.08, label="sun"), Circle((0, 0), 1, label="first orbit")]
    place = r * cos(phi), r * sin(phi)
    push = (w1 * cos(phi) - w2 * sin(phi)) / 3, (w1 * sin(phi) + w2 * cos(phi)) / 3
    return Control(
        lagrangian=(dr**2 + r**2 * dphi**2) / 2 + 1 / r,
        force={r: acceleration * w1, phi: acceleration * r * w2},
        terminal_cost=-r,
        duration=T,
        start={r: 1, phi: 0, dr: 0, dphi: 1},
        end={dr: 0},
        end_conditions=[Eq(r**3 * dphi**2, 1)],
        path=[w1**2 + w2**2 <= 1],
        guess={r: 1 + s**2 * (3 - 2 * s) / 2, phi: T * (s - s**2 / 4), w1: sin(2 * pi * s), w2: cos(2 * pi * s)},
        steps=50,
        drawing=[*sun, Trail(place, label="transfer"), Mass(place, 0.04), Arrow(place, push, label="thrust")],
    )
