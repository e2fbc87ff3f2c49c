"""Measurements beside the motion of a solution: what was fitted, and what is left of the errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from codegen.interfaces import Grid, Matrix, Vector


class Fit:
    """Measurements beside the motion of a solution, one after the other for each body."""

    def __init__(self, module: Any, grid: Grid, unknowns: Vector) -> None:
        """Read where samples lie out of the parameters of a grid, and what the motion is there."""
        self._module, self._unknowns = module, unknowns
        nodes = grid.nodes * grid.h
        self._structure = s = module.problem.structure
        self._chain = grid.steps * s.stride + s.node
        self._samples = [
            (body, int(np.searchsorted(nodes, row[begin])) - 1, begin, row, nodes)
            for body, row in enumerate(self._rows(grid))
            for begin in range(s.first_sample, row.size, s.sample)
            if np.isfinite(row[begin])
        ]
        columns = (s.sample - 2) // 2
        numbers = np.array([row[begin + 1 : begin + s.sample] for _, _, begin, row, _ in self._samples])
        self.bodies = np.array([body for body, *_ in self._samples])
        self.times = np.array([nodes[k] for _, k, *_ in self._samples])
        self.times += numbers[:, 0] * np.array([nodes[k + 1] - nodes[k] for _, k, *_ in self._samples])
        self.weights = numbers[:, 1 + columns :]
        self.measured = np.where(self.weights > 0.0, numbers[:, 1 : 1 + columns], np.nan)
        self.fitted = np.array([self._value(sample, columns) for sample in self._samples])

    def _rows(self, grid: Grid) -> Matrix:
        """The parameters of each body, with the shared unknowns of the solution."""
        rows, s, shared = np.array(grid.parameters), self._structure, self._linking(self._unknowns.size)
        first = s.first_sample - s.tabled - s.shared
        rows[:, first : first + s.shared] = self._unknowns[shared]
        return rows

    def _linking(self, size: int) -> Any:
        """The indices (bodies, shared), among `size` unknowns, of those that no node owns."""
        return size - self._structure.root + self._structure.root_indices()

    def _value(self, sample: Any, columns: int) -> Vector:
        _, values = self._given(sample), np.empty(columns)
        plain(self._module.sample_values)(*self._given(sample), values)
        return values

    def _given(self, sample: Any) -> tuple[Any, ...]:
        """What a kernel is called with for a sample."""
        body, k, begin, row, nodes = sample
        first = body * self._chain + k * self._structure.stride
        local = self._unknowns[first : first + self._structure.element]
        return local, nodes[k], nodes[k + 1] - nodes[k], row, begin

    @property
    def errors(self) -> Matrix:
        """The motion less what was measured, in parts of standard deviations; NaN where nothing was."""
        return np.where(self.weights > 0.0, (self.fitted - self.measured) * self.weights, np.nan)

    @property
    def count(self) -> int:
        """How many values were measured."""
        return int((self.weights > 0.0).sum())

    @property
    def squares(self) -> float:
        """The sum of squares of all errors."""
        return float(np.nansum(self.errors**2))

    def slopes(self, following: Matrix) -> Matrix:
        """How the loss of each sample follows p quantities, a row (p,) for each sample.

        `following` (n, p) says how all unknowns follow them.
        """
        module, s, shared = self._module, self._structure, self._linking(len(following))
        found = np.zeros((len(self._samples), following.shape[1]))
        for i, sample in enumerate(self._samples):
            local = np.zeros(s.element + s.shared)
            plain(module.sample_gradient)(*self._given(sample), local)
            first = sample[0] * self._chain + sample[1] * s.stride
            found[i] = local[: s.element] @ following[first : first + s.element]
            found[i] += local[s.element :] @ following[shared[sample[0]]]
        return found


def plain(function: Any) -> Any:
    """A function of a module as Python runs it, so that nothing has to be compiled."""
    return getattr(function, "py_func", function)
