"""Move a horizontal arm of two links from rest to rest in the least time, with bounded torques.

alpha and beta are the links' absolute angles; u1 acts at the shoulder, u2 at the elbow, both at most 1. The links are
uniform rods of unit mass and length, and the hand carries a unit mass. Source: Weinreb and Bryson, Optimal control of
systems with hard control bounds (1985); data of Luus, Iterative Dynamic Programming (2000), section 12.4.2, as in the
examples of PROPT and PSOPT. All quantities are nondimensional. Published value: T = 2.988662, PSOPT on 40 nodes; the
limit is 2.9823.
"""

from sympy import Rational, cos, sin

from codegen import Control, controls, coordinates, free_parameter, parameters
from codegen.drawing import Mass, Rod, Trail


def problem() -> Control:
    (alpha, beta), (dalpha, dbeta) = coordinates("alpha beta")
    u1, u2 = controls("u1 u2")
    elbow, target, greatest = parameters(elbow=0.5, target=0.522, greatest=1)
    T = free_parameter("T", guess=3, lower=1, upper=10)

    first, second, both = Rational(7, 3), Rational(4, 3), Rational(3, 2)
    joint = cos(alpha), sin(alpha)
    hand = joint[0] + cos(beta), joint[1] + sin(beta)
    return Control(
        lagrangian=first / 2 * dalpha**2 + second / 2 * dbeta**2 + both * cos(beta - alpha) * dalpha * dbeta,
        force={alpha: u1 - u2, beta: u2},
        cost=1,
        duration=T,
        start={alpha: 0, beta: elbow, dalpha: 0, dbeta: 0},
        end={alpha: target, beta: target + elbow, dalpha: 0, dbeta: 0},
        bounds={u1: (-greatest, greatest), u2: (-greatest, greatest)},
        steps=100,
        drawing=[Trail(hand, label="hand"), Rod((0, 0), joint), Rod(joint, hand), Mass(joint, 0.04), Mass(hand, 0.08)],
    )
