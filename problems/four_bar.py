"""Turn the crank of a four-bar linkage by half a turn, from rest to rest, with the least effort.

Crank, coupler and rocker are uniform rods of unit mass and lengths l1, l2, l3 in the horizontal plane, at the absolute
angles a, b, c; the joints of crank and rocker on the ground are l0 apart. That the loop closes is a holonomic
constraint of two equations. The torque u acts on the crank; the cost is the integral of its square. Source: the
linkage is the textbook one, for example Shigley and Uicker, Theory of Machines and Mechanisms, chapter 1. All
quantities are nondimensional. Reference: the same linkage with the crank's angle as its only coordinate.
"""

from sympy import acos, cos, pi, sin

from codegen import Control, control, coordinates, parameters
from codegen.drawing import Mark, Rod, Trail


def problem() -> Control:
    (a, b, c), (da, db, dc) = coordinates("a b c")
    u = control("u")
    l0, l1, l2, l3 = parameters(l0=2, l1=1, l2=2, l3=2)

    coupler = l1**2 * da**2 + l1 * l2 * cos(a - b) * da * db + l2**2 / 3 * db**2
    distances = (l0 - l1, l0 + l1)  # from the crank's tip to the rocker's joint, at the start and at the end
    (b0, b1), (c0, c1) = (
        [acos((l2**2 + d**2 - l3**2) / (2 * l2 * d)) for d in distances],
        [pi - acos((l3**2 + d**2 - l2**2) / (2 * l3 * d)) for d in distances],
    )
    tip, joint = (l1 * cos(a), l1 * sin(a)), (l0 + l3 * cos(c), l3 * sin(c))
    links = [Rod((0, 0), tip), Rod(tip, joint), Rod((l0, 0), joint)]
    return Control(
        lagrangian=l1**2 / 6 * da**2 + coupler / 2 + l3**2 / 6 * dc**2,
        force={a: u},
        cost=u**2,
        duration=1,
        start={a: 0, b: b0, c: c0, da: 0, db: 0, dc: 0},
        end={a: pi, b: b1, c: c1, da: 0, db: 0, dc: 0},
        constraint=[l1 * cos(a) + l2 * cos(b) - l3 * cos(c) - l0, l1 * sin(a) + l2 * sin(b) - l3 * sin(c)],
        steps=50,
        drawing=[Trail(tip), Trail(joint), *links, Mark((0, 0)), Mark((l0, 0))],
    )
