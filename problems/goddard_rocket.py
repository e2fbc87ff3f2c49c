"""Launch a rocket vertically such that it flies as high as its fuel can bring it.

The state is the distance r from the earth's centre, the speed v and the mass m; the thrust lies between 0 and 3.5, the
drag is 310 v^2 exp(-500 (r - 1)), and 40% of the mass is fuel, all of it to be burnt. The flight's duration is free.
The optimal thrust is full, singular, then zero. Source: Goddard (1919); Dolan, More and Munson, Benchmarking
optimization software with COPS 3.0 (2004), "Goddard rocket"; their value for the greatest r is 1.01283. All quantities
are scaled by their values at the start.
"""

from sympy import exp

from codegen import Control, control, free_parameter, parameters, states, time


def problem() -> Control:
    r, v, m = states("r v m")
    thrust = control("thrust")
    t = time()
    g0, h_c, D_c, m_f, c, greatest = parameters(g0=1, h_c=500, D_c=310, m_f=0.6, c=0.5, greatest=3.5)
    T = free_parameter("T", guess=0.2, lower=0)
    drag = D_c * v**2 * exp(-h_c * (r - 1))

    return Control(
        dynamics={r: v, v: (thrust - drag) / m - g0 / r**2, m: -thrust / c},
        terminal_cost=-r,
        duration=T,
        start={r: 1, v: 0, m: 1},
        end={m: m_f},
        bounds={r: (1, None), v: (0, None), m: (m_f, 1), thrust: (0, greatest)},
        guess={r: 1, v: 5 * t * (1 - 5 * t), thrust: greatest / 2},
        steps=100,
    )
