"""What has the same value at the end as at the start, up to a shift; `transcribe.conditions.periodic` imposes it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

from sympy import Expr, Symbol, sstr

from codegen.author.problem import SAME_AT_BOTH_ENDS, Control
from codegen.author.symbols import Parameter
from codegen.errors import BoundaryError, ExpressionError
from codegen.model.conditions.base import Kind, Latex, Scope
from codegen.model.definitions import Model
from codegen.model.relations import Entry, checked_mapping, checked_sequence, entry_of, require_declared


class Periodic(Kind):
    """Coordinates, rates or states, with their shifts."""

    argument, field, words = "periodic", "periodic", "periodic ends"
    scope: ClassVar[Scope] = {"periodic": (Parameter,)}
    not_in_phases = BoundaryError, "it is periodic", SAME_AT_BOTH_ENDS

    def written(self, control: Control) -> Iterator[Entry]:
        """What is periodic; a value that one end gives is given at the other end as well, and periodic no more."""
        for entry in self._shifts(control.periodic):
            symbol, shift = entry.key, entry.expression
            if symbol in control.start and symbol not in control.end:
                yield entry_of("end", f"end of {symbol}", control.start[symbol] + shift, symbol)
            elif symbol in control.end and symbol not in control.start:
                yield entry_of("start", f"start of {symbol}", control.end[symbol] - shift, symbol)
            else:
                yield entry

    def _shifts(self, periodic: Mapping[Symbol, Expr] | Sequence[Symbol]) -> Iterator[Entry]:
        if isinstance(periodic, Mapping):
            shifts = list(checked_mapping("periodic", periodic, "symbol: shift").items())
        else:
            shifts = [(symbol, 0) for symbol in checked_sequence("periodic", periodic, "symbol")]
        for index, (symbol, shift) in enumerate(shifts):
            require_declared("periodic", "lists", symbol)
            if symbol in [other for other, _ in shifts[:index]]:
                raise ExpressionError(f"periodic lists {symbol} twice", "list it once")
            yield entry_of("periodic", f"shift of {symbol}", shift, symbol)

    def require_fitting(self, entry: Entry, control: Control, form: str) -> None:
        if entry.key in control.start:
            raise BoundaryError(
                f"start and end fix {entry.key}, which is periodic", "leave it out of one end, or out of periodic"
            )

    def conditions(self, entries: Sequence[Entry]) -> tuple[tuple[Symbol, Expr], ...]:
        return tuple((entry.key, entry.expression) for entry in entries if entry.role == self.argument)

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ()

    def numbers(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ((f"shift of {symbol}", shift) for symbol, shift in model.periodic)

    def sentences(self, model: Model) -> list[str]:
        return [f"{q} at the end = {q} at the start{_added(shift)}" for q, shift in model.periodic]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if model.periodic:
            rows = tuple((f"{q}@T", Symbol(f"{q}@0", real=True) + shift) for q, shift in model.periodic)
            yield "Periodic ends", rows

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        given: Any = control.periodic
        for symbol, shift in given.items() if isinstance(given, Mapping) else [(symbol, 0) for symbol in given]:
            added = f" + {latex(shift)}" if shift else ""
            yield f"{latex.at(symbol, latex.last)} &= {latex.at(symbol, latex.first)}{added}"


def _added(shift: Expr) -> str:
    text = sstr(shift)
    return "" if shift == 0 else f" - {text[1:]}" if text.startswith("-") and not shift.is_Add else f" + {text}"
