"""Find the rates at which methanol turns into hydrocarbons, from measurements at 17 times.

a, b and c are the shares of methanol and dimethyl ether, olefins, and paraffins with aromatics. Source: Floudas et al.,
Handbook of Test Problems (1999); COPS 3.0 (2004), "methanol to hydrocarbons".
"""

from codegen import Control, Measurements, free_parameter, states


def problem() -> Control:
    a, b, c = states("a b c")
    k_1, k_2, k_3, k_4, k_5 = (free_parameter(f"k_{i}", 1, lower=0) for i in range(1, 6))
    d = (k_2 + k_5) * a + b
    return Control(
        dynamics={
            a: -(2 * k_2 - k_1 * b / d + k_3 + k_4) * a,
            b: k_1 * a * (k_2 * a - b) / d + k_3 * a,
            c: k_1 * a * (b + k_5 * a) / d + k_4 * a,
        },
        observations=Measurements("../data/methanol.csv", values={a: "z1", b: "z2", c: "z3"}),
        duration=1.122,
        start={a: 1, b: 0, c: 0},
        steps=1122,
    )
