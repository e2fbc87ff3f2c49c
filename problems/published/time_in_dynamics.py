"""Move an integrator by one unit in a free time T that multiplies its rate as well.

With x' = T u the constant control 1/T^2 is best, so that T + 1/(2 T^3) is to be least: T = 1.5^(1/4), and the cost is
1.4755759. Source: CTDirect, test problem "bolza_freetf".
"""

from codegen import Control, control, free_parameter, states


def problem() -> Control:
    (x,) = states("x,")
    u = control("u")
    T = free_parameter("T", 1, lower=0.1)
    return Control(
        dynamics={x: T * u},
        cost=u**2 / 2,
        terminal_cost=T,
        duration=T,
        start={x: 0},
        end={x: 1},
        bounds={x: (0, None)},
        steps=50,
    )
