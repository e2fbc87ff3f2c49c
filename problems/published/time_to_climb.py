"""Climb with an F-4 to 20 km and Mach 1 in the least time, with thrust, lift, drag and the atmosphere from tables.

State: altitude h in m, speed v in m/s, angle of the path gamma in rad, mass m in kg; control: angle of attack alpha.
Source: Bryson, Desai and Hoffman (1969), Energy-state approximation in performance optimization of supersonic aircraft,
J. Aircraft 6; numbers as in OpenMDAO/dymos, examples/min_time_climb, which finds 321 s. The tables are made by
tests/f4_model.py.
"""

from sympy import Eq, cos, pi, sin

from codegen import Control, Table, control, free_parameter, parameters, states, time


def problem() -> Control:
    h, v, gamma, m = states("h v gamma m")
    alpha, T = control("alpha"), free_parameter("T", 300, lower=100, upper=600)
    S, g, Isp = parameters(S=49.2386, g=9.80665, Isp=1600)

    thrust = Table("../data/f4_thrust.csv", inputs=("mach", "altitude"), output="thrust")
    C_D0, C_La, kappa = (Table("../data/f4_aerodynamics.csv", "mach", output) for output in ("C_D0", "C_La", "kappa"))
    density, sound = (Table("../data/f4_atmosphere.csv", "altitude", output) for output in ("density", "sound"))

    M = v / sound(h)
    pressure = density(h) * v**2 / 2
    lift = pressure * S * C_La(M) * alpha
    drag = pressure * S * (C_D0(M) + kappa(M) * C_La(M) * alpha**2)
    return Control(
        dynamics={
            h: v * sin(gamma),
            v: (thrust(M, h) * cos(alpha) - drag) / m - g * sin(gamma),
            gamma: (thrust(M, h) * sin(alpha) + lift) / (m * v) - g * cos(gamma) / v,
            m: -thrust(M, h) / (g * Isp),
        },
        terminal_cost=T,
        duration=T,
        start={h: 100, v: 135.964, gamma: 0, m: 19030.468},
        end={h: 20000, gamma: 0},
        end_conditions=[Eq(v, sound(h))],
        bounds={h: (100, 20000), v: (10, None), gamma: (-1.5, 1.5), alpha: (-8 * pi / 180, 8 * pi / 180)},
        path={"Mach number": M <= 1.8},
        guess={v: 136 + time() / 2, m: 19030 - 7 * time()},
        steps=100,
    )
