"""Values that the equations at an end of the time interval, or at an inner time, determine.

The left side of an inequality may be fixed at an end, or be determined by the equations at that end. Then its slack has
one value, which may be zero: an interior-point method cannot keep the slack positive, and the number of equations is
wrong. Therefore such a condition, or such a bound, is left out at that end. The same holds for bounds and path
inequalities at an inner time.

Values at the ends may also follow from path equalities and from other values. Two coordinates that are equal at every
node have equal velocities. If both velocities are prescribed at both ends, one value follows from the others, and the
equations of motion with all conditions are dependent. This depends on the scheme: an explicit step leaves a value
at the start undetermined, but none at the end. Therefore the rank of the Jacobian of all equations on a few intervals
decides. A value that always depends on the others is left out, and a contradiction is an error.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, S, Symbol

from codegen.discretise.conditions.path import nodal_conditions
from codegen.discretise.interval import STEP, PathValue, at_nodes
from codegen.discretise.model.relations import text
from codegen.discretise.model.values import values_at_guess
from codegen.discretise.program import ControlProgram, EndElement
from codegen.errors import BoundaryError
from codegen.runtime.record import Kind
from codegen.symbolic import checks as expressions
from codegen.symbolic.checks import rounding_at
from codegen.symbolic.functions import NUMPY

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EndEquations:
    """The equations between the unknowns of an end: `solved` for some unknowns, and `others`, which vanish.

    `where` is the name of the end in messages, `numbers` are the default values of parameters and boundary values, and
    `fixed` maps unknowns to prescribed values.
    """

    where: str
    unknowns: frozenset[Symbol]
    solved: Mapping[Symbol, Expr]
    others: tuple[Expr, ...]
    numbers: Mapping[Symbol, float]
    fixed: Mapping[Symbol, Expr]

    @staticmethod
    def of(
        where: str,
        equations: Sequence[Expr],
        unknowns: frozenset[Symbol],
        numbers: Mapping[Symbol, float],
        fixed: Mapping[Symbol, Expr],
    ) -> EndEquations:
        """Return the equations (expressions that vanish), solved where they are linear in the unknowns."""

        def is_linear(equation: Expr) -> bool:
            present = sorted(equation.free_symbols & unknowns, key=str)
            return bool(present) and not any(sympy.diff(equation, x).free_symbols & unknowns for x in present)

        linear = [e for e in equations if is_linear(e)]
        present = sorted(set[Symbol]().union(*(e.free_symbols for e in linear)) & unknowns, key=str)
        solutions = sympy.linsolve(linear, present) if linear else sympy.EmptySet
        values = next(iter(solutions), ())
        solved = {symbol: value for symbol, value in zip(present, values, strict=False) if value != symbol}
        reduced = (e.subs(solved, simultaneous=True) for e in equations if e not in linear)
        others = tuple(e for e in reduced if e.free_symbols & unknowns)
        return EndEquations(where, unknowns, solved, others, numbers, fixed)

    def value(self, expression: Expr) -> Expr | None:
        """Return the value of an expression in prescribed quantities alone, None if the equations leave it free."""
        value = expression.xreplace(dict(self.fixed)).subs(self.solved, simultaneous=True)
        if not value.free_symbols & self.unknowns:
            return value
        for equation in self.others:
            # Subtract a multiple of the equation, which vanishes, to eliminate the unknowns.
            symbol = min(value.free_symbols & self.unknowns, key=str)
            slope = sympy.diff(equation, symbol)
            if slope == 0:
                continue
            ratio = sympy.cancel(sympy.diff(value, symbol) / slope)
            if ratio.free_symbols & self.unknowns:
                continue
            rest = sympy.expand(value - ratio * equation)
            if not rest.free_symbols & self.unknowns:
                return rest
        return None

    def touched(self, condition: str, expression: Expr) -> str | None:
        """Return None if the equations leave expression <= 0 free; else `condition` if it is active, or "" if not.

        Raises BoundaryError if the determined value violates the condition.
        """
        value = self.value(expression)
        if value is None:
            return None
        excess = expressions.rounded_at(value, self.numbers)
        if excess is None:
            return ""
        # Rounding errors scale with the terms of the expression, which may be larger than the terms of its value.
        known = {**self.fixed, **self.solved}
        numbers = {s: expressions.rounded_at(known[s], self.numbers) for s in expression.free_symbols & set(known)}
        at = {**self.numbers, **{symbol: number for symbol, number in numbers.items() if number is not None}}
        rounding = rounding_at(value, self.numbers)
        if expression.free_symbols <= set(at):
            rounding = max(rounding, rounding_at(expression, at))
        if excess > rounding:
            raise BoundaryError(f"the {self.where} violates {condition} by {excess:g}", "correct one of them")
        return condition if excess >= -rounding else ""


def with_determined_values(program: ControlProgram, inequalities: Sequence[PathValue]) -> ControlProgram:
    """Return the program with `determined` values at the ends and at inner times, which need no bounds.

    `inequalities` belong to the slacks of an interval. Raises BoundaryError where equations violate a bound, or
    determine an inequality at the same inner time.
    """
    if not program.has_inequalities:
        return program
    program = replace(
        program,
        start=_with_determined_values(program, "start", inequalities),
        end=_with_determined_values(program, "end", inequalities),
    )
    determined = tuple(
        (number, name, intervals_before)
        for number in range(len(program.inner.times))
        for name, intervals_before in _determined_at_inner_time(program, number, inequalities)
    )
    return replace(program, inner=replace(program.inner, determined=determined))


Candidate = tuple[str, str, Expr]
"""The name of an unknown or slack, its condition in words, and the expression that must not be positive."""


def _on_interval(program: ControlProgram, inequalities: Sequence[PathValue]) -> list[Candidate]:
    """Return the candidates for the slacks of an interval."""
    return [(s.name, s.meaning.subject, v.value) for s, v in zip(program.slacks, inequalities, strict=True)]


def _bounded(program: ControlProgram, node: Sequence[Symbol], without: Collection[int]) -> list[Candidate]:
    """Return the candidates for the bounds of a node, except for unknowns with indices in `without`."""
    candidates = list[Candidate]()
    for index, (unknown, symbol) in enumerate(zip(program.node, node, strict=True)):
        if unknown.lower is not None and index not in without:
            candidates.append((unknown.name, f"{unknown.name} >= {unknown.lower}", unknown.lower - symbol))
        if unknown.upper is not None and index not in without:
            candidates.append((unknown.name, f"{unknown.name} <= {unknown.upper}", symbol - unknown.upper))
    return candidates


def _with_determined_values(program: ControlProgram, where: str, inequalities: Sequence[PathValue]) -> EndElement:
    end = program.start if where == "start" else program.end
    node = program.left_symbols if where == "start" else program.right_symbols
    fixed = {node[index]: value for index, value in end.pins}
    model, suffix = program.model, "_k" if where == "start" else "_k1"
    boundary = model.start if where == "start" else model.end
    assert boundary is not None, "a control problem has an end"
    quantities = (*model.coordinates, *model.rates)
    substitution: dict[Symbol, Expr] = dict(zip(quantities, at_nodes(quantities, suffix), strict=True))
    substitution |= {v: value for v, value in zip(model.rates, boundary.rates, strict=True) if value is not None}
    unknowns = {*program.element_symbols, *at_nodes(model.rates, suffix)} - set(fixed)
    duration = expressions.rounded_at(model.duration, model.default_values)
    if where == "end":
        substitution[model.time] = model.time + STEP
        if model.duration.free_symbols & set(program.linking.symbols):
            unknowns |= {model.time, STEP}
    conditions = model.start_conditions if where == "start" else model.end_conditions
    numbers = {**model.default_values, STEP: 0.0, model.time: 0.0 if where == "start" else duration}
    numbers |= {v.symbol: expressions.rounded_at(v.value, model.default_values) for v in program.boundary_values}
    equations = EndEquations.of(
        where,
        [g.expression.subs(substitution, simultaneous=True).xreplace(fixed) for g in conditions if g.equality],
        frozenset(unknowns),
        {symbol: number for symbol, number in numbers.items() if number is not None},
        fixed,
    )
    candidates = _on_interval(program, inequalities)
    if equations.solved or equations.others:
        slacks = {program.node[slack].name for slack, _ in end.slacks}
        candidates += [(e.slack, e.condition, e.value) for e in end.conditions if e.slack in slacks]
        without = {index for index, _ in end.pins} | {index for index, _, _ in end.shared}
        candidates += _bounded(program, node, without)
    determined = dict[str, str]()
    for name, condition, value in candidates:
        touched = equations.touched(condition, value)
        if touched is not None:
            determined[name] = determined.get(name) or touched
    return replace(end, determined=tuple(determined.items()))


def _determined_at_inner_time(
    program: ControlProgram, number: int, inequalities: Sequence[PathValue]
) -> list[tuple[str, int]]:
    """Return pairs (name of a determined unknown or slack, 1 for a slack of the interval before the node, else 0)."""
    model, names = program.model, list[tuple[str, int]]()
    conditions = [c for c in model.inner_conditions if c.number == number]
    quantities, time = (*model.coordinates, *model.rates), model.inner_times[number].time
    where = f"waypoint {number + 1}" if time is None else f"inner time {text(time)}"
    for suffix, intervals_before in (("_k", 0), ("_k1", 1)):
        at_node: dict[Symbol, Expr] = dict(zip(quantities, at_nodes(quantities, suffix), strict=True))
        at_node |= {} if time is None else {model.time: time}
        values = [c.expression.subs(at_node, simultaneous=True) for c in conditions if c.equality]
        unknowns: set[Symbol] = {*program.element_symbols, *at_nodes(model.rates, suffix)}
        equations = EndEquations.of(where, values, frozenset(unknowns), model.default_values, {})
        if not equations.solved and not equations.others:
            return []
        candidates = _on_interval(program, inequalities)
        if not intervals_before:
            for condition in conditions:
                value = condition.expression.subs(at_node)
                if not condition.equality and equations.touched(condition.name, value) is not None:
                    raise BoundaryError(f"the equations there decide {condition}", "leave it out")
            candidates += _bounded(program, program.left_symbols, program.inner.unknowns)
        determined = [name for name, condition, value in candidates if equations.touched(condition, value) is not None]
        names += [(name, intervals_before) for name in dict.fromkeys(determined)]
    return names


_SINGULAR = 1e-10
"""Tolerance below which singular values of the scaled Jacobian, relative to the largest, count as zero."""
_AGREES = 1e-8
_STEPS = (4, 5)
"""Numbers of intervals to test: alternating modes of a periodic motion exist for even numbers only."""
_POINTS = 3
"""Number of random points; the highest rank counts."""


def without_dependent_values(program: ControlProgram) -> ControlProgram:
    """Return the program without end values that follow from path equalities on coordinates and other values.

    Raises BoundaryError if such a value contradicts the others at the default parameters.
    """
    if program.phases or not nodal_conditions(program.model, equality=True):
        return program
    generator = np.random.default_rng(5)
    chains = [[ChainJacobian(program, steps, generator) for _ in range(_POINTS)] for steps in _STEPS]
    deficiency = _rank_deficiency(chains, program)
    for candidate in _candidates(program) if any(deficiency) else ():
        changed = candidate.left_out(program)
        fewer = _rank_deficiency(chains, changed)
        if sum(fewer) < sum(deficiency) and _agrees(chains, program, candidate):
            program, deficiency = changed, fewer
        if not any(deficiency):
            break
    return program


@dataclass(frozen=True)
class _Candidate:
    """A value or equation that could be left out at an end: `index` of its unknown in the node, `name` in messages.

    Without its prescribed value an unknown is free. Without its equation a multiplier is zero.
    """

    where: str
    name: str
    index: int
    is_equation: bool

    def left_out(self, program: ControlProgram) -> ControlProgram:
        """Return the program without the value or equation."""
        end = program.start if self.where == "start" else program.end
        pins = tuple(pin for pin in end.pins if pin[0] != self.index)
        if self.is_equation:
            pins = (*pins, (self.index, S.Zero))
        changed = replace(end, pins=pins, dependent=(*end.dependent, self.name))
        return replace(program, start=changed) if self.where == "start" else replace(program, end=changed)


def _candidates(program: ControlProgram) -> Iterator[_Candidate]:
    """Yield the candidates at the end, then at the start, in the order: velocities, path equalities, other values."""
    model = program.model
    equalities = nodal_conditions(model, equality=True)
    nodal = {unknown.meaning.of: unknown.name for unknown in program.node if unknown.kind is Kind.NODAL}
    equations = [(nodal[condition.name], condition.name) for condition in equalities]
    velocities = [
        (f"{stem}_{symbol}", rate.name)
        for q, rate in reversed(list(zip(model.coordinates, model.rates, strict=False)))
        for stem, symbol in (("lambda", q), ("nu", rate))
    ]
    tied = {symbol.name for condition in equalities for symbol in condition.expression.free_symbols}
    names = [unknown.name for unknown in program.node]
    for where, end in (("end", program.end), ("start", program.start)):
        pinned = {index for index, _ in end.pins}
        prescribed = [value.quantity for value in program.boundary_values if value.where == where]
        for name, quantity in (*velocities, *equations):
            index = names.index(name) if name in names else -1
            is_present = quantity in prescribed or program.node[index].kind is Kind.NODAL
            if index >= 0 and index not in pinned and is_present:
                yield _Candidate(where, quantity, index, True)
        values = {index: value for index, value in end.pins if not program.node[index].multiplier}
        quantities = {v.symbol: v.quantity for v in program.boundary_values}
        for index in sorted(values, key=lambda index: (names[index] in tied, -index)):
            written = [quantities[s] for s in values[index].free_symbols if s in quantities]  # a velocity, or several
            yield _Candidate(where, written[0] if len(written) == 1 else names[index], index, False)


def _rank_deficiency(chains: Sequence[Sequence[ChainJacobian]], program: ControlProgram) -> list[int]:
    """Return the smallest rank deficiency over the random points, for each number of intervals."""
    return [min(_nulls(chain.reduced(program)[0]).shape[1] for chain in points) for points in chains]


def _nulls(matrix: Array) -> Array:
    """Return the left null vectors, as columns, of a matrix whose rows are scaled to similar sizes."""
    left, singular, _ = np.linalg.svd(matrix, full_matrices=True)
    return left[:, int(np.sum(singular > _SINGULAR * singular.max(initial=1e-300))) :]


def _agrees(chains: Sequence[Sequence[ChainJacobian]], program: ControlProgram, candidate: _Candidate) -> bool:
    """Return True if the value of a candidate follows from the other equations at all points; False if uncertain.

    A combination of equations that does not depend on the unknowns must vanish, or BoundaryError is raised. Where the
    combination depends on the point, the equations may still have a common solution.
    """
    for points in chains:
        combined = []
        for chain in points:
            # The component of the residuals in the space of combinations that are constant to first order.
            matrix, residuals, scale = chain.reduced(program)
            basis = np.linalg.qr(_nulls(matrix) / scale[:, None])[0]
            combined.append(basis @ (basis.T @ residuals))
        if any(value.shape != combined[0].shape for value in combined):
            return False
        size = max(float(np.abs(chain.residuals).max(initial=1.0)) for chain in points)
        if all(np.abs(value).max(initial=0.0) <= _AGREES * size for value in combined):
            continue
        if any(np.abs(value - combined[0]).max() > _AGREES * size for value in combined):
            return False
        others = " and ".join(g.name for g in nodal_conditions(program.model, equality=True))
        raise BoundaryError(
            f"{candidate.name} at the {candidate.where} contradicts {others} and the other values at the ends",
            "correct it, or leave it out",
        )
    return True


class ChainJacobian:
    """All equations of one body on `steps` intervals, and their Jacobian with respect to all unknowns.

    The order of unknowns is node 0, interval 0, node 1, ..., the last node, then the linking variables.
    """

    def __init__(self, program: ControlProgram, steps: int, generator: np.random.Generator) -> None:
        """Evaluate both at a random point near straight lines between the prescribed values at the ends."""
        self.steps, self.node = steps, len(program.node)
        inside = (*program.interval, *program.controls, *program.slacks)
        self.stride = self.node + len(inside)
        self.size = steps * self.stride + self.node + len(program.linking.unknowns)
        of_node, of_interval = ([u.multiplier for u in unknowns] for unknowns in (program.node, inside))
        self.is_multiplier = np.array(
            [*((of_node + of_interval) * steps), *of_node, *(u.multiplier for u in program.linking.unknowns)]
        )
        self.matrix, self.residuals = np.zeros((self.size, self.size)), np.zeros(self.size)
        model = program.model
        values = values_at_guess(model) | ({model.body: 0.0} if model.body is not None else {})
        numbers = {v.symbol: expressions.rounded_at(v.value, values) for v in program.boundary_values}
        values |= {symbol: number for symbol, number in numbers.items() if number is not None}
        duration = 1.0 if program.scaled_time else expressions.rounded_at(model.duration, values)
        values |= dict.fromkeys(program.inner.symbols, 0.0)  # no node is at an inner time
        values[STEP] = (duration or 1.0) / steps
        point = self._point(program, values, generator)
        shared = np.arange(self.size - len(program.linking.unknowns), self.size)
        constants = {symbol: number for symbol, number in values.items() if symbol not in program.linking.symbols}
        shares = [(program.element, program.element_symbols, self.stride + self.node, range(steps))]
        for end, symbols, k in ((program.start, program.left_symbols, 0), (program.end, program.right_symbols, steps)):
            shares.append((end.element, (*symbols, *program.linking.symbols), self.node, range(k, k + 1)))
        for share, unknowns, width, places in shares:
            slopes = [sympy.diff(share, x) for x in unknowns]
            pattern = [(i, j) for i, g in enumerate(slopes) for j, x in enumerate(unknowns) if x in g.free_symbols]
            rows, columns = [i for i, _ in pattern], [j for _, j in pattern]
            second = [sympy.diff(slopes[i], unknowns[j]) for i, j in pattern]
            evaluate = sympy.lambdify([*unknowns, model.time, *constants], [slopes, second], modules=NUMPY, cse=True)
            for k in places:
                indices = np.concatenate([k * self.stride + np.arange(width), shared])
                with np.errstate(all="ignore"):
                    gradient, entries = evaluate(*point[indices], k * values[STEP], *constants.values())
                np.add.at(self.residuals, indices, np.array(gradient, dtype=float))
                np.add.at(self.matrix, (indices[rows], indices[columns]), np.array(entries, dtype=float))

    def reduced(self, program: ControlProgram) -> tuple[Array, Array, Array]:
        """Return Jacobian (m, n), residuals (m,) and row scales (m,) of the equations in the free unknowns.

        `program` must have the same intervals and linking variables as the program of the chain. Rows and columns of
        the Jacobian are scaled to the same size; residuals are not scaled.
        """
        free, matrix = np.ones(self.size, bool), self.matrix.copy()
        for end, k in ((program.start, 0), (program.end, self.steps)):
            first = k * self.stride
            free[[first + index for index, _ in end.pins]] = False
            for index, shared, _ in end.shared:
                matrix[:, self.size - len(program.linking.unknowns) + shared] += matrix[:, first + index]
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

    def _point(self, program: ControlProgram, values: dict[Symbol, float], generator: np.random.Generator) -> Array:
        """Return random values of all unknowns near straight lines; multipliers, in which all is linear, are zero."""
        point = np.zeros(self.size)
        ends = [{i: expressions.rounded_at(v, values) for i, v in end.pins} for end in (program.start, program.end)]
        for k in range(self.steps + 1):
            for index in range(self.node):
                first, last = (end.get(index) for end in ends)
                first, last = first if first is not None else last, last if last is not None else first
                if first is not None and last is not None:
                    point[k * self.stride + index] = first + (last - first) * k / self.steps
        point += np.where(point == 0.0, 1.0, np.maximum(1.0, np.abs(point))) * generator.uniform(0.1, 0.4, self.size)
        shared = self.size - len(program.linking.unknowns)
        point[shared:] = [values.get(symbol, point[0]) for symbol in program.linking.symbols]
        for end, prescribed, k in ((program.start, ends[0], 0), (program.end, ends[1], self.steps)):
            for index, value in prescribed.items():
                point[k * self.stride + index] = value or 0.0
            for index, other, offset in end.shared:
                point[k * self.stride + index] = point[shared + other] + (expressions.rounded_at(offset, values) or 0.0)
        return np.where(self.is_multiplier, 0.0, point)
