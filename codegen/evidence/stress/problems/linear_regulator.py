"""Steer a decaying scalar state between two values; the cost of state and control leads to boundary layers.

x' = -a x + u from `begin` to `goal`, cost (x^2 + eps^2 u^2)/2. With a = 0 the state is far from zero only in layers of
width eps at the two ends; with a = eps = 1 and a long duration the problem is hypersensitive. Source: Rao and Mease,
Eigenvector approximate dichotomic basis method for solving hyper-sensitive optimal control problems (2000). All
quantities are nondimensional.
"""

from codegen import Control, control, parameters, states


def problem() -> Control:
    (x,) = states("x")
    u = control("u")
    a, eps, T, begin, goal = parameters(a=1, eps=1, T=10, begin=1.5, goal=1)
    return Control(
        dynamics={x: -a * x + u},
        cost=(x**2 + eps**2 * u**2) / 2,
        duration=T,
        start={x: begin},
        end={x: goal},
        steps=100,
    )
