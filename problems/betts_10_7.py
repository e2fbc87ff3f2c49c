"""Hold a cubic system near rest for a very long time between two given states.

x' = -x^3 + u from x(0) = 1 to x(T) = 3/2; the cost is the integral of x^2 + u^2. All that happens, happens within a few
units of time from the two ends. Source: Betts, Practical Methods for Optimal Control (2nd edition, 2010), example 10.7,
T = 10000; published value 6.7241, as opty's gallery quotes it. All quantities are nondimensional. In the limit of long
times the Hamilton-Jacobi equation gives the closed form J* = F(1) + F(9/4) + (81/16 - 1)/2 = 6.724113810 with
F(y) = (y sqrt(1 + y^2) + asinh y)/2.
"""

from codegen import Control, control, parameters, states


def problem(duration: float = 10000) -> Control:
    (x,) = states("x")
    u = control("u")
    T, a, b = parameters(T=duration, a=1, b=1.5)

    return Control(
        dynamics={x: -(x**3) + u},
        cost=x**2 + u**2,
        duration=T,
        start={x: a},
        end={x: b},
        guess={x: 0},
        steps=100000,
    )
