"""Drive a weak car out of a valley in the least time, by swinging back and forth.

The units are those of the benchmark of reinforcement learning, whose steps are of length one. Source: Moore (1990);
dymos, example "mountain_car".
"""

from sympy import cos, sin

from codegen import Control, control, free_parameter, states, time


def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    T = free_parameter("T", 500, lower=0)
    return Control(
        dynamics={x: v, v: 0.001 * u - 0.0025 * cos(3 * x)},
        terminal_cost=T,
        duration=T,
        start={x: -0.5, v: 0},
        end_conditions=[x >= 0.5, v >= 0],
        bounds={u: (-1, 1), x: (-1.2, 0.5), v: (-0.07, 0.07)},
        guess={u: sin(time())},
        steps=400,
    )
