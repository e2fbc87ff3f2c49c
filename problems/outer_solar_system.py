"""Follow the Sun, the five outer bodies of the solar system and their mutual attraction over a million days.

Lengths are astronomical units, times Earth days, masses relative to the Sun, whose mass includes the inner planets.
Source of all data (5 September 1994, from the Encyclopaedia of Ahnert): Hairer, Lubich and Wanner (2006), Geometric
numerical integration, section I.2.3.
"""

from sympy import sqrt

from codegen import Pairwise, Simulate, parameters, particles

MASSES = [1.00000597682, 0.000954786104043, 0.000285583733151, 0.0000437273164546, 0.0000517759138449, 1 / 1.3e8]
PLACES = [
    (0.0, 0.0, 0.0),
    (-3.5023653, -3.8169847, -1.5507963),
    (9.0755314, -3.0458353, -1.6483708),
    (8.3101420, -16.2901086, -7.2521278),
    (11.4707666, -25.7294829, -10.8169456),
    (-15.5387357, -25.2225594, -3.1902382),
]
VELOCITIES = [
    (0.0, 0.0, 0.0),
    (0.00565429, -0.00412490, -0.00190589),
    (0.00168318, 0.00483525, 0.00192462),
    (0.00354178, 0.00137102, 0.00055029),
    (0.00288930, 0.00114527, 0.00039677),
    (0.00276725, -0.00170702, -0.00136504),
]


def problem() -> Simulate:
    i, j = particles("x y z", "px py pz", "m")
    (G,) = parameters(G=2.95912208286e-4)
    (m,), (m_j,) = i.own, j.own
    distance = sqrt(sum((a - b) ** 2 for a, b in zip(i.q, j.q, strict=True)))
    momenta = [[m * v for m, v in zip(MASSES, column, strict=True)] for column in zip(*VELOCITIES, strict=True)]
    return Simulate(
        hamiltonian=Pairwise((i, j), self_term=sum(p**2 for p in i.p) / (2 * m), pair_term=-G * m * m_j / distance),
        start={
            **dict(zip(i.q, zip(*PLACES, strict=True), strict=True)),
            **dict(zip(i.p, momenta, strict=True)),
            m: MASSES,
        },
        duration=10**6,
        steps=10_000,
    )
