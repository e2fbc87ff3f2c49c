"""Roll a thin disc over a horizontal table, where it leans, turns and wobbles, but does not slip.

The point of contact is (x, y), the disc rolls in the direction phi, leans by theta to its left, and spins by psi. It
does not slip: the point of contact of the disc is at rest, so that the velocity (dx, dy) is r dpsi in the direction
phi. The two equations cannot be integrated: by rolling, the disc reaches every place and every position. A disc with
m g r sin(theta) = ((C + m r^2) (dpsi - dphi sin(theta)) + A dphi sin(theta)) dphi cos(theta) rolls steadily in a
circle, with the moments of inertia A = m r^2/4 and C = m r^2/2. `wobble` is the rate of lean at the start, which
disturbs the circle. The energy is constant. Source: Bloch (2015), Nonholonomic mechanics and control, section 1.4;
Routh (1884), Advanced rigid dynamics, article 244.
"""

from sympy import cos, sin

from codegen import Simulate, coordinates, parameters
from codegen.drawing import Mass, Rod, Trail


def problem() -> Simulate:
    (x, y, phi, theta, psi), (dx, dy, dphi, dtheta, dpsi) = coordinates("x y phi theta psi")
    m, r, g, lean, turn, wobble = parameters(m=1, r=0.5, g=9.81, lean=0.3, turn=1.5, wobble=0.8)
    A, C = m * r**2 / 4, m * r**2 / 2
    # The centre is above the point of contact by r, along the leaning disc.
    vx = dx - r * (cos(theta) * sin(phi) * dtheta + sin(theta) * cos(phi) * dphi)
    vy = dy + r * (cos(theta) * cos(phi) * dtheta - sin(theta) * sin(phi) * dphi)
    vz = -r * sin(theta) * dtheta
    spin = (m * g * r * sin(lean) / (turn * cos(lean)) - A * turn * sin(lean)) / (C + m * r**2) + turn * sin(lean)
    centre = (x - r * sin(theta) * sin(phi), y + r * sin(theta) * cos(phi))
    axle = (0.3 * r * cos(theta) * sin(phi), -0.3 * r * cos(theta) * cos(phi))
    return Simulate(
        lagrangian=m * (vx**2 + vy**2 + vz**2) / 2
        + A * (dtheta**2 + dphi**2 * cos(theta) ** 2) / 2
        + C * (dpsi - dphi * sin(theta)) ** 2 / 2
        - m * g * r * cos(theta),
        rolling=[dx - r * cos(phi) * dpsi, dy - r * sin(phi) * dpsi],
        duration=8,
        start={x: 0, y: 0, phi: 0, theta: lean, psi: 0} | {dx: r * spin, dy: 0, dphi: turn, dtheta: wobble, dpsi: spin},
        steps=800,
        # Seen from above: the path of the contact, the edge of the disc, and its axle.
        drawing=[
            Trail((x, y)),
            Rod((x - r * cos(phi), y - r * sin(phi)), (x + r * cos(phi), y + r * sin(phi))),
            Rod(centre, (centre[0] + axle[0], centre[1] + axle[1])),
            Mass((x, y), 0.04),
        ],
    )
