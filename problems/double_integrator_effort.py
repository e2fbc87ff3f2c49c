"""Move a cart to a given place and to rest there in a given time with the least effort.

A unit mass starts at rest at 0 and is to be at rest at x_f after the time T; the cost is the integral of the squared
force. Source: Bryson and Ho, Applied Optimal Control (1975), section 2.3. All quantities are nondimensional. The
optimum is known in closed form: f = 6 x_f/T^2 (1 - 2t/T), and J* = 12 x_f^2/T^3; with N intervals the discrete optimum
is J* N^2/(N^2 - 1).
"""

from codegen import Control, control, coordinate, parameters


def problem(target: float = 1, time: float = 1) -> Control:
    x, dx = coordinate("x")
    f = control("f")
    x_f, T = parameters(x_f=target, T=time)

    return Control(
        lagrangian=dx**2 / 2,
        force={x: f},
        cost=f**2,
        duration=T,
        start={x: 0, dx: 0},
        end={x: x_f, dx: 0},
        steps=50,
    )
