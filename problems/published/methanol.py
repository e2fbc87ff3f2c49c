"""Find the rates at which methanol turns into hydrocarbons, from measurements at 16 times.

a, b and c are the shares of methanol and dimethyl ether, olefins, and paraffins with aromatics. The clock runs from one
sample to the next in one unit of t, and stops there for another one, during which the squared distance from the
measurement is integrated. What is measured at time 0 is met exactly. Source: Floudas et al., Handbook of Test Problems
(1999); COPS 3.0 (2004), "methanol to hydrocarbons".
"""

from sympy import Piecewise

from codegen import Control, free_parameter, states, time

TIMES = (
    *(0, 0.05, 0.065, 0.08, 0.123, 0.233, 0.273, 0.354, 0.397),
    *(0.418, 0.502, 0.553, 0.681, 0.75, 0.916, 0.937, 1.122),
)
MEASURED = (
    (
        *(0.7085, 0.5971, 0.5537, 0.3684, 0.1712, 0.1198, 0.0747, 0.0529),
        *(0.0415, 0.0261, 0.0208, 0.0085, 0.0053, 0.0019, 0.0018, 0.0006),
    ),
    (
        *(0.1621, 0.1855, 0.1989, 0.2845, 0.3491, 0.3098, 0.3576, 0.3347),
        *(0.3388, 0.3557, 0.3483, 0.3836, 0.3611, 0.3609, 0.3485, 0.3698),
    ),
    (
        *(0.0811, 0.0965, 0.1198, 0.1535, 0.2097, 0.2628, 0.2467, 0.2884),
        *(0.2757, 0.3167, 0.2954, 0.295, 0.2937, 0.2831, 0.2846, 0.2899),
    ),
)


def problem() -> Control:
    a, b, c = state = states("a b c")
    k_1, k_2, k_3, k_4, k_5 = (free_parameter(f"k_{i}", 1, lower=0) for i in range(1, 6))
    t, samples = time(), len(TIMES) - 1
    ds = Piecewise(*((TIMES[i // 2 + 1] - TIMES[i // 2] if i % 2 == 0 else 0, t < i + 1) for i in range(2 * samples)))
    measuring = Piecewise(*((i % 2, t < i + 1) for i in range(2 * samples)))
    measured = [Piecewise(*((value, t < 2 * i + 2) for i, value in enumerate(values))) for values in MEASURED]

    d = (k_2 + k_5) * a + b
    rates = {
        a: -(2 * k_2 - k_1 * b / d + k_3 + k_4) * a,
        b: k_1 * a * (k_2 * a - b) / d + k_3 * a,
        c: k_1 * a * (b + k_5 * a) / d + k_4 * a,
    }
    return Control(
        dynamics={x: ds * rate for x, rate in rates.items()},
        cost=measuring * sum((x - z) ** 2 for x, z in zip(state, measured, strict=True)),
        duration=2 * samples,
        start={a: 1, b: 0, c: 0},
        steps=1280,
    )
