"""Where unknowns stand in the flat vector of a control module, derived from the program alone.

For each body node 0, interval 0, node 1, ..., node N; then the shared unknowns of every body, those of the whole
problem, and the multipliers of the conditions between bodies.

Points where a problem is solved: near the guess of its module, with its boundary values and default parameters. Away
from there an exponential atmosphere, a reaction rate or a Gaussian may be flat, and a check would be blind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sympy import Symbol

from codegen.discretise.interval import STEP
from codegen.discretise.program import ControlProgram, IntervalElement, Unknown
from codegen.emit.lower.control.kernels import named_elements
from codegen.emit.lower.control.layout import parameters
from codegen.emit.verify.comparison import Values, with_time
from codegen.emit.verify.kernels import part_of_chain
from codegen.evidence.checks.base import Context
from codegen.evidence.checks.evaluation import Point
from codegen.runtime.record import Meaning
from codegen.symbolic.functions import numbers_of

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class FlatVector:
    """The layout for `steps` intervals; `body`, `k` and `j` count from zero."""

    program: ControlProgram
    steps: int

    @classmethod
    def on_grid(cls, program: ControlProgram, steps: int) -> FlatVector:
        """The layout on the module's grid of that many steps, which are those of each phase where there are phases."""
        return cls(program, steps * max(1, len(program.phases)))

    @property
    def phase_steps(self) -> int:
        """The intervals of each phase."""
        return self.steps // max(1, len(self.program.phases))

    def share(self, k: int) -> IntervalElement:
        """What interval k adds to the Lagrangian of the optimisation problem."""
        if not self.program.phases:
            return self.program.interval_elements[0]
        index, within = divmod(k, self.phase_steps)
        phase = self.program.phases[index]
        return phase.elements[0] if within == 0 else phase.regular

    @property
    def inner_nodes(self) -> dict[int, int]:
        """The numbers of nodes at inner times, with those of the times, where one interval is between any two."""
        count = len(self.program.inner.times)
        return {number + 1: number for number in range(count)} if self.steps == count + 1 else {}

    @property
    def inside(self) -> tuple[Unknown, ...]:
        """Unknowns of a node and of the interval after it."""
        program = self.program
        return (*program.node, *program.interval, *program.controls, *program.slacks)

    @property
    def chain(self) -> int:
        """How many unknowns a body's nodes and intervals have."""
        return self.steps * len(self.inside) + len(self.program.node)

    @property
    def first_shared(self) -> int:
        """Where the unknowns begin that no node owns."""
        return self.program.bodies * self.chain

    @property
    def first_coupling(self) -> int:
        """Where the multipliers of the conditions between bodies begin."""
        program = self.program
        return self.first_shared + program.bodies * program.own + len(program.shared) - program.own

    @property
    def size(self) -> int:
        """The number of all unknowns."""
        return self.first_coupling + len(self.program.couplings)

    def node(self, body: int, k: int) -> Indices:
        """Indices of the unknowns of a node."""
        return body * self.chain + k * len(self.inside) + np.arange(len(self.program.node))

    def interval(self, body: int, k: int) -> Indices:
        """Indices of the unknowns between two nodes: stages, multipliers, controls, slacks."""
        first = body * self.chain + k * len(self.inside)
        return first + np.arange(len(self.program.node), len(self.inside))

    def shared(self, body: int) -> Indices:
        """Indices of the shared unknowns of a body: its own, then those of the whole problem."""
        program = self.program
        common = self.first_shared + program.bodies * program.own
        own = self.first_shared + body * program.own + np.arange(program.own)
        return np.concatenate([own, common + np.arange(len(program.shared) - program.own)])

    def element(self, body: int, k: int) -> Indices:
        """Indices of all unknowns on which an interval's share of the Lagrangian may depend."""
        return np.concatenate([self.node(body, k), self.interval(body, k), self.node(body, k + 1), self.shared(body)])

    def end(self, body: int, where: str) -> Indices:
        """Indices of all unknowns on which an end's share of the Lagrangian may depend."""
        return np.concatenate([self.node(body, 0 if where == "start" else self.steps), self.shared(body)])

    def multipliers(self) -> NDArray[np.bool_]:
        """Which unknowns multiply an equation."""
        chain = [*[u.multiplier for u in self.inside] * self.steps, *[u.multiplier for u in self.program.node]]
        shared = np.zeros(self.size - self.first_shared, bool)
        shared[self.first_coupling - self.first_shared :] = True
        for body in range(self.program.bodies):
            shared[self.shared(body) - self.first_shared] = [u.multiplier for u in self.program.shared]
        return np.concatenate([np.tile(np.array(chain, bool), self.program.bodies), shared])

    def free(self) -> NDArray[np.bool_]:
        """Which unknowns neither are given at an end, nor equal a shared one, nor lack a meaning where they are."""
        program, free = self.program, np.ones(self.size, bool)
        for body in range(program.bodies):
            for k in range(1, self.steps):
                free[self.node(body, k)[list(program.only_at_ends)]] = False
            for k in range(self.steps):
                free[self.interval(body, k)[list(self.share(k).lacking)]] = False
            for k in range(self.steps + 1):
                free[self.node(body, k)[list(program.inner.unknowns)]] = False
            for k, number in self.inner_nodes.items():
                free[self.node(body, k)[list(program.inner.unknowns)]] = program.inner.present[number]
                free[self.interval(body, k)[list(program.inner.lacking)]] = False
            for k, end in ((0, program.start), (self.steps, program.end)):
                free[self.node(body, k)[[*(i for i, _ in end.pins), *(i for i, _, _ in end.shared)]]] = False
        return free

    def representatives(self) -> Indices:
        """For every unknown its own index, or that of the shared unknown that it equals up to an offset."""
        indices = np.arange(self.size)
        for body in range(self.program.bodies):
            for k, end in ((0, self.program.start), (self.steps, self.program.end)):
                for index, j, _ in end.shared:
                    indices[self.node(body, k)[index]] = self.shared(body)[j]
        return indices

    def names(self) -> list[str]:
        """What to call every unknown, as in `lambda_x at node 3 of body 0`."""
        program, several = self.program, self.program.bodies > 1
        listed = []
        for body in range(program.bodies):
            of_body = f" of body {body}" if several else ""
            for k in range(self.steps):
                listed += [f"{u.name} at node {k}{of_body}" for u in program.node]
                listed += [f"{u.name} on interval {k}{of_body}" for u in self.inside[len(program.node) :]]
            listed += [f"{u.name} at node {self.steps}{of_body}" for u in program.node]
        for body in range(program.bodies):
            listed += [f"{u.name} of body {body}" if several else u.name for u in program.shared[: program.own]]
        listed += [u.name for u in program.shared[program.own :]]
        return listed + [c.multiplier.name for c in program.couplings]

    def meanings(self) -> list[Meaning]:
        """What every unknown is, wherever it lives."""
        program = self.program
        chain = [*[u.meaning for u in self.inside] * self.steps, *[u.meaning for u in program.node]]
        own, common = program.shared[: program.own], program.shared[program.own :]
        of_bodies = [*chain * program.bodies, *[u.meaning for u in own] * program.bodies]
        return [*of_bodies, *(u.meaning for u in common), *(c.multiplier.meaning for c in program.couplings)]


def other_symbols(program: ControlProgram) -> list[Symbol]:
    """What the shares of the Lagrangian depend on beside unknowns: parameters, boundary values, time and step.

    Where there are inner times, numbers of the left node come before the time.
    """
    given = (*program.model.parameters, *(v.symbol for v in program.boundary_values))
    return [*given, *program.inner.symbols, program.model.time, STEP]


def kernel_stems(program: ControlProgram) -> list[str]:
    """The names of the kernels of an interval, without `_gradient` or `_hessian`, one for each of its elements."""
    return [stem for stem, _ in named_elements(program)]


def pattern_of(module: Any, share: str) -> list[tuple[int, int]]:
    """Rows and columns of the emitted Hessian of the interval, the start or the end; none where there is no kernel."""
    prefix = f"{share.upper()}_" if share in ("start", "end") else ""
    rows, columns = (getattr(module, f"{prefix}HESSIAN_{side}", ()) for side in ("ROWS", "COLUMNS"))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True)]


def parameter_vector(point: Point, program: ControlProgram) -> Any:
    """A row of `grid.parameters`: parameters, boundary values, inner times, shared unknowns, and numbers of tables.

    The interval begins at the first of the inner times.
    """
    given = (*program.model.parameters, *(value.symbol for value in program.boundary_values))
    later, inner = range(1, len(program.inner.times)), list[float]()
    if program.inner.times:
        time, step = point[program.model.time], point[STEP]
        inner += [time, *(time + 2.0 * i * step for i in later)]
        inner += [value for s in program.inner.symbols for value in (point[s], *(0.0 for _ in later))]
    shared = [point[s] for s in program.shared_symbols]
    return np.array([*(point[s] for s in given), *inner, *shared, *numbers_of(program.model)])


def few_steps(program: ControlProgram, steps: int) -> int:
    """As many intervals, or, where there are inner times, one between any two of them."""
    return len(program.inner.times) + 1 if program.inner.times else steps


_PREFERRED = (5, 2, 10, 7, 3, 6, 1, 0)
"""The order in which points of three places, each moved by ever more, are taken."""


def near_interval(context: Context, program: ControlProgram, stem: str) -> list[dict[Symbol, float]]:
    """Values of all symbols on intervals of a kind."""
    if context.guessed is None:
        return []
    local = program.element_symbols[: len(program.element_symbols) - len(program.shared)]
    return _points(context.guessed.on_intervals(local, parameters(program), part_of_chain(program, stem)), program)


def near_end(context: Context, program: ControlProgram, end: str) -> list[dict[Symbol, float]]:
    """Values of all symbols at the first or last node."""
    if context.guessed is None:
        return []
    node = program.left_symbols if end == "start" else program.right_symbols
    return _points(context.guessed.at_node(end == "end", node, parameters(program)), program)


def _points(values: Values, program: ControlProgram) -> list[dict[Symbol, float]]:
    named, inner = with_time(values, program.model.time), program.inner
    for column, symbol in enumerate(inner.symbols, start=1):
        named[symbol] = named[inner.parameters[column * len(inner.times)]]
    count = len(next(iter(named.values())))
    return [{s: float(array[index]) for s, array in named.items()} for index in _PREFERRED if index < count]
