"""Dive a missile onto a target from above, in the least time, after a flight close to the ground.

SI units; gamma is the angle of the flight path, alpha the angle of attack. Farther than 2.5 km from the target the
missile stays above 30 m, a bound that a smooth step lifts. Source: Subchan and Zbikowski, Computational Optimal Control
(2009); PSOPT, example "missile".
"""

from sympy import cos, pi, sin, tanh

from codegen import Control, controls, free_parameter, states


def problem() -> Control:
    gamma, v, x, altitude = states("gamma v x altitude")
    thrust, alpha = controls("thrust alpha")
    T = free_parameter("T", 40, lower=0)
    m, g = 1005, 9.81

    density = 3.312e-9 * altitude**2 - 1.142e-4 * altitude + 1.224
    pressure = density * v**2 / 2 * 0.3376
    drag = (-1.9431 * alpha**2 - 0.1499 * alpha + 0.2359) * pressure
    lift = 21.9 * alpha * pressure
    far = (1 + tanh((7500 - x) / 10)) / 2
    return Control(
        dynamics={
            gamma: ((thrust - drag) * sin(alpha) + lift * cos(alpha)) / (m * v) - g * cos(gamma) / v,
            v: ((thrust - drag) * cos(alpha) - lift * sin(alpha)) / m - g * sin(gamma),
            x: v * cos(gamma),
            altitude: v * sin(gamma),
        },
        terminal_cost=T,
        duration=T,
        start={gamma: 0, v: 272, x: 0, altitude: 30},
        end={gamma: -pi / 2, v: 310, x: 10000, altitude: 0},
        bounds={thrust: (1000, 6000), alpha: (-0.3, 0.3), v: (200, 310), altitude: (0, 1900)},
        path=[lift >= -4 * m * g, lift <= 4 * m * g, far * (altitude - 30) + (1 - far) * altitude >= 0],
        steps=400,
    )
