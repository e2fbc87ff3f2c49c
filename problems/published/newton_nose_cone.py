"""Shape a body of revolution, of length and radius 1, such that Newton's drag on it is least.

The height y over the radius r falls from a flat nose of radius r_0, which is free; the body is concave. The drag is
4 r_0^2 plus the integral of 8 r/(1 + y'^2). Source: Newton, Principia (1687), book II, proposition 34; yapss, example
"newton".
"""

from codegen import Control, control, free_parameter, states, time


def problem() -> Control:
    y, slope = states("y slope")
    curvature = control("curvature")
    r_0 = free_parameter("r_0", 0, lower=0, upper=0.7)
    r = r_0 + time()
    return Control(
        dynamics={y: slope, slope: curvature},
        cost=8 * r / (1 + slope**2),
        terminal_cost=4 * r_0**2,
        duration=1 - r_0,
        bounds={y: (0, 1), slope: (None, 0), curvature: (None, 0)},
        steps=500,
    )
