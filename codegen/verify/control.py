"""The kernels of a control problem: intervals of all kinds, both ends, and the controls' block."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from sympy import Expr, S, Symbol

from codegen.derive.mixed import data_of
from codegen.discretise import STEP
from codegen.errors import VerificationError
from codegen.lower.control.layout import parameters
from codegen.lower.control.phases import named_elements
from codegen.transcribe.program import ControlProgram
from codegen.verify.execution import Tape, Text
from codegen.verify.judgement import complex_numbers
from codegen.verify.points import GuessedPoints, Values, random_points, with_time
from codegen.verify.shares import Share, ShareComparison, columns_of, mixed_shares, pattern_of

_DRAWN = 30
_ROUNDING = 1e-8
_READ = (
    *("make_grid", "initial_guess", "read_shared", "STRIDE", "BODIES", "SHARED"),
    *(f"{share}HESSIAN_{side}" for share in ("", "START_", "END_") for side in ("ROWS", "COLUMNS")),
)
"""What is executed of a module as it stands."""


def verify_control(program: ControlProgram, text: Text) -> None:
    """Compare every kernel with its share of the Lagrangian; VerificationError names an entry that is wrong."""
    guessed = guessed_points(program, text)
    module = guessed.module
    intervals = list(_intervals(program, module, guessed))
    block = [_control_block(program, *intervals[0])] if text.defines("control_hessian") else []
    samples = list(_samples(program, intervals))
    ends = list(_ends(program, module, guessed))
    mixed = _mixed(program, text, intervals, samples, ends) if text.defines("QUANTITIES") else []
    for share, near in (*intervals, *block, *samples, *ends, *mixed):
        others = [*parameters(program), program.model.time, STEP, *(program.sample.symbols if program.sample else ())]
        symbols = list(dict.fromkeys([*share.unknowns, *others]))
        drawn = random_points(symbols, program.model.default_values, _DRAWN, seed=5)
        ShareComparison(share, text, [with_time(near, program.model.time), drawn]).verify()
    for share, near in samples:
        _verify_values(program, text, share, with_time(near, program.model.time))


def guessed_points(program: ControlProgram, text: Text) -> GuessedPoints:
    """Points near the guess that the text of a module makes."""
    return GuessedPoints(text.interpreted(*_READ), program.model.steps, len(program.inner.times) + 1)


def _intervals(
    program: ControlProgram, module: Mapping[str, Any], guessed: GuessedPoints
) -> Iterator[tuple[Share, Values]]:
    others, time = parameters(program), program.model.time
    local = program.element_symbols[: len(program.element_symbols) - len(program.shared)]

    def calling(begins_at: int) -> Any:
        """Call a kernel of an interval that begins at the inner time of this number, or at none."""
        times = inner_time_symbols(program)

        def call(kernel: Any, values: Mapping[Symbol, Any], filled: list[Any]) -> Any:
            moved = {s: values[time] + 2 * abs(i - begins_at) * values[STEP] for i, s in enumerate(times)}
            given = [moved[s] if s in moved else values[s] for s in others]
            return kernel([values[s] for s in local], values[time], values[STEP], given, filled)

        return call

    pattern = _pattern(module, "")
    kinds = list(zip(named_elements(program), program.interval_elements, [0] * len(program.interval_elements)))
    if program.inner.times:
        kinds += [((stem, f"{where} that begins at no inner time"), share, -1) for (stem, where), share, _ in kinds]
    for (stem, where), element, begins_at in kinds:
        call = calling(begins_at)
        share = Share(
            name="an interval" + where,
            scalar=element.element.xreplace(inner_numbers(program, begins_at)),
            beside=element.cost,
            unknowns=program.element_symbols,
            indices=tuple(range(len(program.element_symbols))),
            pattern=pattern,
            gradient=f"{stem}_gradient",
            hessian=f"{stem}_hessian",
            call_gradient=call,
            call_hessian=call,
        )
        yield share, guessed.on_intervals(local, others, part_of_chain(program, stem))


def _mixed(
    program: ControlProgram,
    text: Text,
    intervals: Sequence[tuple[Share, Values]],
    samples: Sequence[tuple[Share, Values]],
    ends: Sequence[tuple[Share, Values]],
) -> list[tuple[Share, Values]]:
    """The shares with derivatives by data in place of those by unknowns, where the text has sensitivities."""
    found, count = [], len(program.interval_elements)
    for number, (share, near) in enumerate((*intervals, *samples)):
        columns = columns_of(program, -1 if count <= number < len(intervals) else 0)
        kernel = share.gradient.removesuffix("gradient") + "mixed"
        found += [(one, near) for one in mixed_shares(share, kernel, pattern_of(text), columns)]
    for (share, near), name in zip(ends, ("start", "end"), strict=True):
        columns = columns_of(program, -1)
        first = len(data_of(program))
        columns |= {first + i: s for i, s in enumerate(share.unknowns) if i not in share.indices}
        pattern = pattern_of(text, f"{name.upper()}_")
        found += [(one, near) for one in mixed_shares(share, f"{name}_mixed", pattern, columns)]
    return found


def inner_time_symbols(program: ControlProgram) -> tuple[Symbol, ...]:
    """The parameters that are inner times."""
    return program.inner.parameters[: len(program.inner.times)]


def inner_numbers(program: ControlProgram, number: int) -> dict[Symbol, Expr]:
    """What an interval that begins at the inner time of this number, or at none (-1), reads of its left node."""
    count, inner = len(program.inner.times), program.inner
    of_times = inner.parameters[count:]
    return {s: of_times[i * count + number] if number >= 0 else S.Zero for i, s in enumerate(inner.symbols)}


def _samples(program: ControlProgram, intervals: Sequence[tuple[Share, Values]]) -> Iterator[tuple[Share, Values]]:
    """What a sample adds to the share of an interval, with values that may have been measured."""
    if program.sample is None:
        return
    (share, near), sample = intervals[0], program.sample
    others, time, own = parameters(program), program.model.time, sample.symbols
    local = program.element_symbols[: len(program.element_symbols) - len(program.shared)]

    def call(kernel: Any, values: Mapping[Symbol, Any], filled: list[Any]) -> Any:
        # A sample stands behind the parameters, and its middle, which kernels do not read, before all else.
        row = [*(values[s] for s in others), None, *(values[s] for s in own)]
        return kernel([values[s] for s in local], values[time], values[STEP], row, len(others), filled)

    measured = replace(
        share, name="a sample", scalar=sample.element, beside=sample.element, gradient="sample_gradient",
        hessian="sample_hessian", call_gradient=call, call_hessian=call, returned="the losses of",
    )  # fmt: skip
    generator, count = np.random.default_rng(7), len(next(iter(near.values())))
    yield measured, near | {symbol: generator.uniform(0.1, 0.9, count) for symbol in own}


def _verify_values(program: ControlProgram, text: Text, share: Share, near: Values) -> None:
    """Compare what the motion has at a sample, on which no derivative depends, with the expressions themselves."""
    assert program.sample is not None, "there are samples"
    tape, numbers = Tape(program.sample.observed), complex_numbers(np.complex128)
    given = {symbol: values.astype(complex) for symbol, values in near.items()}
    emitted: list[Any] = [0.0] * len(program.sample.observed)
    with np.errstate(all="ignore"):
        exact = tape.evaluate(given, numbers)
        share.call_gradient(text.kernels(("sample_values",), numbers)["sample_values"], given, emitted)
    for observed, found, right in zip(program.model.observed, emitted, exact, strict=True):
        finite = np.isfinite(right)
        if not np.allclose(np.where(finite, found, 0.0), np.where(finite, right, 0.0), rtol=_ROUNDING, atol=_ROUNDING):
            raise VerificationError(
                f"the emitted code gives another value than the expression that {observed.name} measures",
                "this is a defect of codegen, and nothing was written; please report it with the problem file",
            )


def _control_block(program: ControlProgram, share: Share, near: Values) -> tuple[Share, Values]:
    """The same with the kernel of the controls' block, whose lower triangle is filled by row and column."""
    others, size = parameters(program), len(program.control_symbols)
    first = len(program.left_symbols) + len(program.interval_symbols)
    pairs = [(row, column) for row in range(size) for column in range(row + 1)]

    def call(kernel: Any, values: Mapping[Symbol, Any], filled: list[Any]) -> None:
        block: dict[tuple[int, int], Any] = {}
        kernel(values[STEP], [values[s] for s in others], block)
        for index, pair in enumerate(pairs):
            filled[index] = block.get(pair, filled[index])

    block = replace(
        share,
        indices=tuple(range(first, first + size)),
        pattern=tuple((first + row, first + column) for row, column in pairs),
        hessian="control_hessian",
        call_hessian=call,
    )
    return block, near


def part_of_chain(program: ControlProgram, stem: str) -> tuple[float, float]:
    """Where intervals of a kind lie, in parts of the whole chain."""
    if not program.phases:
        return 0.0, 1.0
    kind, number = stem.split("_")
    begin = int(number) - (kind == "phase")
    return begin / len(program.phases), (begin + (kind == "phase")) / len(program.phases)


def _ends(program: ControlProgram, module: Mapping[str, Any], guessed: GuessedPoints) -> Iterator[tuple[Share, Values]]:
    others, time = parameters(program), program.model.time
    for name, end, node in (
        ("start", program.start, program.left_symbols),
        ("end", program.end, program.right_symbols),
    ):

        def call(kernel: Any, values: Mapping[Symbol, Any], filled: list[Any], node: Sequence[Symbol] = node) -> Any:
            return kernel([values[s] for s in node], values[time], [values[s] for s in others], filled)

        unknowns, pinned = (*node, *program.shared_symbols), {index for index, _ in end.pins}
        share = Share(
            name=f"the {name}",
            scalar=end.element,
            beside=end.cost,
            unknowns=unknowns,
            indices=tuple(index for index in range(len(unknowns)) if index not in pinned),
            pattern=_pattern(module, f"{name.upper()}_"),
            gradient=f"{name}_gradient",
            hessian=f"{name}_hessian",
            call_gradient=call,
            call_hessian=call,
        )
        yield share, guessed.at_node(name == "end", node, others)


def _pattern(module: Mapping[str, Any], prefix: str) -> tuple[tuple[int, int], ...]:
    rows, columns = (module.get(f"{prefix}HESSIAN_{side}", ()) for side in ("ROWS", "COLUMNS"))
    return tuple((int(r), int(c)) for r, c in zip(rows, columns, strict=True))
