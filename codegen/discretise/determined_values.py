"""What the values and equations at an end of the time interval decide there already.

An inequality whose left side is given at an end, or is determined by the equations that hold there, has no unknown
left to satisfy it: its slack has one value, which may be zero. Neither an interior point method nor a count of
equations can do with that, so that such a condition, or such a bound, is left out at that end.

What the equations at an inner time decide there already: bounds and path inequalities that hold or are met there.

As at the ends (`determined_ends`), such an inequality has no unknown left to satisfy it, and is left out at that node.

Values at the ends that follow from path equalities and from other values, found by the rank of all equations.

Two coordinates that are equal at every node have equal velocities: where those are prescribed at both ends, one of
them follows from the rest, and the equations of motion with all conditions depend on each other. That is a matter of
the scheme (an explicit step leaves over a value at the start, not at the end), so that the Jacobian of all equations on
a few intervals decides. What depends on the others everywhere is left out, and what contradicts them is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

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
from codegen.symbolic.special_functions import NUMPY

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EndEquations:
    """The equations between the unknowns of an end: solved ones as substitutions, and others that vanish.

    `numbers` are the default values of parameters and boundary values, `given` the unknowns that have a value there.
    """

    where: str
    unknowns: frozenset[Symbol]
    solved: Mapping[Symbol, Expr]
    others: tuple[Expr, ...]
    numbers: Mapping[Symbol, float]
    given: Mapping[Symbol, Expr]

    @staticmethod
    def of(
        where: str,
        equations: Sequence[Expr],
        unknowns: frozenset[Symbol],
        numbers: Mapping[Symbol, float],
        given: Mapping[Symbol, Expr],
    ) -> EndEquations:
        """Solve those equations that are linear in the unknowns; all are expressions that vanish."""
        linear = [e for e in equations if _is_linear(e, unknowns)]
        present = sorted(set[Symbol]().union(*(e.free_symbols for e in linear)) & unknowns, key=str)
        solutions = sympy.linsolve(linear, present) if linear else sympy.EmptySet
        values = next(iter(solutions), ())
        solved = {symbol: value for symbol, value in zip(present, values, strict=False) if value != symbol}
        others = (e.subs(solved, simultaneous=True) for e in equations if e not in linear)
        left = tuple(e for e in others if e.free_symbols & unknowns)
        return EndEquations(where, unknowns, solved, left, numbers, given)

    def value(self, expression: Expr) -> Expr | None:
        """What an expression is equal to at this end, in given quantities alone; None where it may vary."""
        value = expression.xreplace(dict(self.given)).subs(self.solved, simultaneous=True)
        if not value.free_symbols & self.unknowns:
            return value
        found = (_without_multiple(value, equation, self.unknowns) for equation in self.others)
        return next((rest for rest in found if rest is not None), None)

    def touched(self, condition: str, expression: Expr) -> str | None:
        """None where expression <= 0 is not decided here; else the condition if its limit is met, or "" if not.

        Raises BoundaryError where what decides it violates it.
        """
        value = self.value(expression)
        if value is None:
            return None
        excess = expressions.rounded_at(value, self.numbers)
        if excess is None:
            return ""
        rounding = max(rounding_at(value, self.numbers), self._rounding_before(expression))
        if excess > rounding:
            raise BoundaryError(f"the {self.where} violates {condition} by {excess:g}", "correct one of them")
        return condition if excess >= -rounding else ""

    def _rounding_before(self, expression: Expr) -> float:
        """The rounding of an expression in whose value, numbers put in, the terms are no longer seen; else zero."""
        known = {**self.given, **self.solved}
        numbers = {s: expressions.rounded_at(known[s], self.numbers) for s in expression.free_symbols & set(known)}
        at = {**self.numbers, **{symbol: number for symbol, number in numbers.items() if number is not None}}
        return rounding_at(expression, at) if expression.free_symbols <= set(at) else 0.0


def with_determined_values(program: ControlProgram, inequalities: Sequence[PathValue]) -> ControlProgram:
    """The program whose ends say what is decided there; `inequalities` belong to the slacks of an interval."""
    if not program.has_inequalities:
        return program
    return replace(
        program,
        start=_with_determined_values(program, "start", inequalities),
        end=_with_determined_values(program, "end", inequalities),
    )


def _with_determined_values(program: ControlProgram, where: str, inequalities: Sequence[PathValue]) -> EndElement:
    end = program.start if where == "start" else program.end
    node = program.left_symbols if where == "start" else program.right_symbols
    given = {node[index]: value for index, value in end.pins}
    equations = _equations(program, where, given)
    candidates = [(s.name, s.meaning.subject, v.value) for s, v in zip(program.slacks, inequalities, strict=True)]
    if equations.solved or equations.others:
        candidates += _of_the_node(program, end, node)
    found = ((name, equations.touched(text, value)) for name, text, value in candidates)
    decided = dict[str, str]()
    for name, touched in found:
        if touched is not None:
            decided[name] = decided.get(name) or touched
    return replace(end, determined=tuple(decided.items()))


def _of_the_node(program: ControlProgram, end: EndElement, node: Sequence[Symbol]) -> list[tuple[str, str, Expr]]:
    """Slacks and bounded unknowns of an end node: name, condition, and the expression that is not positive."""
    found = []
    names = {f"-{program.node[slack].name}": program.node[slack].name for slack, _ in end.slacks}
    for name, value in end.conditions:
        head, _, condition = name.partition(" ")
        if head in names:
            found.append((names[head], condition[1:-1], value))
    fixed = {index for index, _ in end.pins} | {index for index, _, _ in end.shared}
    for index, unknown in enumerate(program.node):
        if index in fixed:
            continue
        if unknown.lower is not None:
            found.append((unknown.name, f"{unknown.name} >= {unknown.lower}", unknown.lower - node[index]))
        if unknown.upper is not None:
            found.append((unknown.name, f"{unknown.name} <= {unknown.upper}", node[index] - unknown.upper))
    return found


def _equations(program: ControlProgram, where: str, given: Mapping[Symbol, Expr]) -> EndEquations:
    """The equations on coordinates and rates that the author wrote for an end, at its node."""
    model, suffix = program.model, "_k" if where == "start" else "_k1"
    boundary = model.start if where == "start" else model.end
    assert boundary is not None, "a control problem has an end"
    quantities = (*model.coordinates, *model.rates)
    substitution: dict[Symbol, Expr] = dict(zip(quantities, at_nodes(quantities, suffix), strict=True))
    substitution |= {v: value for v, value in zip(model.rates, boundary.rates, strict=True) if value is not None}
    unknowns = {*program.element_symbols, *at_nodes(model.rates, suffix)} - set(given)
    duration = expressions.rounded_at(model.duration, model.default_values)
    if where == "end":
        substitution[model.time] = model.time + STEP
        if model.duration.free_symbols & set(program.shared_symbols):
            unknowns |= {model.time, STEP}
    conditions = model.start_conditions if where == "start" else model.end_conditions
    numbers = {**model.default_values, STEP: 0.0, model.time: 0.0 if where == "start" else duration}
    values = {v.symbol: expressions.rounded_at(v.value, model.default_values) for v in program.boundary_values}
    return EndEquations.of(
        where,
        [g.expression.subs(substitution, simultaneous=True).xreplace(given) for g in conditions if g.equality],
        frozenset(unknowns),
        {symbol: number for symbol, number in {**numbers, **values}.items() if number is not None},
        given,
    )


def _is_linear(equation: Expr, unknowns: frozenset[Symbol]) -> bool:
    present = sorted(equation.free_symbols & unknowns, key=str)
    slopes = [sympy.diff(equation, symbol) for symbol in present]
    return bool(present) and not any(slope.free_symbols & unknowns for slope in slopes)


def _without_multiple(value: Expr, equation: Expr, unknowns: frozenset[Symbol]) -> Expr | None:
    """What is left of a value when a multiple of something that vanishes is taken off, if no unknown is left."""
    symbol = min(value.free_symbols & unknowns, key=str)
    slope = sympy.diff(equation, symbol)
    if slope == 0:
        return None
    ratio = sympy.cancel(sympy.diff(value, symbol) / slope)
    if ratio.free_symbols & unknowns:
        return None
    rest = sympy.expand(value - ratio * equation)
    return None if rest.free_symbols & unknowns else rest


def with_determined_inner_values(program: ControlProgram, inequalities: Sequence[PathValue]) -> ControlProgram:
    """The program that says what is decided at inner times; `inequalities` belong to the slacks of an interval.

    Raises BoundaryError where equations violate a bound, or decide an inequality at the same inner time.
    """
    if not program.inner.times or not program.has_inequalities:
        return program
    found = tuple(
        (number, name, behind)
        for number in range(len(program.inner.times))
        for name, behind in _decided(program, number, inequalities)
    )
    return replace(program, inner=replace(program.inner, determined=found))


def _decided(program: ControlProgram, number: int, inequalities: Sequence[PathValue]) -> list[tuple[str, int]]:
    """Names of unknowns of the node, or with 1 and 0 of slacks of the intervals before and after it."""
    names = list[tuple[str, int]]()
    for suffix, before in (("_k", 0), ("_k1", 1)):
        equations = _inner_equations(program, number, suffix)
        if not equations.solved and not equations.others:
            return []
        pairs = zip(program.slacks, inequalities, strict=True)
        candidates = [(slack.name, slack.meaning.subject, value.value) for slack, value in pairs]
        if not before:
            _require_undecided(program, number, equations)
            candidates += _bounds(program)
        decided = [name for name, condition, value in candidates if equations.touched(condition, value) is not None]
        names += [(name, before) for name in dict.fromkeys(decided)]
    return names


def _bounds(program: ControlProgram) -> list[tuple[str, str, Expr]]:
    """Bounded unknowns of a node, each with what says so and what is not positive."""
    found = []
    inner = program.inner.unknowns
    for index, (unknown, symbol) in enumerate(zip(program.node, program.left_symbols, strict=True)):
        if unknown.lower is not None and index not in inner:
            found.append((unknown.name, f"{unknown.name} >= {unknown.lower}", unknown.lower - symbol))
        if unknown.upper is not None and index not in inner:
            found.append((unknown.name, f"{unknown.name} <= {unknown.upper}", symbol - unknown.upper))
    return found


def _inner_equations(program: ControlProgram, number: int, suffix: str) -> EndEquations:
    model = program.model
    there = [c.expression for c in model.inner_conditions if c.number == number and c.equality]
    values = [expression.subs(_at(program, number, suffix), simultaneous=True) for expression in there]
    unknowns: set[Symbol] = {*program.element_symbols, *at_nodes(model.rates, suffix)}
    time = model.inner_times[number].time
    where = f"waypoint {number + 1}" if time is None else f"inner time {text(time)}"
    return EndEquations.of(where, values, frozenset(unknowns), model.default_values, {})


def _at(program: ControlProgram, number: int, suffix: str) -> dict[Symbol, Expr]:
    model = program.model
    quantities = (*model.coordinates, *model.rates)
    values: dict[Symbol, Expr] = dict(zip(quantities, at_nodes(quantities, suffix), strict=True))
    time = model.inner_times[number].time
    return values if time is None else values | {model.time: time}


def _require_undecided(program: ControlProgram, number: int, equations: EndEquations) -> None:
    for condition in program.model.inner_conditions:
        if condition.number != number or condition.equality:
            continue
        if equations.touched(condition.name, condition.expression.subs(_at(program, number, "_k"))) is not None:
            raise BoundaryError(f"the equations there decide {condition}", "leave it out")


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
        for name, quantity in _path_equations(program):
            index = names.index(name) if name in names else -1
            if index >= 0 and index not in pinned and (quantity in given or program.node[index].kind is Kind.NODAL):
                yield _Candidate(where, quantity, index, True)
        bound = _bound(program)
        values = {index: value for index, value in end.pins if not program.node[index].multiplier}
        quantities = {v.symbol: v.quantity for v in program.boundary_values}
        for index in sorted(values, key=lambda index: (names[index] in bound, -index)):
            written = [quantities[s] for s in values[index].free_symbols if s in quantities]  # a velocity, or several
            yield _Candidate(where, written[0] if len(written) == 1 else names[index], index, False)


def _path_equations(program: ControlProgram) -> Iterator[tuple[str, str]]:
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
        element = _chain_equations(program.element, program.element_symbols, [time, *others])
        for k in range(self.steps):
            indices = np.concatenate([k * self.stride + np.arange(self.stride + self.node), shared])
            self._add(element, indices, point, [k * values[STEP], *numbers])
        for end, symbols, k in (
            (program.start, program.left_symbols, 0),
            (program.end, program.right_symbols, self.steps),
        ):
            share = _chain_equations(end.element, (*symbols, *program.shared_symbols), [time, *others])
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


def _chain_equations(share: Expr, unknowns: Sequence[Symbol], others: Sequence[Symbol]) -> _Share:
    gradient = [sympy.diff(share, x) for x in unknowns]
    indices = [(i, j) for i, g in enumerate(gradient) for j, x in enumerate(unknowns) if x in g.free_symbols]
    entries = [sympy.diff(gradient[i], unknowns[j]) for i, j in indices]
    function = sympy.lambdify([*unknowns, *others], [gradient, entries], modules=NUMPY, cse=True)
    return ([i for i, _ in indices], [j for _, j in indices]), function
