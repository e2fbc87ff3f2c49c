"""Damp Rayleigh's oscillator of an electric circuit under a bound that ties control and state.

Source: Jacobson and Mayne (1970); Betts, Practical Methods for Optimal Control, 3rd ed., example 10.113; PSOPT,
example "rayleigh" (coarser).
"""

from codegen import Control, control, states


def problem() -> Control:
    x, y = states("x y")
    u = control("u")
    return Control(
        dynamics={x: y, y: -x + y * (1.4 - 0.14 * y**2) + 4 * u},
        cost=u**2 + x**2,
        duration=4.5,
        start={x: -5, y: -5},
        path=[u + x / 6 <= 0],
        steps=500,
    )
