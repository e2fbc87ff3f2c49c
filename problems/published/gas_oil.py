"""Find the rates at which gas oil is cracked, from measurements at 21 times.

a is the share of gas oil, b that of gasoline. Source: Tjoa and Biegler (1991); COPS 3.0 (2004), "catalytic cracking of
gas oil".
"""

from codegen import Control, Measurements, free_parameter, states


def problem() -> Control:
    a, b = states("a b")
    k_1, k_2, k_3 = (free_parameter(f"k_{i}", 0, lower=0) for i in (1, 2, 3))
    return Control(
        dynamics={a: -(k_1 + k_3) * a**2, b: k_1 * a**2 - k_2 * b},
        observations=Measurements("../data/gas_oil.csv", values={a: "z1", b: "z2"}),
        duration=0.95,
        start={a: 1, b: 0},
        steps=7600,
    )
