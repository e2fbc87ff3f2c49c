"""Turn a rigid body by 150 degrees about its first axis, from rest to rest, in the least time.

The attitude is a quaternion; torques about the three principal axes are bounded by 50. Turning about the first axis
alone takes longer, 34.31. The motion keeps the quaternion's length, so that its last component at the end follows.
Source: Bilimoria and Wie (1993); Fleming, Sekhavat and Ross (2010); PSOPT, example "reorientation", where that
component is an algebraic control.
"""

from sympy import rad, sin

from codegen import Control, controls, free_parameter, states


def problem() -> Control:
    q_1, q_2, q_3, q_4, w_1, w_2, w_3 = states("q_1 q_2 q_3 q_4 w_1 w_2 w_3")
    torques = u_1, u_2, u_3 = controls("u_1 u_2 u_3")
    T = free_parameter("T", 30, lower=25, upper=35)
    I_1, I_2, I_3 = 5621, 4547, 2364
    return Control(
        dynamics={
            q_1: (w_1 * q_4 - w_2 * q_3 + w_3 * q_2) / 2,
            q_2: (w_1 * q_3 + w_2 * q_4 - w_3 * q_1) / 2,
            q_3: (-w_1 * q_2 + w_2 * q_1 + w_3 * q_4) / 2,
            q_4: -(w_1 * q_1 + w_2 * q_2 + w_3 * q_3) / 2,
            w_1: (u_1 - (I_3 - I_2) * w_2 * w_3) / I_1,
            w_2: (u_2 - (I_1 - I_3) * w_1 * w_3) / I_2,
            w_3: (u_3 - (I_2 - I_1) * w_1 * w_2) / I_3,
        },
        terminal_cost=T,
        duration=T,
        start={q_1: 0, q_2: 0, q_3: 0, q_4: 1, w_1: 0, w_2: 0, w_3: 0},
        end={q_1: sin(rad(75)), q_2: 0, q_3: 0, w_1: 0, w_2: 0, w_3: 0},
        bounds=dict.fromkeys(torques, (-50, 50)),
        steps=400,
    )
