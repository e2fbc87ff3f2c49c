"""Measurements beside the motion of a solution: what was fitted, and what is left of the errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from codegen.loading import Grid, Matrix, Vector


class Fit:
    """Measurements beside the motion of a solution, one after the other for each body."""

    def __init__(self, module: Any, grid: Grid, unknowns: Vector) -> None:
        """Read where samples lie out of the parameters of a grid, and what the motion is there."""
        self._module, self._unknowns = module, unknowns
        nodes = grid.nodes * grid.h
        self._chain = grid.steps * module.STRIDE + module.NODE
        self._places = [
            (body, int(np.searchsorted(nodes, row[sample])) - 1, sample, row, nodes)
            for body, row in enumerate(self._rows(grid))
            for sample in range(module.FIRST_SAMPLE, row.size, module.SAMPLE)
            if np.isfinite(row[sample])
        ]
        columns = (module.SAMPLE - 2) // 2
        numbers = np.array([row[s + 1 : s + module.SAMPLE] for _, _, s, row, _ in self._places])
        self.bodies = np.array([body for body, *_ in self._places])
        self.times = np.array([nodes[k] for _, k, *_ in self._places])
        self.times += numbers[:, 0] * np.array([nodes[k + 1] - nodes[k] for _, k, *_ in self._places])
        self.weights = numbers[:, 1 + columns :]
        self.measured = np.where(self.weights > 0.0, numbers[:, 1 : 1 + columns], np.nan)
        self.fitted = np.array([self._value(place, columns) for place in self._places])

    def _rows(self, grid: Grid) -> Matrix:
        """The parameters of each body, with the shared unknowns of the solution."""
        rows, module = np.array(grid.parameters), self._module
        if module.SHARED:
            for body in range(module.BODIES):
                plain(module.read_shared)(self._unknowns, body, rows)
        return rows

    def _value(self, place: Any, columns: int) -> Vector:
        _, values = self._given(place), np.empty(columns)
        plain(self._module.sample_values)(*self._given(place), values)
        return values

    def _given(self, place: Any) -> tuple[Any, ...]:
        """What a kernel is called with for a sample."""
        body, k, sample, row, nodes = place
        first = body * self._chain + k * self._module.STRIDE
        local = self._unknowns[first : first + self._module.ELEMENT]
        return local, nodes[k], nodes[k + 1] - nodes[k], row, sample

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
        module, size = self._module, len(following)
        found = np.zeros((len(self._places), following.shape[1]))
        for i, place in enumerate(self._places):
            local = np.zeros(module.ELEMENT + module.SHARED)
            plain(module.sample_gradient)(*self._given(place), local)
            first = place[0] * self._chain + place[1] * module.STRIDE
            found[i] = local[: module.ELEMENT] @ following[first : first + module.ELEMENT]
            for j in range(module.SHARED):
                index = size - module.ROOT + plain(module.root_index)(place[0], j)
                found[i] += local[module.ELEMENT + j] * following[index]
        return found


def plain(function: Any) -> Any:
    """A function of a module as Python runs it, so that nothing has to be compiled."""
    return getattr(function, "py_func", function)
