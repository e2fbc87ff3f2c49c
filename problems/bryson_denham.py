"""Throw a cart back with the least effort, without letting it pass a wall.

A unit mass passes 0 with speed 1 and is to pass it again, with speed -1, after one unit of time; the wall is at
`wall`. Source: Bryson, Denham and Dreyfus, Optimal programming problems with inequality constraints I, AIAA Journal 1
(1963); Bryson and Ho, Applied Optimal Control (1975), section 3.11. All quantities are nondimensional. The cost, half
the integral of the squared force, is known in closed form: J* = 4/(9 wall) for walls nearer than 1/6.
"""

from codegen import Control, control, coordinate, parameters


def problem(wall: float = 1 / 9) -> Control:
    x, dx = coordinate("x")
    f = control("f")
    (greatest,) = parameters(wall=wall)

    return Control(
        lagrangian=dx**2 / 2,
        force={x: f},
        cost=f**2 / 2,
        duration=1,
        start={x: 0, dx: 1},
        end={x: 0, dx: -1},
        bounds={x: (None, greatest)},
        steps=60,
    )
