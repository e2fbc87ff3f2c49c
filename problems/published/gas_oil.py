"""Find the rates at which gas oil is cracked, from measurements at 20 times.

a is the share of gas oil, b that of gasoline. The clock s runs from one sample to the next in one unit of t, and stops
there for another one, during which the squared distance from the measurement is integrated. What is measured at time 0
is met exactly. Source: Tjoa and Biegler (1991); COPS 3.0 (2004), "catalytic cracking of gas oil".
"""

from sympy import Piecewise

from codegen import Control, free_parameter, states, time

TIMES = (
    *(0, 0.025, 0.05, 0.075, 0.1, 0.125, 0.15, 0.175, 0.2, 0.225, 0.25),
    *(0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.65, 0.75, 0.85, 0.95),
)
GAS_OIL = (
    *(0.8105, 0.6208, 0.5258, 0.4345, 0.3903, 0.3342, 0.3034, 0.2735, 0.2405, 0.2283),
    *(0.2071, 0.1669, 0.153, 0.1339, 0.1265, 0.12, 0.099, 0.087, 0.077, 0.069),
)
GASOLINE = (
    *(0.2, 0.2886, 0.301, 0.3215, 0.3123, 0.2716, 0.2551, 0.2258, 0.1959, 0.1789),
    *(0.1457, 0.1198, 0.0909, 0.0719, 0.0561, 0.046, 0.028, 0.019, 0.014, 0.01),
)


def problem() -> Control:
    a, b = states("a b")
    k_1, k_2, k_3 = (free_parameter(f"k_{i}", 0, lower=0) for i in (1, 2, 3))
    t, samples = time(), len(GAS_OIL)
    ds = Piecewise(*((TIMES[i // 2 + 1] - TIMES[i // 2] if i % 2 == 0 else 0, t < i + 1) for i in range(2 * samples)))
    measuring = Piecewise(*((i % 2, t < i + 1) for i in range(2 * samples)))
    a_measured, b_measured = (
        Piecewise(*((value, t < 2 * i + 2) for i, value in enumerate(values))) for values in (GAS_OIL, GASOLINE)
    )
    return Control(
        dynamics={a: -ds * (k_1 + k_3) * a**2, b: ds * (k_1 * a**2 - k_2 * b)},
        cost=measuring * ((a - a_measured) ** 2 + (b - b_measured) ** 2),
        duration=2 * samples,
        start={a: 1, b: 0},
        steps=4000,
    )
