"""The layout of the flat vector of unknowns of a ControlProgram: indices, free unknowns, bounds, first guess."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import sympy

from codegen.discretise.model.guesses import DURATION
from codegen.discretise.program import ControlProgram, EndElement


class DenseLayout:
    """Where the unknowns of a program with `steps` intervals stand, at the model's parameters or those given by name.

    `x` is the flat vector of all unknowns, `z` that of the free ones; `x = expand @ z + fixed`.
    """

    def __init__(self, program: ControlProgram, steps: int, parameters: Mapping[str, float] | None = None) -> None:
        self.program, self.steps = program, steps
        self.values = dict(program.model.default_values)
        self.values |= {p: parameters[p.name] for p in program.model.parameters if parameters and p.name in parameters}
        self.node, self.shared = len(program.node), len(program.linking.unknowns)
        inside = len(program.interval) + len(program.controls) + len(program.slacks)
        self.stride = self.node + inside
        self.body_size = steps * self.stride + self.node
        self.own_start = program.model.bodies * self.body_size
        self.common_start = self.own_start + program.model.bodies * program.linking.own
        self.coupling_start = self.common_start + self.shared - program.linking.own
        self.size = self.coupling_start + len(program.linking.couplings)
        at_guess = {p.symbol: self.number(p.guess) for p in program.model.free_parameters}
        self.duration = self.number(program.model.duration, at_guess)
        self.h = (1.0 if program.scaled_time else self.duration) / steps
        self.is_multiplier = self._multipliers()
        self.expand, self.fixed, self.free = self._affine_map()
        self.free_multiplier = self.is_multiplier[self.free]

    def number(self, expression: Any, more: Mapping[sympy.Symbol, float] | None = None, body: int = 0) -> float:
        """An expression of parameters, of the body's number and of further symbols."""
        values = {**self.values, **(more or {})}
        if self.program.model.body is not None:
            values[self.program.model.body] = body
        return float(sympy.sympify(expression).subs(values))

    def node_indices(self, body: int, k: int) -> np.ndarray:
        return body * self.body_size + k * self.stride + np.arange(self.node)

    def shared_indices(self, body: int) -> np.ndarray:
        own = self.own_start + body * self.program.linking.own + np.arange(self.program.linking.own)
        return np.concatenate([own, self.common_start + np.arange(self.shared - self.program.linking.own)]).astype(int)

    def element_indices(self, body: int, k: int) -> np.ndarray:
        local = body * self.body_size + k * self.stride + np.arange(self.stride + self.node)
        return np.concatenate([local, self.shared_indices(body)])

    def boundary_numbers(self, body: int) -> dict[sympy.Symbol, float]:
        return {v.symbol: self.number(v.value, body=body) for v in self.program.boundary_values}

    def _multipliers(self) -> np.ndarray:
        program = self.program
        node = [u.multiplier for u in program.node]
        inside = [u.multiplier for u in (*program.interval, *program.controls, *program.slacks)]
        body = [*((node + inside) * self.steps), *node]
        shared = [False] * (self.coupling_start - self.own_start)
        return np.array([*(body * program.model.bodies), *shared, *([True] * len(program.linking.couplings))])

    def _affine_map(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        program = self.program
        full, fixed, bound = np.eye(self.size), np.zeros(self.size), set[int]()

        def bind(index: int, value: float) -> None:
            assert index not in bound, f"unknown {index} is bound twice"
            bound.add(index)
            full[index], fixed[index] = 0.0, value

        for body in range(program.model.bodies):
            for end, k in ((program.start, 0), (program.end, self.steps)):
                indices, known = self.node_indices(body, k), self.boundary_numbers(body)
                for i, value in end.pins:
                    bind(indices[i], self.number(value, known, body))
                for i, j, offset in end.shared:
                    bind(indices[i], self.number(offset, known, body))
                    full[indices[i], self.shared_indices(body)[j]] = 1.0
        free = np.array([i for i in range(self.size) if i not in bound])
        return full[:, free], fixed, free

    def full(self, z: np.ndarray) -> np.ndarray:
        """All unknowns."""
        return self.expand @ z + self.fixed

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest values of the free unknowns; slacks are not negative."""
        program = self.program
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)

        def put(index: int, unknown: Any, body: int) -> None:
            if unknown.lower is not None:
                lower[index] = self.number(unknown.lower, body=body)
            if unknown.upper is not None:
                upper[index] = self.number(unknown.upper, body=body)

        for body in range(program.model.bodies):
            for k in range(self.steps):
                for index, unknown in zip(self.element_indices(body, k), self.inner_unknowns(), strict=False):
                    put(index, unknown, body)
                first = self.node_indices(body, k)[0] + self.stride - len(program.slacks)
                lower[first : first + len(program.slacks)] = 0.0
            for index, unknown in zip(self.node_indices(body, self.steps), program.node, strict=True):
                put(index, unknown, body)
            for index, unknown in zip(self.shared_indices(body), program.linking.unknowns, strict=True):
                put(index, unknown, body)
            for end, k in ((program.start, 0), (program.end, self.steps)):
                for slack, _ in end.slacks:
                    lower[self.node_indices(body, k)[slack]] = 0.0
                for own, bound in end.bounds:
                    index = self.node_indices(body, k)[own]
                    if bound.lower is not None:
                        lower[index] = max(lower[index], self.number(bound.lower, body=body))
                    if bound.upper is not None:
                        upper[index] = min(upper[index], self.number(bound.upper, body=body))
        return lower[self.free], upper[self.free]

    def initial(self) -> np.ndarray:
        """The program's own guesses; multipliers and slacks are zero."""
        program, x = self.program, np.zeros(self.size)
        for body in range(program.model.bodies):
            known = {**self.boundary_numbers(body), DURATION: self.duration}
            for k in range(self.steps + 1):
                at_node = {**known, program.model.time: k * self.duration / self.steps}
                indices = self.node_indices(body, k)
                for i, guess in enumerate(program.guess.node):
                    x[indices[i]] = self.number(guess, at_node, body)
                if program.nodal_controls:
                    controls = indices[-len(program.model.controls) :]
                    for index, guess in zip(controls, program.guess.controls, strict=True):
                        x[index] = self.number(guess, at_node, body)
            for k in range(self.steps):
                at_middle = {**known, program.model.time: (k + 0.5) * self.duration / self.steps}
                first = self.node_indices(body, k)[0] + self.node
                for i, guess in enumerate(program.guess.stages):
                    x[first + i] = self.number(guess, at_middle, body)
                if not program.nodal_controls:
                    for i, guess in enumerate(program.guess.controls):
                        x[first + len(program.interval) + i] = self.number(guess, at_middle, body)
            for index, guess in zip(self.shared_indices(body), program.linking.guess, strict=True):
                x[index] = self.number(guess, known, body)
        return x[self.free]

    def inner_unknowns(self) -> tuple[Any, ...]:
        program = self.program
        return (*program.node, *program.interval, *program.controls, *program.slacks)

    def at_nodes(self, z: np.ndarray, name: str, body: int = 0) -> np.ndarray:
        """An unknown of the nodes at all nodes."""
        index = [u.name for u in self.program.node].index(name)
        return self.full(z)[[self.node_indices(body, k)[index] for k in range(self.steps + 1)]]

    def on_intervals(self, z: np.ndarray, name: str, body: int = 0) -> np.ndarray:
        """An unknown of the intervals on all intervals: stage, multiplier, control or slack."""
        index = [u.name for u in self.inner_unknowns()].index(name)
        return self.full(z)[[self.node_indices(body, k)[0] + index for k in range(self.steps)]]

    def shared_value(self, z: np.ndarray, name: str, body: int = 0) -> float:
        """A shared unknown."""
        index = [u.name for u in self.program.linking.unknowns].index(name)
        return float(self.full(z)[self.shared_indices(body)[index]])


def pinned_names(program: ControlProgram, end: EndElement) -> set[str]:
    """The names of the unknowns that are pinned at an end."""
    return {program.node[i].name for i, _ in end.pins}
