"""Drive a mass on a spring by an actuator with a tiny time constant.

x'' = a - x, lag a' = 1 - a, from rest. The problem is linear: its exact motion is a matrix exponential. All quantities
are nondimensional.
"""

from codegen import Simulate, parameters, states


def problem() -> Simulate:
    x, v, a = states("x v a")
    (lag,) = parameters(lag=1e-9)
    return Simulate(dynamics={x: v, v: a - x, a: (1 - a) / lag}, start={x: 0, v: 0, a: 0}, duration=10, steps=200)
