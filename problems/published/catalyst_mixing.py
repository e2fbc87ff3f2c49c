"""Mix two catalysts along a reactor such that the yield of the last of three substances is greatest.

a and b are the shares of the first two substances, u that of the first catalyst: 1, then singular, then 0. Source: von
Stryk (1999); COPS 3.0 (2004), "catalyst mixing"; PSOPT, example "catmix".
"""

from codegen import Control, control, states, time


def problem() -> Control:
    a, b = states("a b")
    u = control("u")
    t = time()
    return Control(
        dynamics={a: u * (10 * b - a), b: u * (a - 10 * b) - (1 - u) * b},
        terminal_cost=a + b - 1,
        duration=1,
        start={a: 1, b: 0},
        bounds={u: (0, 1)},
        guess={a: 1 - 0.085 * t, b: 0.05 * t, u: 1 - t},
        steps=500,
    )
