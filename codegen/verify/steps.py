"""The kernels of a simulation: the scheme's equations, what is left of them for Newton's method, and the energy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from sympy import Expr, Symbol

from codegen.expressions.checks import rounded_at
from codegen.transcribe.step_program import StepProgram
from codegen.verify.execution import Arithmetic, Tape, Text
from codegen.verify.judgement import EXACT, SIZED, Sized, complex_numbers, difference, judge, sized, step_of
from codegen.verify.points import Values, finite_points, random_points

_DRAWN = 30
Assignment = tuple[Symbol, Expr]


def verify_step(program: StepProgram, text: Text) -> None:
    """Compare every kernel with what the program says; VerificationError names a value that is wrong."""
    base = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
    interval = [*program.stage_symbols, *program.right_symbols]
    kernels = _Kernels(program, text, base)
    written, values = zip(*program.equations, strict=True)
    kernels.compare("step_equations", interval, (), list(values), [f"the equation {name}" for name in written])
    kernels.compare("energy", [], program.state_assignments, [program.energy], ["the energy"])
    named = [f"the {symbol} of a step" for symbol in interval]
    if not program.unknowns:
        kernels.compare("explicit_step", [], program.before, list(interval), named)
        return
    unknowns, assigned = list(program.unknowns), (*program.before, *program.after)
    kernels.compare("complete_step", unknowns, assigned, list(interval), named)
    residual = [f"equation {i + 1} that a step solves" for i in range(len(unknowns))]
    kernels.compare("step_residual", unknowns, program.before, list(program.residual), residual)
    kernels.compare_slopes(unknowns, program.before, list(program.residual), residual)


class _Values:
    """Expressions that read assignments, evaluated as they stand."""

    def __init__(self, assignments: Sequence[Assignment], values: Sequence[Expr]) -> None:
        self.names = [symbol for symbol, _ in assignments]
        self.tapes = [Tape([value]) for _, value in assignments]
        self.tape = Tape(values)

    def evaluate(self, given: Mapping[Symbol, Any], numbers: Arithmetic) -> list[Any]:
        known = dict(given)
        for symbol, tape in zip(self.names, self.tapes, strict=True):
            known[symbol] = tape.evaluate(known, numbers)[0]
        return self.tape.evaluate(known, numbers)


class _Kernels:
    """Calls kernels of a step, at points where the program's expressions have values."""

    def __init__(self, program: StepProgram, text: Text, base: Sequence[Symbol]) -> None:
        self.program, self.text, self.base = program, text, base

    def compare(
        self,
        name: str,
        inside: Sequence[Symbol],
        assignments: Sequence[Assignment],
        values: Sequence[Expr],
        names: Sequence[str],
    ) -> None:
        """A kernel that fills values, given those of some symbols beside the state, time, length and parameters."""
        if not values:
            return
        read = _Values(assignments, values)
        points, count = self._points(inside, read)

        def filled(given: Mapping[Symbol, Any], numbers: Arithmetic) -> list[Any]:
            return self._filled(name, self.text.kernels((name,), numbers)[name], given, inside, len(values))

        def evaluate(kind: Any) -> tuple[Any, Any]:
            given = {symbol: array.astype(kind) for symbol, array in points.items()}
            numbers = complex_numbers(kind)
            return _columns(filled(given, numbers), count), _columns(read.evaluate(given, numbers), count)

        def opinion(entry: int, point: int) -> tuple[Sized, Any, Any]:
            at = {symbol: float(array[point]) for symbol, array in points.items()}
            exact, error = difference(lambda given: read.evaluate(given, EXACT)[entry], at, [])
            found = filled({symbol: Sized(value) for symbol, value in at.items()}, SIZED)[entry]
            return sized(found), exact, error

        if count:
            judge(names, evaluate, opinion)

    def compare_slopes(
        self, unknowns: Sequence[Symbol], before: Sequence[Assignment], residual: Sequence[Expr], names: Sequence[str]
    ) -> None:
        """The Jacobian of the residual, and the residual that its kernel fills as well."""
        read, size = _Values(before, residual), len(unknowns)
        points, count = self._points(unknowns, read)

        def filled(given: Mapping[Symbol, Any], numbers: Arithmetic) -> list[Any]:
            kernel = self.text.kernels(("step_jacobian",), numbers)["step_jacobian"]
            beside: list[Any] = [0] * size
            matrix: list[Any] = [0] * size**2
            kernel([given[y] for y in unknowns], *self._arguments(given), beside, matrix)
            return [*beside, *matrix]

        def evaluate(kind: Any) -> tuple[Any, Any]:
            step, numbers = step_of(kind), complex_numbers(kind)
            given = {symbol: array.astype(kind)[:, None] for symbol, array in points.items()}
            moved = dict(given)
            for index, y in enumerate(unknowns):
                moved[y] = np.tile(given[y], (1, size))
                moved[y][:, index] += 1j * step
            exact = [np.broadcast_to(np.asarray(value, kind), (count, size)) for value in read.evaluate(moved, numbers)]
            heights = np.stack([value[:, 0].real for value in exact], axis=1)
            slopes = np.concatenate([value.imag / step for value in exact], axis=1)
            emitted = [np.asarray(value).reshape(-1) for value in filled(given, numbers)]
            return _columns(emitted, count), np.concatenate([heights, slopes], axis=1)

        def opinion(entry: int, point: int) -> tuple[Sized, Any, Any]:
            at = {symbol: float(array[point]) for symbol, array in points.items()}
            row, by = (entry, []) if entry < size else ((entry - size) // size, [unknowns[(entry - size) % size]])
            exact, error = difference(lambda given: read.evaluate(given, EXACT)[row], at, by)
            found = filled({symbol: Sized(value) for symbol, value in at.items()}, SIZED)[entry]
            return sized(found), exact, error

        if count:
            slopes = [f"the derivative of {name} by {y}" for name in names for y in unknowns]
            judge([*names, *slopes], evaluate, opinion)

    def _filled(
        self, name: str, kernel: Callable[..., Any], given: Mapping[Symbol, Any], inside: Sequence[Symbol], size: int
    ) -> list[Any]:
        state, time, length, parameters = self._arguments(given)
        within, filled = [given[symbol] for symbol in inside], [0] * size
        if name == "energy":
            return [kernel(state, time, parameters)]
        if name == "step_equations":
            kernel(state, within, time, length, parameters, filled)
        elif name == "explicit_step":
            kernel(state, time, length, parameters, filled)
        else:
            kernel(within, state, time, length, parameters, filled)
        return filled

    def _arguments(self, given: Mapping[Symbol, Any]) -> tuple[list[Any], Any, list[Any], list[Any]]:
        program = self.program
        return (
            [given[symbol] for symbol in program.left_symbols],
            given[program.model.time],
            [given[h] for h in program.lengths],
            [given[symbol] for symbol in program.model.parameters],
        )

    def _points(self, inside: Sequence[Symbol], read: _Values) -> tuple[Values, int]:
        defaults = self.program.model.default_values
        symbols = list(dict.fromkeys([*self.base, *inside]))
        drawn = random_points(symbols, defaults, _DRAWN, seed=5)
        return finite_points(read, [drawn | self._near_start(symbols), drawn])

    def _near_start(self, symbols: Sequence[Symbol]) -> Values:
        """States near the initial one, with the steps and parameters that a solution has by default."""
        program, generator = self.program, np.random.default_rng(6)
        values = dict(program.model.default_values)
        values |= {v.symbol: rounded_at(v.value, values) or 0.0 for v in program.start_values}
        state = dict(zip(program.left_symbols, (rounded_at(e, values) or 0.0 for e in program.start), strict=True))
        state |= dict(zip(program.right_symbols, list(state.values()), strict=True))
        length = (rounded_at(program.model.duration, values) or 1.0) / program.model.steps
        near = {symbol: np.full(_DRAWN, number) for symbol, number in values.items()}
        for symbol, number in state.items():
            near[symbol] = number + 0.1 * (abs(number) or 1.0) * generator.uniform(-1.0, 1.0, _DRAWN)
        near |= {h: np.full(_DRAWN, length) for h in program.lengths} | {program.model.time: np.zeros(_DRAWN)}
        return {symbol: array for symbol, array in near.items() if symbol in symbols}


def _columns(values: Sequence[Any], count: int) -> Any:
    return np.stack([np.broadcast_to(np.asarray(value).real, count) for value in values], axis=1)
