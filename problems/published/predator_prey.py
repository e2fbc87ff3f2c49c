"""Find the parameters of a predator-prey model from measurements at 10 times.

x is the prey, y the predator. Source: Lotka (1925), Volterra (1926); PSOPT, example "predator".
"""

from codegen import Control, Measurements, free_parameter, states


def problem() -> Control:
    x, y = states("x y")
    p_1, p_2, p_3, p_4 = (
        free_parameter(f"p_{i}", guess, lower=-1, upper=5) for i, guess in enumerate((0.8, 0.8, 1.5, 1.5), 1)
    )
    return Control(
        dynamics={x: -p_1 * x + p_2 * x * y, y: p_3 * y - p_4 * x * y},
        observations=Measurements("../data/predator_prey.csv", values={x: "x", y: "y"}),
        duration=10,
        start={x: 0.4, y: 1},
        steps=4000,
    )
