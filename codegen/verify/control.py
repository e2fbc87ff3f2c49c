"""The kernels of a control problem: intervals of all kinds, both ends, and the controls' block."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sympy import Symbol

from codegen.discretise import STEP
from codegen.lower.control_layout import parameters
from codegen.lower.phases import named_elements
from codegen.transcribe.program import ControlProgram
from codegen.verify.execution import Text
from codegen.verify.points import GuessedPoints, Values, random_points, with_time
from codegen.verify.shares import Share, ShareComparison

_DRAWN = 30
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
    for share, near in (*intervals, *block, *_ends(program, module, guessed)):
        others = [*parameters(program), program.model.time, STEP]
        symbols = list(dict.fromkeys([*share.unknowns, *others]))
        drawn = random_points(symbols, program.model.default_values, _DRAWN, seed=5)
        ShareComparison(share, text, [with_time(near, program.model.time), drawn]).verify()


def guessed_points(program: ControlProgram, text: Text) -> GuessedPoints:
    """Points near the guess that the text of a module makes."""
    return GuessedPoints(text.interpreted(*_READ), program.model.steps)


def _intervals(
    program: ControlProgram, module: Mapping[str, Any], guessed: GuessedPoints
) -> Iterator[tuple[Share, Values]]:
    others, time = parameters(program), program.model.time
    local = program.element_symbols[: len(program.element_symbols) - len(program.shared)]

    def call(kernel: Any, values: Mapping[Symbol, Any], filled: list[Any]) -> Any:
        rows = [values[s] for s in local], values[time], values[STEP], [values[s] for s in others]
        return kernel(*rows, filled)

    pattern = _pattern(module, "")
    for (stem, where), element in zip(named_elements(program), program.interval_elements, strict=True):
        share = Share(
            name="an interval" + where,
            scalar=element.element,
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
    """Rows and columns of an emitted Hessian; none where there is no kernel."""
    rows, columns = (module.get(f"{prefix}HESSIAN_{side}", ()) for side in ("ROWS", "COLUMNS"))
    return tuple((int(r), int(c)) for r, c in zip(rows, columns, strict=True))
