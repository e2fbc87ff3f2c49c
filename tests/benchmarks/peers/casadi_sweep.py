"""The orbital transfer for many radii and masses, as one does it without codegen: joblib over CasADi and IPOPT.

The program of `casadi_control.py` with the radius r1 and the mass m as parameters of one solver, which every process
makes once. Cases are shared in batches, so that joblib itself takes next to nothing.
"""

from __future__ import annotations

from functools import cache
from time import perf_counter, process_time
from typing import Any

import casadi as ca
import numpy as np
from joblib import Parallel, delayed

from .casadi_control import IPOPT_OPTIONS

GM, R0 = 0.40038, 5.0
BATCH = 100


def _duration(r1: Any) -> Any:
    return ca.pi * (ca.sqrt(R0**3 / GM) + ca.sqrt(r1**3 / GM))


@cache
def solver(steps: int) -> ca.Function:
    """IPOPT for unknowns u_0, q_1, u_1, ..., as a function of a guess and of (r1, m)."""
    p = ca.MX.sym("p", 2)
    h, q0, q1, u = ca.SX.sym("h"), ca.SX.sym("q0", 2), ca.SX.sym("q1", 2), ca.SX.sym("u")
    mass, q, v = ca.SX.sym("m"), ca.SX.sym("q", 2), ca.SX.sym("v", 2)

    def lagrangian(q: Any, v: Any) -> Any:
        return mass / 2 * (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) + GM * mass / q[0]

    middle = (q0 + q1) / 2
    action, impulse = h * lagrangian(middle, (q1 - q0) / h), h / 2 * ca.vertcat(0, middle[0] * u)
    left, right = ca.gradient(action, q0) + impulse, ca.gradient(action, q1) + impulse
    interval = ca.Function("interval", [q0, q1, u, h, mass], [h * u**2, left, right])
    momentum = ca.Function("momentum", [q, v, mass], [ca.gradient(lagrangian(q, v), v)])

    x = ca.MX.sym("x", 3 * (steps - 1) + 1)
    inner = ca.reshape(x[1:], 3, steps - 1)
    first, last = ca.DM([R0, 0.0]), ca.vertcat(p[0], 2 * ca.pi)
    places, controls = ca.horzcat(first, inner[:2, :], last), ca.horzcat(x[0], inner[2, :])
    length = _duration(p[0]) / steps
    cost, left, right = interval.map(steps)(places[:, :-1], places[:, 1:], controls, length, p[1])
    begun = momentum(first, ca.vertcat(0, np.sqrt(GM / R0**3)), p[1])
    ended = momentum(last, ca.vertcat(0, ca.sqrt(GM / p[0] ** 3)), p[1])
    rows = ca.horzcat(begun + left[:, 0], right[:, :-1] + left[:, 1:], right[:, -1] - ended)
    program = {"x": x, "p": p, "f": ca.sum2(cost), "g": ca.vec(rows)}
    return ca.nlpsol("transfer", "ipopt", program, {**IPOPT_OPTIONS, "expand": True})


def _batch(cases: Any, steps: int) -> tuple[Any, float, int]:
    own = solver(steps)
    begin, costs = process_time(), []
    for r1, mass in cases:
        parts = np.arange(1, steps) / steps
        guess = np.zeros(3 * (steps - 1) + 1)
        guess[1::3], guess[2::3] = R0 + parts * (r1 - R0), 2.0 * np.pi * parts
        costs.append(float(own(x0=guess, p=[r1, mass], lbg=0.0, ubg=0.0)["f"]))
    return np.array(costs), process_time() - begin, len(costs)


def swept(cases: Any, steps: int, workers: int) -> tuple[Any, float, float]:
    """Costs (n,) of cases (n, 2), and for each case the seconds that pass and the processor time of all processes."""
    batches = [cases[first : first + BATCH] for first in range(0, len(cases), BATCH)]
    with Parallel(n_jobs=workers) as parallel:
        parallel(delayed(_batch)(cases[:1], steps) for _ in range(4 * workers))  # solvers are made
        begin = perf_counter()
        found = parallel(delayed(_batch)(batch, steps) for batch in batches)
        seconds = perf_counter() - begin
    processor = sum(own for _, own, _ in found)
    return np.concatenate([costs for costs, _, _ in found]), seconds / len(cases), processor / len(cases)
