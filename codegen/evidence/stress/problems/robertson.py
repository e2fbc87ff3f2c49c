"""Follow three reactions with rates from 0.04 to 3e7.

Source: Hairer and Wanner (1996), Solving ordinary differential equations II, IV.1 (Robertson 1966). All quantities are
nondimensional.
"""

from codegen import Simulate, states


def problem() -> Simulate:
    x, y, z = states("x y z")
    slow, fast, back = 0.04 * x, 3e7 * y**2, 1e4 * y * z
    dynamics = {x: back - slow, y: slow - back - fast, z: fast}
    return Simulate(dynamics=dynamics, start={x: 1, y: 0, z: 0}, duration=40, steps=400)
