"""Feed a fermenter such that most penicillin is in it after 132 hours.

x, p and s are the densities of biomass, penicillin and substrate, v is the volume, and u the feed of substrate. Without
substrate nothing grows; a density of substrate that is negative would make biomass of nothing. The value is the product
of p and v at the end. Source: Cuthrell and Biegler (1989), Computers and Chemical Engineering 13; Banga, Balsa-Canto,
Moles and Alonso (2005), Journal of Biotechnology 117, case study III.
"""

from sympy import Rational

from codegen import Control, control, states


def problem(hours: float = 132) -> Control:
    x, p, s, v = states("x p s v")
    u = control("u")
    growth = 0.11 * s / (0.006 * x + s)
    production = 0.0055 * s / (0.0001 + s * (1 + 10 * s))
    maintenance = 0.029 * s / (0.0001 + s)
    return Control(
        dynamics={
            x: growth * x - u * x / (500 * v),
            p: production * x - 0.01 * p - u * p / (500 * v),
            s: -growth * x / 0.47 - production * x / 1.2 - maintenance * x + u * (1 - s / 500) / v,
            v: u / 500,
        },
        terminal_maximise=p * v,
        duration=hours,
        start={x: 1.5, p: 0, s: 0, v: 7},
        bounds={x: (0, 40), s: (0, 25), v: (0, 10), u: (0, 50)},
        guess={x: 20, p: 5, s: Rational(1, 10), v: 8, u: 10},
        steps=50,
    )
