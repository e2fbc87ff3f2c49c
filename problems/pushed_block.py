"""Push a block over a rough floor from rest to rest in a given time, with least effort.

The block lies on the floor, which carries it and slows it by Coulomb friction, mu m g while it slides. The force of the
floor is an unknown of the problem. Source: Stewart and Trinkle (1996), An implicit time-stepping scheme for rigid body
dynamics with inelastic collisions and Coulomb friction, for the contact laws.

If the block slides forwards all the time, the force is mu m g + 6 m d (T - 2 t)/T^3, and the least effort is
12 m^2 d^2/T^3 + (mu m g)^2 T.
"""

from codegen import Control, controls, coordinates, parameters
from codegen.drawing import Arrow, Ground, Mass


def problem() -> Control:
    (x, y), (dx, dy) = coordinates("x y")
    (u,) = controls("u")
    m, g, mu, d = parameters(m=1, g=9.81, mu=0.3, d=1)
    return Control(
        lagrangian=m / 2 * (dx**2 + dy**2) - m * g * y,
        force={x: u},
        cost=u**2,
        duration=1,
        start={x: 0, y: 0, dx: 0, dy: 0},
        end={x: d, y: 0, dx: 0, dy: 0},
        unilateral={"floor": y >= 0},
        friction=mu,
        slip=[dx],
        steps=30,
        drawing=[
            Ground((-0.2, 0), (1.2, 0)),
            Mass((x, y + 0.05), 0.05),
            Arrow((x, y + 0.05), (u / 20, 0), label="force"),
        ],
    )
