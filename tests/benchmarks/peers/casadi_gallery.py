"""The gallery in CasADi: the programs that our generated solvers solve, for IPOPT and MUMPS.

Lagrangian problems, with v = (q_{k+1} - q_k)/h, the interval's midpoint q and the time t in the middle:

    Ld = h L(q, v, t),    f- = f+ = h/2 f(q, v, u_k, t),    left = D1 Ld + f-,    right = D2 Ld + f+

    minimise    sum_k h C(q, v, u_k, t) + terminal cost
    subject to  D2L(q_0, v_0) + left_0 = G(q_0)' y_0
                right_{k-1} + left_k = G(q_k)' y_k                 (k = 1..N-1)
                right_{N-1} - D2L(q_N, v_N) = G(q_N)' y_N
                c(q_k) = 0                                         (k = 1..N-1; the ends are given)

with the velocities v_0, v_N of the two ends, the holonomic constraints c and their Jacobian G. The trapezoidal rule
takes half of L and f at either node instead. First-order problems use the implicit midpoint rule,
x_{k+1} - x_k = h f(x, u_k, t). Path inequalities hold at the midpoints, bounds on coordinates at the nodes.

The order of the unknowns is q (node by node, body by body), u likewise, static parameters, end velocities, y. What is
given is an unknown with equal bounds, which IPOPT takes out. For the options and for how functions are mapped and
compiled see `casadi_control.py`.
"""

import subprocess
import tempfile
from dataclasses import dataclass
from math import inf
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .casadi_control import COMPILER, IPOPT_OPTIONS
from .gallery_problem import GalleryProblem, nothing

if hasattr(ca.GlobalOptions, "setNumpyMode"):
    ca.GlobalOptions.setNumpyMode(-1)  # numpy's sine of a symbol is CasADi's, as it always was, and nothing is said

Array = NDArray[np.float64]
OPTIONS = IPOPT_OPTIONS | {"error_on_fail": False}


@dataclass
class Program:
    """A nonlinear program with its bounds and guess; `size` of q, u, static parameters, and the rest."""

    functions: dict[str, ca.MX]
    lower: Array
    upper: Array
    guess: Array
    constraint_lower: Array
    constraint_upper: Array
    size: tuple[int, int, int, int]


def interval_function(problem: GalleryProblem, steps: int) -> ca.Function:
    """One interval: (q_k, q_{k+1}, u_k, k, p) to cost, `left` and `right` (or the step's defect), `path` if any."""
    n = problem.dimension
    q0, q1 = ca.SX.sym("q0", n), ca.SX.sym("q1", n)
    u, k, p = ca.SX.sym("u", problem.controls), ca.SX.sym("k"), ca.SX.sym("p", len(problem.free))
    step = problem.duration(ca.vertsplit(p)) / steps
    time, controls = step * (k + 0.5), ca.vertsplit(u)
    middle, rate = ca.vertsplit((q0 + q1) / 2), ca.vertsplit((q1 - q0) / step)
    if problem.dynamics:
        cost = step * problem.cost(middle, None, controls, time)
        slope = ca.vertcat(*problem.dynamics(ca, middle, controls, time, ca.vertsplit(p)))
        outputs = [cost, q1 - q0 - step * slope]
    else:
        assert problem.lagrangian
        minus, plus = impulses(problem, (q0, q1), u, step, k)
        if problem.trapezoidal:
            ends = [(ca.vertsplit(q), step * (k + i)) for i, q in enumerate((q0, q1))]
            action = step / 2 * sum(problem.lagrangian(ca, q, rate, t) for q, t in ends)
            cost = step / 2 * sum(problem.cost(q, rate, controls, t) for q, t in ends)
        else:
            action = step * problem.lagrangian(ca, middle, rate, time)
            cost = step * problem.cost(middle, rate, controls, time)
        outputs = [cost, ca.gradient(action, q0) + minus, ca.gradient(action, q1) + plus]
    if has_path(problem):
        outputs.append(ca.vertcat(*problem.path(middle, rate, controls, time), *problem.nodal_path(ca.vertsplit(q1))))
    return ca.Function("interval", [q0, q1, u, k, p], outputs, {"cse": True})


def has_path(problem: GalleryProblem) -> bool:
    """Whether inequalities hold at every time."""
    return problem.path is not nothing or problem.nodal_path is not nothing


def impulses(problem: GalleryProblem, q: tuple[ca.SX, ca.SX], u: ca.SX, step: ca.SX, k: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The discrete forces f- and f+ of one interval."""
    rate, controls = ca.vertsplit((q[1] - q[0]) / step), ca.vertsplit(u)
    if problem.trapezoidal:
        points = [(q[0], step * k), (q[1], step * (k + 1))]
    else:
        points = [((q[0] + q[1]) / 2, step * (k + 0.5))] * 2
    first, second = (
        step / 2 * ca.vertcat(*problem.force(ca, ca.vertsplit(at), rate, controls, time)) for at, time in points
    )
    return first, second


def momentum_function(problem: GalleryProblem) -> ca.Function:
    """(q, v, t) to D2L."""
    assert problem.lagrangian
    q, v, t = ca.SX.sym("q", problem.dimension), ca.SX.sym("v", problem.dimension), ca.SX.sym("t")
    lagrangian = problem.lagrangian(ca, ca.vertsplit(q), ca.vertsplit(v), t)
    return ca.Function("momentum", [q, v, t], [ca.gradient(lagrangian, v)])


def constraint_function(problem: GalleryProblem) -> ca.Function:
    """(q, y) to the holonomic constraints c and G' y."""
    q = ca.SX.sym("q", problem.dimension)
    c = ca.vertcat(*problem.constraint(ca, ca.vertsplit(q)))
    y = ca.SX.sym("y", c.shape[0])
    return ca.Function("constraint", [q, y], [c, ca.jtimes(c, q, y, True) if c.shape[0] else ca.SX(c.shape[0], 1)])


def holonomic_count(problem: GalleryProblem) -> int:
    """The number of holonomic constraints."""
    return len(problem.constraint(ca, ca.vertsplit(ca.SX.sym("q", problem.dimension))))


def transcribe(problem: GalleryProblem, steps: int) -> Program:
    """The program of the module's docstring with N = `steps`."""
    n, m, bodies = problem.dimension, problem.controls, problem.bodies
    holonomic = holonomic_count(problem)
    rates = 0 if problem.dynamics else 2 * n * bodies
    size = (n * (steps + 1) * bodies, m * steps * bodies, len(problem.free), rates + holonomic * (steps + 1))
    x = ca.MX.sym("x", sum(size))
    flat_q, flat_u, p, flat_v, flat_y = ca.vertsplit(x, np.cumsum([0, *size[:3], rates, size[3] - rates]).tolist())
    q = ca.reshape(flat_q, n, (steps + 1) * bodies)
    nodes = np.arange((steps + 1) * bodies).reshape(bodies, steps + 1)
    numbers = ca.DM(np.tile(np.arange(steps), bodies)).T
    mapped = interval_function(problem, steps).map("intervals", "serial", steps * bodies, [4], [])
    u = ca.reshape(flat_u, m, steps * bodies)
    cost, *rest = mapped(columns(q, nodes[:, :-1]), columns(q, nodes[:, 1:]), u, numbers, p)
    starts, ends = columns(q, nodes[:, 0]), columns(q, nodes[:, -1])
    velocities = (ca.reshape(flat_v, n, 2 * bodies)[:, i::2] for i in range(2)) if rates else (ca.MX(0, bodies),) * 2
    first_rate, last_rate = velocities
    values = ca.vertsplit(p) if problem.free else []

    constraints: list[tuple[ca.MX, float, float]] = []
    if problem.dynamics:
        constraints.append((ca.vec(rest[0]), 0.0, 0.0))
    else:
        momentum = momentum_function(problem).map(bodies)
        first = momentum(starts, first_rate, ca.DM.zeros(1, bodies))
        last = momentum(ends, last_rate, ca.repmat(ca.MX(problem.duration(values)), 1, bodies))
        balance = node_sums(first, rest[0], rest[1], last, steps, bodies)
        if holonomic:
            y = ca.reshape(flat_y, holonomic, steps + 1)
            c, reaction = constraint_function(problem).map(steps + 1)(q, y)
            constraints.append((ca.vec(c[:, 1:-1]), 0.0, 0.0))
            balance -= reaction
        constraints.append((ca.vec(balance), 0.0, 0.0))
    for conditions, position, rate in (
        (problem.start_conditions, starts, first_rate),
        (problem.end_conditions, ends, last_rate),
    ):
        for body in range(bodies):
            constraints += conditions(ca, ca.vertsplit(position[:, body]), ca.vertsplit(rate[:, body]))
    if has_path(problem):
        constraints.append((ca.vec(rest[-1]), -inf, 0.0))
    constraints += [(c, 0.0, 0.0) for c in problem.couplings(ca, [ca.vertsplit(e) for e in ca.horzsplit(ends)])]
    final = problem.terminal_cost(ca.vertsplit(ends[:, 0]), ca.vertsplit(last_rate[:, 0]), values)
    g = ca.vertcat(*(c for c, _, _ in constraints))
    low, high = (np.concatenate([np.full(c.shape[0], c_bounds[i]) for c, *c_bounds in constraints]) for i in (0, 1))
    return Program(
        {"x": x, "f": ca.sum2(cost) + final, "g": g}, *bounds_and_guess(problem, steps, size), low, high, size
    )


def columns(matrix: ca.MX, indices: NDArray[np.int64]) -> ca.MX:
    """The columns at the given indices, in their order."""
    return matrix[:, indices.ravel().tolist()]


def node_sums(first: ca.MX, left: ca.MX, right: ca.MX, last: ca.MX, steps: int, bodies: int) -> ca.MX:
    """What both intervals at a node contribute, for all nodes of all bodies; the ends' momenta stand in outside."""
    intervals = np.arange(steps * bodies).reshape(bodies, steps)
    outside = (steps * bodies + np.arange(bodies))[:, None]
    before, after = np.hstack([outside, intervals]), np.hstack([intervals, outside])
    return columns(ca.horzcat(right, first), before) + columns(ca.horzcat(left, -last), after)


def bounds_and_guess(problem: GalleryProblem, steps: int, size: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Bounds and guess of all unknowns; what is given has equal bounds and is guessed right."""
    n, m = problem.dimension, problem.controls
    lower, upper, guess = np.full(sum(size), -inf), np.full(sum(size), inf), np.zeros(sum(size))
    for body in range(problem.bodies):
        start = problem.start(body) if callable(problem.start) else problem.start
        qs = slice(body * n * (steps + 1), (body + 1) * n * (steps + 1))
        us = slice(size[0] + body * m * steps, size[0] + (body + 1) * m * steps)
        who = (body,) if problem.bodies > 1 else ()
        at_nodes = np.array([problem.guess(np, k / steps, *who)[0] for k in range(steps + 1)], dtype=float)
        on_intervals = np.array([problem.guess(np, (k + 0.5) / steps, *who)[1] for k in range(steps)], dtype=float)
        low, high = np.full((steps + 1, n), -inf), np.full((steps + 1, n), inf)
        for i, (least, greatest) in problem.bounds.items():
            low[:, i], high[:, i] = least, greatest
        for index, given in ((0, start), (-1, problem.end)):
            for i, value in enumerate(given):
                if value is not None:
                    low[index, i] = high[index, i] = at_nodes[index, i] = value
        lower[qs], upper[qs], guess[qs] = low.ravel(), high.ravel(), at_nodes.ravel()
        guess[us] = on_intervals.ravel()
        for i, (least, greatest) in problem.control_bounds.items():
            lower[us][i::m], upper[us][i::m] = least, greatest
        if not problem.dynamics:
            for end, given in enumerate((problem.start_rate, problem.end_rate)):
                offset = sum(size[:3]) + (2 * body + end) * n
                for i, value in enumerate(given):
                    if value is not None:
                        lower[offset + i] = upper[offset + i] = guess[offset + i] = value
    for i, (value, least, greatest) in enumerate(problem.free):
        index = size[0] + size[1] + i
        guess[index], lower[index], upper[index] = value, least, greatest
    return lower, upper, guess


class PreparedGallery:
    """A program made ready once and solved many times; `run(guess)` is the timed call."""

    def __init__(
        self, problem: GalleryProblem, steps: int, *, compiled: bool = False, options: dict[str, Any] | None = None
    ) -> None:
        """Transcribe, and build the solver; CalledProcessError if gcc refuses the code."""
        started = perf_counter()
        self.problem = problem
        self.program = transcribe(problem, steps)
        chosen = OPTIONS | (options or {})
        functions = self.program.functions
        if compiled:
            self.solver = compiled_solver(functions, chosen)
        else:
            self.solver = ca.nlpsol("solver", "ipopt", functions, chosen | {"expand": True})
        self.residuals = ca.Function("residuals", [functions["x"]], [functions["f"], functions["g"]])
        self.build_seconds = perf_counter() - started
        self.solution: dict[str, ca.DM] = {}

    def run(self, guess: Array | None = None) -> None:
        """Solve from the given unknowns, or from the problem's guess."""
        program = self.program
        self.solution = self.solver(
            x0=program.guess if guess is None else guess,
            lbx=program.lower,
            ubx=program.upper,
            lbg=program.constraint_lower,
            ubg=program.constraint_upper,
        )

    def violation(self, unknowns: Array) -> float:
        """The largest violation of any constraint or bound, unscaled."""
        program = self.program
        g = np.asarray(self.residuals(unknowns)[1]).ravel()
        parts = [program.constraint_lower - g, g - program.constraint_upper]
        parts += [program.lower - unknowns, unknowns - program.upper]
        return float(max(0.0, *(np.max(part, initial=0.0) for part in parts)))

    def fitted(self, unknowns: Array) -> Array:
        """The unknowns with those end velocities and reactions, the last ones, that fit the equations best.

        The equations are linear in them but for the end conditions, so a few Gauss-Newton steps do.
        """
        result, count = unknowns.copy(), self.program.size[3]
        indices = np.arange(result.size) >= result.size - count
        indices &= self.program.lower < self.program.upper
        if not indices.any():
            return result
        x, g = self.program.functions["x"], self.program.functions["g"]
        slopes = ca.Function("slopes", [x], [g, ca.jacobian(g, x)])
        equalities = self.program.constraint_lower == self.program.constraint_upper
        for _ in range(4):
            value, jacobian = slopes(result)
            defect = (np.asarray(value).ravel() - self.program.constraint_upper)[equalities]
            matrix = np.asarray(jacobian[:, np.flatnonzero(indices).tolist()])[equalities]
            result[indices] -= np.linalg.lstsq(matrix, defect, rcond=None)[0]
        return result

    def cost(self, unknowns: Array) -> float:
        """The discrete cost."""
        return float(self.residuals(unknowns)[0])

    def report(self) -> dict[str, Any]:
        """Cost, violation, iterations, status and the time spent in CasADi's functions, of the last run."""
        unknowns = np.asarray(self.solution["x"]).ravel()
        statistics = self.solver.stats()
        return {
            "cost": self.cost(unknowns),
            "residual": self.violation(unknowns),
            "iterations": int(statistics["iter_count"]),
            "status": "solved" if statistics["success"] else str(statistics["return_status"]),
            "callback_seconds": sum(t for k, t in statistics.items() if k.startswith("t_wall_nlp_")),
        }


def compiled_solver(functions: dict[str, ca.MX], options: dict[str, Any]) -> ca.Function:
    """Emit the program's functions as C, compile them and give the library back to IPOPT."""
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder, "program.c"), Path(folder, "program.so")
        emitted = ca.nlpsol("solver", "ipopt", functions, options).generate_dependencies(source.name)
        Path(emitted).replace(source)
        subprocess.run([*COMPILER, "-w", str(source), "-o", str(library)], check=True)
        return ca.nlpsol("solver", "ipopt", str(library), options)
