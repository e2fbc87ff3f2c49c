"""The same control problems in opty: its own midpoint collocation of the first-order equations of motion.

opty's program differs from ours: the states are (q, v) at the nodes, and the controls too are at the nodes, averaged
on an interval. The cost is h sum u_k^2 over all nodes, so it agrees with ours only to first
order. (`create_objective_function` is no help: its midpoint rule averages u, which leaves an alternating control
free; its Euler rules leave one end's control free, and backward Euler finds a cost 27% too low at N = 300.) All
problems here have the cost u^2, which is assumed.

opty supplies no Hessian, and IPOPT builds a limited-memory approximation. The tolerance is 1e-6, where ours is 1e-10:
below 1e-6 IPOPT takes 1.7 times as long to end at its "acceptable" level, with a cost that differs by 1.3e-7 of it.

Needs opty and cyipopt (and so the system's IPOPT). Run in an environment that has them:
`cd tests/benchmarks && python -m peers.opty_control [problem] [steps]`.
"""

import sys
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from numpy.typing import NDArray
from opty import Problem

from .problems import PROBLEMS, ControlProblem

STATUS = {0: "solved", 1: "acceptable"}  # the latter short of the tolerance, which happens without a Hessian


def equations_of_motion(
    problem: ControlProblem, q: list[Any], v: list[Any], u: Any, time: sm.Symbol
) -> sm.ImmutableMatrix:
    """The first-order residuals q' - v and (d/dt D2L) - D1L - f, with q' replaced by v."""
    lagrangian = problem.lagrangian(q, v)
    rates = {sm.diff(a, time): b for a, b in zip(q, v, strict=True)}
    forces = problem.force(q, v, u)
    kinematics = [sm.diff(a, time) - b for a, b in zip(q, v, strict=True)]
    dynamics = [
        sm.diff(sm.diff(lagrangian, b), time).subs(rates) - sm.diff(lagrangian, a) - f
        for a, b, f in zip(q, v, forces, strict=True)
    ]
    return sm.ImmutableMatrix(kinematics + dynamics)


def prepare(problem: ControlProblem, steps: int, tolerance: float) -> tuple[Problem, NDArray[np.float64]]:
    """The opty problem on steps + 1 nodes, with its constraint function compiled, and the straight-line guess."""
    n, nodes, step = problem.dimension, steps + 1, problem.duration / steps
    time = me.dynamicsymbols._t
    q = [sm.Function(f"q{i}")(time) for i in range(n)]
    v = [sm.Function(f"v{i}")(time) for i in range(n)]
    u = sm.Function("u")(time)
    ends = [(0.0, problem.start + problem.start_velocity), (problem.duration, problem.end + problem.end_velocity)]
    fixed = tuple(s.func(instant) - value for instant, values in ends for s, value in zip(q + v, values, strict=True))

    def cost(free: NDArray[np.float64]) -> float:
        return float(step * np.sum(free[-nodes:] ** 2))

    def gradient(free: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([np.zeros(2 * n * nodes), 2 * step * free[-nodes:]])

    control = Problem(
        cost,
        gradient,
        equations_of_motion(problem, q, v, u, time),
        q + v,
        nodes,
        step,
        instance_constraints=fixed,
        time_symbol=time,
        integration_method="midpoint",
    )
    for option, value in {"tol": tolerance, "print_level": 0, "sb": "yes", "linear_solver": "mumps"}.items():
        control.add_option(option, value)
    line = np.linspace(problem.start, problem.end, nodes)
    velocity = np.tile((np.array(problem.end) - problem.start) / problem.duration, (nodes, 1))
    return control, np.concatenate([line.T.ravel(), velocity.T.ravel(), np.zeros(nodes)])


def solve(problem_name: str, steps: int, repeat: int, tolerance: float = 1e-6) -> dict[str, Any]:
    """Build, run once unmeasured, then take the best of `repeat` runs.

    Returns cost, residual (largest constraint violation, unscaled; stationarity is not accessible), iterations,
    seconds (best warm run), median_seconds, build_seconds and status. RuntimeError if IPOPT does not succeed.
    """
    started = perf_counter()
    control, guess = prepare(PROBLEMS[problem_name], steps, tolerance)
    build_seconds = perf_counter() - started
    seconds: list[float] = []
    for _ in range(repeat + 1):
        control.obj_value.clear()  # opty appends one value an iteration, the guess's included
        started = perf_counter()
        solution, record = control.solve(guess)
        seconds.append(perf_counter() - started)
        if record["status"] not in STATUS:
            raise RuntimeError(f"opty, {problem_name}, {steps} steps: IPOPT says {record['status_msg'].decode()!r}")
    return {
        "cost": float(record["obj_val"]),
        "residual": float(np.abs(control.con(solution)).max()),
        "iterations": len(control.obj_value) - 1,
        "status": STATUS[record["status"]],
        "seconds": min(seconds[1:]),
        "median_seconds": median(seconds[1:]),
        "build_seconds": build_seconds,
    }


if __name__ == "__main__":
    chosen = sys.argv[1] if len(sys.argv) > 1 else "orbital_transfer_2"
    print(solve(chosen, int(sys.argv[2]) if len(sys.argv) > 2 else 300, repeat=3))
