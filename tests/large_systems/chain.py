"""Masses in a row between two walls, joined by springs that harden (Fermi, Pasta, Ulam and Tsingou's beta chain).

They start from their lowest shape of vibration. `control` brings them to rest by a force on each. Nondimensional.
"""

from typing import Literal

from sympy import pi, sin

from codegen import Control, Simulate, controls, coordinates, parameters


def problem(masses: int = 12, task: Literal["simulate", "control"] = "simulate") -> Simulate | Control:
    q, dq = coordinates(" ".join(f"q{i}" for i in range(1, masses + 1)))
    m, k, beta = parameters(m=1, k=1, beta=0.3)
    stretches = [b - a for a, b in zip((0, *q), (*q, 0))]
    lagrangian = sum(m * v**2 / 2 for v in dq) - sum(k * s**2 / 2 + beta * s**4 / 4 for s in stretches)
    start = {x: sin(pi * i / (masses + 1)) for i, x in enumerate(q, start=1)} | dict.fromkeys(dq, 0)
    if task == "simulate":
        return Simulate(lagrangian=lagrangian, start=start, duration=10, steps=200)
    u = controls(" ".join(f"u{i}" for i in range(1, masses + 1)))
    return Control(
        lagrangian=lagrangian,
        force=dict(zip(q, u)),
        cost=sum(force**2 for force in u),
        start=start,
        end=dict.fromkeys((*q, *dq), 0),
        duration=10,
        steps=50,
    )
