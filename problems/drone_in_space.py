"""Fly a drone in space through three gates and home again, soon and with little effort (an example of the project).

The drone is a rigid body with a position x and an attitude R. Four rotors push along the body's third axis, and turn
it by their distances from the centre and by their drag. A gate is a point in space, through which the drone flies at
a free time. The drone begins and ends at rest, upright.
"""

from sympy import Eq, Matrix, diag

from codegen import Control, controls, free_parameter, parameters, pose
from codegen.drawing import Mark, Rod, Trail


def problem() -> Control:
    (x, R), (v, omega) = pose("drone")
    rotors = f1, f2, f3, f4 = controls("f1 f2 f3 f4", unit="N")
    T = free_parameter("T", 4, lower=1)
    m, g, arm, drag, effort = parameters(m=1, g=9.81, arm=0.17, drag=0.016, effort=0.002)
    inertia = diag(0.01, 0.01, 0.018)
    thrust = Matrix([0, 0, sum(rotors)])
    torque = Matrix([arm * (f2 - f4), arm * (f3 - f1), drag * (f1 - f2 + f3 - f4)])
    gates = [(2, 1, 1.5), (4, -1, 2), (2, -2, 0.5)]
    arms = [R @ Matrix(place) for place in ((0.3, 0, 0), (0, 0.3, 0))]
    return Control(
        lagrangian=m * v.dot(v) / 2 + omega.dot(inertia * omega) / 2 - m * g * x[2],
        force={x: R @ thrust, R: torque},
        cost=1 + effort * sum(f**2 for f in rotors),
        duration=T,
        start={x: (0, 0, 0), v: (0, 0, 0), R: ([0, 0, 1], 0), omega: (0, 0, 0)},
        end={x: (0, 0, 0), v: (0, 0, 0), R: ([0, 0, 1], 0), omega: (0, 0, 0)},
        bounds=dict.fromkeys(rotors, (0, 6)),
        waypoints=[[Eq(here, there) for here, there in zip(x, gate, strict=True)] for gate in gates],
        guess=dict.fromkeys(rotors, m * g / 4),
        steps=120,
        drawing=[Trail(x), *(Rod(x - each, x + each) for each in arms), *(Mark(gate) for gate in gates)],
    )
