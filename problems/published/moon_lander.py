"""Land on the moon from a given height and speed with the least fuel.

The unit of acceleration is the moon's gravity; the thrust lies between 0 and 1.227 and uses up mass. The optimal
lander falls freely for 0.2392591 and then burns at full thrust for 1.1575490. Source: Meditch (1964); PSOPT, example
"moon"; dymos has it as well.
"""

from codegen import Control, control, free_parameter, states


def problem() -> Control:
    height, v, m = states("height v m")
    thrust = control("thrust")
    T = free_parameter("T", 1.5, lower=0)
    return Control(
        dynamics={height: v, v: -1 + thrust / m, m: -thrust / 2.349},
        cost=thrust,
        duration=T,
        start={height: 1, v: -0.783, m: 1},
        end={height: 0, v: 0},
        bounds={thrust: (0, 1.227), m: (0.01, None)},
        steps=200,
    )
