"""Verification of the kernels of all three tasks against the expressions of the discretised problem.

A control problem has kernels of intervals of all kinds, samples and both ends. A simulation has the scheme's equations,
the reduced equations for Newton's method, and the energy. Particles have loops for H, its derivatives and Hessian
products: the reference is the sum of the author's two terms over a few particles. Its first derivatives are complex
steps, its second derivatives differences of these in extended precision.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from sympy import Expr, S, Symbol

from codegen.discretise.interval import STEP
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import PairwiseProgram
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.emit.differentiation import data_of
from codegen.emit.lower.control.kernels import named_elements
from codegen.emit.lower.control.layout import parameters
from codegen.emit.lower.simulate import EVENT_KERNELS, rows_of_events
from codegen.emit.verify.comparison import (
    EXACT,
    SIZED,
    Complex,
    GuessedPoints,
    Sized,
    Values,
    complex_numbers,
    difference,
    finite_points,
    judge,
    random_points,
    sized,
    step_of,
    with_time,
)
from codegen.emit.verify.execution import Arithmetic, Function, Operand, Tape, Text, defect
from codegen.emit.verify.shares import Share, ShareComparison, columns_of, mixed_shares, pattern_of
from codegen.symbolic.checks import rounded_at
from codegen.symbolic.graph import Assignment

_DRAWN = 30
_ROUNDING = 1e-8
_READ = (
    *("make_grid", "initial_guess", "read_shared", "STRIDE", "BODIES", "SHARED"),
    *(f"{share}HESSIAN_{side}" for share in ("", "START_", "END_") for side in ("ROWS", "COLUMNS")),
)
"""Names in a module whose definitions are executed unchanged."""


def verify_control(program: ControlProgram, text: Text) -> None:
    """Compare every kernel with its share of the Lagrangian; raise VerificationError with the name of a wrong entry."""
    guessed = guessed_points(program, text)
    intervals = list(_intervals(program, guessed))
    samples = [_sample(program, *intervals[0])] if program.sample is not None else []
    ends = list(_ends(program, guessed))
    mixed = _mixed(program, text, intervals, samples, ends) if text.defines("QUANTITIES") else []
    others = [*parameters(program), program.model.time, STEP, *(program.sample.symbols if program.sample else ())]
    for share, near in (*intervals, *samples, *ends, *mixed):
        symbols = list(dict.fromkeys([*share.unknowns, *others]))
        drawn = random_points(symbols, program.model.default_values, _DRAWN, seed=5)
        ShareComparison(share, text, [with_time(near, program.model.time), drawn]).verify()
    for share, near in intervals:
        if text.defines(_shooting(share)):
            _verify_shooting(text, share, with_time(near, program.model.time))
    for share, near in samples:
        _verify_values(program, text, share, with_time(near, program.model.time))


def guessed_points(program: ControlProgram, text: Text) -> GuessedPoints:
    """Return a source of points near the initial guess of a control module."""
    return GuessedPoints(text.interpreted(*_READ), program.model.steps, len(program.inner.times) + 1)


def _intervals(program: ControlProgram, guessed: GuessedPoints) -> Iterator[tuple[Share, Values]]:
    """Yield share and points of each kind of interval, then of intervals of each kind that begin at no inner time."""
    others, time = parameters(program), program.model.time
    local = program.element_symbols[: len(program.element_symbols) - len(program.linking.unknowns)]

    def calling(begins_at: int) -> Operand:
        """Return a function that calls a kernel of an interval that begins at inner time `begins_at`, or none (-1)."""
        times = program.inner.parameters[: len(program.inner.times)]

        def call(kernel: Function, values: Mapping[Symbol, Operand], filled: list[Operand]) -> Operand:
            moved = {s: values[time] + 2 * abs(i - begins_at) * values[STEP] for i, s in enumerate(times)}
            vector = [moved[s] if s in moved else values[s] for s in others]
            return kernel([values[s] for s in local], values[time], values[STEP], vector, filled)

        return call

    kinds = list(zip(named_elements(program), program.interval_elements, [0] * len(program.interval_elements)))
    if program.inner.times:
        kinds += [((stem, f"{where} that begins at no inner time"), share, -1) for (stem, where), share, _ in kinds]
    for (stem, where), element, begins_at in kinds:
        # Values, at the left node, of the parameters of conditions at inner times.
        count, numbers = len(program.inner.times), [S.Zero] * len(program.inner.symbols)
        if begins_at >= 0:
            numbers = list(program.inner.parameters[count + begins_at :: count]) if count else []
        share = Share(
            name="an interval" + where,
            scalar=element.element.xreplace(dict(zip(program.inner.symbols, numbers, strict=True))),
            output=element.cost,
            unknowns=program.element_symbols,
            indices=tuple(range(len(program.element_symbols))),
            pattern=pattern_of(guessed.module, "HESSIAN"),
            gradient=f"{stem}_gradient",
            hessian=f"{stem}_hessian",
            call_gradient=calling(begins_at),
            call_hessian=calling(begins_at),
        )
        yield share, guessed.on_intervals(local, others, part_of_chain(program, stem))


def _mixed(
    program: ControlProgram,
    text: Text,
    intervals: Sequence[tuple[Share, Values]],
    samples: Sequence[tuple[Share, Values]],
    ends: Sequence[tuple[Share, Values]],
) -> list[tuple[Share, Values]]:
    """Return shares that verify derivatives with respect to data, and mixed derivatives, with points for each share."""
    mixed, count = [], len(program.interval_elements)
    module = text.interpreted(*(f"{s}MIXED_{side}" for s in ("", "START_", "END_") for side in ("ROWS", "COLUMNS")))
    for number, (share, near) in enumerate((*intervals, *samples)):
        columns = columns_of(program, -1 if count <= number < len(intervals) else 0)
        kernel = share.gradient.removesuffix("gradient") + "mixed"
        mixed += [(one, near) for one in mixed_shares(share, kernel, pattern_of(module, "MIXED"), columns)]
    for (share, near), name in zip(ends, ("start", "end"), strict=True):
        columns, first = columns_of(program, -1), len(data_of(program))
        columns |= {first + i: s for i, s in enumerate(share.unknowns) if i not in share.indices}
        pattern = pattern_of(module, f"{name.upper()}_MIXED")
        mixed += [(one, near) for one in mixed_shares(share, f"{name}_mixed", pattern, columns)]
    return mixed


def _sample(program: ControlProgram, share: Share, near: Values) -> tuple[Share, Values]:
    """Return the share of a sample of measurements, and the points with random measured values."""
    assert program.sample is not None, "there are samples"
    others, time, sample = parameters(program), program.model.time, program.sample
    local = program.element_symbols[: len(program.element_symbols) - len(program.linking.unknowns)]

    def call(kernel: Function, values: Mapping[Symbol, Operand], filled: list[Operand]) -> Operand:
        # A sample is stored behind the parameters. Its first entry is its middle, which kernels do not read.
        row = [*(values[s] for s in others), None, *(values[s] for s in sample.symbols)]
        return kernel([values[s] for s in local], values[time], values[STEP], row, len(others), filled)

    measured = replace(
        share, name="a sample", scalar=sample.element, output=sample.element, gradient="sample_gradient",
        hessian="sample_hessian", call_gradient=call, call_hessian=call, returned="the losses of",
    )  # fmt: skip
    generator, count = np.random.default_rng(7), len(next(iter(near.values())))
    return measured, near | {symbol: generator.uniform(0.1, 0.9, count) for symbol in sample.symbols}


def _shooting(share: Share) -> str:
    """Return the name of the kernel that computes the stages of an interval and the gradient by all other unknowns."""
    return share.gradient.removesuffix("gradient") + "shooting"


def _verify_shooting(text: Text, share: Share, near: Values) -> None:
    """Compare the gradient without stages with the gradient of the interval at the stages that the kernel computes."""
    numbers, size = complex_numbers(np.complex128), len(share.unknowns)
    points = {symbol: values.astype(complex) for symbol, values in near.items()}
    kernels = text.kernels((_shooting(share), share.gradient), numbers)
    found: list[Operand] = [0.0] * size
    expected: list[Operand] = [0.0] * size

    def both(unknowns: list[Operand], *others: Operand) -> Operand:
        *given, filled = others
        cost = kernels[_shooting(share)](unknowns, *given, filled)
        return cost - kernels[share.gradient](unknowns, *given, expected)

    with np.errstate(all="ignore"):
        excess = share.call_gradient(both, points, found)
    size_of_terms = np.maximum(1.0, np.max([np.abs(value) + 0.0 * near[STEP] for value in expected], axis=0))
    names = [*(f"dl/d{symbol}" for symbol in share.unknowns), "Cd"]
    excesses = [*(a - b for a, b in zip(found, expected, strict=True)), excess]
    for name, each in zip(names, excesses, strict=True):
        if np.any(np.abs(each) / size_of_terms > _ROUNDING):
            raise defect(f"{name} of {share.name} without stages differs from its value at the stages")


def _verify_values(program: ControlProgram, text: Text, share: Share, near: Values) -> None:
    """Compare the observed values at a sample with their expressions; no derivative verifies these values."""
    assert program.sample is not None, "there are samples"
    tape, numbers = Tape(program.sample.observed), complex_numbers(np.complex128)
    points = {symbol: values.astype(complex) for symbol, values in near.items()}
    emitted: list[Operand] = [0.0] * len(program.sample.observed)
    with np.errstate(all="ignore"):
        exact = tape.evaluate(points, numbers)
        share.call_gradient(text.kernels(("sample_values",), numbers)["sample_values"], points, emitted)
    for observed, value, right in zip(program.model.observed, emitted, exact, strict=True):
        finite = np.isfinite(right)
        if not np.allclose(np.where(finite, value, 0.0), np.where(finite, right, 0.0), rtol=_ROUNDING, atol=_ROUNDING):
            raise defect(f"the emitted code gives another value than the expression that {observed.name} measures")


def part_of_chain(program: ControlProgram, stem: str) -> tuple[float, float]:
    """Return where intervals of a kind begin and end, as fractions of all intervals; `stem` is the kernels' prefix."""
    if not program.phases:
        return 0.0, 1.0
    kind, number = stem.split("_")
    begin = int(number) - (kind == "phase")
    return begin / len(program.phases), (begin + (kind == "phase")) / len(program.phases)


def _ends(program: ControlProgram, guessed: GuessedPoints) -> Iterator[tuple[Share, Values]]:
    """Yield the shares of both ends, each with points near the guess."""
    others, time = parameters(program), program.model.time
    for name, end, node in (
        ("start", program.start, program.left_symbols),
        ("end", program.end, program.right_symbols),
    ):

        def call(
            kernel: Function, values: Mapping[Symbol, Operand], filled: list[Operand], node: Sequence[Symbol] = node
        ) -> Operand:
            return kernel([values[s] for s in node], values[time], [values[s] for s in others], filled)

        unknowns, pinned = (*node, *program.linking.symbols), {index for index, _ in end.pins}
        share = Share(
            name=f"the {name}",
            scalar=end.element,
            output=end.cost,
            unknowns=unknowns,
            indices=tuple(index for index in range(len(unknowns)) if index not in pinned),
            pattern=pattern_of(guessed.module, f"{name.upper()}_HESSIAN"),
            gradient=f"{name}_gradient",
            hessian=f"{name}_hessian",
            call_gradient=call,
            call_hessian=call,
        )
        yield share, guessed.at_node(name == "end", node, others)


def verify_step(program: StepProgram, text: Text) -> None:
    """Compare every kernel of a simulation with its expressions; raise VerificationError for a wrong value."""
    interval = [*program.stage_symbols, *program.right_symbols]
    kernels = _StepKernels(program, text)
    written, values = zip(*program.equations, strict=True)
    kernels.compare("step_equations", interval, (), list(values), [f"the equation {name}" for name in written])
    if program.energy is not None:
        kernels.compare("energy", [], program.state_assignments, [program.energy], ["the energy"])
    rows = [(c.name, value) for c in program.constraints for value in c.row]
    held = [f"the constraint {name}, its rate or gradient" for name, _ in rows]
    kernels.compare("node_constraints", [], program.state_assignments, [value for _, value in rows], held)
    assignments = (*program.state_assignments, *program.event_assignments)
    for name, entries in rows_of_events(program).items():
        kernels.compare(name, [], assignments, [value for _, value in entries], [f"the {what}" for what, _ in entries])
    named = [f"the {symbol} of a step" for symbol in interval]
    if not program.unknowns:
        kernels.compare("explicit_step", [], program.before, list(interval), named)
        return
    unknowns, assigned = list(program.unknowns), (*program.before, *program.after)
    kernels.compare("complete_step", unknowns, assigned, list(interval), named)
    residual = [f"equation {i + 1} that a step solves" for i in range(len(unknowns))]
    kernels.compare("step_residual", unknowns, program.before, list(program.residual), residual)
    kernels.compare_slopes(unknowns, program.before, list(program.residual), residual)


class _StepKernels:
    """A comparison of the kernels of a time step with expressions, at points where the expressions have values."""

    def __init__(self, program: StepProgram, text: Text) -> None:
        self.program, self.text = program, text

    def compare(
        self,
        name: str,
        inside: Sequence[Symbol],
        assignments: Sequence[Assignment],
        values: Sequence[Expr],
        names: Sequence[str],
    ) -> None:
        """Compare the array that kernel `name` fills and the expressions `values`, which errors call `names`.

        The kernel reads `inside`, symbols inside a step; the expressions may read `assignments`.
        """
        if not values:
            return
        read = Tape(values, assignments)
        points, count = self._points(inside, read)

        def filled(at: Mapping[Symbol, Operand], numbers: Arithmetic) -> list[Operand]:
            kernel = self.text.kernels((name,), numbers)[name]
            state, time, lengths, parameters = self._arguments(at)
            within, results = [at[symbol] for symbol in inside], [0] * len(values)
            if name == "energy":
                return [kernel(state, time, parameters)]
            if name == "node_constraints" or name in EVENT_KERNELS:
                kernel(state, time, parameters, results)
            elif name == "step_equations":
                kernel(state, within, time, lengths, parameters, results)
            elif name == "explicit_step":
                kernel(state, time, lengths, parameters, results)
            else:
                kernel(within, state, time, lengths, parameters, results)
            return results

        def evaluate(kind: Complex) -> tuple[Operand, Operand]:
            at = {symbol: array.astype(kind) for symbol, array in points.items()}
            numbers = complex_numbers(kind)
            return _columns(filled(at, numbers), count), _columns(read.evaluate(at, numbers), count)

        def opinion(entry: int, point: int) -> tuple[Sized, Operand, Operand]:
            at = {symbol: float(array[point]) for symbol, array in points.items()}
            exact, error = difference(lambda numbers: read.evaluate(numbers, EXACT)[entry], at, [])
            value = filled({symbol: Sized(number) for symbol, number in at.items()}, SIZED)[entry]
            return sized(value), exact, error

        if count:
            judge(names, evaluate, opinion)

    def compare_slopes(
        self, unknowns: Sequence[Symbol], before: Sequence[Assignment], residual: Sequence[Expr], names: Sequence[str]
    ) -> None:
        """Compare both arrays that the kernel of the Jacobian fills: the residual, and its Jacobian."""
        read, size = Tape(residual, before), len(unknowns)
        points, count = self._points(unknowns, read)

        def filled(at: Mapping[Symbol, Operand], numbers: Arithmetic) -> list[Operand]:
            kernel = self.text.kernels(("step_jacobian",), numbers)["step_jacobian"]
            heights: list[Operand] = [0] * size
            matrix: list[Operand] = [_ABSENT] * size**2
            kernel([at[y] for y in unknowns], *self._arguments(at), heights, matrix)
            return [*heights, *matrix]

        def evaluate(kind: Complex) -> tuple[Operand, Operand]:
            step, numbers = step_of(kind), complex_numbers(kind)
            at = {symbol: array.astype(kind)[:, None] for symbol, array in points.items()}
            moved = dict(at)
            for index, y in enumerate(unknowns):
                moved[y] = np.tile(at[y], (1, size))
                moved[y][:, index] += 1j * step
            exact = [np.broadcast_to(np.asarray(value, kind), (count, size)) for value in read.evaluate(moved, numbers)]
            heights = np.stack([value[:, 0].real for value in exact], axis=1)
            slopes = np.concatenate([value.imag / step for value in exact], axis=1)
            emitted = [v if v is _ABSENT else np.asarray(v).reshape(-1) for v in filled(at, numbers)]
            return _columns(emitted, count), np.concatenate([heights, slopes], axis=1)

        def opinion(entry: int, point: int) -> tuple[Sized, Operand, Operand]:
            at = {symbol: float(array[point]) for symbol, array in points.items()}
            row, by = (entry, []) if entry < size else ((entry - size) // size, [unknowns[(entry - size) % size]])
            exact, error = difference(lambda numbers: read.evaluate(numbers, EXACT)[row], at, by)
            value = filled({symbol: Sized(number) for symbol, number in at.items()}, SIZED)[entry]
            return sized(value), exact, error

        if count:
            slopes = [f"the derivative of {name} by {y}" for name in names for y in unknowns]
            judge([*names, *slopes], evaluate, opinion)

    def _arguments(self, at: Mapping[Symbol, Operand]) -> tuple[list[Operand], Operand, list[Operand], list[Operand]]:
        program = self.program
        return (
            [at[symbol] for symbol in program.left_symbols],
            at[program.model.time],
            [at[h] for h in program.lengths],
            [at[symbol] for symbol in program.model.parameters],
        )

    def _points(self, inside: Sequence[Symbol], read: Tape) -> tuple[Values, int]:
        """Return points where expressions `read` have values, near the initial state and random, and their count."""
        program, generator = self.program, np.random.default_rng(6)
        defaults = program.model.default_values
        arguments = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
        symbols = list(dict.fromkeys([*arguments, *inside]))
        drawn = random_points(symbols, defaults, _DRAWN, seed=5)
        values = dict(defaults)
        values |= {v.symbol: rounded_at(v.value, values) or 0.0 for v in program.start_values}
        state = dict(zip(program.left_symbols, (rounded_at(e, values) or 0.0 for e in program.start), strict=True))
        state |= dict(zip(program.right_symbols, list(state.values()), strict=True))
        length = (rounded_at(program.model.duration, values) or 1.0) / program.model.steps
        near = {symbol: np.full(_DRAWN, number) for symbol, number in values.items()}
        for symbol, number in state.items():
            near[symbol] = number + 0.1 * (abs(number) or 1.0) * generator.uniform(-1.0, 1.0, _DRAWN)
        near |= {h: np.full(_DRAWN, length) for h in program.lengths} | {program.model.time: np.zeros(_DRAWN)}
        near = {symbol: array for symbol, array in near.items() if symbol in symbols}
        return finite_points(read.evaluate, [drawn | near, drawn])


def _columns(values: Sequence[Operand], count: int) -> Operand:
    columns = np.zeros((count, len(values)), np.longdouble)
    for i, value in enumerate(values):
        if value is not _ABSENT:
            columns[:, i] = np.asarray(value).real
    return columns


_ABSENT = 0
"""An entry that no kernel fills."""
_PARTICLES = 3
_SCALES = (0.6, 0.05)
"""Magnitudes of positions and momenta at which loops are compared."""
_DIFFERENCE = 1e-7
_FIRST, _SECOND = 1e-9, 1e-7
"""Tolerances relative to the largest entry of an array: for values and gradients, and for second derivatives."""
_DIRECTIONS = 2
_LOOPS = ("hamiltonian", "hamiltonian_gradient", "slope", "velocity", "hamiltonian_hessian", "hessian_products")
_MATRIX = "momentum_matrix"
Array = Operand


def verify_particles(program: PairwiseProgram, text: Text) -> None:
    """Compare every loop over particles with the author's terms; raise VerificationError for a wrong value."""
    model, generator = program.model, np.random.default_rng(5)
    exact, module = _Hamiltonian(model), text.interpreted(*_LOOPS, _MATRIX)
    for scale in _SCALES:
        size = (2, _PARTICLES, len(model.coordinates))
        state = scale * generator.uniform(-1.0, 1.0, size) / np.sqrt(size[-1])
        own = generator.uniform(0.5, 1.5, (_PARTICLES, len(model.own)))
        parameters = np.array(model.defaults) * generator.uniform(0.9, 1.1, len(model.defaults))
        with np.errstate(all="ignore"):
            for quantity, value, reference, tolerance in _compared(module, exact, (state, own, parameters)):
                emitted, right = np.asarray(value), np.asarray(reference, float)
                if not np.all(np.isfinite(right)):  # the terms have no value there
                    continue
                odd = ~(abs(emitted - right) <= tolerance * abs(right).max(initial=0.0))
                if odd.any():
                    index = tuple(int(i) for i in np.argwhere(odd)[0])
                    raise defect(
                        f"the emitted code gives {float(emitted[index]):.8g} for {quantity}{list(index) or ''}, where "
                        f"{float(right[index]):.8g} is right"
                    )


def _compared(
    module: dict[str, Operand], exact: _Hamiltonian, arguments: tuple[Array, Array, Array]
) -> Iterator[tuple[str, Array, Array, float]]:
    """Yield, for each loop, the name of the quantity, its emitted value, its exact value and the relative tolerance."""
    energy, gradient, hessian = exact.at(*arguments)
    state = arguments[0]

    def filled(name: str, shape: Sequence[int], *inputs: Array) -> Array:
        array = np.zeros(shape)
        module[name](*arguments, *inputs, array)
        return array

    yield "the energy H", module["hamiltonian"](*arguments), energy, _FIRST
    for name, right in (("hamiltonian_gradient", gradient), ("slope", gradient[0]), ("velocity", gradient[1])):
        if name in module:
            yield f"{name} of H", filled(name, right.shape), right, _FIRST
    if "hamiltonian_hessian" in module:
        yield "hamiltonian_hessian", filled("hamiltonian_hessian", hessian.shape), hessian, _SECOND
    if "hessian_products" in module:
        directions = np.random.default_rng(6).normal(size=(state.size, _DIRECTIONS))
        products = filled("hessian_products", directions.shape, directions)
        yield "hessian_products", products, hessian.astype(float) @ directions, _SECOND
    if _MATRIX in module:
        size, half = state.shape[2], state.size // 2
        yield _MATRIX, filled(_MATRIX, (_PARTICLES, _PARTICLES)), hessian[half::size, half::size], _SECOND


class _Hamiltonian:
    """The Hamiltonian H of a few particles and its derivatives, computed from the author's terms."""

    def __init__(self, model: PairwiseModel) -> None:
        self.model = model
        self.alone, self.both = Tape([model.self_term]), Tape([model.pair_term])
        self.numbers, self.step = complex_numbers(np.clongdouble), step_of(np.clongdouble)

    def at(self, state: Array, own: Array, parameters: Array) -> tuple[Array, Array, Array]:
        """Return H, its gradient (2, n, d), and its Hessian (2 n d, 2 n d) with respect to the flattened state."""
        size = state.size
        flat = state.reshape(-1).astype(np.clongdouble)
        # Rows are the state itself, then states displaced by +-length in each entry; columns are complex steps.
        length = np.longdouble(_DIFFERENCE) * abs(flat).max()
        moves = length * np.concatenate([np.zeros((1, size)), np.eye(size), -np.eye(size)])
        points = (flat + moves)[:, None, :] + 1j * self.step * np.eye(size)
        states = points.reshape(*points.shape[:2], *state.shape)
        model = self.model
        common: dict[Symbol, Operand] = dict(zip(model.parameters, parameters.astype(np.clongdouble), strict=True))
        values = np.zeros(states.shape[:2], np.clongdouble)
        for i in range(_PARTICLES):
            first = common | self._symbols(model.first, states, own, i)
            values = values + self.alone.evaluate(first, self.numbers)[0]
            for j in range(i):
                both = first | self._symbols(model.second, states, own, j)
                values = values + self.both.evaluate(both, self.numbers)[0]
        slopes = values.imag / self.step
        hessian = (slopes[1 : size + 1] - slopes[size + 1 :]) / (2 * length)
        return values[0, 0].real, slopes[0].reshape(state.shape), hessian

    def _symbols(self, symbols: Operand, states: Array, own: Array, particle: int) -> dict[Symbol, Operand]:
        """Return the values of the symbols of one particle."""
        moving = [states[:, :, part, particle, k] for part in range(2) for k in range(states.shape[-1])]
        values = dict(zip(symbols.moving, moving, strict=True))
        return values | dict(zip(symbols.own, own[particle].astype(np.clongdouble), strict=True))
