"""Swing a pendulum up with the least effort."""

from sympy import cos, pi

from codegen import Control, control, coordinate, parameters


def problem() -> Control:
    theta, omega = coordinate("theta", "omega")
    torque = control("torque")
    m, l, g = parameters(m=1, l=0.5, g=9.81)
    return Control(
        lagrangian=m * l**2 * omega**2 / 2 + m * g * l * cos(theta),
        force={theta: torque},
        cost=torque**2,
        duration=2,
        start={theta: 0, omega: 0},
        end={theta: pi, omega: 0},
        steps=100,
    )
