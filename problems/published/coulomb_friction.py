"""Move two coupled masses that rub against the ground to other places, in the least time.

Coulomb's friction, the sign of a velocity, is made smooth as tanh(velocity/0.01). Source: Driessen and Sadegh (2000);
PSOPT, example "coulomb", whose 2.1049 on 40 nodes does not resolve the layers in which velocities change their sign:
the midpoint rule has 2.1097 and 2.1167 with 40 and 60 intervals, and 2.11403, 2.11419 and 2.11421 with 400, 1000 and
2000.
"""

from sympy import tanh

from codegen import Control, controls, coordinates, free_parameter


def problem() -> Control:
    (a, b), (da, db) = coordinates("a b")
    u, w = controls("u w")
    T = free_parameter("T", 2, lower=0)
    return Control(
        lagrangian=(1.1 * da**2 + 1.2 * db**2 - 1.8 * a**2 + 1.7 * a * b - 0.85 * b**2) / 2,
        force={a: u - tanh(da / 0.01), b: w - tanh(db / 0.01)},
        terminal_cost=T,
        cost=0,
        duration=T,
        start={a: 0, da: -1, b: 0, db: -2},
        end={a: 1, da: 0, b: 2, db: 0},
        bounds={u: (-4, 4), w: (-4, 4)},
        steps=1000,
    )
