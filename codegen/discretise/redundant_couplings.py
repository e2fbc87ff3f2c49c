"""Which couplings between bodies follow from the others, found numerically where all of them hold.

A set of conditions may be redundant although no two of them are alike: of the sides, centre, height and interior angles
of a regular polygon with H corners, 2 H + 3 equations, only 2 H are independent. A solver needs the independent ones.

The Jacobian of all equations of a control problem on a few intervals, at a random point, for questions of rank.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from codegen.discretise.interval import STEP
from codegen.discretise.model.definitions import Model, prescribed
from codegen.discretise.model.values import values_at_guess
from codegen.discretise.program import ControlProgram
from codegen.symbolic import checks as expressions
from codegen.symbolic.functions import NUMPY
from codegen.symbolic.terms import Kind, sorted_terms

_DEPENDENT = 1e-7
"""Part of a gradient outside the span of earlier gradients, relative to its length, that counts as rounding."""
_NAMED = 1e-6
_HOLDS = 1e-8
"""Distance to the set where a coupling holds, relative to the size of the configuration, that counts as none."""
_EXACT = 1e-15
_ITERATIONS = 50

Array = NDArray[np.float64]
System = Callable[[Array], tuple[Array, Array]]
"""Residuals and their Jacobian at a configuration."""


@dataclass(frozen=True)
class IndependentCouplings:
    """Which couplings are to be `kept` (indices in `Model.couplings`), and why the others are not.

    `dropped` gives the index of each other coupling and the names of those that it follows from; no names where its
    gradient vanishes. When the couplings are not `consistent`, no configuration was found where all of them hold;
    `violated` then names the one that is farthest from holding, and dependence was judged at the configuration where
    they are nearest to it.
    """

    kept: tuple[int, ...]
    dropped: tuple[tuple[int, tuple[str, ...]], ...]
    consistent: bool = True
    violated: str = ""


@dataclass(frozen=True)
class _Equations:
    """Equations between end values: names, expressions of the unknowns, and values of the unknowns to start from.

    The first ones are the end conditions of each body by itself, the last ones the couplings.
    """

    names: tuple[str, ...]
    expressions: tuple[sympy.Expr, ...]
    unknowns: tuple[sympy.Symbol, ...]
    guess: Array


def independent_couplings(model: Model) -> IndependentCouplings:
    """Sort the couplings of a model into independent ones and ones that follow from those written before them.

    A coupling may also follow from equations that hold at the end of each body by itself; those are always kept.
    Judged to first order at the default parameters, at a configuration that lies near the guess and fulfils all
    equations, if there is one (Levenberg-Marquardt steps, from the guess and from points beside it).
    """
    if not model.couplings:
        return IndependentCouplings((), ())
    equations = _equations(model)
    system = _system(equations)
    tried = []
    for number, start in enumerate(_starts(equations.guess)):
        tried.append(_projected(system, start))
        # The guess may be special, such as bodies in one line, and so may the configuration that is found from it.
        if number > 0 and any(distance <= _HOLDS for _, distance in tried):
            break
    nearest, least = min(tried, key=lambda projection: projection[1])
    typical = np.linalg.norm(system(start)[1], axis=1)
    points = [point for point, distance in tried if distance <= _HOLDS] or [nearest]
    sorted_rows = [_sorted_rows(equations.names, _without_vanishing(system(point)[1], typical)) for point in points]
    kept, dropped = max(sorted_rows, key=lambda rows: len(rows[0]))
    first = len(equations.names) - len(model.couplings)
    found = IndependentCouplings(
        tuple(index - first for index in kept if index >= first),
        tuple((index - first, names) for index, names in dropped if index >= first),
    )
    if least <= _HOLDS:
        return found
    worst = int(np.argmax(np.abs(_scaled(*system(nearest))[0])))
    return replace(found, consistent=False, violated=equations.names[worst])


def _equations(model: Model) -> _Equations:
    own = {(value.body, value.coordinate): value.symbol for value in model.end_values}
    moving = (*model.coordinates, *model.rates)
    fixed = prescribed(model, "end")
    equations, guess = [], dict[sympy.Symbol, float]()
    conditions = [condition for condition in model.end_conditions if condition.equality]
    present = {symbol for condition in conditions for symbol in condition.expression.free_symbols}
    values = _values_at_end(model)
    for body in range(model.bodies):
        values |= {model.body: float(body)} if model.body is not None else {}
        substitution: dict[sympy.Symbol, sympy.Expr] = {}
        for index, symbol in enumerate(moving):
            if symbol not in present and (body, index) not in own:
                continue
            number = expressions.rounded_at(fixed[symbol], values) if symbol in fixed else None
            substitution[symbol] = own.get((body, index), sympy.Dummy(f"{symbol}_{body}", real=True))
            if number is None:
                guess[substitution[symbol]] = _guessed_end(model, index, values)
            else:
                substitution[symbol] = sympy.Float(number)
        equations += [(f"{g.name} of body {body}", g.expression.xreplace(substitution)) for g in conditions]
    equations += [(condition.name, condition.expression) for condition in model.couplings]
    guess |= {parameter.symbol: values[parameter.symbol] for parameter in model.free_parameters}
    inside = {symbol for _, expression in equations for symbol in expression.free_symbols}
    unknowns = tuple(symbol for symbol in guess if symbol in inside)
    numbers = {symbol: sympy.Float(number) for symbol, number in model.default_values.items()}
    return _Equations(
        names=tuple(name for name, _ in equations),
        expressions=tuple(expression.xreplace(numbers) for _, expression in equations),
        unknowns=unknowns,
        guess=np.array([guess[symbol] for symbol in unknowns]),
    )


def _values_at_end(model: Model) -> dict[sympy.Symbol, float]:
    """What guesses and boundary values depend on at the end of the motion, the number of a body aside."""
    values = values_at_guess(model)
    duration = expressions.rounded_at(model.duration, values)
    assert duration is not None, "checked when the model was made"
    return values | {model.time: duration}


def _guessed_end(model: Model, index: int, values: Mapping[sympy.Symbol, float]) -> float:
    """The end of the motion from which the solver starts, or zero where it has no value."""
    motions = [
        dict(model.guess).get(q, start) for q, start in zip(model.coordinates, model.start.positions, strict=True)
    ]
    count = len(model.coordinates)
    motion = motions[index] if index < count else motions[index - count]
    if motion is None or (index >= count and model.form != "lagrangian"):
        return 0.0
    value = motion if index < count else sympy.diff(motion, model.time)
    return expressions.rounded_at(value, values) or 0.0


def _system(equations: _Equations) -> System:
    """Residuals and Jacobian, term by term; all terms of a kind are evaluated at once."""
    size = len(equations.expressions), len(equations.unknowns)
    kinds, instances = sorted_terms(equations.expressions, {s: j for j, s in enumerate(equations.unknowns)})
    functions = [_with_slopes(kind) for kind in kinds]
    groups = [[instance for instance in instances if instance.kind == kind] for kind in range(len(kinds))]
    rows = [np.array([instance.row for instance in group]) for group in groups]
    indices = [np.array([instance.indices for instance in group], dtype=int).T for group in groups]

    def system(point: Array) -> tuple[Array, Array]:
        residuals, jacobian = np.zeros(size[0]), np.zeros(size)
        for function, row, read in zip(functions, rows, indices, strict=True):
            with np.errstate(all="ignore"):
                value, *slopes = function(*point[read])
            np.add.at(residuals, row, value)
            for index, slope in zip(read, slopes, strict=True):
                np.add.at(jacobian, (row, index), slope)
        return residuals, jacobian

    return system


def _with_slopes(kind: Kind) -> Callable[..., Any]:
    """A term and its derivatives by all its arguments, as a function of arrays."""
    value = kind.expression
    if value.has(sympy.Max, sympy.Min):  # numpy's take no array beside a number
        value = value.rewrite(sympy.Piecewise)
    slopes = [sympy.diff(value, argument) for argument in kind.arguments]
    return sympy.lambdify(kind.arguments, [value, *slopes], "numpy", cse=True)  # type: ignore[no-any-return]


def _starts(guess: Array) -> Iterator[Array]:
    """The guess, then points at growing distances from it, the same in every run."""
    generator = np.random.default_rng(1)
    size = max(1.0, float(np.abs(guess).max()))
    yield guess
    for distance in (1e-3, 1e-1, 1.0, 1.0, 1.0):
        yield guess + distance * size * generator.uniform(-1.0, 1.0, guess.size)


def _scaled(residuals: Array, jacobian: Array) -> tuple[Array, Array]:
    """Equations divided by the lengths of their gradients, so that residuals are distances."""
    length = np.linalg.norm(jacobian, axis=1)
    length[~(length > 0.0)] = 1.0
    return residuals / length, jacobian / length[:, None]


def _without_vanishing(jacobian: Array, typical: Array) -> Array:
    """The Jacobian with zeros for those gradients that vanish, compared to their `typical` lengths elsewhere."""
    vanishes = np.linalg.norm(jacobian, axis=1) <= _DEPENDENT * typical
    return np.where(vanishes[:, None], 0.0, jacobian)


def _projected(system: System, point: Array) -> tuple[Array, float]:
    """The point moved to where all equations hold, as far as that succeeds, and its relative distance from there.

    The damping of the steps is the square of the residuals, with which they converge quadratically even where
    equations are redundant (Yamashita and Fukushima, 2001, On the rate of convergence of the Levenberg-Marquardt
    method).
    """
    residuals, jacobian = _scaled(*system(point))
    error = float(np.linalg.norm(residuals))
    for _ in range(_ITERATIONS):
        if not np.isfinite(jacobian).all() or not _EXACT * np.abs(point).max() < error < np.inf:
            break
        damped = np.vstack([jacobian, min(error, 1.0) * np.eye(point.size)])
        step = np.linalg.lstsq(damped, -np.concatenate([residuals, np.zeros(point.size)]), rcond=None)[0]
        moved = _improved(system, point, step, error)
        if moved is None:
            break
        point, (residuals, jacobian), error = moved
    size = max(1.0, float(np.abs(point).max()))
    return point, error / size if np.isfinite(error) and np.isfinite(jacobian).all() else np.inf


def _improved(
    system: System, point: Array, step: Array, error: float
) -> tuple[Array, tuple[Array, Array], float] | None:
    """The first of ever shorter steps that makes the error less, if any does."""
    for length in 0.5 ** np.arange(12):
        trial = point + length * step
        equations = _scaled(*system(trial))
        trial_error = float(np.linalg.norm(equations[0]))
        if trial_error < error and np.isfinite(equations[1]).all():
            return trial, equations, trial_error
    return None


def _sorted_rows(
    titles: Sequence[str], jacobian: Array
) -> tuple[tuple[int, ...], tuple[tuple[int, tuple[str, ...]], ...]]:
    """Gram-Schmidt in the order of the rows: those that point out of the span of earlier ones, and the others.

    Each row is orthogonalised twice, which keeps the basis orthogonal to rounding.
    """
    kept: list[int] = []
    dropped: list[tuple[int, tuple[str, ...]]] = []
    basis = np.empty((0, jacobian.shape[1]))
    _, rows = _scaled(np.zeros(len(jacobian)), jacobian)
    for index, row in enumerate(rows):
        rest = row - basis.T @ (basis @ row)
        rest -= basis.T @ (basis @ rest)
        length = float(np.linalg.norm(rest))
        if length > _DEPENDENT:
            basis = np.vstack([basis, rest / length])
            kept.append(index)
        else:
            dropped.append((index, _sources(titles, kept, rows[kept], row)))
    return tuple(kept), tuple(dropped)


def _sources(titles: Sequence[str], kept: Sequence[int], rows: Array, row: Array) -> tuple[str, ...]:
    """The kept equations whose gradients combine to the given row."""
    weights = np.linalg.lstsq(rows.T, row, rcond=None)[0]
    return tuple(titles[index] for index, weight in zip(kept, weights, strict=True) if abs(weight) > _NAMED)


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
