"""Turn a rigid body by 150 degrees about its first axis, from rest to rest, in the least time.

Torques about the three principal axes are bounded by 50. Turning about the first axis alone takes longer, 34.31.
Source: Bilimoria and Wie (1993); Fleming, Sekhavat and Ross (2010); PSOPT, example "reorientation", which has a
quaternion as its states, and one component of it as an algebraic control.
"""

from sympy import Matrix, diag, eye, rad

from codegen import Control, controls, free_parameter, rotation


def problem() -> Control:
    R, omega = rotation("R")
    torques = controls("u_1 u_2 u_3")
    T = free_parameter("T", 30, lower=25, upper=35)
    inertia = diag(5621, 4547, 2364)
    return Control(
        lagrangian=omega.dot(inertia * omega) / 2,
        force={R: Matrix(torques)},
        terminal_cost=T,
        duration=T,
        start={R: eye(3), omega: (0, 0, 0)},
        end={R: ([1, 0, 0], rad(150)), omega: (0, 0, 0)},
        bounds=dict.fromkeys(torques, (-50, 50)),
        steps=500,
    )
