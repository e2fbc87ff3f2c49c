"""Turn a telescopic robot arm by two thirds of a half circle in the least time.

The arm, of length L = 5, slides through a pivot: rho is the part in front of it, theta its angle in the horizontal
plane, phi that against the vertical. Each has a bounded drive of its own. Centrifugal and Coriolis forces are left out,
so the equations are no Lagrangian's. Source: Moessner-Beigel (1999); Dolan, More and Munson, Benchmarking optimization
software with COPS 3.0 (2004), "robot arm"; published value T = 9.14138, COPS and dymos; the limit is 9.1409. All
quantities are nondimensional.
"""

from sympy import pi, sin

from codegen import Control, controls, free_parameter, parameters, states


def problem() -> Control:
    rho, theta, phi, drho, dtheta, dphi = states("rho theta phi drho dtheta dphi")
    u_rho, u_theta, u_phi = controls("u_rho u_theta u_phi")
    (L,) = parameters(L=5)
    T = free_parameter("T", guess=10, lower=1)
    inertia = ((L - rho) ** 3 + rho**3) / 3

    return Control(
        dynamics={
            rho: drho,
            theta: dtheta,
            phi: dphi,
            drho: u_rho / L,
            dtheta: u_theta / (inertia * sin(phi) ** 2),
            dphi: u_phi / inertia,
        },
        cost=1,
        duration=T,
        start={rho: 4.5, theta: 0, phi: pi / 4, drho: 0, dtheta: 0, dphi: 0},
        end={rho: 4.5, theta: 2 * pi / 3, phi: pi / 4, drho: 0, dtheta: 0, dphi: 0},
        bounds=dict.fromkeys((u_rho, u_theta, u_phi), (-1, 1)),
        steps=100,
    )
