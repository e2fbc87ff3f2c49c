"""Drive a snakeboard along its own direction, from rest to rest, by the least torques of the rider.

The board of half length l has a pair of wheels at each end, which the rider turns in opposite directions by the angles
phi and -phi. He also turns his body by the angle psi against the board. The wheels do not slip sideways: two rolling
constraints tie the velocities of the centre (x, y) and of the heading theta. Nothing pushes the board forward but the
forces of the constraints, while body and wheels swing. The moment of inertia of board, body and wheels together is
m l^2. There are other local optima, with other numbers of swings. Source: Ostrowski, Desai and Kumar (2000), Optimal
gait selection for nonholonomic locomotion systems; Bloch (2015), Nonholonomic mechanics and control, section 1.5.
"""

from sympy import cos, pi, sin

from codegen import Control, controls, coordinates, parameters, time
from codegen.drawing import Rod, Trail


def problem() -> Control:
    (x, y, theta, psi, phi), (dx, dy, dtheta, dpsi, dphi) = coordinates("x y theta psi phi")
    u_psi, u_phi = controls("u_psi u_phi")  # the torques that turn body and wheels
    m, half, J_body, J_wheel, d, T = parameters(m=1, l=0.5, J_body=0.1, J_wheel=0.01, d=0.3, T=4)
    t = time()
    front, back = ((cos(theta + a), sin(theta + a)) for a in (phi, -phi))  # the directions in which the wheels roll
    pivots = [(x + s * half * cos(theta), y + s * half * sin(theta)) for s in (1, -1)]
    wheels = [
        Rod((p - 0.1 * a, q - 0.1 * b), (p + 0.1 * a, q + 0.1 * b))
        for (p, q), (a, b) in zip(pivots, (front, back), strict=True)
    ]
    body = (0.2 * sin(theta + psi), -0.2 * cos(theta + psi))
    at_rest = dict.fromkeys((y, theta, psi, phi, dx, dy, dtheta, dpsi, dphi), 0)
    return Control(
        lagrangian=m * (dx**2 + dy**2 + half**2 * dtheta**2) / 2
        + J_body * (dpsi**2 + 2 * dtheta * dpsi) / 2
        + J_wheel * dphi**2,
        force={psi: u_psi, phi: u_phi},
        rolling=[
            front[0] * dy - front[1] * dx + half * cos(phi) * dtheta,
            back[0] * dy - back[1] * dx - half * cos(phi) * dtheta,
        ],
        cost=u_psi**2 + u_phi**2,
        duration=T,
        start={x: 0, **at_rest},
        end={x: d, **at_rest},
        guess={psi: -sin(2 * pi * t / T) / 5, phi: -4 * sin(3 * pi * t / T) / 5},
        steps=80,
        drawing=[Trail((x, y)), Rod(*pivots), *wheels, Rod((x - body[0], y - body[1]), (x + body[0], y + body[1]))],
    )
