"""Swing a chain of pendulums from hanging to another configuration of rest, with the least effort.

The chain has unit mass and length: each link is a point mass on a massless rod, with its share of both. The angles are
absolute, 0 when hanging. `every` joint has a motor, or only the `first`. All links are to be at rest at 45 degrees
after one unit of time; the cost is the integral of the squared torques. The problem is meant to grow: `links` sets the
size of its expressions. All quantities are nondimensional, but for g = 9.81.
"""

from typing import Literal

from sympy import cos, pi, sin

from codegen import Control, controls, coordinates, parameters
from codegen.drawing import Mass, Rod, Trail


def problem(links: int = 2, motors: Literal["every", "first"] = "every") -> Control:
    qs, dqs = coordinates(" ".join(f"q{i}" for i in range(1, links + 1)))
    torques = controls(" ".join(f"u{i}" for i in range(1, (links if motors == "every" else 1) + 1)))
    m, rod, g = parameters(m=1 / links, rod=1 / links, g=9.81)

    lagrangian, height, forward, upward = 0, 0, 0, 0
    for q, dq in zip(qs, dqs, strict=True):
        height -= rod * cos(q)
        forward += rod * cos(q) * dq
        upward += rod * sin(q) * dq
        lagrangian += m * (forward**2 + upward**2) / 2 - m * g * height
    # A joint's motor turns its own link one way and the link before it the other way.
    force = dict.fromkeys(qs, 0)
    for i, u in enumerate(torques):
        force[qs[i]] += u
        if i:
            force[qs[i - 1]] -= u
    joints = [(rod * sum(sin(q) for q in qs[:i]), -rod * sum(cos(q) for q in qs[:i])) for i in range(links + 1)]
    return Control(
        lagrangian=lagrangian,
        force={q: f for q, f in force.items() if f != 0},
        cost=sum(u**2 for u in torques),
        duration=1,
        start=dict.fromkeys((*qs, *dqs), 0),
        end=dict.fromkeys(qs, pi / 4) | dict.fromkeys(dqs, 0),
        steps=20,
        drawing=[Trail(joints[-1]), *map(Rod, joints, joints[1:]), *(Mass(joint, 0.03) for joint in joints[1:])],
    )
