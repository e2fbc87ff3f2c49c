"""Shove a cart that rolls to its target, and return to the start, with least effort.

A driven cart touches another one at the gap x_2 - x_1 = 0, and only pushes it. The other cart is slowed by viscous
friction. When the carts touch, whether they stay together, and when they part are results. Impacts are inelastic.
Source: Stewart and Trinkle (1996), An implicit time-stepping scheme for rigid body dynamics with inelastic collisions
and Coulomb friction, for the contact laws.
"""

from codegen import Control, controls, coordinates, parameters
from codegen.drawing import Arrow, Ground, Mass


def problem() -> Control:
    (x_1, x_2), (dx_1, dx_2) = coordinates("x_1 x_2")
    (u,) = controls("u")
    m_1, m_2, c = parameters(m_1=1, m_2=0.5, c=0.5)
    return Control(
        lagrangian=m_1 / 2 * dx_1**2 + m_2 / 2 * dx_2**2,
        force={x_1: u, x_2: -c * dx_2},
        cost=u**2,
        duration=2,
        start={x_1: 0, x_2: 0.3, dx_1: 0, dx_2: 0},
        end={x_1: 0, x_2: 1, dx_1: 0},
        unilateral={"bumper": x_2 - x_1 >= 0},
        steps=40,
        drawing=[
            Ground((-0.2, 0), (1.2, 0)),
            Mass((x_1, 0.05), 0.04, label="driven"),
            Mass((x_2, 0.05), 0.03),
            Arrow((x_1, 0.05), (u / 20, 0), label="force"),
        ],
    )
