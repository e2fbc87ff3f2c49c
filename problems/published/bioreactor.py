"""Produce as much methane as possible from algae and bacteria that share one reactor, under the light of days.

y is the density of algae, s that of the substrate and b that of bacteria; u is the flow from the first to the second
tank. A day takes 10 units of time, of which 5 are dark. One day is periodic; with days=30 the states at the start are
free between bounds. The value is the negative of the methane produced. Source: Bayen, Mairet and Mazenc (2013); Bocop;
CTDirect, test problem "bioreactor".
"""

from sympy import Max, pi, sin

from codegen import Control, control, states, time


def problem(days: int = 1) -> Control:
    y, s, b = states("y s b")
    u = control("u")
    light = Max(0, sin(2 * pi * time() / 10)) ** 2
    growth = 0.1 * s / (s + 0.05)
    if days == 1:
        ends = {"periodic": [y, s, b], "start_conditions": [y >= 1, b >= 1]}
    else:
        ends = {"start_conditions": [y >= 0.05, y <= 0.25, s >= 0.5, s <= 5, b >= 0.5, b <= 3]}
    return Control(
        dynamics={
            y: light * y / (1 + y) - (0.005 + u) * y,
            s: -growth * b + u * (y - s),
            b: (growth - u) * b,
        },
        cost=-growth * b / 3,
        duration=10 * days,
        bounds={y: (0, None), s: (0, None), b: (0.001, None), u: (0, 1)},
        steps=200 * days,
        **ends,
    )
