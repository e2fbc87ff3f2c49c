"""Soar in circles without an engine, as an albatross does, in the weakest wind that allows it.

The wind blows along x and grows by beta feet per second with every foot of altitude. The glider, in feet, slugs and
seconds, returns to where it was, turned by a full circle. Its lift coefficient and bank are the controls. Source: Zhao
(2004); yapss, example "dynamic_soaring".
"""

from sympy import cos, pi, rad, sin

from codegen import Control, controls, free_parameter, states, time


def problem() -> Control:
    x, y, altitude, v, gamma, psi = states("x y altitude v gamma psi")
    lift_coefficient, bank = controls("lift_coefficient bank")
    beta = free_parameter("beta", 0.08)
    T = free_parameter("T", 24, lower=10, upper=30)
    m, g = 5.6, 32.2

    pressure = 0.002378 / 2 * v**2 * 45.09703
    lift = pressure * lift_coefficient
    drag = pressure * (0.00873 + 0.045 * lift_coefficient**2)
    climb = v * sin(gamma)
    gust = beta * climb

    turn = 2 * pi * time() / 24
    return Control(
        dynamics={
            x: v * cos(gamma) * sin(psi) + beta * altitude,
            y: v * cos(gamma) * cos(psi),
            altitude: climb,
            v: -drag / m - g * sin(gamma) - gust * cos(gamma) * sin(psi),
            gamma: (lift * cos(bank) - m * g * cos(gamma) + m * gust * sin(gamma) * sin(psi)) / (m * v),
            psi: (lift * sin(bank) - m * gust * cos(psi)) / (m * v * cos(gamma)),
        },
        terminal_cost=beta,
        duration=T,
        start={x: 0, y: 0, altitude: 0},
        end={x: 0, y: 0, altitude: 0},
        periodic={v: 0, gamma: 0, psi: 2 * pi},
        bounds={
            x: (-1500, 1500),
            y: (-1000, 1000),
            altitude: (0, 1000),
            v: (10, 350),
            gamma: (rad(-75), rad(75)),
            psi: (rad(-225), rad(225)),
            lift_coefficient: (0, 1.5),
            bank: (rad(-75), rad(75)),
        },
        path=[lift >= -2 * m * g, lift <= 5 * m * g],
        guess={
            x: 600 * (cos(turn) - 1),
            y: -200 * sin(turn),
            altitude: -0.7 * 600 * (cos(turn) - 1),
            v: 150,
            psi: turn,
            lift_coefficient: 0.5,
            bank: rad(45),
        },
        steps=200,
    )
