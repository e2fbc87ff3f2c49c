"""Steer an integrator through a given point on its way, with the least sum of squares of state and control.

Two phases of given durations meet at x = 0.9. Source: PSOPT, example "interior_point"; the optimum consists of
hyperbolic functions.
"""

from codegen import Control, Phases, control, states


def problem() -> Phases:
    (x,) = states("x,")
    u = control("u")
    motion = {"dynamics": {x: u}, "cost": x**2 + u**2, "steps": 300}
    return Phases(
        Control(**motion, duration=0.75, start={x: 1}, end={x: 0.9}),
        Control(**motion, duration=0.25, end={x: 0.75}),
    )
