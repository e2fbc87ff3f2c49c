"""An arm of equal rigid links in the plane, with angles between neighbouring links and a torque at every joint.

It hangs at rest; `control` lifts it to 45 degrees at its shoulder with the least effort, `simulate` lets it fall.
"""

from typing import Literal

from sympy import cos, pi, sin

from codegen import Control, Simulate, controls, coordinates, parameters


def problem(links: int = 6, task: Literal["simulate", "control"] = "control") -> Simulate | Control:
    q, dq = coordinates(" ".join(f"q{i}" for i in range(1, links + 1)))
    m, rod, J, g = parameters(m=1, rod=0.5, J=0.02, g=9.81)
    lagrangian, angle, rate, forward, upward, depth = 0, 0, 0, 0, 0, 0
    for x, dx in zip(q, dq):
        angle, rate = angle + x, rate + dx
        v, w = forward + rod / 2 * cos(angle) * rate, upward + rod / 2 * sin(angle) * rate
        lagrangian += m * (v**2 + w**2) / 2 + J * rate**2 / 2 + m * g * (depth + rod / 2 * cos(angle))
        forward, upward = forward + rod * cos(angle) * rate, upward + rod * sin(angle) * rate
        depth += rod * cos(angle)
    at_rest = dict.fromkeys((*q, *dq), 0)
    if task == "simulate":
        return Simulate(lagrangian=lagrangian, start=at_rest | {q[0]: 1}, duration=2, steps=400)
    u = controls(" ".join(f"u{i}" for i in range(1, links + 1)))
    return Control(
        lagrangian=lagrangian,
        force=dict(zip(q, u)),
        cost=sum(torque**2 for torque in u),
        start=at_rest,
        end=at_rest | {q[0]: pi / 4},
        duration=1,
        steps=20,
    )
