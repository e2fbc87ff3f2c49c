"""Values at the ends that follow from path equalities and from other values, found by the rank of all equations.

Two coordinates that are equal at every node have equal velocities: where those are prescribed at both ends, one of
them follows from the rest, and the equations of motion with all conditions depend on each other. That is a matter of
the scheme (an explicit step leaves over a value at the start, not at the end), so that the Jacobian of all equations on
a few intervals decides. What depends on the others everywhere is left out, and what contradicts them is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sympy import S

from codegen.errors import BoundaryError
from codegen.model.conditions.path import nodal_conditions
from codegen.runtime.record import Kind
from codegen.transcribe.program import ControlProgram
from codegen.transcribe.redundancy.chain_jacobian import ChainJacobian

_SINGULAR = 1e-10
"""Singular values of the scaled Jacobian below it, relative to the largest, count as rounding."""
_AGREES = 1e-8
_STEPS = (4, 5)
"""Numbers of intervals: alternating modes of a periodic motion exist for even ones only."""
_POINTS = 3
"""Random points; that with the highest rank counts."""


def without_dependent_values(program: ControlProgram) -> ControlProgram:
    """Leave out values at the ends that follow from path equalities on coordinates and from the other values.

    Raises BoundaryError where such a value contradicts the others at the default parameters.
    """
    if program.phases or not nodal_conditions(program.model, equality=True):
        return program
    generator = np.random.default_rng(5)
    chains = [[ChainJacobian(program, steps, generator) for _ in range(_POINTS)] for steps in _STEPS]
    lacking = _lacking(chains, program)
    for candidate in _candidates(program) if any(lacking) else ():
        changed = candidate.left_out(program)
        fewer = _lacking(chains, changed)
        if sum(fewer) < sum(lacking) and _agrees(chains, program, candidate):
            program, lacking = changed, fewer
        if not any(lacking):
            break
    return program


@dataclass(frozen=True)
class _Candidate:
    """What could be left out at an end: an unknown of the node, and what it means to the author.

    To leave out a value that is given frees the unknown; to leave out an equation, its multiplier has to vanish.
    """

    where: str
    name: str
    index: int
    is_equation: bool

    def left_out(self, program: ControlProgram) -> ControlProgram:
        """The program without it."""
        end = program.start if self.where == "start" else program.end
        pins = tuple(pin for pin in end.pins if pin[0] != self.index)
        if self.is_equation:
            pins = (*pins, (self.index, S.Zero))
        changed = replace(end, pins=pins, dependent=(*end.dependent, self.name))
        return replace(program, start=changed) if self.where == "start" else replace(program, end=changed)


def _candidates(program: ControlProgram) -> Iterator[_Candidate]:
    """What could be left out at the end, and then at the start: velocities, path equalities, other given values."""
    for where, end in (("end", program.end), ("start", program.start)):
        names, pinned = [unknown.name for unknown in program.node], {index for index, _ in end.pins}
        given = [value.quantity for value in program.boundary_values if value.where == where]
        for name, quantity in _equations(program):
            index = names.index(name) if name in names else -1
            if index >= 0 and index not in pinned and (quantity in given or program.node[index].kind is Kind.NODAL):
                yield _Candidate(where, quantity, index, True)
        bound = _bound(program)
        values = {index: value for index, value in end.pins if not program.node[index].multiplier}
        quantities = {v.symbol: v.quantity for v in program.boundary_values}
        for index in sorted(values, key=lambda index: (names[index] in bound, -index)):
            written = [quantities[s] for s in values[index].free_symbols if s in quantities]  # a velocity, or several
            yield _Candidate(where, written[0] if len(written) == 1 else names[index], index, False)


def _equations(program: ControlProgram) -> Iterator[tuple[str, str]]:
    """Multipliers of equations at an end that could be left out, and what these say: velocities, path equalities."""
    model = program.model
    for q, rate in reversed(list(zip(model.coordinates, model.rates, strict=False))):
        yield f"lambda_{q}", rate.name
        yield f"nu_{rate}", rate.name
    multipliers = {unknown.meaning.of: unknown.name for unknown in program.node if unknown.kind is Kind.NODAL}
    for condition in nodal_conditions(model, equality=True):
        yield multipliers[condition.name], condition.name


def _bound(program: ControlProgram) -> set[str]:
    """The names of what path equalities tie."""
    conditions = nodal_conditions(program.model, equality=True)
    return {symbol.name for condition in conditions for symbol in condition.expression.free_symbols}


def _lacking(chains: Sequence[Sequence[ChainJacobian]], program: ControlProgram) -> list[int]:
    """The rank deficiency on each number of intervals."""
    return [min(_nulls(chain.reduced(program)[0]).shape[1] for chain in points) for points in chains]


def _nulls(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The left null vectors of a matrix whose rows are of like size, as columns."""
    left, singular, _ = np.linalg.svd(matrix, full_matrices=True)
    return left[:, int(np.sum(singular > _SINGULAR * singular.max(initial=1e-300))) :]


def _agrees(chains: Sequence[Sequence[ChainJacobian]], program: ControlProgram, left: _Candidate) -> bool:
    """Whether a value is what the other equations say, wherever the unknowns are; False where that is not known.

    A combination of equations that does not change with the unknowns has to vanish: BoundaryError where it is another
    number. Where it depends on the point, the equations may have a common solution all the same.
    """
    for points in chains:
        combined = [_combined(chain, program) for chain in points]
        if any(value.shape != combined[0].shape for value in combined):
            return False
        size = max(float(np.abs(chain.residuals).max(initial=1.0)) for chain in points)
        if all(np.abs(value).max(initial=0.0) <= _AGREES * size for value in combined):
            continue
        if any(np.abs(value - combined[0]).max() > _AGREES * size for value in combined):
            return False
        others = " and ".join(g.name for g in nodal_conditions(program.model, equality=True))
        raise BoundaryError(
            f"{left.name} at the {left.where} contradicts {others} and the other values at the ends",
            "correct it, or leave it out",
        )
    return True


def _combined(chain: ChainJacobian, program: ControlProgram) -> NDArray[np.float64]:
    """The residuals' part in the space of combinations that do not change to first order."""
    matrix, residuals, sizes = chain.reduced(program)
    basis = np.linalg.qr(_nulls(matrix) / sizes[:, None])[0]
    return basis @ (basis.T @ residuals)
