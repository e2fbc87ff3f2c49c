"""Follow a body on a Kepler ellipse of unit semi-major axis, from its farthest point.

H = |p|^2/2 - mu/|q|. Source: Hairer, Lubich and Wanner (2006), Geometric numerical integration, I.2.1. All quantities
are nondimensional.
"""

from sympy import Rational, sqrt

from codegen import Simulate, canonical_pairs, parameters


def problem() -> Simulate:
    (x, y), (px, py) = canonical_pairs("x y", "px py")
    (mu,) = parameters(mu=1)
    e = Rational(1, 2)
    return Simulate(
        hamiltonian=(px**2 + py**2) / 2 - mu / sqrt(x**2 + y**2),
        start={x: 1 + e, y: 0, px: 0, py: sqrt((1 - e) / (1 + e))},
        duration=10,
        steps=1000,
    )
