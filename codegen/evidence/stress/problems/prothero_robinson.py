"""Follow a slow motion with a fast decay towards it: the damping and the order reduction of schemes.

y' = rate (y - cos t) - sin t, whose solution from y(0) = 1 is cos t. Source: Prothero and Robinson, On the stability
and accuracy of one-step methods for solving stiff systems, Mathematics of Computation 28 (1974). All quantities are
nondimensional.
"""

from sympy import cos, sin

from codegen import Simulate, parameters, states, time


def problem() -> Simulate:
    (y,) = states("y")
    t = time()
    (rate,) = parameters(rate=-1e6)
    return Simulate(dynamics={y: rate * (y - cos(t)) - sin(t)}, start={y: 1}, duration=1, steps=20)
