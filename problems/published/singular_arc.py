"""Move a unit mass by three units, from rest to rest, with the least of time and kinetic energy.

The force is bounded by 1. It is 1 until the speed is 1, then zero, on a singular arc, and -1 in the end: T = 4, and the
cost is 10/3. Source: PSOPT, example "singular_di".
"""

from codegen import Control, control, free_parameter, states


def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    T = free_parameter("T", 4, lower=0)
    return Control(
        dynamics={x: v, v: u},
        cost=(1 + v**2) / 2,
        duration=T,
        start={x: 2, v: 0},
        end={x: 5, v: 0},
        bounds={u: (-1, 1)},
        steps=100,
    )
