"""Bring a chain of three integrators to rest above a floor that it may touch.

The bound x >= 0 is of third order: the optimal motion touches it at infinitely many points. Source: Robbins (1980);
control-toolbox, CTBenchmarks.jl, problem "robbins"; extrapolated from N = 500, 1000 and 2000 there.
"""

from codegen import Control, control, states


def problem() -> Control:
    x, y, z = states("x y z")
    u = control("u")
    return Control(
        dynamics={x: y, y: z, z: u},
        cost=3 * x + u**2 / 2,
        duration=10,
        start={x: 1, y: -2, z: 0},
        end={x: 0, y: 0, z: 0},
        bounds={x: (0, None)},
        steps=1000,
    )
