"""Bodies in the plane that attract each other, G = 1: three on a figure eight, others on a regular polygon.

Source of the figure eight: Chenciner and Montgomery (2000), A remarkable periodic solution of the three-body problem in
the case of equal masses; Simo's initial values and period, which three bodies of mass 1 return after. On the polygon
the bodies turn about its centre. All quantities are nondimensional.
"""

from typing import Literal

from sympy import cos, pi, sin, sqrt

from codegen import Control, Simulate, controls, coordinates, parameters


def problem(bodies: int = 3, task: Literal["simulate", "control"] = "simulate") -> Simulate | Control:
    numbers = range(1, bodies + 1)
    q, dq = coordinates(" ".join(f"x{i} y{i}" for i in numbers))
    masses = parameters(**{f"m{i}": 1 for i in numbers})
    places, speeds = list(zip(q[::2], q[1::2])), list(zip(dq[::2], dq[1::2]))

    lagrangian = sum(m * (v**2 + w**2) / 2 for m, (v, w) in zip(masses, speeds))
    for i, (a, b) in enumerate(places):
        for j, (c, d) in enumerate(places[:i]):
            lagrangian += masses[i] * masses[j] / sqrt((a - c) ** 2 + (b - d) ** 2)
    if bodies == 3:
        x, v = [0.97000436, -0.24308753, -0.97000436, 0.24308753, 0, 0], [0.466203685, 0.43236573]
        v = [*v, *v, -2 * v[0], -2 * v[1]]
    else:
        rate = sqrt(sum(1 / sin(pi * k / bodies) for k in range(1, bodies)) / 4)
        angles = [2 * pi * k / bodies for k in range(bodies)]
        x = [part for angle in angles for part in (cos(angle), sin(angle))]
        v = [part for angle in angles for part in (-rate * sin(angle), rate * cos(angle))]
    start, duration = dict(zip((*q, *dq), (*x, *v))), 6.32591398
    if task == "simulate":
        return Simulate(lagrangian=lagrangian, start=start, duration=duration, steps=1000)
    u = controls(" ".join(f"u{i} w{i}" for i in numbers))
    cost = sum(force**2 for force in u)
    return Control(
        lagrangian=lagrangian, force=dict(zip(q, u)), cost=cost, start=start, end=start, duration=duration, steps=100
    )
