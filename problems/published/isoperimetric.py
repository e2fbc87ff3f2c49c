"""Bring a nonlinear integrator from 1 to 0 such that the integral of its state is least, with a given energy.

The integral of the squared control is 10. Source: PSOPT, example "isoperimetric", after Rutquist and Edvall, PROPT
user's guide (2009).
"""

from sympy import Eq, sin

from codegen import Control, control, state


def problem() -> Control:
    x = state("x")
    u = control("u")
    return Control(
        dynamics={x: -sin(x) + u},
        cost=x,
        duration=1,
        start={x: 1},
        end={x: 0},
        integral={"energy": Eq(u**2, 10)},
        bounds={u: (-4, 4)},
        steps=200,
    )
