"""Let a hanging chain of 64 links swing, in Cartesian coordinates with one constraint for each link.

The chain has unit mass and length. It hangs at one end, and consists of equal point masses joined by massless rods. At
the start it is at rest on a straight line, at the `angle` to the vertical. Both the build and a step take a time
that is proportional to the number of links: the equations of all inner links are one loop, and the linear systems are
bands. The energy has no drift, and the constraints hold to rounding after every step (RATTLE). Source: Hairer, Lubich
and Wanner (2006), Geometric numerical integration, section VII.1.4. All quantities are nondimensional, but for
g = 9.81.
"""

from sympy import cos, sin

from codegen import Simulate, coordinates, parameters
from codegen.drawing import Rod, Trail


def problem(links: int = 64, angle: float = 0.5) -> Simulate:
    q, dq = coordinates(" ".join(f"x{i} y{i}" for i in range(1, links + 1)))
    m, rod, g, a = parameters(m=1 / links, rod=1 / links, g=9.81, a=angle)
    joints = [(0, 0), *zip(q[::2], q[1::2], strict=True)]
    start = {x: i * rod * sin(a) for i, x in enumerate(q[::2], 1)} | {y: -i * rod * cos(a) for i, y in enumerate(q[1::2], 1)}
    return Simulate(
        lagrangian=m * sum(v**2 for v in dq) / 2 - m * g * sum(q[1::2]),
        constraint=[
            (x - x0) ** 2 + (y - y0) ** 2 - rod**2 for (x0, y0), (x, y) in zip(joints, joints[1:], strict=False)
        ],
        duration=2,
        start=start | dict.fromkeys(dq, 0),
        steps=1000,
        drawing=[Trail(joints[-1]), *map(Rod, joints, joints[1:])],
    )
