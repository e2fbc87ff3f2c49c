"""Choose one constant rate such that a quantity decays to a small value with little effort.

The rate is a static parameter; the cost weighs the final value against the square of the rate. The optimum is
u = -7.5/26, with the cost 0.2163461538. Source: Hull, Optimal Control Theory for Applications (2003), example 9.5, with
a constant control; dymos, example "hull_problem".
"""

from codegen import Control, free_parameter, states


def problem() -> Control:
    (x,) = states("x,")
    u = free_parameter("u", 0)
    return Control(
        dynamics={x: u},
        cost=u**2 / 2,
        terminal_cost=2.5 * x**2,
        duration=5,
        start={x: 1.5},
        steps=10,
    )
