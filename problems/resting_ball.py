"""Let a ball bounce on the floor, infinitely often in a finite time, until it slides.

The ball starts at the height a with the horizontal velocity w. With the fall t_0 = sqrt(2 a/g) and the coefficient of
restitution e, impact n is at t_0 (1 + 2 e (1 - e^n)/(1 - e)), and the height between two impacts is a e^(2 n). All
impacts are before t_0 (1 + e)/(1 - e) = 4.0637 (Zeno). From then on the ball rests on the floor, while it moves along
the floor: the gap acts as a constraint. Source: Brogliato, Nonsmooth mechanics (2016), chapter 1.
"""

from codegen import Simulate, coordinates, parameters
from codegen.drawing import Ground, Mass, Trail


def problem() -> Simulate:
    (x, y), (dx, dy) = coordinates("x y")
    m, g, e, a, w = parameters(m=1, g=9.81, e=0.8, a=1, w=0.5)
    return Simulate(
        lagrangian=m / 2 * (dx**2 + dy**2) - m * g * y,
        unilateral={"floor": y >= 0},
        restitution=e,
        duration=5,
        start={x: 0, y: a, dx: w, dy: 0},
        steps=500,
        drawing=[Ground((-0.1, 0), (2.6, 0)), Trail((x, y)), Mass((x, y), 0.03)],
    )
