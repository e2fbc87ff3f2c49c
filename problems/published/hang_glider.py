"""Fly a hang glider through a thermal such that it comes as far as possible.

SI units; c is the lift coefficient. The glider starts and ends in its steady glide, and comes down by 100 m. Source:
Bulirsch, Nerz, Pesch and von Stryk (1993); Betts, Practical Methods for Optimal Control, 3rd ed., example 10.54; COPS
3.0 has rounder constants and 1247.97. PSOPT's "glider" takes drag without the updraft and is another problem.
"""

from sympy import exp, sqrt

from codegen import Control, control, free_parameter, states, time


def problem() -> Control:
    x, y, v_x, v_y = states("x y v_x v_y")
    c = control("c")
    t = time()
    T = free_parameter("T", 100, lower=1)
    X = (x / 100 - 2.5) ** 2
    w = v_y - 2.5 * (1 - X) * exp(-X)
    s = sqrt(v_x**2 + w**2)
    drag = (0.034 + 0.069662 * c**2) * 1.13 * 14 / 2 * s**2
    lift = c * 1.13 * 14 / 2 * s**2
    return Control(
        dynamics={
            x: v_x,
            y: v_y,
            v_x: -(lift * w + drag * v_x) / (100 * s),
            v_y: (lift * v_x - drag * w) / (100 * s) - 9.80665,
        },
        terminal_cost=-x,
        duration=T,
        start={x: 0, y: 1000, v_x: 13.2275675, v_y: -1.28750052},
        end={y: 900, v_x: 13.2275675, v_y: -1.28750052},
        bounds={c: (0, 1.4), x: (0, None), v_x: (0, None)},
        guess={x: 12.5 * t, c: 0.5 + t / 200},
        steps=400,
    )
