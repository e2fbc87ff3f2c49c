"""Follow a chain of masses with alternating stiff and soft springs (Fermi, Pasta, Ulam and Tsingou).

Six masses between two walls: the springs inside three pairs are harmonic with frequency omega, the springs between
pairs and to the walls are quartic. Source: Hairer, Lubich and Wanner (2006), Geometric numerical integration, I.5.1.
All quantities are nondimensional.
"""

from codegen import Simulate, canonical_pairs, parameters


def problem() -> Simulate:
    numbers = range(1, 7)
    q, p = canonical_pairs(" ".join(f"q{i}" for i in numbers), " ".join(f"p{i}" for i in numbers))
    (omega,) = parameters(omega=50)
    stiff = sum((q[i + 1] - q[i]) ** 2 for i in (0, 2, 4)) * omega**2 / 4
    soft = q[0] ** 4 + sum((q[i + 1] - q[i]) ** 4 for i in (1, 3)) + q[5] ** 4
    # The first pair is stretched about its centre and moves apart, as in the first figure of the source.
    return Simulate(
        hamiltonian=sum(momentum**2 for momentum in p) / 2 + stiff + soft,
        start=dict.fromkeys((*q, *p), 0) | {q[0]: 0.7, q[1]: 0.72, p[1]: 1.4},
        duration=1,
        steps=1000,
    )
