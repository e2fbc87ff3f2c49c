"""The conditions between bodies: the kernels and tables of their terms, put together again, and what each says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from sympy import S, Symbol

from codegen.lower.control.layout import parameters
from codegen.transcribe.program import ControlProgram, Coupling
from codegen.verify.execution import Text
from codegen.verify.points import random_points
from codegen.verify.shares import Share, ShareComparison, columns_of

_DRAWN = 30
_TABLES = ("COUPLING_KINDS", "COUPLING_ROWS", "COUPLING_COUNTS", "COUPLING_INDICES")
_KERNEL, _MIXED = "coupling_term", "coupling_mixed"


def verify_couplings(program: ControlProgram, text: Text) -> None:
    """Compare every condition between bodies with the terms that the tables name; VerificationError names an entry."""
    if not program.couplings:
        return
    module = text.interpreted(*_TABLES)
    terms = list(zip(*(module[table].tolist() for table in _TABLES), strict=True))
    for number, coupling in enumerate(program.couplings):
        own = [(kind, indices[:count]) for kind, row, count, indices in terms if row == number]
        share = _share(program, coupling, own)
        symbols = list(dict.fromkeys([*share.unknowns, *parameters(program)]))
        points = random_points(symbols, program.model.default_values, _DRAWN, seed=5)
        for compared in (share, *(_by_data(program, share, own) if text.defines(_MIXED) else ())):
            ShareComparison(compared, text, [points]).verify()


def _by_data(program: ControlProgram, share: Share, terms: Sequence[tuple[int, Sequence[int]]]) -> tuple[Share, Share]:
    """The share with slopes by data in place of those by unknowns, and with mixed derivatives by both."""
    every, others, size = shared_symbols(program), parameters(program), len(share.unknowns)
    data = {column: s for column, s in columns_of(program, -1).items() if s in others}
    places = dict(zip(data, range(size, size + len(data)), strict=True))
    pattern = tuple((row, place) for row in range(size) for place in places.values())
    entry = {pair: i for i, pair in enumerate(pattern)}

    def call(kernel: Any, values: Mapping[Symbol, Any], slopes: list[Any], mixed: list[Any]) -> int:
        for kind, indices in terms:
            by_data, by_both = dict[int, Any](), dict[tuple[int, int], Any]()
            inputs, beside = [values[every[index]] for index in indices], [values[s] for s in others]
            kernel(kind, inputs, beside, by_data, by_both)
            for column, value in by_data.items():
                slopes[places[column]] = value + slopes[places[column]]
            for (a, column), value in by_both.items():
                i = entry[share.unknowns.index(every[indices[a]]), places[column]]
                mixed[i] = value + mixed[i]
        return 0

    common = replace(share, unknowns=(*share.unknowns, *data.values()), hessian=_MIXED)
    return (
        replace(
            common, beside=S.Zero, indices=tuple(places.values()), pattern=(), pairs=(), gradient=_MIXED,
            call_gradient=lambda kernel, values, filled: call(kernel, values, filled, [0] * len(pattern)),
        ),
        replace(
            common, pattern=pattern, pairs=pattern,
            call_hessian=lambda kernel, values, filled: call(kernel, values, [0] * (size + len(data)), filled),
        ),
    )  # fmt: skip


def _share(program: ControlProgram, coupling: Coupling, terms: Sequence[tuple[int, Sequence[int]]]) -> Share:
    """A condition as a scalar of the shared unknowns that it reads, or that its terms read."""
    every, others = shared_symbols(program), parameters(program)
    named = {index for _, indices in terms for index in indices}
    read = [index for index, symbol in enumerate(every) if index in named or coupling.expression.has(symbol)]
    local, size = {index: i for i, index in enumerate(read)}, len(read)
    pattern = tuple((row, column) for row in range(size) for column in range(row + 1))
    entry = {pair: i for i, pair in enumerate(pattern)}

    def call_gradient(kernel: Any, values: Mapping[Symbol, Any], filled: list[Any]) -> Any:
        total: Any = 0
        for kind, indices in terms:
            slopes = [0] * len(indices)
            inputs, beside = [values[every[index]] for index in indices], [values[s] for s in others]
            total = kernel(kind, inputs, beside, slopes, [0] * len(indices) ** 2) + total
            for index, slope in zip(indices, slopes, strict=True):
                filled[local[index]] = slope + filled[local[index]]
        return total

    def call_hessian(kernel: Any, values: Mapping[Symbol, Any], filled: list[Any]) -> None:
        for kind, indices in terms:
            curvatures = [0] * len(indices) ** 2
            inputs, beside = [values[every[index]] for index in indices], [values[s] for s in others]
            kernel(kind, inputs, beside, [0] * len(indices), curvatures)
            for a, row in enumerate(indices):
                for b, column in enumerate(indices):
                    if local[column] <= local[row]:
                        i = entry[local[row], local[column]]
                        filled[i] = curvatures[a * len(indices) + b] + filled[i]

    return Share(
        name=f"the condition {coupling.multiplier.meaning}",
        scalar=coupling.expression,
        beside=coupling.expression,
        unknowns=tuple(every[index] for index in read),
        indices=tuple(range(size)),
        pattern=pattern,
        gradient=_KERNEL,
        hessian=_KERNEL,
        call_gradient=call_gradient,
        call_hessian=call_hessian,
        returned="the value of",
    )


def shared_symbols(program: ControlProgram) -> list[Symbol]:
    """A symbol for every shared unknown: of each body in turn, then of the whole problem."""
    symbols = [Symbol(f"_shared_{index}", real=True) for index in range(program.bodies * program.own)]
    for symbol, body, j in program.coupling_symbols:
        symbols[body * program.own + j] = symbol
    return [*symbols, *program.shared_symbols[program.own :]]
