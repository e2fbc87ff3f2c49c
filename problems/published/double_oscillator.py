"""Damp two coupled masses under a periodic load by a variable damper, with free initial velocities.

The first mass is driven by sin t; the damping of the second is modulated by u, |u| <= 1. Source: Coudurier, Lepreux
and Petit (2018); control-toolbox, OptimalControlProblems.jl, "double_oscillator"; value by CTBenchmarks.jl with
N = 1000 and 2000.
"""

from sympy import pi, sin

from codegen import Control, control, states, time


def problem() -> Control:
    a, b, c, d = states("a b c d")
    u = control("u")
    return Control(
        dynamics={
            a: c,
            b: d,
            c: (-103 * a + 3 * b + sin(time())) / 100,
            d: 1.5 * (a - b) - 0.25 * (1 - u) * d,
        },
        cost=(a**2 + b**2 + u**2) / 2,
        duration=2 * pi,
        start={a: 0, b: 0},
        bounds={u: (-1, 1)},
        steps=1000,
    )
