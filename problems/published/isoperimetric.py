"""Bring a nonlinear integrator from 1 to 0 such that the integral of its state is least, with a given energy.

The integral of the squared control is 10: a state with given values at both ends. Source: PSOPT, example
"isoperimetric", after Rutquist and Edvall, PROPT user's guide (2009).
"""

from sympy import sin

from codegen import Control, control, states


def problem() -> Control:
    x, energy = states("x energy")
    u = control("u")
    return Control(
        dynamics={x: -sin(x) + u, energy: u**2},
        cost=x,
        duration=1,
        start={x: 1, energy: 0},
        end={x: 0, energy: 10},
        bounds={u: (-4, 4)},
        steps=200,
    )
