"""Swing the pole of a cart up and bring both to rest, with the least effort.

The cart (1 kg) moves along a rail of 2 m to either side and is pushed by at most 20 N; the pole is a point mass of 0.3
kg on a massless rod of 0.5 m. From rest with the pole hanging, cart and pole are to be at rest 1 m further with the
pole upright, after 2 s. The angle counts from the hanging position; the cost is the integral of the squared force.
Source: Kelly, An introduction to trajectory optimization, SIAM Review 59 (2017), section 6 and appendix E.1. Published
value: 58.8839489745 N^2 s, dymos's test of the same data (there with 40 segments and no force at the end); the limit is
58.80767.
"""

from sympy import cos, pi, sin

from codegen import Control, control, coordinates, parameters
from codegen.drawing import Arrow, Box, Ground, Mass, Rod, Trail


def problem() -> Control:
    (x, theta), (dx, dtheta) = coordinates("x theta")
    u = control("u")
    m1, m2, rod, g, d, T = parameters(m1=1, m2=0.3, rod=0.5, g=9.81, d=1, T=2)
    u_max, d_max = parameters(u_max=20, d_max=2)

    kinetic = (m1 + m2) / 2 * dx**2 + m2 * rod * cos(theta) * dx * dtheta + m2 * rod**2 / 2 * dtheta**2
    bob = x + rod * sin(theta), -rod * cos(theta)
    cart = [Box((x, 0), 0.24, 0.12), Arrow((x, 0), (u / u_max, 0), label="force")]
    return Control(
        lagrangian=kinetic + m2 * g * rod * cos(theta),
        force={x: u},
        cost=u**2,
        duration=T,
        start={x: 0, theta: 0, dx: 0, dtheta: 0},
        end={x: d, theta: pi, dx: 0, dtheta: 0},
        bounds={x: (-d_max, d_max), u: (-u_max, u_max)},
        steps=50,
        drawing=[Ground((-d, -0.06), (2 * d, -0.06)), Trail(bob), *cart, Rod((x, 0), bob), Mass(bob, 0.04)],
    )
