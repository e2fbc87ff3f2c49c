"""Swing up a double pendulum that has a motor at its elbow only, with the least effort.

Point masses of 1 kg at the elbow and at the end of two massless links of 0.5 m; q1 and q2 are the links' absolute
angles, 0 when hanging. The motor turns the lower link one way and the upper link the other way, with at most 20 N m.
From hanging at rest the acrobot is to stand at rest after 2 s; the cost is the integral of the squared torque. Source:
OptimTraj's demo "acrobot" (Kelly, 2015). There are many local optima; the guess leads to the best one that is known,
34.919 N^2 m^2 s.
"""

from sympy import cos, pi, sin

from codegen import Control, control, coordinates, parameters, time
from codegen.drawing import Mass, Rod, Trail


def problem() -> Control:
    (q1, q2), (dq1, dq2) = coordinates("q1 q2")
    u = control("u")
    t = time()
    m1, m2, l1, l2, g, T, u_max = parameters(m1=1, m2=1, l1=0.5, l2=0.5, g=9.81, T=2, u_max=20)

    elbow = l1**2 * dq1**2
    wrist = elbow + l2**2 * dq2**2 + 2 * l1 * l2 * cos(q1 - q2) * dq1 * dq2
    upper = l1 * sin(q1), -l1 * cos(q1)
    lower = upper[0] + l2 * sin(q2), upper[1] - l2 * cos(q2)
    return Control(
        lagrangian=m1 / 2 * elbow + m2 / 2 * wrist + (m1 + m2) * g * l1 * cos(q1) + m2 * g * l2 * cos(q2),
        force={q1: -u, q2: u},
        cost=u**2,
        duration=T,
        start={q1: 0, q2: 0, dq1: 0, dq2: 0},
        end={q1: pi, q2: pi, dq1: 0, dq2: 0},
        bounds={u: (-u_max, u_max)},
        guess={q1: pi * (t / T) ** 2, q2: pi * t / T - 2 * sin(2 * pi * t / T)},
        steps=60,
        drawing=[Trail(lower), Rod((0, 0), upper), Rod(upper, lower), Mass(upper, 0.05), Mass(lower, 0.05)],
    )
