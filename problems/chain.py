"""Let a hanging chain of 64 links swing, in Cartesian coordinates with one constraint for each link.

The chain has unit mass and length. It hangs at one end, and consists of equal point masses joined by massless rods. At
the start it is at rest on a straight line, at the `angle` to the vertical. Both the build and a step take a time
that is proportional to the number of links: the equations of all inner links are one loop, and the linear systems are
bands. The energy has no drift, and the constraints hold to rounding after every step (RATTLE). Source: Hairer, Lubich
and Wanner (2006), Geometric numerical integration, section VII.1.4. All quantities are nondimensional, but for
g = 9.81.
"""

from itertools import pairwise

from sympy import cos, sin

from codegen import Simulate, coordinates, parameters
from codegen.drawing import Rod, Trail


def problem(links: int = 64, angle: float = 0.5) -> Simulate:
    q, dq = coordinates(" ".join(f"x{i} y{i}" for i in range(1, links + 1)))
    m, rod, g, tilt = parameters(m=1 / links, rod=1 / links, g=9.81, tilt=angle)
    joints = [(0, 0), *zip(q[::2], q[1::2], strict=True)]
    down = {y: -i * rod * cos(tilt) for i, y in enumerate(q[1::2], start=1)}
    start = {x: i * rod * sin(tilt) for i, x in enumerate(q[::2], start=1)} | down
    return Simulate(
        lagrangian=m * sum(v**2 for v in dq) / 2 - m * g * sum(q[1::2]),
        constraint=[(x - a) ** 2 + (y - b) ** 2 - rod**2 for (a, b), (x, y) in pairwise(joints)],
        duration=2,
        start=start | dict.fromkeys(dq, 0),
        steps=1000,
        drawing=[Trail(joints[-1]), *(Rod(*ends) for ends in pairwise(joints))],
    )
