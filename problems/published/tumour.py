"""Shrink a tumour as far as a limited amount of a drug against its blood vessels can.

p is the volume of the tumour, q that of its blood vessels in mm^3, z the drug used, u its dose; the treatment's
duration is free. Source: Ledzewicz and Schaettler (2007); Betts, Practical Methods for Optimal Control, 3rd ed.,
example 10.141; pycollo, with the values of SOS and GPOPS-II.
"""

from sympy import Rational, log

from codegen import Control, control, free_parameter, states, time


def problem() -> Control:
    p, q, z = states("p q z")
    u = control("u")
    t = time()
    T = free_parameter("T", 1, lower=0.1, upper=5)
    P = ((5.85 - 0.02) / 0.00873) ** 1.5
    return Control(
        dynamics={
            p: -0.084 * p * log(p / q),
            q: q * (5.85 - 0.02 - 0.00873 * p ** Rational(2, 3) - 0.15 * u),
            z: u,
        },
        terminal_cost=p,
        duration=T,
        start={p: P / 2, q: P / 4, z: 0},
        bounds={u: (0, 75), p: (0.01, P), q: (0.01, P)},
        end_conditions=[z <= 15],
        guess={p: P / 2 * (1 + t), q: P / 4 * (1 + 3 * t), u: 75},
        steps=500,
    )
