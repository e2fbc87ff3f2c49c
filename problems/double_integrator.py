"""Move a cart to a given place and to rest there in the least time, with a bounded force.

A unit mass starts at rest at 0 and is to be at rest at `distance`; the force is at most `limit`. Source: Bryson and Ho,
Applied Optimal Control (1975), section 3.9. All quantities are nondimensional. The optimum is bang-bang with one
switch halfway, T* = 2 sqrt(distance/limit); the midpoint rule reproduces it exactly whenever N is even.
"""

from codegen import Control, control, coordinate, free_parameter, parameters


def problem(distance: float = 1, limit: float = 1) -> Control:
    x, dx = coordinate("x")
    f = control("f")
    d, a = parameters(distance=distance, limit=limit)
    T = free_parameter("T", guess=1, lower=0)

    return Control(
        lagrangian=dx**2 / 2,
        force={x: f},
        cost=1,
        duration=T,
        start={x: 0, dx: 0},
        end={x: d, dx: 0},
        bounds={f: (-a, a)},
        steps=50,
    )
