"""Let Chaplygin's sleigh turn on the ice, on a blade and two smooth feet.

The blade touches the ice at (x, y) and glides in its own direction theta alone. The centre of mass is ahead of the
blade by a, with the moment of inertia J about it. The sleigh begins with a spin and no speed, and the spin becomes
speed: with k^2 = (J + m a^2)/m and the spin w at the start, the speed is v = k w tanh(a w t/k) and the spin is w/cosh(a
w t/k). The motion ends in a straight line. The energy is constant, but no volume of phase space is: motions are
attracted without friction. Source: Chaplygin (1911); Bloch (2015), Nonholonomic mechanics and control, section 1.7.
"""

from sympy import cos, sin

from codegen import Simulate, coordinates, parameters
from codegen.drawing import Mass, Rod, Trail


def problem() -> Simulate:
    (x, y, theta), (dx, dy, dtheta) = coordinates("x y theta")
    m, J, a, w = parameters(m=1, J=0.2, a=0.3, w=2)
    ahead = (cos(theta), sin(theta))
    return Simulate(
        lagrangian=m * ((dx - a * sin(theta) * dtheta) ** 2 + (dy + a * cos(theta) * dtheta) ** 2) / 2
        + J * dtheta**2 / 2,
        rolling=[dx * sin(theta) - dy * cos(theta)],
        duration=6,
        start={x: 0, y: 0, theta: 0, dx: 0, dy: 0, dtheta: w},
        steps=600,
        drawing=[
            Trail((x, y)),
            Rod((x - 0.1 * ahead[0], y - 0.1 * ahead[1]), (x + 0.5 * ahead[0], y + 0.5 * ahead[1])),
            Rod((x + 0.5 * ahead[0], y + 0.5 * ahead[1]), (x - 0.3 * sin(theta), y + 0.3 * cos(theta))),
            Rod((x + 0.5 * ahead[0], y + 0.5 * ahead[1]), (x + 0.3 * sin(theta), y - 0.3 * cos(theta))),
            Mass((x + a * ahead[0], y + a * ahead[1]), 0.05),
        ],
    )
