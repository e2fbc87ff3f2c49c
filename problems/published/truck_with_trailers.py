"""Park a truck with two trailers in reverse and in the least time, without jackknifing.

theta_0, theta_1 and theta_2 are the headings of the truck and of its trailers, (x, y) is the place of the last axle,
v_0 and delta are the truck's speed and steering angle, and their rates are the controls. The cost is the time plus the
integral of the squared angles at both hitches. Source: control-toolbox, CTDirect.jl and OptimalControlProblems.jl,
"truck_trailer".
"""

from sympy import Eq, cos, pi, sin, tan

from codegen import Control, controls, free_parameter, states


def problem() -> Control:
    theta_0, theta_1, theta_2, x, y, v_0, delta = states("theta_0 theta_1 theta_2 x y v_0 delta")
    p, q = controls("p q")
    T = free_parameter("T", 10, lower=1, upper=1000)
    L_0, M_0, L_1, M_1, L_2 = 0.4, 0.1, 1.1, 0.2, 0.8

    b_01, b_12 = theta_0 - theta_1, theta_1 - theta_2
    rate_0 = v_0 / L_0 * tan(delta)
    rate_1 = v_0 / L_1 * sin(b_01) - M_0 / L_1 * cos(b_01) * rate_0
    v_1 = v_0 * cos(b_01) + M_0 * sin(b_01) * rate_0
    rate_2 = v_1 / L_2 * sin(b_12) - M_1 / L_2 * cos(b_12) * rate_1
    v_2 = v_1 * cos(b_12) + M_1 * sin(b_12) * rate_1

    right = pi / 2
    return Control(
        dynamics={
            theta_0: rate_0,
            theta_1: rate_1,
            theta_2: rate_2,
            x: v_2 * cos(theta_2),
            y: v_2 * sin(theta_2),
            v_0: p,
            delta: q,
        },
        cost=b_01**2 + b_12**2,
        terminal_cost=T,
        duration=T,
        start={x: 0, y: 0, theta_0: 0, theta_1: 0, theta_2: 0},
        end={x: 0, y: -2, theta_2: right},
        end_conditions=[Eq(b_01, 0), Eq(b_12, 0)],
        bounds={
            theta_0: (-right, right),
            theta_1: (-right, right),
            v_0: (-0.2, 0.2),
            delta: (-pi / 6, pi / 6),
            p: (-1, 1),
            q: (-pi / 10, pi / 10),
        },
        path=[b_01 >= -right, b_01 <= right, b_12 >= -right, b_12 <= right],
        steps=200,
    )
