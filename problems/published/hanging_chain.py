"""Hang a chain of length 4 between two points such that its potential energy is least.

The chain goes from height 1 to height 3 over a horizontal distance of 1; the control is its slope. Its length is an
integral that is given. All quantities are nondimensional. Source: Dolan, More and Munson, Benchmarking optimization
software with COPS 3.0 (2004), "hanging chain"; also PSOPT, example "chain". The solution is a catenary.
"""

from sympy import Eq, sqrt

from codegen import Control, control, state


def problem() -> Control:
    height = state("height")
    slope = control("slope")
    stretch = sqrt(1 + slope**2)
    return Control(
        dynamics={height: slope},
        cost=height * stretch,
        duration=1,
        start={height: 1},
        end={height: 3},
        integral={"length of the chain": Eq(stretch, 4)},
        bounds={slope: (-20, 20)},
        guess={slope: 2},
        steps=1000,
    )
