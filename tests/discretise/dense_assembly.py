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
from functools import lru_cache
from typing import Any

import numpy as np
import sympy
from dense_layout import DenseLayout
from scipy.optimize import OptimizeResult, minimize

from codegen.discretise.interval import STEP
from codegen.discretise.program import ControlProgram


class Scalar:
    """A scalar of some unknowns and other arguments, with gradient and Hessian in the unknowns."""

    def __init__(
        self, expression: sympy.Expr, unknowns: tuple[sympy.Symbol, ...], others: tuple[sympy.Symbol, ...]
    ) -> None:
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


scalar_of = lru_cache(maxsize=100)(Scalar)
"""The same program on several grids has the same scalars."""


@dataclass(frozen=True)
class Share:
    """One scalar at some indices of the flat vector, with the values of its other arguments."""

    scalar: Scalar
    indices: np.ndarray
    others: list[float]


class DenseProblem(DenseLayout):
    """The optimisation problem of a program with `steps` intervals; `z` are its free unknowns (see DenseLayout)."""

    def __init__(self, program: ControlProgram, steps: int, parameters: Mapping[str, float] | None = None) -> None:
        super().__init__(program, steps, parameters)
        self.others = (program.model.time, STEP, *self.values, *(v.symbol for v in program.boundary_values))
        self.shares = self._shares()

    def _others(self, body: int, t: float) -> list[float]:
        boundary = [self.number(v.value, body=body) for v in self.program.boundary_values]
        return [t, self.h, *self.values.values(), *boundary]

    def _shares(self) -> list[Share]:
        program = self.program
        element = scalar_of(program.element, program.element_symbols, self.others)
        start = scalar_of(program.start.element, (*program.left_symbols, *program.linking.symbols), self.others)
        end = scalar_of(program.end.element, (*program.right_symbols, *program.linking.symbols), self.others)
        out = []
        for body in range(program.model.bodies):
            for k in range(self.steps):
                out.append(Share(element, self.element_indices(body, k), self._others(body, k * self.h)))
            for scalar, k in ((start, 0), (end, self.steps)):
                indices = np.concatenate([self.node_indices(body, k), self.shared_indices(body)])
                out.append(Share(scalar, indices, self._others(body, k * self.h)))
        common = program.linking.common_symbols
        symbols = tuple(symbol for symbol, _, _ in program.linking.coupling_symbols)
        own_indices = [
            self.own_start + body * program.linking.own + index for _, body, index in program.linking.coupling_symbols
        ]
        for i, coupling in enumerate(program.linking.couplings):
            multiplier = sympy.Symbol(f"_{coupling.multiplier.name}")
            scalar = scalar_of(multiplier * coupling.expression, (*symbols, *common, multiplier), self.others)
            indices = [*own_indices, *range(self.common_start, self.coupling_start), self.coupling_start + i]
            out.append(Share(scalar, np.array(indices), self._others(0, 0.0)))
        return out

    def lagrangian(self, z: np.ndarray) -> float:
        """The Lagrangian of the optimisation problem."""
        x = self.full(z)
        return sum(s.scalar.value(x[s.indices], s.others) for s in self.shares)

    def gradient(self, z: np.ndarray) -> np.ndarray:
        """Its gradient: stationarity at primal unknowns, residuals of the equations at multipliers."""
        x, out = self.full(z), np.zeros(self.size)
        for s in self.shares:
            np.add.at(out, s.indices, s.scalar.gradient(x[s.indices], s.others))
        return self.expand.T @ out

    def hessian(self, z: np.ndarray) -> np.ndarray:
        """The KKT matrix."""
        x, out = self.full(z), np.zeros((self.size, self.size))
        for s in self.shares:
            np.add.at(out, np.ix_(s.indices, s.indices), s.scalar.hessian(x[s.indices], s.others))
        return self.expand.T @ out @ self.expand

    def cost(self, z: np.ndarray) -> float:
        """The Lagrangian without its multipliers: the discrete cost, where unused unknowns vanish."""
        return self.lagrangian(np.where(self.free_multiplier, 0.0, z))

    def program_cost(self, z: np.ndarray) -> float:
        """The cost as the program's own expressions say it: intervals and ends."""
        program, x = self.program, self.full(z)
        evaluate = sympy.lambdify([program.element_symbols, self.others], program.cost)
        ends = {
            k: sympy.lambdify([(*symbols, *program.linking.symbols), self.others], end.cost)
            for k, end, symbols in (
                (0, program.start, program.left_symbols),
                (self.steps, program.end, program.right_symbols),
            )
        }
        total = 0.0
        for body in range(program.model.bodies):
            for k in range(self.steps):
                total += float(evaluate(x[self.element_indices(body, k)], self._others(body, k * self.h)))
            for k, end_cost in ends.items():
                indices = np.concatenate([self.node_indices(body, k), self.shared_indices(body)])
                total += float(end_cost(x[indices], self._others(body, k * self.h)))
        return total

    def with_least_squares_multipliers(self, z: np.ndarray) -> np.ndarray:
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
        z = self.with_least_squares_multipliers(z)
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
