"""Return a cart to its start with the least effort, without passing a wall.

A unit mass starts at 0 with velocity 1 and must return to 0 with velocity -1 after one unit of time. Source: Bryson,
Denham and Dreyfus, Optimal programming problems with inequality constraints I, AIAA Journal 1 (1963). All quantities
are nondimensional. The least cost, half the integral of the squared force, is 4/(9 wall) for walls nearer than 1/6.
"""

from codegen import Control, control, coordinate, parameters


def problem() -> Control:
    x, dx = coordinate("x")
    f = control("f")
    wall, T = parameters(wall=1 / 9, T=1)
    return Control(
        lagrangian=dx**2 / 2,
        force={x: f},
        cost=f**2 / 2,
        duration=T,
        start={x: 0, dx: 1},
        end={x: 0, dx: -1},
        bounds={x: (None, wall)},
        steps=60,
    )
