"""Let seven argon atoms of a frozen crystal in the plane vibrate under the potential of Lennard and Jones.

H = sum |p|^2/(2 m) + sum_{i<j} 4 eps ((sigma/r)^12 - (sigma/r)^6). Lengths are nanometres, times nanoseconds, masses
1e-27 kg; Boltzmann's constant is 1.380658e-23 J/K, so that energies are 1e-27 kg nm^2/ns^2 = 1e-27 J. Source of all
data: Hairer, Lubich and Wanner (2006), Geometric numerical integration, section I.4 (Biesiadecki and Skeel 1993).
"""

from codegen import Pairwise, Simulate, parameters, particles

PLACES = [(0.0, 0.0), (0.02, 0.39), (0.34, 0.17), (0.36, -0.21), (-0.02, -0.40), (-0.35, -0.16), (-0.31, 0.21)]
VELOCITIES = [(-30, -20), (50, -90), (-70, -60), (90, 40), (80, 90), (-40, 100), (-80, -60)]
MASS = 66.34


def problem() -> Simulate:
    i, j = particles("x y", "px py")
    m, eps, sigma = parameters(m=MASS, eps=119.8 * 1.380658e-23 / 1e-27, sigma=0.341)
    ratio = sigma**2 / sum((a - b) ** 2 for a, b in zip(i.q, j.q, strict=True))
    return Simulate(
        hamiltonian=Pairwise(
            (i, j), self_term=sum(p**2 for p in i.p) / (2 * m), pair_term=4 * eps * (ratio**6 - ratio**3)
        ),
        start={
            **dict(zip(i.q, zip(*PLACES, strict=True), strict=True)),
            **{p: [MASS * v for v in column] for p, column in zip(i.p, zip(*VELOCITIES, strict=True), strict=True)},
        },
        duration=0.2,
        steps=5000,
    )
