"""Let Newton's cradle swing: five equal balls on strings of unit length, of which the first is released.

The angles q_i are those of the strings. Neighbours touch where q_i = q_(i+1); all balls touch at the bottom. Impacts
are elastic. The impacts at the bottom follow each other through the row, in the order of time: each hands the velocity
of a ball to its neighbour, and the last ball rises to the angle of the first. Simultaneous impacts of rigid bodies have
no unique solution; with impacts in this order, as many balls leave as have arrived. Source: Brogliato, Nonsmooth
mechanics (2016), chapter 6.
"""

from sympy import cos, pi, sin

from codegen import Simulate, coordinates, parameters
from codegen.drawing import Mass, Rod

BALLS, WIDTH = 5, 0.2


def problem() -> Simulate:
    q, v = coordinates(" ".join(f"q{i}" for i in range(1, BALLS + 1)))
    (g,) = parameters(g=9.81)
    hooks = [((i - BALLS // 2) * WIDTH, 0) for i in range(BALLS)]
    balls = [(x + sin(angle), -cos(angle)) for (x, _), angle in zip(hooks, q, strict=True)]
    return Simulate(
        lagrangian=sum(rate**2 / 2 + g * cos(angle) for angle, rate in zip(q, v, strict=True)),
        unilateral={f"gap {i}": q[i] - q[i - 1] >= 0 for i in range(1, BALLS)},
        restitution=1,
        duration=6,
        start={q[0]: -pi / 4, **dict.fromkeys([*q[1:], *v], 0)},
        steps=1000,
        drawing=[
            *(Rod(hook, ball) for hook, ball in zip(hooks, balls, strict=True)),
            *(Mass(ball, WIDTH / 2) for ball in balls),
        ],
    )
