"""The program of a moving horizon by direct multiple shooting in CasADi and fatrop; the state enters by a constraint.

fatrop starts from its own last solution, shifted, without multipliers: CasADi passes none to it. A small first weight
of the barrier makes use of the guess.
"""

from __future__ import annotations

from time import thread_time
from typing import Any

import casadi as ca
import numpy as np

from .casadi_shooting import COMPILED, QUIET, Array, transcribe
from .regulators import Regulator


class FatropHorizon:
    """A solver that starts from its own last solution, shifted; `seconds` is the time without the shift."""

    def __init__(self, regulator: Regulator, barrier: float, tolerance: float) -> None:
        """Write and compile the solver; `barrier` is the first weight of the barrier of later solves."""
        problem = regulator.problem
        program = transcribe(problem, regulator.steps, True)
        self.regulator, self.program = regulator, program
        constraints = program.functions["g"].numel()
        self.solvers = []
        for first in (None, barrier):
            own: dict[str, Any] = {} if first is None else {"mu_init": first}
            options = {
                "print_time": False,
                "structure_detection": "auto",
                "equality": [True] * constraints,
                "fatrop": {"print_level": 0, "tolerance": tolerance, "max_iter": 200, **own},
            }
            self.solvers.append(ca.nlpsol("solver", "fatrop", program.functions, options | QUIET | COMPILED))
        n = problem.dimension
        self.given = slice(n, 2 * n)  # rows of x_0 - (state at the start) = 0, after those of the first interval
        self.level = np.zeros(constraints)
        self.x = program.guess.copy()
        self.status, self.iterations, self.seconds, self.is_first = "", 0, 0.0, True

    def step(self, state: Array, _t: float) -> Array:
        """The inputs of the first interval."""
        problem, steps = self.regulator.problem, self.regulator.steps
        n, m = problem.dimension, problem.controls
        if not self.is_first:
            table = self.x[: (n + m) * steps].reshape(steps, n + m)
            table[:-1] = table[1:].copy()
            table[-1, :n] = self.x[-n:]
        self.x[:n] = state
        self.level[self.given] = state - np.array(problem.start)
        solver = self.solvers[not self.is_first]
        begin = thread_time()
        found = solver(x0=self.x, lbx=self.program.lower, ubx=self.program.upper, lbg=self.level, ubg=self.level)
        self.x = found["x"].full().ravel()
        self.seconds, self.is_first = thread_time() - begin, False
        statistics = solver.stats()
        self.status = "solved" if statistics["success"] else str(statistics["return_status"])
        self.iterations = int(statistics["iter_count"])
        return self.x[n : n + m].copy()

    def plan(self) -> tuple[Any, Any]:
        """States (N + 1, n) and controls (N, m) of the last solution."""
        n, m, steps = self.regulator.problem.dimension, self.regulator.problem.controls, self.regulator.steps
        table = self.x[: (n + m) * steps].reshape(steps, n + m)
        return np.vstack([table[:, :n], self.x[-n:]]), table[:, n:]
