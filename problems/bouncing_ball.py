"""Bring a ball to rest beyond one bounce, higher than it would rise by itself, with least effort.

The ball falls from rest at height 1, hits the ground, loses a part of its velocity, and comes to rest at the height 0.9
one unit further. A force, whose square is the rate of the cost, acts on it all the time; when it hits the ground and
when it arrives is free. Impacts as jumps of the velocity are Newton's, with the coefficient of restitution e; the
factor f stands for friction. Source: Brogliato, Nonsmooth mechanics (2016), chapter 4.

Between given states a point is moved by the least effort 12 a^2/T^3 - 12 a b/T^2 + 4 b^2/T in each direction, where b
is the change of velocity and a the distance beyond that of the first velocity, both without gravity. The sum of four
such terms is least, over both durations, both velocities of the impact and its place, at 17.27107933.
"""

from codegen import Control, Phases, controls, coordinates, free_parameter, parameters
from codegen.drawing import Arrow, Ground, Mass, Trail


def problem() -> Phases:
    (x, y), (dx, dy) = coordinates("x y")
    f_x, f_y = controls("f_x f_y")
    m, g, e, f = parameters(m=1, g=9.81, e=0.8, f=0.7)
    T_1, T_2 = free_parameter("T_1", guess=0.45), free_parameter("T_2", guess=0.45)

    motion = {
        "lagrangian": m / 2 * (dx**2 + dy**2) - m * g * y,
        "force": {x: f_x, y: f_y},
        "cost": f_x**2 + f_y**2,
        "steps": 20,
    }
    force = Arrow((x, y), (f_x / 20, f_y / 20), label="force")
    return Phases(
        Control(
            **motion,
            duration=T_1,
            start={x: 0, y: 1, dx: 0, dy: 0},
            end={y: 0},
            drawing=[Ground((-0.1, 0), (1.1, 0)), Trail((x, y)), Mass((x, y), 0.03), force],
        ),
        Control(**motion, duration=T_2, end={x: 1, y: 0.9, dx: 0, dy: 0}),
        jumps=[{dx: f * dx, dy: -e * dy}],
    )
