"""Ride along the contour of mountains with a stiff linear system of four states.

The sum of the squared states must stay above a terrain of four peaks. Source: Betts, Practical Methods for Optimal
Control, 3rd ed., example 10.1. The published value belongs to +2 w in the second equation and to the bound without the
relaxation by 0.01 in opty's example.
"""

from sympy import exp

from codegen import Control, controls, states, time


def problem() -> Control:
    a, b, c, d = states("a b c d")
    u, w = controls("u w")
    t = time()
    peaks = ((3, 12, 3), (3, 10, 6), (3, 6, 10), (8, 4, 15))
    terrain = sum(height * exp(-width * (t - place) ** 2) for height, width, place in peaks) + 0.01
    square = a**2 + b**2 + c**2 + d**2
    return Control(
        dynamics={a: -10 * a + u + w, b: -2 * b + u + 2 * w, c: -3 * c + 5 * d + u - w, d: 5 * c - 3 * d + u + 3 * w},
        cost=100 * square + 0.01 * (u**2 + w**2),
        duration=20,
        start={a: 2, b: 1, c: 2, d: 1},
        end={a: 2, b: 3, c: 1, d: -2},
        path=[square >= terrain],
        steps=2000,
    )
