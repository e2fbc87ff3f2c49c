"""Velocities and energy as functions of a state (q, p), without the inverse of a large mass matrix written out.

Written out, the inverse of a matrix of n coordinates that all depend on each other has about 4^n terms. Step by step,
as M = L D L^T on a graph of values, it takes about n^3/6 products. Source: Golub and Van Loan (2013), Matrix
computations, section 4.1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from sympy import Expr

from codegen.expressions import Assignment, program_of
from codegen.expressions.adjoint import accumulate
from codegen.expressions.graph import ONE, Graph
from codegen.expressions.samples import hessian_samples
from codegen.expressions.tangents import gradient
from codegen.model import Model, legendre
from codegen.model.sample_points import sample_points

_WRITTEN_OUT = 3
"""Coordinates coupled by the mass matrix up to which its inverse is written out."""
_PIVOT = 1e-6
"""A pivot that is smaller than this, beside the other entries of its row, is put off."""
_HALF = ONE / 2


@dataclass(frozen=True)
class PhaseFunctions:
    """The velocities dH/dp and the energy H at (q, p, t); both may read the symbols of `assignments`, made in order."""

    assignments: tuple[Assignment, ...]
    velocities: tuple[Expr, ...]
    energy: Expr


def phase_functions(model: Model) -> PhaseFunctions | None:
    """Solve p = dL/dv for v step by step; None where the Hamiltonian may as well be written out.

    That is where no more than three coordinates depend on each other in the mass matrix, or where it depends on
    velocities, so that momenta are not linear in them. Momenta are called as `legendre.conjugate_symbols` calls them.
    """
    if model.form != "lagrangian" or len(model.coordinates) <= _WRITTEN_OUT:
        return None
    momenta, count = legendre.conjugate_symbols(model), len(model.rates)
    leaves = (*model.rates, *model.coordinates, *momenta)
    graph = Graph(leaves)
    found = accumulate(graph, graph.of(model.function), range(len(leaves)))
    mass = {pair: node for pair, node in found.second.items() if max(pair) < count}
    mass |= {(j, i): node for (i, j), node in mass.items()}
    if not graph.independent(mass.values(), range(count)) or _largest_block(mass, count) <= _WRITTEN_OUT:
        return None
    order = _pivots(hessian_samples(model.function, model.rates, sample_points(model)))
    if order is None:
        return None
    still = dict.fromkeys(model.rates, sympy.S.Zero)
    slopes = (slope.xreplace(still) for slope in gradient(model.function, model.rates))
    impulses = [graph.of(p - slope) for p, slope in zip(momenta, slopes, strict=True)]
    at_rest = graph.of(model.function.xreplace(still))
    solver = _Elimination(graph, mass, order)
    kinetic = solver.forward(impulses)
    velocities = solver.backward()
    energy = graph.sum([(kinetic, _HALF), (at_rest, -ONE)])
    program = program_of(graph, [*(velocities[i] for i in range(count)), energy])
    return PhaseFunctions(program.assignments, program.values[:-1], program.values[-1])


def _largest_block(entries: Iterable[tuple[int, int]], count: int) -> int:
    """How many unknowns depend on each other at most."""
    matrix = sympy.zeros(count, count)
    for index in entries:
        matrix[index] = 1
    return max(map(len, matrix.connected_components()))


def _pivots(samples: Iterable[np.ndarray | None]) -> list[int] | None:
    """An order of rows in which no pivot of a symmetric elimination vanishes; None if none was found."""
    for values in samples:
        if values is None:
            continue
        order: list[int] = []
        left = list(range(len(values)))
        while left:
            pivot = next((i for i in left if abs(values[i, i]) > _PIVOT * np.abs(values[i, left]).max()), None)
            if pivot is None:
                break
            left.remove(pivot)
            order.append(pivot)
            values = values - np.outer(values[:, pivot], values[pivot]) / values[pivot, pivot]
        else:
            return order
    return None


class _Elimination:
    """M v = y solved for v by nodes of a graph, M being symmetric."""

    def __init__(self, graph: Graph, mass: Mapping[tuple[int, int], int], order: Sequence[int]) -> None:
        self.graph = graph
        self.order = list(order)
        self.pivots: dict[int, int] = {}
        self.factors: dict[tuple[int, int], int] = {}
        self.solved: dict[int, int] = {}
        self._factorise(mass)

    def _factorise(self, mass: Mapping[tuple[int, int], int]) -> None:
        zero = self.graph.sum(())
        for index, i in enumerate(self.order):
            column: dict[int, int] = {}
            for j in self.order[:index]:
                known = [(self.factors[j, k], column[k]) for k in column if (j, k) in self.factors]
                entry = self._reduced(mass.get((i, j), zero), known)
                if entry != zero:
                    column[j] = entry
            for j, entry in column.items():
                self.factors[i, j] = self._divided(entry, self.pivots[j])
            self.pivots[i] = self._reduced(mass[i, i], [(self.factors[i, j], entry) for j, entry in column.items()])

    def forward(self, right: Sequence[int]) -> int:
        """Solve L z = y, and return y.v = sum of z_i^2 / d_i."""
        for i in self.order:
            known = [(self.factors[i, j], z) for j, z in self.solved.items() if (i, j) in self.factors]
            self.solved[i] = self._reduced(right[i], known)
        squares = (self.graph.product([(z, ONE * 2), (self.pivots[i], -ONE)]) for i, z in self.solved.items())
        return self.graph.sum((square, ONE) for square in squares)

    def backward(self) -> dict[int, int]:
        """Solve D L^T v = z."""
        found: dict[int, int] = {}
        for i in reversed(self.order):
            known = [(self.factors[j, i], v) for j, v in found.items() if (j, i) in self.factors]
            found[i] = self._reduced(self._divided(self.solved[i], self.pivots[i]), known)
        return found

    def _divided(self, node: int, by: int) -> int:
        return self.graph.product([(node, ONE), (by, -ONE)])

    def _reduced(self, node: int, products: Sequence[tuple[int, int]]) -> int:
        """A value less some products."""
        return self.graph.sum([(node, ONE), *((self.graph.times(a, b), -ONE) for a, b in products)])
