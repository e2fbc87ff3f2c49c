"""The gallery by Gauss-Legendre collocation in CasADi and IPOPT: where the optimum goes as N grows.

Nothing of it is shared with the transcription under test: the equations are first-order, x = (q, v) with
v' = M^-1 (f + D1L - d/dt D2L at constant v), the states of an interval are polynomials through its left end with the
given number of collocation points, and every point has controls of its own. Where the optimum is smooth the order is
twice the number of points.
"""

from dataclasses import dataclass
from math import inf
from typing import Any

import casadi as ca
import numpy as np

from .casadi_gallery import OPTIONS, Array, holonomic_count
from .gallery_problem import GalleryProblem


def rates_function(problem: GalleryProblem) -> ca.Function:
    """(x, u, t, p) to (x', running cost, path)."""
    n = problem.dimension
    q, v = ca.SX.sym("q", n), ca.SX.sym("v", 0 if problem.dynamics else n)
    u, t, p = ca.SX.sym("u", problem.controls), ca.SX.sym("t"), ca.SX.sym("p", len(problem.free))
    qs, vs, us, ps = ca.vertsplit(q), ca.vertsplit(v), ca.vertsplit(u), ca.vertsplit(p)
    if problem.dynamics:
        rate = ca.vertcat(*problem.dynamics(ca, qs, us, t, ps))
    else:
        assert problem.lagrangian
        lagrangian = problem.lagrangian(ca, qs, vs, t)
        momentum = ca.gradient(lagrangian, v)
        change = ca.jtimes(momentum, q, v) + ca.jacobian(momentum, t)
        push = ca.vertcat(*problem.force(ca, qs, vs, us, t)) + ca.gradient(lagrangian, q) - change
        rate = ca.vertcat(v, ca.solve(ca.jacobian(momentum, v), push))
    outputs = [
        rate,
        ca.SX(problem.cost(qs, vs, us, t)),
        ca.vertcat(*problem.path(qs, vs, us, t), *problem.nodal_path(qs)),
    ]
    return ca.Function("rates", [ca.vertcat(q, v), u, t, p], outputs, {"cse": True})


class PreparedCollocation:
    """The program with N = `steps` and the given number of collocation points, made ready for IPOPT.

    Problems with holonomic constraints or several bodies have no first-order form here: AssertionError.
    """

    def __init__(self, problem: GalleryProblem, steps: int, points: int = 3, **options: Any) -> None:
        """Write the program and differentiate it."""
        assert problem.bodies == 1
        assert not holonomic_count(problem)
        self.problem, self.steps, self.points = problem, steps, points
        program = _program(problem, steps, points)
        self.solver = ca.nlpsol("solver", "ipopt", program.functions, OPTIONS | {"expand": True} | options)
        self.arguments = program.arguments

    def run(self) -> None:
        """Solve from the problem's guess."""
        self.solution = self.solver(**self.arguments)

    @property
    def cost(self) -> float:
        """The least cost."""
        return float(self.solution["f"])

    @property
    def status(self) -> str:
        """IPOPT's status."""
        return str(self.solver.stats()["return_status"])

    @property
    def iterations(self) -> int:
        """IPOPT's iterations."""
        return int(self.solver.stats()["iter_count"])

    def trajectories(self) -> tuple[Array, Array, Array]:
        """States at nodes (N + 1, n), abscissae of the collocation points, controls (N points, m) there."""
        free, m, points = len(self.problem.free), self.problem.controls, self.points
        unknowns = np.asarray(self.solution["x"]).ravel()[free:]
        size = (unknowns.size - self.steps * points * m) // (1 + self.steps * (points + 1))
        table = unknowns[size:].reshape(self.steps, -1)
        states = np.vstack([unknowns[:size], table[:, -size:]])
        controls = table[:, points * size : -size].reshape(-1, m)
        return states, np.array(ca.collocation_points(points, "legendre")), controls


@dataclass(frozen=True)
class _Program:
    """Functions of CasADi, and the arguments of a solver: guess and bounds."""

    functions: dict[str, ca.MX]
    arguments: dict[str, Array]


def _program(problem: GalleryProblem, steps: int, points: int) -> _Program:
    """The program of the module's docstring."""
    taus = [0.0, *ca.collocation_points(points, "legendre")]
    derivative, at_end, quadrature = ca.collocation_coeff(taus[1:])
    rates = rates_function(problem)
    n, size = problem.dimension, rates.size1_in(0)
    p = ca.MX.sym("p", len(problem.free))
    duration = problem.duration(ca.vertsplit(p) if problem.free else [])
    step = duration / steps
    unknowns, guess, lower, upper = [p], [], [], []
    constraints: list[tuple[ca.MX, float, float]] = []
    total, left = ca.MX(0), None
    length = float(ca.Function("length", [p], [duration])([value for value, _, _ in problem.free]))

    def node(place: float, given: tuple[float | None, ...]) -> ca.MX:
        x = ca.MX.sym("x", size)
        unknowns.append(x)
        q, delta = np.asarray(problem.guess(np, place)[0], float), 1e-4
        ends = [np.asarray(problem.guess(np, place + d)[0], float) for d in (-delta, delta)]
        v = (ends[1] - ends[0]) / (2 * delta * length)
        start = np.concatenate([q, v[: size - n]])
        low, high = np.full(size, -inf), np.full(size, inf)
        for i, (least, greatest) in problem.bounds.items():
            low[i], high[i] = least, greatest
        for i, value in enumerate(given):
            if value is not None:
                start[i] = low[i] = high[i] = value
        guess.append(start)
        lower.append(low)
        upper.append(high)
        return x

    assert not callable(problem.start)
    left = node(0.0, problem.start + problem.start_rate)
    for k in range(steps):
        stages = [node((k + tau) / steps, ()) for tau in taus[1:]]
        controls = [ca.MX.sym("u", problem.controls) for _ in stages]
        for j, u in enumerate(controls):
            unknowns.append(u)
            guess.append(np.asarray(problem.guess(np, (k + taus[j + 1]) / steps)[1], float))
            ends = [problem.control_bounds.get(i, (-inf, inf)) for i in range(problem.controls)]
            lower.append(np.array([low for low, _ in ends]))
            upper.append(np.array([high for _, high in ends]))
        slopes = ca.horzcat(left, *stages) @ derivative
        for j, (x, u) in enumerate(zip(stages, controls, strict=True)):
            rate, cost, path = rates(x, u, step * (k + taus[j + 1]), p)
            constraints.append((step * rate - slopes[:, j], 0.0, 0.0))
            total += step * quadrature[j] * cost
            if path.shape[0]:
                constraints.append((path, -inf, 0.0))
        right = node((k + 1) / steps, problem.end + problem.end_rate if k + 1 == steps else ())
        constraints.append((right - ca.horzcat(left, *stages) @ at_end, 0.0, 0.0))
        left = right
    q, v = ca.vertsplit(left[:n]), ca.vertsplit(left[n:])
    constraints += problem.end_conditions(ca, q, v)
    total += problem.terminal_cost(q, v, ca.vertsplit(p) if problem.free else [])
    program = {"x": ca.vertcat(*unknowns), "f": total, "g": ca.vertcat(*(c for c, _, _ in constraints))}
    free: Array = np.array(problem.free, dtype=float).reshape(-1, 3)
    arguments = {
        "x0": np.concatenate([free[:, 0], *guess]),
        "lbx": np.concatenate([free[:, 1], *lower]),
        "ubx": np.concatenate([free[:, 2], *upper]),
        "lbg": np.concatenate([np.full(c.shape[0], low) for c, low, _ in constraints]),
        "ubg": np.concatenate([np.full(c.shape[0], high) for c, _, high in constraints]),
    }
    return _Program(program, arguments)
