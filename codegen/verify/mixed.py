"""The kernels of sensitivities: derivatives by data against complex steps, mixed ones against those of the gradient."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from sympy import S, Symbol

from codegen.derive.mixed import data_of
from codegen.transcribe.program import ControlProgram
from codegen.verify.execution import Text
from codegen.verify.shares import Share

Columns = dict[int, Symbol]
"""Data by the index of the column in which kernels write derivatives by them."""


def columns_of(program: ControlProgram, begins_at: int = 0) -> Columns:
    """Data of intervals that begin at the inner time of this number, or at none (-1)."""
    inner, data = program.inner, data_of(program)
    first, count = len(data) - len(inner.symbols), len(inner.times)
    columns = {i: datum for i, datum in enumerate(data[:first]) if datum not in inner.parameters}
    if begins_at >= 0:  # numbers of the node stand among the parameters
        numbers = inner.parameters[count + begins_at :: count] if count else ()
        columns |= {first + i: number for i, number in enumerate(numbers)}
    return columns


def mixed_shares(share: Share, kernel: str, pattern: Iterable[tuple[int, int]], columns: Columns) -> list[Share]:
    """Two shares in place of one: its slopes by data, and the mixed derivatives of its gradient by unknowns and data.

    `kernel` fills both, the latter by a `pattern` of unknowns and columns. What is not among the share's indices is
    pinned, and counts as data.
    """
    data = [datum for datum in columns.values() if datum not in share.unknowns]
    unknowns = (*share.unknowns, *data)
    indices = {column: unknowns.index(datum) for column, datum in columns.items()}
    pairs = tuple(pattern)
    width = 1 + max((*columns, *(column for _, column in pairs)))

    def call_slopes(called: Callable[..., Any], values: Mapping[Symbol, Any], filled: list[Any]) -> Any:
        slopes: list[Any] = [0] * width
        mixed: list[Any] = [0] * len(pairs)
        share.call_gradient(lambda *given: called(*given[:-1], slopes, mixed), values, [])
        for column, index in indices.items():
            filled[index] = slopes[column] + filled[index]
        return 0

    def call_mixed(called: Callable[..., Any], values: Mapping[Symbol, Any], filled: list[Any]) -> None:
        slopes: list[Any] = [0] * width
        share.call_gradient(lambda *given: called(*given[:-1], slopes, given[-1]), values, filled)

    of_slopes = replace(
        share, beside=S.Zero, unknowns=unknowns, indices=tuple(indices.values()), pattern=(), pairs=(), gradient=kernel,
        hessian=kernel, call_gradient=call_slopes,
    )  # fmt: skip
    every = tuple((row, index) for row in share.indices for index in indices.values() if index not in share.indices)
    of_mixed = replace(
        share, unknowns=unknowns, pattern=tuple((row, indices[column]) for row, column in pairs if column in indices),
        pairs=every, hessian=kernel, call_hessian=_picked(call_mixed, [column in indices for _, column in pairs]),
    )  # fmt: skip
    return [of_slopes, of_mixed]


def _picked(call: Callable[..., Any], is_wanted: list[bool]) -> Callable[..., Any]:
    """A call that fills only what is wanted."""

    def called(kernel: Any, values: Mapping[Symbol, Any], filled: list[Any]) -> None:
        every: list[Any] = [0] * len(is_wanted)
        call(kernel, values, every)
        filled[:] = [value for value, wanted in zip(every, is_wanted, strict=True) if wanted]

    return called


def pattern_of(text: Text, prefix: str = "") -> tuple[tuple[int, int], ...]:
    """Unknowns and columns of the mixed derivatives of intervals, or of an end."""
    names = f"{prefix}MIXED_ROWS", f"{prefix}MIXED_COLUMNS"
    module = text.interpreted(*names)
    return tuple((int(row), int(column)) for row, column in zip(*(module[name] for name in names), strict=True))
