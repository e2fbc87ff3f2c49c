"""Throw a cart back with the least effort, without letting it pass a wall.

A unit mass passes 0 with speed 1 and is to pass it again with speed -1 after one unit of time. Source: Bryson, Denham
and Dreyfus, Optimal programming problems with inequality constraints I, AIAA Journal 1 (1963). All quantities are
nondimensional. The least half integral of the squared force is 4/(9 wall) for walls nearer than 1/6.
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
