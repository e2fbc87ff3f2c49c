"""Drop a unit mass onto a stiff spring with a damper, which act only below the ground.

x'' = stiffness d(x) - damping d(x)/(d(x) + width) x' - 1 with the depth d(x) = (sqrt(x^2 + width^2) - x)/2. All
quantities are nondimensional.
"""

from sympy import sqrt

from codegen import Simulate, parameters, states


def problem() -> Simulate:
    x, v = states("x v")
    stiffness, damping, width = parameters(stiffness=1e6, damping=1e3, width=1e-4)
    depth = (sqrt(x**2 + width**2) - x) / 2
    force = stiffness * depth - damping * depth / (depth + width) * v
    return Simulate(dynamics={x: v, v: force - 1}, start={x: 0.1, v: 0}, duration=1, steps=4000)
