"""Bring a drone and a trolley to their places, within radio range of each other, with the least effort.

Two different bodies in a vertical plane: a trolley of mass M at s on a straight rail, driven by the force F, and a
drone of mass m at (x, y), whose rotors pull with the force (f_x, f_y) against its weight. The drone starts with a
velocity that carries it away; both are to come to rest. Their distance is never to exceed the range R. The cost is the
integral of all squared forces. All quantities are nondimensional. Dynamics are linear, the cost is quadratic and the
range convex, so that there is one optimum.
"""

from codegen import Control, control, controls, coordinate, coordinates, parameters, together
from codegen.drawing import Arrow, Box, Ground, Mass, Trail


def problem() -> Control:
    T, R = parameters(T=1, R=1)

    s, ds = coordinate("s")
    F = control("F")
    (M,) = parameters(M=2)
    trolley = Control(
        lagrangian=M / 2 * ds**2,
        force={s: F},
        cost=F**2,
        duration=T,
        start={s: 0, ds: 0},
        end={s: 2, ds: 0},
        steps=40,
        drawing=[Ground((-1, -0.1), (3, -0.1)), Box((s, -0.05), 0.25, 0.1)],
    )

    (x, y), (dx, dy) = coordinates("x y")
    f_x, f_y = controls("f_x f_y")
    m, g, v = parameters(m=1, g=1, v=4)
    drone = Control(
        lagrangian=m / 2 * (dx**2 + dy**2) - m * g * y,
        force={x: f_x, y: f_y},
        cost=f_x**2 + f_y**2,
        duration=T,
        start={x: 0, y: 0.5, dx: -v, dy: v},
        end={x: 2, y: 0.5, dx: 0, dy: 0},
        steps=40,
        drawing=[Trail((x, y)), Mass((x, y), 0.06), Arrow((x, y), (f_x / 60, f_y / 60), label="force")],
    )
    return together(trolley, drone, path=[(x - s) ** 2 + y**2 <= R**2])
