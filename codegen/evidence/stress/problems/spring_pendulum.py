"""Follow a mass that swings on a stiff spring.

H = |p|^2/2 + k (|q| - 1)^2/2 + y: unit mass, natural length and gravity, stiffness k. Source: Ascher and Reich, The
midpoint scheme and variants for Hamiltonian systems: advantages and pitfalls, SIAM Journal on Scientific Computing 21
(1999). All quantities are nondimensional.
"""

from sympy import sqrt

from codegen import Simulate, canonical_pairs, parameters


def problem() -> Simulate:
    (x, y), (px, py) = canonical_pairs("x y", "px py")
    (k,) = parameters(k=10000)
    stretch = sqrt(x**2 + y**2) - 1
    return Simulate(
        hamiltonian=(px**2 + py**2) / 2 + k * stretch**2 / 2 + y,
        start={x: 1, y: 0, px: 0, py: 0},
        duration=10,
        steps=1000,
    )
