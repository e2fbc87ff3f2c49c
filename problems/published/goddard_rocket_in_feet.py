"""Launch a sounding rocket vertically such that it flies as high as its fuel can bring it, in feet and seconds.

The mass falls from 3 to 1; drag is sigma v^2 exp(-h/23800). The thrust is full, singular, then zero. Source: Bryson,
Dynamic Optimization (1999), and yapss, example "goddard_problem_3_phase"; with greatest = 200, sigma = 5.4915e-5 and
c = 1580.9425 dymos has 18745. opty's example of Betts 10.47 quotes 18664.187, which belongs to other data.
"""

from sympy import exp

from codegen import Control, control, free_parameter, states


def problem(greatest: float = 193.044, sigma: float = 5.49153484923381e-5, c: float = 1580.9425279876559) -> Control:
    altitude, v, m = states("altitude v m")
    thrust = control("thrust")
    T = free_parameter("T", 60, lower=20, upper=100)
    drag = sigma * v**2 * exp(-altitude / 23800)
    return Control(
        dynamics={altitude: v, v: (thrust - drag) / m - 32.174, m: -thrust / c},
        terminal_cost=-altitude,
        duration=T,
        start={altitude: 0, v: 0, m: 3},
        end={m: 1},
        bounds={thrust: (0, greatest), m: (1, None), v: (0, None)},
        steps=400,
    )
