"""Lift a mass from rest to rest with the least effort."""

from codegen import Control, control, coordinate, parameters
from codegen.drawing import Arrow, Box, Ground


def problem(height: float = 1) -> Control:
    z, dz = coordinate("z")
    f = control("f")
    m, g, H = parameters(m=2, g=9.81, H=height)
    return Control(
        lagrangian=m * dz**2 / 2 - m * g * z,
        force={z: f},
        cost=f**2,
        duration=1,
        start={z: 0, dz: 0},
        end={z: H, dz: 0},
        steps=50,
        drawing=[
            Ground((-0.5, -0.1), (0.5, -0.1)),
            Box((0, z), 0.3, 0.2),
            Arrow((0, z + 0.1), (0, f / 100)),
        ],
    )
