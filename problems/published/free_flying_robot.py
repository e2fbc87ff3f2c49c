"""Bring a free-flying robot to rest at the origin with the least fuel.

Two pairs of opposite jets with bounded thrusts u_1 to u_4 push the robot along its heading a and turn it. The controls
are bang-bang with coasting. Source: Sakawa (1999); Betts, Practical Methods for Optimal Control, 3rd ed., example
10.43; pycollo, tests/integration/test_free_flying_robot.py, with the values of SOS and GPOPS-II.
"""

from sympy import cos, pi, sin

from codegen import Control, controls, states


def problem() -> Control:
    x, y, a, p, q, w = states("x y a p q w")
    u_1, u_2, u_3, u_4 = jets = controls("u_1 u_2 u_3 u_4")
    A, B = u_1 - u_2, u_3 - u_4
    return Control(
        dynamics={x: p, y: q, a: w, p: (A + B) * cos(a), q: (A + B) * sin(a), w: 0.2 * A - 0.2 * B},
        cost=u_1 + u_2 + u_3 + u_4,
        duration=12,
        start={x: -10, y: -10, a: pi / 2, p: 0, q: 0, w: 0},
        end={x: 0, y: 0, a: 0, p: 0, q: 0, w: 0},
        bounds={
            **dict.fromkeys(jets, (0, None)),
            **dict.fromkeys((x, y), (-10, 10)),
            **dict.fromkeys((p, q), (-2, 2)),
            a: (-pi, pi),
            w: (-1, 1),
        },
        path=[u_1 + u_2 <= 1, u_3 + u_4 <= 1],
        steps=500,
    )
