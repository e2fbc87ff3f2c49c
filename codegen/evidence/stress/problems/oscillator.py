"""Follow a harmonic oscillator, whose discrete motion by any scheme has a closed form.

H = (p^2 + omega^2 q^2)/2. Source: Hairer, Lubich and Wanner (2006), Geometric numerical integration, I.5.2 and XIII.1.
All quantities are nondimensional.
"""

from codegen import Simulate, canonical_pair, parameters


def problem() -> Simulate:
    q, p = canonical_pair("q", "p")
    (omega,) = parameters(omega=1)
    return Simulate(hamiltonian=(p**2 + omega**2 * q**2) / 2, start={q: 1, p: 0}, duration=10, steps=100)
