"""Direct multiple shooting in CasADi, by fatrop or IPOPT: the programs that our solvers by rk4 solve.

With one step, or some equal steps, of the classical Runge-Kutta method F from node k under the control u_k of the
interval, and the cost integrated like a further state,

    minimise    sum_k (cost of the step k) + terminal cost
    subject to  x_{k+1} - F(x_k, u_k, t_k, h; p) = 0          (k = 0..N-1)
                given states at both ends, bounds on the other states at nodes, bounds on controls and parameters p

The unknowns are x_0, u_0, x_1, u_1, ..., x_N, as fatrop needs them. fatrop has no global variables. So static
parameters are further states with the rate zero, bounded at the first node, and given states are constraints. fatrop
detects the stages if the equations of the interval k stand before all other constraints of the node k. For IPOPT static
parameters are the last unknowns, and given states have equal bounds, by which IPOPT eliminates them.

The step is one CasADi function of SX, mapped over the intervals. Its C code is a loop, compiled with
-O3 -march=native. Separate calls for all intervals were no faster for the cart-pole with N = 50 and 200, and took
two to three times as long to compile.
"""

from dataclasses import dataclass
from math import inf
from multiprocessing import get_context
from time import perf_counter
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .casadi_control import IPOPT_OPTIONS
from .gallery_problem import GalleryProblem

if hasattr(ca.GlobalOptions, "setNumpyMode"):
    ca.GlobalOptions.setNumpyMode(-1)  # numpy's sine of a symbol is CasADi's, without a warning

Array = NDArray[np.float64]
Solver = Literal["fatrop", "ipopt"]
QUIET = {"error_on_fail": False, "show_eval_warnings": False}  # a failure is told by the status
COMPILED = {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O3", "-march=native", "-w"]}}


@dataclass(frozen=True)
class Program:
    """A nonlinear program whose constraints vanish; if `staged`, in the form for fatrop."""

    functions: dict[str, ca.MX]
    lower: Array
    upper: Array
    guess: Array
    staged: bool


def step_function(problem: GalleryProblem, steps: int, substeps: int = 1) -> ca.Function:
    """Equal steps of the classical Runge-Kutta method: (x_k, u_k, k, p) to x_{k+1} and the cost of the interval."""
    assert problem.dynamics
    dynamics = problem.dynamics
    x, u, k = ca.SX.sym("x", problem.dimension), ca.SX.sym("u", problem.controls), ca.SX.sym("k")
    p = ca.SX.sym("p", len(problem.free))
    parameters, controls = ca.vertsplit(p) if problem.free else [], ca.vertsplit(u)
    interval = problem.duration(parameters) / steps
    h = interval / substeps

    def rate(state: ca.SX, time: ca.SX) -> ca.SX:
        at = ca.vertsplit(state)[: problem.dimension]
        return ca.vertcat(*dynamics(ca, at, controls, time, parameters), problem.cost(at, None, controls, time))

    state = ca.vertcat(x, 0)
    for part in range(substeps):
        t = k * interval + part * h
        first = rate(state, t)
        second = rate(state + h / 2 * first, t + h / 2)
        third = rate(state + h / 2 * second, t + h / 2)
        fourth = rate(state + h * third, t + h)
        state = state + h / 6 * (first + 2 * second + 2 * third + fourth)
    return ca.Function("step", [x, u, k, p], [state[:-1], state[-1]], {"cse": True})


def transcribe(problem: GalleryProblem, steps: int, staged: bool, substeps: int = 1) -> Program:
    """The program of the module's docstring; if `staged`, for fatrop."""
    n, m, shared = problem.dimension, problem.controls, len(problem.free)
    size = n + shared if staged else n
    intervals = (size + m) * steps
    w = ca.MX.sym("w", intervals + size + (0 if staged else shared))
    table = ca.reshape(w[:intervals], size + m, steps)
    states, u, last = table[:size, :], table[size:, :], w[intervals : intervals + size]
    following = ca.horzcat(states[:, 1:], last)
    numbers, step = ca.DM(np.arange(steps)).T, step_function(problem, steps, substeps)
    if staged:
        mapped = step.map(steps)
        end, cost = mapped(states[:n, :], u, numbers, states[n:, :])
        end, p = ca.vertcat(end, states[n:, :]), last[n:]
    else:
        p = w[intervals + size :]
        end, cost = step.map("steps", "serial", steps, [3], [])(states, u, numbers, p)
    final = problem.terminal_cost(ca.vertsplit(last)[:n], None, ca.vertsplit(p) if shared else [])

    at_nodes = np.array([problem.guess(np, k / steps)[0] for k in range(steps + 1)], dtype=float)
    on_intervals = np.array([problem.guess(np, (k + 0.5) / steps)[1] for k in range(steps)], dtype=float)
    low, high = np.full((steps + 1, size), -inf), np.full((steps + 1, size), inf)
    for i, bounds in problem.bounds.items():
        low[:, i], high[:, i] = bounds
    assert not callable(problem.start)
    given = []
    for node, values in ((0, problem.start), (-1, problem.end)):
        indices = [i for i, value in enumerate(values) if value is not None]
        numbers_there = [values[i] for i in indices]
        at_nodes[node, indices] = numbers_there
        low[node, indices], high[node, indices] = (-inf, inf) if staged else (numbers_there, numbers_there)
        given.append((last if node else states[:, 0])[indices] - ca.DM(numbers_there))
    control_low, control_high = np.full((steps, m), -inf), np.full((steps, m), inf)
    for i, bounds in problem.control_bounds.items():
        control_low[:, i], control_high[:, i] = bounds
    of_parameters = np.array(problem.free, dtype=float).reshape(shared, 3).T
    constraints = ca.vec(following - end)
    if staged:
        guesses = np.hstack([at_nodes, np.tile(of_parameters[0], (steps + 1, 1))])
        low[0, n:], high[0, n:] = of_parameters[1:]
        constraints = ca.vertcat(constraints[:size], given[0], constraints[size:], given[1])
        beyond = np.zeros((3, 0))
    else:
        guesses, beyond = at_nodes, of_parameters
    flat = [
        np.concatenate([np.hstack([nodes[:-1], between]).ravel(), nodes[-1], rest])
        for nodes, between, rest in (
            (low, control_low, beyond[1]),
            (high, control_high, beyond[2]),
            (guesses, on_intervals, beyond[0]),
        )
    ]
    functions = {"x": w, "f": ca.sum2(cost) + final, "g": constraints}
    return Program(functions, *flat, staged)


class PreparedShooting:
    """One program made ready for one solver, as compiled C."""

    def __init__(
        self,
        problem: GalleryProblem,
        steps: int,
        solver: Solver,
        tolerance: float,
        iterations: int,
        substeps: int = 1,
    ) -> None:
        """Write the program, differentiate and compile it."""
        started = perf_counter()
        self.problem, self.steps = problem, steps
        self.program = transcribe(problem, steps, solver == "fatrop", substeps)
        functions = self.program.functions
        options: dict[str, Any]
        if solver == "fatrop":
            options = {
                "print_time": False,
                "structure_detection": "auto",
                "equality": [True] * functions["g"].numel(),
                "fatrop": {"print_level": 0, "tolerance": tolerance, "max_iter": iterations},
            }
        else:
            options = IPOPT_OPTIONS | {"ipopt.tol": tolerance, "ipopt.max_iter": iterations}
        self.solver = ca.nlpsol("solver", solver, functions, options | QUIET | COMPILED)
        self.arguments = {
            "x0": ca.DM(self.program.guess),
            "lbx": ca.DM(self.program.lower),
            "ubx": ca.DM(self.program.upper),
            "lbg": 0.0,
            "ubg": 0.0,
        }
        self.values = ca.Function("values", [functions["x"]], [functions["f"], functions["g"]])
        self.build_seconds = perf_counter() - started
        self.solution: dict[str, ca.DM] = {}

    def ends(self, limit: float) -> bool:
        """Return True if a solve ends within `limit` seconds; fatrop may loop for ever where a step overflows.

        The solve runs in a copy of this process, since nothing interrupts compiled code but the end of a process.
        """
        child = get_context("fork").Process(target=self.run)
        child.start()
        child.join(limit)
        ended = not child.is_alive()
        child.kill()
        child.join()
        return ended

    def run(self) -> None:
        """Solve from the problem's guess."""
        self.solution = self.solver(**self.arguments)

    def ordered(self, states: Array, controls: Array, parameters: Array) -> Array:
        """Values at nodes (N + 1, n), on intervals (N, m) and of static parameters, in the order of the program."""
        if self.program.staged:
            states, parameters = np.hstack([states, np.tile(parameters, (len(states), 1))]), parameters[:0]
        return np.concatenate([np.hstack([states[:-1], controls]).ravel(), states[-1], parameters])

    def judged(self, unknowns: Array) -> tuple[float, float]:
        """The cost, and the largest violation of any constraint or bound, unscaled."""
        cost, g = self.values(unknowns)
        outside = [self.program.lower - unknowns, unknowns - self.program.upper, np.abs(np.asarray(g)).ravel()]
        return float(cost), float(max(0.0, *(np.max(part, initial=0.0) for part in outside)))

    def report(self) -> dict[str, Any]:
        """Cost, violation, iterations and status of the last run."""
        cost, residual = self.judged(np.asarray(self.solution["x"]).ravel())
        statistics = self.solver.stats()
        status = "solved" if statistics["success"] else f"failed, {statistics['return_status']}"
        return {"cost": cost, "residual": residual, "iterations": int(statistics["iter_count"]), "status": status}
