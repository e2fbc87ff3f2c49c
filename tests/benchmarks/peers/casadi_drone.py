"""The optimum of `problems/drone_in_space.py` by CasADi and IPOPT, from a second description of the problem.

    python tests/benchmarks/peers/casadi_drone.py [--intervals N]

The attitude is a quaternion among 13 first-order states. Between two gates there are N intervals of Gauss-Legendre
collocation of order 4, with one control each. 30 intervals give the cost 2.98731 and the time 2.47519, after 377
iterations.
"""

from __future__ import annotations

import argparse
from itertools import pairwise

import casadi as ca
import numpy as np

MASS, GRAVITY, ARM, DRAG, EFFORT, LARGEST = 1.0, 9.81, 0.17, 0.016, 0.002, 6.0
INERTIA = np.array([0.01, 0.01, 0.018])
PLACES = [(0, 0, 0), (2, 1, 1.5), (4, -1, 2), (2, -2, 0.5), (0, 0, 0)]
STAGES = 2
REST = np.array([0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0], dtype=float)
"""Position, velocity, quaternion (w, x, y, z) and angular velocity of the drone at rest at home."""


def rates(state: ca.MX, rotors: ca.MX) -> ca.MX:
    """Return the time derivative of the state (13,) under the forces (4,) of the rotors."""
    velocity, q, spin = state[3:6], state[6:10], state[10:13]
    w, x, y, z = ca.vertsplit(q / ca.norm_2(q))
    upward = ca.vertcat(2 * (x * z + w * y), 2 * (y * z - w * x), w**2 - x**2 - y**2 + z**2)
    acceleration = upward * ca.sum1(rotors) / MASS - ca.DM([0, 0, GRAVITY])
    torque = ca.vertcat(
        ARM * (rotors[1] - rotors[3]), ARM * (rotors[2] - rotors[0]),
        DRAG * (rotors[0] - rotors[1] + rotors[2] - rotors[3]),
    )  # fmt: skip
    a, b, c = ca.vertsplit(spin)
    turning = ca.vertcat(-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a)
    return ca.vertcat(velocity, acceleration, turning / 2, (torque - ca.cross(spin, INERTIA * spin)) / INERTIA)


def optimum(intervals: int) -> tuple[float, float, int]:
    """Return cost, duration and iterations of IPOPT."""
    derivative, last, _ = ca.collocation_coeff(ca.collocation_points(STAGES, "legendre"))
    opti = ca.Opti()
    durations, state, cost = opti.variable(len(PLACES) - 1), opti.variable(13), ca.MX(0)
    opti.set_initial(durations, 1)
    opti.set_initial(state, REST)
    opti.subject_to(state == REST)
    for phase, (begin, end) in enumerate(pairwise(PLACES)):
        step = durations[phase] / intervals
        opti.subject_to(durations[phase] >= 0.05)
        for k in range(intervals):
            rotors, inside, after = opti.variable(4), opti.variable(13, STAGES), opti.variable(13)
            opti.subject_to(opti.bounded(0, rotors, LARGEST))
            opti.set_initial(rotors, MASS * GRAVITY / 4)
            part = (k + 0.5) / intervals
            guess = REST + np.r_[(1 - part) * np.array(begin) + part * np.array(end), np.zeros(10)]
            opti.set_initial(after, guess)
            points = ca.horzcat(state, inside)
            slopes = ca.mtimes(points, derivative)
            for stage in range(STAGES):
                opti.set_initial(inside[:, stage], guess)
                opti.subject_to(slopes[:, stage] == step * rates(inside[:, stage], rotors))
            opti.subject_to(after == ca.mtimes(points, last))
            cost += step * (1 + EFFORT * ca.sumsqr(rotors))
            state = after
        opti.subject_to(state[:3] == ca.DM(end))
    opti.subject_to(ca.vertcat(state[3:6], state[7:13]) == 0)
    opti.minimize(cost)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "max_iter": 1000})
    solution = opti.solve()
    return float(solution.value(cost)), float(sum(solution.value(durations))), solution.stats()["iter_count"]


def main() -> None:
    """Print the optimum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--intervals", type=int, default=30, help="intervals between two gates")
    cost, duration, iterations = optimum(parser.parse_args().intervals)
    print(f"cost {cost:.6g}, duration {duration:.6g}, {iterations} iterations")


if __name__ == "__main__":
    main()
