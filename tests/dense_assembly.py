"""A dense, direct assembly of a ControlProgram for few intervals: the yardstick of the structured solver.

It reads nothing but the program: every interval's and end's share of the Lagrangian is evaluated by sympy's lambdify,
scattered by the layout of the flat vector of unknowns,

    [body 0: node 0, interval 0, controls 0, slacks 0, node 1, ... node N] [body 1 ...] [own of body 0, ...] [common]
    [coupling multipliers],

and pins and shared unknowns are an affine map from the free unknowns to that vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy
from scipy.optimize import OptimizeResult, minimize

from codegen.discretise import STEP
from codegen.transcribe.guesses import DURATION
from codegen.transcribe.program import ControlProgram, EndElement


class Scalar:
    """A scalar of some unknowns and other arguments, with gradient and Hessian in the unknowns."""

    def __init__(self, expression: sympy.Expr, unknowns: tuple[sympy.Symbol, ...], others: list[sympy.Symbol]) -> None:
        gradient = [expression.diff(x) for x in unknowns]
        hessian = [[g.diff(x) for x in unknowns] for g in gradient]
        self._value = sympy.lambdify([unknowns, others], expression, cse=True)
        self._gradient = sympy.lambdify([unknowns, others], gradient, cse=True)
        self._hessian = sympy.lambdify([unknowns, others], hessian, cse=True)

    def value(self, x: Any, others: Any) -> float:
        return float(self._value(x, others))

    def gradient(self, x: Any, others: Any) -> np.ndarray:
        return np.array(self._gradient(x, others), dtype=float)

    def hessian(self, x: Any, others: Any) -> np.ndarray:
        return np.array(self._hessian(x, others), dtype=float).reshape(len(x), len(x))


@dataclass(frozen=True)
class Share:
    """One scalar at some places of the flat vector, with the values of its other arguments."""

    scalar: Scalar
    places: np.ndarray
    others: list[float]


class DenseProblem:
    """The optimisation problem of a program with `steps` intervals and the model's parameters, or those given by name.

    `x` is the flat vector of all unknowns, `z` that of the free ones; `x = expand @ z + fixed`.
    """

    def __init__(self, program: ControlProgram, steps: int, parameters: Mapping[str, float] | None = None) -> None:
        self.program, self.steps = program, steps
        self.values = dict(program.model.default_values)
        self.values |= {p: parameters[p.name] for p in program.model.parameters if parameters and p.name in parameters}
        self.node, self.shared = len(program.node), len(program.shared)
        self.inside = len(program.interval) + len(program.controls) + len(program.slacks)
        self.stride = self.node + self.inside
        self.body_size = steps * self.stride + self.node
        self.own_start = program.bodies * self.body_size
        self.common_start = self.own_start + program.bodies * program.own
        self.coupling_start = self.common_start + self.shared - program.own
        self.size = self.coupling_start + len(program.couplings)
        at_guess = {p.symbol: self.number(p.guess) for p in program.model.free_parameters}
        self.duration = self.number(program.model.duration, at_guess)
        self.h = (1.0 if program.scaled_time else self.duration) / steps
        self.others = [program.model.time, STEP, *self.values, *(v.symbol for v in program.boundary_values)]
        self.is_multiplier = self._multipliers()
        self.shares = self._shares()
        self.expand, self.fixed = self._affine_map()
        self.free_multiplier = self.is_multiplier[np.argmax(self.expand, axis=0)]

    # ---- layout -------------------------------------------------------------------------------------------------

    def number(self, expression: Any, more: Mapping[sympy.Symbol, float] | None = None, body: int = 0) -> float:
        """An expression of parameters, of the body's number and of further symbols."""
        values = {**self.values, **(more or {})}
        if self.program.body is not None:
            values[self.program.body] = body
        return float(sympy.sympify(expression).subs(values))

    def node_places(self, body: int, k: int) -> np.ndarray:
        return body * self.body_size + k * self.stride + np.arange(self.node)

    def shared_places(self, body: int) -> np.ndarray:
        own = self.own_start + body * self.program.own + np.arange(self.program.own)
        return np.concatenate([own, self.common_start + np.arange(self.shared - self.program.own)]).astype(int)

    def element_places(self, body: int, k: int) -> np.ndarray:
        local = body * self.body_size + k * self.stride + np.arange(self.stride + self.node)
        return np.concatenate([local, self.shared_places(body)])

    def _multipliers(self) -> np.ndarray:
        program = self.program
        node = [u.multiplier for u in program.node]
        inside = [u.multiplier for u in (*program.interval, *program.controls, *program.slacks)]
        body = [*((node + inside) * self.steps), *node]
        shared = [False] * (self.coupling_start - self.own_start)
        return np.array([*(body * program.bodies), *shared, *([True] * len(program.couplings))])

    def _others(self, body: int, t: float) -> list[float]:
        boundary = [self.number(v.value, body=body) for v in self.program.boundary_values]
        return [t, self.h, *self.values.values(), *boundary]

    def _boundary(self, body: int) -> dict[sympy.Symbol, float]:
        return {v.symbol: self.number(v.value, body=body) for v in self.program.boundary_values}

    def _shares(self) -> list[Share]:
        program = self.program
        element = Scalar(program.element, program.element_symbols, self.others)
        start = Scalar(program.start.element, (*program.left_symbols, *program.shared_symbols), self.others)
        end = Scalar(program.end.element, (*program.right_symbols, *program.shared_symbols), self.others)
        out = []
        for body in range(program.bodies):
            for k in range(self.steps):
                out.append(Share(element, self.element_places(body, k), self._others(body, k * self.h)))
            for scalar, k in ((start, 0), (end, self.steps)):
                places = np.concatenate([self.node_places(body, k), self.shared_places(body)])
                out.append(Share(scalar, places, self._others(body, k * self.h)))
        common = program.shared_symbols[program.own :]
        symbols = tuple(symbol for symbol, _, _ in program.coupling_symbols)
        own_places = [self.own_start + body * program.own + index for _, body, index in program.coupling_symbols]
        for i, coupling in enumerate(program.couplings):
            multiplier = sympy.Symbol(f"_{coupling.multiplier.name}")
            scalar = Scalar(multiplier * coupling.expression, (*symbols, *common, multiplier), self.others)
            places = [*own_places, *range(self.common_start, self.coupling_start), self.coupling_start + i]
            out.append(Share(scalar, np.array(places), self._others(0, 0.0)))
        return out

    def _affine_map(self) -> tuple[np.ndarray, np.ndarray]:
        program = self.program
        full, fixed, bound = np.eye(self.size), np.zeros(self.size), set[int]()

        def bind(place: int, value: float) -> None:
            assert place not in bound, f"unknown {place} is bound twice"
            bound.add(place)
            full[place], fixed[place] = 0.0, value

        for body in range(program.bodies):
            for end, k in ((program.start, 0), (program.end, self.steps)):
                places, known = self.node_places(body, k), self._boundary(body)
                for i, value in end.pins:
                    bind(places[i], self.number(value, known, body))
                for i, j, offset in end.shared:
                    bind(places[i], self.number(offset, known, body))
                    full[places[i], self.shared_places(body)[j]] = 1.0
        return full[:, [i for i in range(self.size) if i not in bound]], fixed

    # ---- functions of the free unknowns ---------------------------------------------------------------------------

    def full(self, z: np.ndarray) -> np.ndarray:
        """All unknowns."""
        return self.expand @ z + self.fixed

    def lagrangian(self, z: np.ndarray) -> float:
        """The Lagrangian of the optimisation problem."""
        x = self.full(z)
        return sum(s.scalar.value(x[s.places], s.others) for s in self.shares)

    def gradient(self, z: np.ndarray) -> np.ndarray:
        """Its gradient: stationarity at primal unknowns, residuals of the equations at multipliers."""
        x, out = self.full(z), np.zeros(self.size)
        for s in self.shares:
            np.add.at(out, s.places, s.scalar.gradient(x[s.places], s.others))
        return self.expand.T @ out

    def hessian(self, z: np.ndarray) -> np.ndarray:
        """The KKT matrix."""
        x, out = self.full(z), np.zeros((self.size, self.size))
        for s in self.shares:
            np.add.at(out, np.ix_(s.places, s.places), s.scalar.hessian(x[s.places], s.others))
        return self.expand.T @ out @ self.expand

    def cost(self, z: np.ndarray) -> float:
        """The Lagrangian without its multipliers: the discrete cost, where unused unknowns vanish."""
        return self.lagrangian(np.where(self.free_multiplier, 0.0, z))

    def program_cost(self, z: np.ndarray) -> float:
        """The cost as the program's own expressions say it: intervals and ends."""
        program, x = self.program, self.full(z)
        evaluate = sympy.lambdify([program.element_symbols, self.others], program.cost)
        ends = {
            k: sympy.lambdify([(*symbols, *program.shared_symbols), self.others], end.cost)
            for k, end, symbols in (
                (0, program.start, program.left_symbols),
                (self.steps, program.end, program.right_symbols),
            )
        }
        total = 0.0
        for body in range(program.bodies):
            for k in range(self.steps):
                total += float(evaluate(x[self.element_places(body, k)], self._others(body, k * self.h)))
            for k, end_cost in ends.items():
                places = np.concatenate([self.node_places(body, k), self.shared_places(body)])
                total += float(end_cost(x[places], self._others(body, k * self.h)))
        return total

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest values of the free unknowns; slacks are not negative."""
        program = self.program
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)

        def put(place: int, unknown: Any, body: int) -> None:
            if unknown.lower is not None:
                lower[place] = self.number(unknown.lower, body=body)
            if unknown.upper is not None:
                upper[place] = self.number(unknown.upper, body=body)

        for body in range(program.bodies):
            for k in range(self.steps):
                for place, unknown in zip(self.element_places(body, k), self._inside(), strict=False):
                    put(place, unknown, body)
                first = self.node_places(body, k)[0] + self.stride - len(program.slacks)
                lower[first : first + len(program.slacks)] = 0.0
            for place, unknown in zip(self.node_places(body, self.steps), program.node, strict=True):
                put(place, unknown, body)
            for place, unknown in zip(self.shared_places(body), program.shared, strict=True):
                put(place, unknown, body)
            for end, k in ((program.start, 0), (program.end, self.steps)):
                for slack, _ in end.slacks:
                    lower[self.node_places(body, k)[slack]] = 0.0
        chosen = np.argmax(self.expand, axis=0)
        own_rows = self.expand[chosen, np.arange(self.expand.shape[1])] == 1.0
        assert own_rows.all()
        return lower[self._owner()], upper[self._owner()]

    def _inside(self) -> tuple[Any, ...]:
        program = self.program
        return (*program.node, *program.interval, *program.controls, *program.slacks)

    def _owner(self) -> np.ndarray:
        """For each free unknown its own place in the flat vector (not that of an alias)."""
        bound = {i for i in range(self.size) if self.expand[i].sum() == 0.0} | self._aliased()
        return np.array([i for i in range(self.size) if i not in bound])

    def _aliased(self) -> set[int]:
        program = self.program
        ends = ((program.start, 0), (program.end, self.steps))
        return {
            int(self.node_places(body, k)[i])
            for body in range(program.bodies)
            for end, k in ends
            for i, _, _ in end.shared
        }

    # ---- start and solution -----------------------------------------------------------------------------------------

    def initial(self) -> np.ndarray:
        """The program's own guesses; multipliers and slacks are zero."""
        program, x = self.program, np.zeros(self.size)
        for body in range(program.bodies):
            known = {**self._boundary(body), DURATION: self.duration}
            for k in range(self.steps + 1):
                at_node = {**known, program.model.time: k * self.duration / self.steps}
                places = self.node_places(body, k)
                for i, guess in enumerate(program.node_guess):
                    x[places[i]] = self.number(guess, at_node, body)
                if program.nodal_controls:
                    for place, guess in zip(places[-len(program.model.controls) :], program.control_guess, strict=True):
                        x[place] = self.number(guess, at_node, body)
            for k in range(self.steps):
                at_middle = {**known, program.model.time: (k + 0.5) * self.duration / self.steps}
                first = self.node_places(body, k)[0] + self.node
                for i, guess in enumerate(program.stage_guess):
                    x[first + i] = self.number(guess, at_middle, body)
                if not program.nodal_controls:
                    for i, guess in enumerate(program.control_guess):
                        x[first + len(program.interval) + i] = self.number(guess, at_middle, body)
            for place, guess in zip(self.shared_places(body), program.shared_guess, strict=True):
                x[place] = self.number(guess, known, body)
        return x[self._owner()]

    def with_multipliers(self, z: np.ndarray) -> np.ndarray:
        """The same primal unknowns with the least-squares multipliers."""
        primal, multiplier = ~self.free_multiplier, self.free_multiplier
        z = np.where(multiplier, 0.0, z)
        coupling = self.hessian(z)[np.ix_(primal, multiplier)]
        z[multiplier] = np.linalg.lstsq(coupling, -self.gradient(z)[primal], rcond=None)[0]
        return z

    def newton(self, z: np.ndarray, iterations: int = 60, tolerance: float = 1e-10) -> np.ndarray:
        """Newton's method on the stationarity of the Lagrangian, with step halving; for problems without inequalities.

        Multipliers start from least squares. Raises AssertionError when it does not converge.
        """
        z = self.with_multipliers(z)
        for _ in range(iterations):
            gradient = self.gradient(z)
            norm = np.linalg.norm(gradient)
            if np.abs(gradient).max() < tolerance:
                return z
            step, length = np.linalg.solve(self.hessian(z), -gradient), 1.0
            while length > 1e-2 and not np.linalg.norm(self.gradient(z + length * step)) < norm:
                length /= 2
            z = z + length * step
        raise AssertionError(f"no convergence, residual {np.abs(self.gradient(z)).max():.2e}")

    def condition_number(self, z: np.ndarray) -> float:
        """Of the KKT matrix, with rows and columns scaled to norm one."""
        kkt = self.hessian(z)
        for _ in range(5):
            scale = 1.0 / np.sqrt(np.maximum(np.abs(kkt).max(axis=1), 1e-300))
            kkt = scale[:, None] * kkt * scale
        return float(np.linalg.cond(kkt))

    def slsqp(self, z: np.ndarray, **options: Any) -> OptimizeResult:
        """Minimise the cost subject to the equations and bounds by SLSQP; `result.z` are the free unknowns."""
        primal, multiplier = ~self.free_multiplier, self.free_multiplier
        rows = np.flatnonzero(multiplier)

        def lifted(y: np.ndarray) -> np.ndarray:
            out = np.zeros(len(z))
            out[primal] = y
            return out

        probe = np.abs(self.hessian(lifted(z[primal] + 1e-2)))[np.ix_(rows, np.flatnonzero(primal))]
        # Multipliers of one end only have no equation at inner nodes.
        rows = rows[probe.sum(axis=1) > 0]
        lower, upper = self.bounds()
        result = minimize(
            lambda y: self.cost(lifted(y)),
            z[primal],
            jac=lambda y: self.gradient(lifted(y))[primal],
            method="SLSQP",
            bounds=list(zip(lower[primal], upper[primal], strict=True)),
            constraints={
                "type": "eq",
                "fun": lambda y: self.gradient(lifted(y))[rows],
                "jac": lambda y: self.hessian(lifted(y))[np.ix_(rows, np.flatnonzero(primal))],
            },
            options={"maxiter": 500, "ftol": 1e-12, **options},
        )
        result.z = lifted(result.x)
        return result

    # ---- reading --------------------------------------------------------------------------------------------------

    def at_nodes(self, z: np.ndarray, name: str, body: int = 0) -> np.ndarray:
        """An unknown of the nodes at all nodes."""
        place = [u.name for u in self.program.node].index(name)
        return self.full(z)[[self.node_places(body, k)[place] for k in range(self.steps + 1)]]

    def on_intervals(self, z: np.ndarray, name: str, body: int = 0) -> np.ndarray:
        """An unknown of the intervals on all intervals: stage, multiplier, control or slack."""
        place = [u.name for u in self._inside()].index(name)
        return self.full(z)[[self.node_places(body, k)[0] + place for k in range(self.steps)]]

    def shared_value(self, z: np.ndarray, name: str, body: int = 0) -> float:
        """A shared unknown."""
        place = [u.name for u in self.program.shared].index(name)
        return float(self.full(z)[self.shared_places(body)[place]])


def pinned_names(program: ControlProgram, end: EndElement) -> set[str]:
    """The names of the unknowns that are pinned at an end."""
    return {program.node[i].name for i, _ in end.pins}
