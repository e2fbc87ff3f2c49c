"""Find the curve on which a bead slides between two points in the least time.

The bead starts at rest at (0, 10) m and slides without friction to (10, 5) m, under g = 9.80665 m/s^2; the control is
the angle between its direction and the vertical. Source: Johann Bernoulli (1696); data of dymos's brachistochrone
example, whose published time is 1.8016 s. The optimum is a cycloid, so the time is known in closed form,
T* = 1.801603122 s.
"""

from sympy import cos, pi, sin

from codegen import Control, control, free_parameter, parameters, states, time
from codegen.drawing import Mark, Mass, Trail


def problem() -> Control:
    x, y, v = states("x y v")
    theta = control("theta")
    t = time()
    g, x1, y0, y1 = parameters(g=9.80665, x1=10, y0=10, y1=5)
    T = free_parameter("T", guess=2, lower=0.5, upper=10)

    return Control(
        dynamics={x: v * sin(theta), y: -v * cos(theta), v: g * cos(theta)},
        cost=1,
        duration=T,
        start={x: 0, y: y0, v: 0},
        end={x: x1, y: y1},
        bounds={theta: (0, pi)},
        guess={v: 5 * t, theta: (1 + 8 * t) * pi / 18},
        steps=50,
        drawing=[Trail((x, y), label="path"), Mark((0, y0)), Mark((x1, y1)), Mass((x, y), 0.2)],
    )
