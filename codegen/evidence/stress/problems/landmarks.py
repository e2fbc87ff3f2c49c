"""Move landmarks in the unit disc to their targets along a geodesic, with the clamped plate's Green's function.

H = 1/2 sum_ij p_i . p_j G(q_i, q_j). Source: Mills and Marsland, Interpolating diffeomorphisms and landmark
registration (2005); Boggio (1905) for G. All quantities are nondimensional.
"""

from pathlib import Path

from sympy import log

from codegen import Connect, Pairwise, Points, particles


def problem(landmarks: Points = Path("two_landmarks.csv")) -> Connect:
    i, j = particles("x y", "px py")
    a, b = (1 - sum(x**2 for x in k.q) for k in (i, j))
    s = sum((x - y) ** 2 for x, y in zip(i.q, j.q, strict=True))
    green = a * b / 2 - s / 2 * log(1 + a * b / s)
    return Connect(
        hamiltonian=Pairwise((i, j), pair_term=sum(x * y for x, y in zip(i.p, j.p, strict=True)) * green, domain=[a]),
        points=landmarks,
        steps=10,
    )
