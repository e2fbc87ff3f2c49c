"""Control a scalar equation whose rate depends on the state half a unit of time ago.

x'(t) = x(t - 1/2)^2 - u(t) on [0, 2], with x = 1 before and x >= 0.7. The four pieces of length 1/2 run side by side:
what delays the one is the one before it, and the values at which they meet are free parameters. Source: Betts,
Practical Methods for Optimal Control, 3rd ed., example 10.90.
"""

from sympy import Eq

from codegen import Control, controls, free_parameter, states


def problem() -> Control:
    x = states("x_0 x_1 x_2 x_3")
    u = controls("u_0 u_1 u_2 u_3")
    meeting = [free_parameter(f"X_{i}", 1) for i in (1, 2, 3)]
    return Control(
        dynamics={x[i]: (x[i - 1] if i else 1) ** 2 - u[i] for i in range(4)},
        cost=sum(value**2 for value in (*x, *u)),
        duration=0.5,
        start={x[0]: 1},
        start_conditions=[Eq(x[i + 1], meeting[i]) for i in range(3)],
        end_conditions=[Eq(x[i], meeting[i]) for i in range(3)],
        bounds=dict.fromkeys(x, (0.7, None)),
        steps=100,
    )
