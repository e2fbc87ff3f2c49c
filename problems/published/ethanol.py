"""Feed a fermenter such that most ethanol is in it at the end.

x, s and p are the densities of biomass, substrate and ethanol, v is the volume, and u the feed. The value is the
product of p and v at the end. Source: Chen and Hwang (1990), Chemical Engineering Communications 97; Banga,
Balsa-Canto, Moles and Alonso (2005), Journal of Biotechnology 117, case study IV.
"""

from codegen import Control, control, parameter, states


def problem() -> Control:
    x, s, p, v = states("x s p v")
    u = control("u")
    hours = parameter("hours", 61.17)
    growth = 0.408 / (1 + p / 16) * s / (0.22 + s)
    production = 1 / (1 + p / 71.5) * s / (0.44 + s)
    return Control(
        dynamics={
            x: growth * x - u * x / v,
            s: -10 * growth * x + u * (150 - s) / v,
            p: production * x - u * p / v,
            v: u,
        },
        terminal_maximise=p * v,
        duration=hours,
        start={x: 1, s: 150, p: 0, v: 10},
        bounds={x: (0, None), s: (0, None), p: (0, None), v: (0, 200), u: (0, 12)},
        guess={x: 5, s: 50, p: 50, v: 100, u: 3},
        steps=100,
    )
