"""How large the error of a solution is: compared with one on the bisected grid, as a whole and interval by interval.

Quantities are coordinates, momenta, and the cost up to each node; each is measured in parts of its own largest value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.interfaces import ControlModule, Matrix, Vector, time_grid
from codegen.runtime.search.parts import interval_parts
from codegen.solutions.result import Result
from codegen.solving.accuracy.arcs import FAR, Gap, around

NEGLIGIBLE = 1e-12
"""A quantity that is no larger counts as zero."""


@dataclass(frozen=True)
class Estimate:
    """The largest relative difference between two solutions: of which quantity, and at what time."""

    difference: float
    quantity: str
    time: float


def trajectories(module: ControlModule, result: Result) -> tuple[Matrix, tuple[str, ...]]:
    """Coordinates, momenta and the cost so far at all nodes, (nodes, quantities), in parts of sizes; their names."""
    table = np.column_stack([result.q, result.p, _cost_so_far(module, result)])
    names = [*result.names["q"], *result.names["p"], "the cost"]
    kept = [i for i in range(table.shape[1]) if np.isfinite(table[:, i]).all()]
    return table[:, kept], tuple(names[i] for i in kept)


def _cost_so_far(module: ControlModule, result: Result) -> Vector:
    """The discrete cost up to each node, of all bodies together, without ends, and without samples, where it jumps."""
    grid: Any = time_grid(module, result.steps, result.grid)
    if module.metadata.observations is not None:
        first = module.problem.structure.first_sample
        grid = grid._replace(parameters=np.ascontiguousarray(grid.parameters[:, :first]))
    costs = interval_parts(grid, result.unknowns)[..., -1]
    return np.concatenate([[0.0], np.cumsum(costs.sum(axis=0))])


def sizes_of(table: Matrix) -> Vector:
    """The largest value of every quantity; one where it is next to zero."""
    sizes = np.abs(table).max(axis=0)
    return np.where(sizes > NEGLIGIBLE, sizes, 1.0)


def compared(module: ControlModule, coarse: Result, fine: Result, without: Sequence[Gap] = ()) -> Estimate:
    """The largest relative difference of two results at nodes of the coarser grid, and of costs and parameters.

    Nodes in the gaps `without`, and beside them, do not count.
    """
    table, names = trajectories(module, fine)
    before, _ = trajectories(module, coarse)
    if before.shape[1] != table.shape[1]:
        return Estimate(np.inf, "a state", 0.0)
    differences = np.abs(table[::2] - before) / sizes_of(table)
    for gap in without:
        first = gap.phase * coarse.steps
        touched = around(
            time_grid(module, coarse.steps, coarse.grid).nodes[first:] / coarse.steps - gap.phase, gap, FAR
        )
        differences[first : first + coarse.steps + 1][touched] = 0.0
    node, column = np.unravel_index(int(np.argmax(differences)), differences.shape)
    worst = Estimate(float(differences[node, column]), names[column], float(fine.t[::2][node]))
    for name, (old, new) in _numbers(module, coarse, fine).items():
        difference = abs(new - old) / (abs(new) if abs(new) > NEGLIGIBLE else 1.0)
        if difference > worst.difference:
            worst = Estimate(difference, name, float(fine.t[-1]))
    return worst


def _numbers(module: ControlModule, coarse: Result, fine: Result) -> dict[str, tuple[float, float]]:
    """Cost, duration and free parameters of both."""
    names = ("duration", *module.metadata.free_parameters)
    pairs = {name: (coarse.summary[name], fine.summary[name]) for name in names}
    if coarse.cost is not None and fine.cost is not None:
        pairs["the cost"] = coarse.cost, fine.cost
    return pairs


def interval_errors(module: ControlModule, fine: Result, order: int) -> Matrix:
    """What every interval of the coarser grid errs by: (phases, N), from a solution on the bisected grid.

    It is the distance of the inner node from a polynomial of degree p = `order` through nodes of the coarser grid
    around it, of the order p + 1 as the error of a step. Of several polynomials, more to the left or to the right, the
    closest counts, so that a kink at a node is none of its neighbours' business.
    """
    table, _ = trajectories(module, fine)
    table = table / sizes_of(table)
    phases = module.metadata.phases
    steps = fine.steps // 2
    out = np.empty((phases, steps))
    for phase in range(phases):
        first = phase * fine.steps
        times, own = fine.t[first : first + fine.steps + 1], table[first : first + fine.steps + 1]
        skipped = min(phase, 1)  # the node at a switch has the values before a jump
        out[phase, skipped:] = _departures(times[2 * skipped :], own[2 * skipped :], order)
        if skipped:
            out[phase, 0] = out[phase, min(1, steps - 1)]
    return out


def _departures(times: Vector, table: Matrix, order: int) -> Vector:
    """How far every second row is from the closest polynomial through its neighbours."""
    nodes, values = times[::2], table[::2]
    between, truth = times[1::2], table[1::2]
    count = min(order + 1, nodes.size)
    best = np.full(between.size, np.inf)
    intervals = np.arange(between.size)
    for left in range(count - 1):  # how many nodes of the stencil lie left of the interval's left node
        starts = np.clip(intervals - left, 0, nodes.size - count)
        indices = starts[:, None] + np.arange(count)
        weights = _lagrange(nodes[indices], between)
        guess = np.einsum("ki,kij->kj", weights, values[indices])
        best = np.minimum(best, np.abs(guess - truth).max(axis=1))
    return best


def _lagrange(nodes: Matrix, at: Vector) -> Matrix:
    """The values (K, m) of the Lagrange polynomials of K sets of nodes (K, m), each at an index of its own."""
    weights = np.ones_like(nodes)
    for i in range(nodes.shape[1]):
        for j in range(nodes.shape[1]):
            if i != j:
                weights[:, i] *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
    return weights
