"""Control a scalar equation whose rate depends on the state half a unit of time ago.

x'(t) = x(t - 1/2)^2 - u(t) on [0, 2], with x = 1 before and x >= 0.7. Source: Betts, Practical Methods for Optimal
Control, 3rd ed., example 10.90.
"""

from codegen import Control, control, state


def problem() -> Control:
    x, u = state("x"), control("u")
    return Control(
        dynamics={x: x.delayed(0.5) ** 2 - u},
        cost=x**2 + u**2,
        duration=2,
        history={x: 1},
        bounds={x: (0.7, None)},
        steps=400,
    )
