"""Turn a rigid satellite by 180 degrees about a tilted axis with the least torque, in quaternion components.

The quaternion (a, b, c, d) has length one by a holonomic constraint; changes of its length have a kinetic energy, so
that the Lagrangian is regular. Source of the Lagrangian: Betsch and Siebert (2009), Rigid body dynamics in terms of
quaternions. All quantities are nondimensional.
"""

from sympy import Rational, cos, pi, sin, sqrt

from codegen import Control, controls, coordinates, parameters, time


def problem() -> Control:
    (a, b, c, d), (da, db, dc, dd) = coordinates("a b c d")
    I1, I2, I3 = parameters(I1=1, I2=2, I3=3)
    t1, t2, t3 = controls("t1 t2 t3")
    w1, w2, w3 = (
        2 * (a * db - b * da - c * dd + d * dc),
        2 * (a * dc + b * dd - c * da - d * db),
        2 * (a * dd - b * dc + c * db - d * da),
    )
    stretching = 2 * (a * da + b * db + c * dc + d * dd)
    axis, turned = (1 / sqrt(2), Rational(1, 2), Rational(1, 2)), pi * time() / 2
    return Control(
        lagrangian=(I1 * w1**2 + I2 * w2**2 + I3 * w3**2 + stretching**2) / 2,
        force={
            a: -2 * (b * t1 + c * t2 + d * t3),
            b: 2 * (a * t1 - d * t2 + c * t3),
            c: 2 * (d * t1 + a * t2 - b * t3),
            d: 2 * (-c * t1 + b * t2 + a * t3),
        },
        constraint=[a**2 + b**2 + c**2 + d**2 - 1],
        cost=t1**2 + t2**2 + t3**2,
        start={a: 1, b: 0, c: 0, d: 0, da: 0, db: 0, dc: 0, dd: 0},
        end={a: 0, b: axis[0], c: axis[1], d: axis[2], da: 0, db: 0, dc: 0, dd: 0},
        guess={a: cos(turned), **{x: part * sin(turned) for x, part in zip((b, c, d), axis)}},
        duration=1,
        steps=50,
    )
