"""Enclose the largest area by a closed curve of length 1.

The curve is followed at unit speed; its centroid, two integrals, is at the origin. The optimum is a circle, the area
1/(4 pi). Where on the circle the curve starts does not matter. Source: yapss, example "isoperimetric".
"""

from sympy import Eq, cos, pi, sin

from codegen import Control, controls, states, time


def problem() -> Control:
    x, y = states("x y")
    a, b = controls("a b")
    t = time()
    return Control(
        dynamics={x: a, y: b},
        maximise=(y * a - x * b) / 2,
        duration=1,
        integral=[Eq(x, 0), Eq(y, 0)],
        periodic=[x, y],
        path=[Eq(a**2 + b**2, 1)],
        guess={x: cos(2 * pi * t), y: -sin(2 * pi * t), a: -sin(2 * pi * t), b: -cos(2 * pi * t)},
        steps=2000,
    )
