"""Carry a container from a ship to a truck such that it swings as little as possible.

x1 and x2 are the trolley's place and the length of the rope in m, x3 is the swing angle, x4 to x6 are their rates; u1
drives the trolley and u2 the hoist, within the motors' limits, in 9 s. The cost is half the integral of the squares of
swing angle and its rate. Source: Sakawa and Shindo, Optimal control of container cranes, Automatica 18 (1982); Teo,
Goh and Wong (1991). Data and published value 5.1513e-3 of PSOPT's example "crane".
"""

from sympy import cos, sin

from codegen import Control, controls, parameters, states
from codegen.drawing import Box, Ground, Rod, Trail


def problem() -> Control:
    x1, x2, x3, x4, x5, x6 = states("x1 x2 x3 x4 x5 x6")
    u1, u2 = controls("u1 u2")
    T, trolley, rope = parameters(T=9, trolley=17.2656, rope=27.0756)
    speed, hoist, drive, down, up = parameters(speed=2.5, hoist=1, drive=2.83374, down=0.80865, up=0.71265)

    load = x1 + x2 * sin(x3), -x2 * cos(x3)
    return Control(
        dynamics={
            x1: x4,
            x2: x5,
            x3: x6,
            x4: u1 + trolley * x3,
            x5: u2,
            x6: -(u1 + rope * x3 + 2 * x5 * x6) / x2,
        },
        cost=(x3**2 + x6**2) / 2,
        duration=T,
        start={x1: 0, x2: 22, x3: 0, x4: 0, x5: -1, x6: 0},
        end={x1: 10, x2: 14, x3: 0, x4: 2.5, x5: 0, x6: 0},
        bounds={x4: (-speed, speed), x5: (-hoist, hoist), u1: (-drive, drive), u2: (-down, up)},
        steps=90,
        drawing=[Ground((14, 0.5), (-4, 0.5)), Trail(load), Box((x1, 0), 2, 1), Rod((x1, 0), load), Box(load, 3, 1.5)],
    )
