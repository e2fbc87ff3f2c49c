"""Follow van der Pol's oscillator along its slow part, with a decay mu times as fast.

y'' = mu ((1 - y^2) y' - y). Source: Hairer and Wanner (1996), Solving ordinary differential equations II, IV.1. All
quantities are nondimensional.
"""

from codegen import Simulate, parameters, states


def problem() -> Simulate:
    y, v = states("y v")
    (mu,) = parameters(mu=1000)
    return Simulate(dynamics={y: v, v: mu * ((1 - y**2) * v - y)}, start={y: 2, v: 0}, duration=0.5, steps=100)
