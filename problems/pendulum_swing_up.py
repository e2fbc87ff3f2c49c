"""Swing a pendulum up with a torque that is too weak to lift it at once.

A compound pendulum (moment of inertia J, mass m at the distance d from the joint) hangs at rest and is to stand at rest
after 10 s. The torque is at most 2 N m, a fifth of what holds the pendulum level; the cost is the integral of its
square. Source: opty's gallery, "Fixed Duration Pendulum Swing Up". opty ends in a local optimum, 15.64 N^2 m^2 s; the
guess here, which swings ever wider, leads to 9.31395.
"""

from sympy import cos, pi, sin

from codegen import Control, control, coordinate, parameters, time
from codegen.drawing import Mass, Rod, Trail


def problem() -> Control:
    theta, dtheta = coordinate("theta")
    torque = control("torque")
    t = time()
    J, m, g, d, T, greatest = parameters(J=1, m=1, g=9.81, d=1, T=10, greatest=2)

    bob = d * sin(theta), -d * cos(theta)
    return Control(
        lagrangian=J / 2 * dtheta**2 + m * g * d * cos(theta),
        force={theta: torque},
        cost=torque**2,
        duration=T,
        start={theta: 0, dtheta: 0},
        end={theta: pi, dtheta: 0},
        bounds={torque: (-greatest, greatest)},
        guess={theta: pi * (t / T) ** 2 * sin(9 * pi * t / (2 * T))},
        steps=100,
        drawing=[Trail(bob), Rod((0, 0), bob), Mass(bob, 0.08)],
    )
