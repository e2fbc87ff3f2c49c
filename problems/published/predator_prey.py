"""Find the parameters of a predator-prey model from measurements at 10 times.

x is the prey, y the predator. The clock runs from one sample to the next, one unit of time later, in one unit of t, and
stops there for another one, during which the squared distance from the measurement is integrated. Source: Lotka (1925),
Volterra (1926); PSOPT, example "predator".
"""

from sympy import Piecewise

from codegen import Control, free_parameter, states, time

PREY = (
    *(0.58462429, 1.480323792, 1.941197515, 1.266090393, 0.68499583),
    *(0.435253441, 0.404814065, 0.822427034, 1.771604896, 1.754832745),
)
PREDATOR = (
    *(1.653802752, 1.898433328, 0.791087389, 0.402385741, 0.435968041),
    *(0.725707829, 1.244405746, 2.052562952, 1.426515341, 0.548344791),
)


def problem() -> Control:
    x, y = states("x y")
    p_1, p_2, p_3, p_4 = (
        free_parameter(f"p_{i}", guess, lower=-1, upper=5) for i, guess in enumerate((0.8, 0.8, 1.5, 1.5), 1)
    )
    t, samples = time(), len(PREY)
    running = Piecewise(*((1 - i % 2, t < i + 1) for i in range(2 * samples)))
    x_measured, y_measured = (
        Piecewise(*((value, t < 2 * i + 2) for i, value in enumerate(values))) for values in (PREY, PREDATOR)
    )
    return Control(
        dynamics={x: running * (-p_1 * x + p_2 * x * y), y: running * (p_3 * y - p_4 * x * y)},
        cost=(1 - running) * ((x - x_measured) ** 2 + (y - y_measured) ** 2),
        duration=2 * samples,
        start={x: 0.4, y: 1},
        steps=2000,
    )
