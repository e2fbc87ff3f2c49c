"""Swing up a pendulum that hangs from a cart, as bioptim's test of discrete mechanics and optimal control does.

The pendulum is a rigid body of unit mass, its centre of mass at (0.0688, -0.9542) m from the joint and its moment of
inertia 0.0391 kg m^2; the cart has no mass and is pushed by the force u. `holonomic` also lets the joint move
vertically, holds it at z = 0 by a constraint, and allows end velocities of 0.01. Source: bioptim,
tests/shard4/test_variational_integrator_examples.py. Build it with the trapezoidal rule, as there: its published values
for N = 20 are q_10 = (-0.325653795765479, 0.514317755981177), u_0 = 9.952650040830257, u_10 = 1.326124391015805 and
u_19 = -24.871395482788490 for the plain form, q_10 = (-0.5307718, 0, 0.7052470), u_0 = 10.502854, u_10 = 12.717297 and
u_19 = -19.131171 for the holonomic one.
"""

from typing import Literal

from sympy import cos, sin

from codegen import Control, control, coordinates, parameters
from codegen.drawing import Arrow, Box, Ground, Mass, Rod, Trail


def problem(form: Literal["plain", "holonomic"] = "plain") -> Control:
    holonomic = form == "holonomic"
    (y, *heights, theta), (dy, *vertical, dtheta) = coordinates("y z theta" if holonomic else "y theta")
    u = control("u")
    a, b, J, g, T, target = parameters(a=0.0688, b=0.9542, J=0.0391, g=9.81, T=1, target=3.14)

    z, dz = sum(heights), sum(vertical)
    sideways = dy + (b * cos(theta) - a * sin(theta)) * dtheta
    upwards = dz + (a * cos(theta) + b * sin(theta)) * dtheta
    potential = g * (z + a * sin(theta) - b * cos(theta))
    centre = y + b * sin(theta) + a * cos(theta), z + a * sin(theta) - b * cos(theta)
    at_rest = dict.fromkeys((*heights, *vertical), 0) | ({} if holonomic else {dy: 0, dtheta: 0})
    slow = [condition for v in (dy, dtheta) for condition in (v <= 0.01, v >= -0.01)] if holonomic else []
    cart = [Box((y, z), 0.3, 0.2), Arrow((y, z), (u / 50, 0), label="force")]
    return Control(
        lagrangian=(sideways**2 + upwards**2) / 2 + J / 2 * dtheta**2 - potential,
        force={y: u},
        cost=u**2,
        duration=T,
        start={y: 0, theta: 0, **at_rest},
        end={y: 0, theta: target, **at_rest},
        start_conditions=slow,
        end_conditions=slow,
        bounds={y: (-1, 5), theta: (-6.283185307179586, 6.283185307179586), u: (-100, 100)},
        constraint=heights,
        steps=20,
        drawing=[Ground((-1.2, -0.1), (1, -0.1)), Trail(centre), *cart, Rod((y, z), centre), Mass(centre, 0.07)],
    )
