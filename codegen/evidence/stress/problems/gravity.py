"""Follow two bodies that attract each other, written as particles with pairwise interaction.

H = sum |p|^2/(2 m) - sum G m_i m_j/r. Source: Hairer, Lubich and Wanner (2006), Geometric numerical integration, I.2.
All quantities are nondimensional.
"""

from sympy import sqrt

from codegen import Pairwise, Simulate, parameters, particles


def problem() -> Simulate:
    i, j = particles("x y", "px py", "m")
    (G,) = parameters(G=1)
    (m,), (m_j,) = i.own, j.own
    distance = sqrt(sum((a - b) ** 2 for a, b in zip(i.q, j.q, strict=True)))
    return Simulate(
        hamiltonian=Pairwise((i, j), self_term=sum(p**2 for p in i.p) / (2 * m), pair_term=-G * m * m_j / distance),
        start={i.q[0]: [0, 1], i.q[1]: [0, 0], i.p[0]: [0, 0], i.p[1]: [-0.001, 0.001], m: [1, 0.001]},
        duration=10,
        steps=1000,
    )
