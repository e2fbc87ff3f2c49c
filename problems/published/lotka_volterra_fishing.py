"""Fish such that prey and predators come to the steady state of both.

x and y are the prey and the predators, w is the share of the fleet that is at sea, relaxed from 0 or 1 to numbers
between. The optimal control ends in a singular arc. Source: Sager (2005), mintoc.de, "Lotka-Volterra fishing problem",
whose relaxation is the lower bound; PSOPT, example "lotka".
"""

from codegen import Control, control, states


def problem() -> Control:
    x, y = states("x y")
    w = control("w")
    return Control(
        dynamics={x: x - x * y - 0.4 * x * w, y: -y + x * y - 0.2 * y * w},
        cost=(x - 1) ** 2 + (y - 1) ** 2,
        duration=12,
        start={x: 0.5, y: 0.7},
        bounds={w: (0, 1)},
        steps=1000,
    )
