"""What every declared symbol is, which of them move, and their values of the past.

Each declaration is a symbol of its own, also where two share a name; `recorded_declarations` collects them.
"""

from __future__ import annotations

import itertools
import secrets
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, ClassVar

import sympy

from codegen.errors import SymbolError
from codegen.identifiers import MARK
from codegen.symbolic.checks import checked, tidied

_serial_numbers = itertools.count(secrets.randbits(60) << 32)
"""Beginning at another number in every process: what another one has pickled is none of its own symbols."""
_recorder: ContextVar[list[Quantity] | None] = ContextVar("declared quantities", default=None)


class Quantity(sympy.Symbol):  # type: ignore[misc]  # sympy is untyped
    """A declared real symbol; `declared` orders symbols as their author wrote them.

    One that is not `own` follows from another one, so that nobody has to use it. `unit` is there where one was given.
    """

    __slots__ = ("declared", "unit")
    declared: int
    unit: str
    own: ClassVar[bool] = True

    @property
    def rate_remedy(self) -> str:
        """The advice to an author who differentiates this symbol by time; empty for a constant symbol."""
        return ""

    def __new__(cls, name: str) -> Quantity:
        """Make a new symbol, different from all others; SymbolError when its name cannot be used."""
        if not isinstance(name, str) or not name.isidentifier() or MARK in name:
            raise SymbolError(f"{name!r} is not an identifier", "use letters, digits and underscores")
        # As Python reads identifiers, where several characters stand for one letter.
        symbol: Quantity = sympy.Symbol.__xnew__(cls, unicodedata.normalize("NFKC", name), real=True)
        symbol.declared = next(_serial_numbers)
        recorded = _recorder.get()
        if recorded is not None and cls.own:
            recorded.append(symbol)
        return symbol

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        """What makes the same symbol, with all that was declared of it, from a pickle or for a copy."""
        kinds = [kind for kind in type(self).__mro__ if issubclass(kind, Quantity)]
        slots = [name for kind in kinds for name in vars(kind).get("__slots__", ()) if hasattr(self, name)]
        return _restored, (type(self), self.name, self.declared), {name: getattr(self, name) for name in slots}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)

    def _hashable_content(self) -> tuple[Any, ...]:
        return (*super()._hashable_content(), self.declared)

    def delayed(self, tau: Any) -> Delayed:
        """Refuse the past of what has none; what moves has one."""
        raise SymbolError(f"{self}.delayed({tau})", f"{self} does not move: delay states, coordinates or controls")


def _restored(kind: type[Quantity], name: str, declared: int) -> Quantity:
    """A symbol as it was declared once; what else is known of it follows, since partners know each other."""
    symbol: Quantity = sympy.Symbol.__xnew__(kind, name, real=True)
    symbol.declared = declared
    return symbol


class Parameter(Quantity):
    """A number that stays an argument of the generated module; `value` is its default."""

    __slots__ = ("value",)
    value: float


class Moving(Quantity):
    """What changes with time, and has a past."""

    __slots__ = ("past",)
    past: dict[sympy.Expr, Delayed]

    def __new__(cls, name: str) -> Moving:
        """Make a new symbol, of which no value of the past has been asked for."""
        symbol = super().__new__(cls, name)
        assert isinstance(symbol, Moving), "it is of this class"
        symbol.past = {}
        return symbol

    def delayed(self, tau: Any) -> Delayed:
        """The value at the time t - tau; `tau` is a positive number, or an expression of parameters.

        The same symbol each time. What it is before t = 0 says `history={...}` of the problem. Raises SymbolError for a
        delay that is not positive, or not constant.
        """
        where = f"{self}.delayed({tau})"
        lag = tidied(checked(tau, f"the delay of {self}"))
        moving = sorted(map(str, (s for s in lag.free_symbols if not isinstance(s, Parameter))))
        if moving:
            raise SymbolError(f"{where} depends on {moving[0]}", "give a number, or an expression of parameters")
        if lag.is_positive is False or (lag.is_number and not lag > 0):
            raise SymbolError(f"{where} is no value of the past", "give a positive delay")
        if lag not in self.past:
            self.past[lag] = Delayed(self, lag)
        return self.past[lag]


class Delayed(Quantity):
    """The value of its `partner`, a coordinate, state, velocity, momentum or control, at the time t - `lag`."""

    __slots__ = ("lag", "partner")
    own = False
    partner: Moving
    lag: sympy.Expr

    @property
    def rate_remedy(self) -> str:
        """The advice for the symbol that is delayed, with the delay added."""
        return f"{self.partner.rate_remedy}, and delay that"

    def __new__(cls, partner: Moving, lag: sympy.Expr) -> Delayed:
        """Make a new symbol, which no author declares."""
        symbol: Delayed = sympy.Symbol.__xnew__(cls, f"{partner.name}.delayed({lag})", real=True)
        symbol.declared = next(_serial_numbers)
        symbol.partner, symbol.lag = partner, lag
        return symbol

    def delayed(self, tau: Any) -> Delayed:
        """The value still earlier."""
        return self.partner.delayed(self.lag + tau)


@contextmanager
def recorded_declarations() -> Iterator[list[Quantity]]:
    """Record every quantity that is declared inside the block, so that unused ones can be named."""
    declared: list[Quantity] = []
    token = _recorder.set(declared)
    try:
        yield declared
    finally:
        _recorder.reset(token)
