"""Move a planar ducted fan sideways by one unit, from rest to rest, with little thrust and in little time.

u and w are the thrusts across and along the fan, alpha its tilt. The cost is the mean of the squares plus 1000 T.
Source: Graichen and Petit (2009); control-toolbox, OptimalControlProblems.jl, "ducted_fan" (250 trapezoidal
intervals).
"""

from sympy import cos, pi, sin

from codegen import Control, controls, free_parameter, states


def problem() -> Control:
    x, v, y, q, alpha, b = states("x v y q alpha b")
    u, w = controls("u w")
    T = free_parameter("T", 1, lower=0)
    return Control(
        dynamics={
            x: v,
            v: (u * cos(alpha) - w * sin(alpha)) / 2.2,
            y: q,
            q: (-4 + u * sin(alpha) + w * cos(alpha)) / 2.2,
            alpha: b,
            b: 4 * u,
        },
        cost=(2 * u**2 + w**2) / T,
        terminal_cost=1000 * T,
        duration=T,
        start={x: 0, v: 0, y: 0, q: 0, alpha: 0, b: 0},
        end={x: 1, v: 0, y: 0, q: 0, alpha: 0, b: 0},
        bounds={alpha: (-pi / 6, pi / 6), u: (-5, 5), w: (0, 17)},
        steps=250,
    )
