"""The Jacobian of all equations of a control problem on a few intervals, at a random point, for questions of rank."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from codegen.discretise import STEP
from codegen.expressions import checks as expressions
from codegen.expressions.special_functions import NUMPY
from codegen.model.values import values_at_guess
from codegen.transcribe.program import ControlProgram

Array = NDArray[np.float64]


class ChainJacobian:
    """All equations of one body on `steps` intervals, and their derivatives by all unknowns.

    Unknowns are those of node 0, interval 0, node 1, ..., the last node, then the shared ones.
    """

    def __init__(self, program: ControlProgram, steps: int, generator: np.random.Generator) -> None:
        """Evaluate at a point beside straight lines between the values that are given at the ends."""
        self.steps, self.node = steps, len(program.node)
        inside = (*program.interval, *program.controls, *program.slacks)
        self.stride = self.node + len(inside)
        self.size = steps * self.stride + self.node + len(program.shared)
        of_node, of_interval = ([u.multiplier for u in unknowns] for unknowns in (program.node, inside))
        self.is_multiplier = np.array(
            [*((of_node + of_interval) * steps), *of_node, *(u.multiplier for u in program.shared)]
        )
        values = self._values(program)
        self.matrix, self.residuals = np.zeros((self.size, self.size)), np.zeros(self.size)
        self._add_all(program, values, self._point(program, values, generator))

    def reduced(self, program: ControlProgram) -> tuple[Array, Array, Array]:
        """Jacobian, residuals and sizes of the equations of a program with these elements, in its free unknowns.

        Rows and columns of the Jacobian are scaled to the same size; residuals are not.
        """
        free, matrix = np.ones(self.size, bool), self.matrix.copy()
        for end, k in ((program.start, 0), (program.end, self.steps)):
            first = k * self.stride
            free[[first + index for index, _ in end.pins]] = False
            for index, shared, _ in end.shared:
                matrix[:, self.size - len(program.shared) + shared] += matrix[:, first + index]
                free[first + index] = False
        for k in range(1, self.steps):
            free[[k * self.stride + index for index in program.only_at_ends]] = False
        for k in range(self.steps + 1):
            free[[k * self.stride + index for index in program.inner.unknowns]] = False
        rows, columns = np.flatnonzero(free & self.is_multiplier), np.flatnonzero(free & ~self.is_multiplier)
        matrix, residuals = matrix[np.ix_(rows, columns)], self.residuals[rows]
        scale = np.abs(matrix).max(axis=1, initial=0.0)
        scale[scale == 0.0] = 1.0
        matrix = matrix / scale[:, None]
        width = np.abs(matrix).max(axis=0, initial=0.0)
        width[width == 0.0] = 1.0
        return matrix / width, residuals, scale

    def _values(self, program: ControlProgram) -> dict[Symbol, float]:
        """Numbers of parameters, free parameters, boundary values and the step."""
        model = program.model
        values = values_at_guess(model) | ({model.body: 0.0} if model.body is not None else {})
        numbers = {v.symbol: expressions.rounded_at(v.value, values) for v in program.boundary_values}
        values |= {symbol: number for symbol, number in numbers.items() if number is not None}
        duration = 1.0 if program.scaled_time else expressions.rounded_at(model.duration, values)
        values |= dict.fromkeys(program.inner.symbols, 0.0)  # no node is at an inner time
        return values | {STEP: (duration or 1.0) / self.steps}

    def _point(self, program: ControlProgram, values: dict[Symbol, float], generator: np.random.Generator) -> Array:
        """Random values beside straight lines; multipliers are zero, because all is linear in them."""
        point = np.zeros(self.size)
        ends = [{i: expressions.rounded_at(v, values) for i, v in end.pins} for end in (program.start, program.end)]
        for k in range(self.steps + 1):
            for index in range(self.node):
                first, last = (end.get(index) for end in ends)
                first, last = first if first is not None else last, last if last is not None else first
                if first is not None and last is not None:
                    point[k * self.stride + index] = first + (last - first) * k / self.steps
        point += np.where(point == 0.0, 1.0, np.maximum(1.0, np.abs(point))) * generator.uniform(0.1, 0.4, self.size)
        shared = self.size - len(program.shared)
        point[shared:] = [values.get(symbol, point[0]) for symbol in program.shared_symbols]
        for end, given, k in ((program.start, ends[0], 0), (program.end, ends[1], self.steps)):
            for index, value in given.items():
                point[k * self.stride + index] = value or 0.0
            for index, other, offset in end.shared:
                point[k * self.stride + index] = point[shared + other] + (expressions.rounded_at(offset, values) or 0.0)
        return np.where(self.is_multiplier, 0.0, point)

    def _add_all(self, program: ControlProgram, values: dict[Symbol, float], point: Array) -> None:
        time = program.model.time
        shared = np.arange(self.size - len(program.shared), self.size)
        others = [symbol for symbol in values if symbol not in program.shared_symbols]
        numbers = [values[symbol] for symbol in others]
        element = _equations(program.element, program.element_symbols, [time, *others])
        for k in range(self.steps):
            indices = np.concatenate([k * self.stride + np.arange(self.stride + self.node), shared])
            self._add(element, indices, point, [k * values[STEP], *numbers])
        for end, symbols, k in (
            (program.start, program.left_symbols, 0),
            (program.end, program.right_symbols, self.steps),
        ):
            share = _equations(end.element, (*symbols, *program.shared_symbols), [time, *others])
            indices = np.concatenate([k * self.stride + np.arange(self.node), shared])
            self._add(share, indices, point, [k * values[STEP], *numbers])

    def _add(self, share: _Share, indices: NDArray[np.intp], point: Array, others: Sequence[float]) -> None:
        (rows, columns), evaluate = share
        with np.errstate(all="ignore"):
            gradient, entries = evaluate(*point[indices], *others)
        np.add.at(self.residuals, indices, np.array(gradient, dtype=float))
        np.add.at(self.matrix, (indices[rows], indices[columns]), np.array(entries, dtype=float))


_Share = tuple[tuple[list[int], list[int]], Callable[..., Any]]
"""Rows and columns of the entries of a Hessian, and a function of unknowns that gives the gradient and them."""


def _equations(share: Expr, unknowns: Sequence[Symbol], others: Sequence[Symbol]) -> _Share:
    gradient = [sympy.diff(share, x) for x in unknowns]
    indices = [(i, j) for i, g in enumerate(gradient) for j, x in enumerate(unknowns) if x in g.free_symbols]
    entries = [sympy.diff(gradient[i], unknowns[j]) for i, j in indices]
    function = sympy.lambdify([*unknowns, *others], [gradient, entries], modules=NUMPY, cse=True)
    return ([i for i, _ in indices], [j for _, j in indices]), function
