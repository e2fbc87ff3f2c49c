"""Follow eight reactions of plants to light.

Source: Hairer and Wanner (1996), Solving ordinary differential equations II, IV.10 (Schaefer 1975). All quantities are
nondimensional.
"""

from codegen import Simulate, states


def problem() -> Simulate:
    y = states("y1 y2 y3 y4 y5 y6 y7 y8")
    bound = 280 * y[5] * y[7]
    rates = (
        -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007,
        1.71 * y[0] - 8.75 * y[1],
        -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4],
        8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
        -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6],
        -bound + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
        bound - 1.81 * y[6],
        1.81 * y[6] - bound,
    )
    start = dict(zip(y, (1, 0, 0, 0, 0, 0, 0, 0.0057), strict=True))
    return Simulate(dynamics=dict(zip(y, rates, strict=True)), start=start, duration=321.8122, steps=2000)
