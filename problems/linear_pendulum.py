"""Swing a linearised pendulum to a given angle and to rest with the least effort.

Unit mass, length and gravity; the pendulum starts at rest at 3 pi/5 and ends at rest at 2 pi/5 after a quarter
period. All quantities are nondimensional. The problem is linear-quadratic (Bryson and Ho, 1975, Applied optimal
control, chapter 5), and its optimum is known in closed form, J* = 4.530760981081599.
"""

from sympy import cos, pi, sin

from codegen import Control, control, coordinate
from codegen.drawing import Mass, Rod, Trail


def problem() -> Control:
    q, dq = coordinate("q")
    f = control("f")

    bob = sin(q), -cos(q)
    return Control(
        lagrangian=dq**2 / 2 - q**2 / 2,
        force={q: f},
        cost=f**2,
        duration=pi / 2,
        start={q: 3 * pi / 5, dq: 0},
        end={q: 2 * pi / 5, dq: 0},
        steps=50,
        drawing=[Trail(bob), Rod((0, 0), bob), Mass(bob, 0.06)],
    )
