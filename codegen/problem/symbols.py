"""The symbols that an author declares: coordinates, velocities, momenta, states, controls, parameters, time.

Each is a sympy Symbol of a kind of its own, so that a symbol in an expression tells what it is, and a plain
`sympy.Symbol` is recognised as never declared. Two declarations are two symbols even when they share a name, which is
how a name that is used twice is found out.

What every declared symbol is, which of them move, and their values of the past.

Each declaration is a symbol of its own, also where two share a name; `recorded_declarations` collects them.
"""

from __future__ import annotations

import itertools
import secrets
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, ClassVar, TypeVar

import numpy as np
import sympy

from codegen.errors import ExpressionError, SymbolError, clause
from codegen.identifiers import MARK
from codegen.symbolic.checks import checked, tidied
from codegen.symbolic.terms import EachBodyBase

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


_Declared = TypeVar("_Declared", bound=Quantity)


class _Variable(Moving):
    """A coordinate or a state, which each of several bodies has; `of` tells them apart."""

    __slots__ = ("end_values",)
    end_values: dict[int, EndValue]

    def __new__(cls, name: str) -> _Variable:
        symbol = super().__new__(cls, name)
        assert isinstance(symbol, _Variable), "it is of this class"
        symbol.end_values = {}
        return symbol

    def of(self, body: int) -> EndValue:
        """The value for one body (0, 1, ...), to be used in `end_conditions`, and in `path` at every time.

        The same symbol each time, named `<name>_<body>`. Raises SymbolError when `body` is no such number.
        """
        if isinstance(body, bool) or not isinstance(body, (int, np.integer)) or body < 0:
            raise SymbolError(f"{self}.of({body})", "give the number of a body: 0, 1, ...")
        number = int(body)
        if number not in self.end_values:
            symbol = EndValue(f"{self.name}_{number}")
            symbol.partner, symbol.body = self, number
            self.end_values[number] = symbol
        return self.end_values[number]


class EndValue(Quantity):
    """The value of its `partner`, a coordinate or a state, for one body, at the end unless it stands in `path`."""

    __slots__ = ("body", "partner")
    partner: Coordinate | State
    body: int
    own = False

    @property
    def rate_remedy(self) -> str:
        """The advice for the same quantity of all bodies."""
        return self.partner.rate_remedy


class Coordinate(_Variable):
    """A generalised coordinate; `partner` is the velocity or the momentum that was declared with it."""

    __slots__ = ("partner",)
    partner: Velocity | Momentum

    @property
    def rate_remedy(self) -> str:
        """Its velocity, which is declared, or follows from the Hamiltonian."""
        if isinstance(self.partner, Velocity):
            return f"use its velocity {self.partner}"
        return f"use the derivative of the Hamiltonian by {self.partner}"


class State(_Variable):
    """A state x of a first-order system x' = f(x, u, t)."""

    __slots__ = ()

    @property
    def rate_remedy(self) -> str:
        """Its rate is an expression that the author has."""
        return f"write the expression that dynamics={{{self}: ...}} gives"


class Velocity(Moving):
    """The time derivative of its `partner`, a coordinate."""

    __slots__ = ("partner",)
    partner: Coordinate

    @property
    def rate_remedy(self) -> str:
        """Accelerations follow from the equations of motion, unless they are a control."""
        x = self.partner
        return f"make the acceleration the control a of states {x} and {self}: dynamics={{{x}: {self}, {self}: a}}"


class Momentum(Moving):
    """The momentum conjugate to its `partner`, a coordinate."""

    __slots__ = ("partner",)
    partner: Coordinate

    @property
    def rate_remedy(self) -> str:
        """Its rate follows from the Hamiltonian and the force."""
        return f"use the force less the derivative of the Hamiltonian by {self.partner}"


class ControlInput(Moving):
    """A control, free to be chosen by the optimiser at every time."""

    __slots__ = ()

    @property
    def rate_remedy(self) -> str:
        """The rate of a control is one, of which the old control is a state."""
        return f"declare the rate as the control and {self} as a state: dynamics={{{self}: d{self}, ...}}"


class FreeParameter(Quantity):
    """A number that is optimised along with the motion: its first guess and its bounds, None where there is none."""

    __slots__ = ("guess", "lower", "upper")
    guess: Any
    lower: Any
    upper: Any


class _Common(Quantity):
    """What there is once: declared again under the same name, it is the same."""

    __slots__ = ()

    def _hashable_content(self) -> tuple[Any, ...]:
        return tuple(sympy.Symbol._hashable_content(self))


class BodyNumber(_Common):
    """The number 0, 1, ... of a body among several identical ones."""

    __slots__ = ()


class Time(_Common):
    """The independent variable; in another unit it is another one."""

    __slots__ = ()

    @property
    def _diff_wrt(self) -> bool:
        """Refuse the time derivative of a moving quantity, which sympy evaluates to zero: its symbols are constants.

        sympy looks here before it evaluates a derivative, but does not tell of which expression. Functions of time are
        differentiated as ever.
        """
        caller = sys._getframe(1)
        if caller.f_code is sympy.Derivative.__new__.__code__:
            _require_at_rest(caller.f_locals["expr"], self)
        return True

    def _hashable_content(self) -> tuple[Any, ...]:
        return (*super()._hashable_content(), getattr(self, "unit", ""))


def _require_at_rest(expression: sympy.Basic, time: Time) -> None:
    """ExpressionError for an expression, to be differentiated by time, with a quantity that moves."""
    declared = [symbol for symbol in expression.free_symbols if isinstance(symbol, Quantity) and symbol.rate_remedy]
    if declared:
        first = min(declared, key=lambda symbol: symbol.declared)
        finding = f"the derivative of {clause(str(expression))} by {time}: sympy takes {first} for a constant"
        raise ExpressionError(finding, first.rate_remedy)


def coordinate(name: str, velocity: str | None = None, *, unit: str | None = None) -> tuple[Coordinate, Velocity]:
    """Declare one coordinate and its velocity, which is called `d<name>` unless told otherwise.

    A `unit` as pint reads it, such as "rad" or "kg*m/s**2", stands on axes, in tables and in data sets.
    """
    (q,), (v,) = coordinates(name, velocity, unit=unit)
    return q, v


def coordinates(
    names: str, velocities: str | None = None, *, unit: str | None = None
) -> tuple[tuple[Coordinate, ...], tuple[Velocity, ...]]:
    """Declare several coordinates and their velocities.

    For example `(r, phi), (dr, dphi) = coordinates("r phi")`; a velocity is called `d<name>` unless told otherwise.
    "x1:4" stands for x1, x2 and x3, as in sympy.symbols, here and wherever several are declared. The `unit` is that of
    all, or one for each as in "m rad"; velocities have it by that of the time. Raises SymbolError when a name is no
    identifier or when two lists differ in length.
    """
    qs = _split(names)
    vs = [f"d{name}" for name in qs] if velocities is None else _split(velocities)
    pairs = _pairs(qs, vs, Velocity)
    _with_units(pairs[0], unit)
    return pairs


def canonical_pair(
    coordinate: str, momentum: str, *, unit: str | None = None, momentum_unit: str | None = None
) -> tuple[Coordinate, Momentum]:
    """Declare one coordinate and its conjugate momentum, each with its unit if it has one.

    For example `q, p = canonical_pair("q", "p")`.
    """
    (q,), (p,) = canonical_pairs(coordinate, momentum, unit=unit, momentum_unit=momentum_unit)
    return q, p


def canonical_pairs(
    coordinates: str, momenta: str, *, unit: str | None = None, momentum_unit: str | None = None
) -> tuple[tuple[Coordinate, ...], tuple[Momentum, ...]]:
    """Declare several coordinates and their conjugate momenta.

    For example `(r, phi), (pr, pphi) = canonical_pairs("r phi", "pr pphi")`. A unit is that of all, or one for each.
    """
    pairs = _pairs(_split(coordinates), _split(momenta), Momentum)
    _with_units(pairs[0], unit)
    _with_units(pairs[1], momentum_unit)
    return pairs


def state(name: str, *, unit: str | None = None) -> State:
    """Declare one state of a first-order system, with its unit if it has one."""
    return _with_units((State(name),), unit)[0]


def states(names: str, *, unit: str | None = None) -> tuple[State, ...]:
    """Declare the states of a first-order system, which `dynamics={x: ..., v: ...}` gives the derivatives of.

    For example `x, v = states("x v")`, or with units `x, v = states("x v", unit="m m/s")`.
    """
    return _with_units(tuple(State(name) for name in _split(names)), unit)


def control(name: str, *, unit: str | None = None) -> ControlInput:
    """Declare one control, with its unit if it has one."""
    return _with_units((ControlInput(name),), unit)[0]


def controls(names: str, *, unit: str | None = None) -> tuple[ControlInput, ...]:
    """Declare several controls.

    For example `f1, f2 = controls("f1 f2")`. The `unit` is that of all, or one for each, as in "N N*m".
    """
    return _with_units(tuple(ControlInput(name) for name in _split(names)), unit)


def parameter(name: str, value: Any, *, unit: str | None = None) -> Parameter:
    """Declare one parameter with its default value, a finite real number, or a pair of that and its unit."""
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[1], str):
        value, unit = value
    symbol = Parameter(name)
    symbol.value = finite_number(value, f"parameter {name}")
    return _with_units((symbol,), unit)[0]


def parameters(**values: Any) -> tuple[Parameter, ...]:
    """Declare several parameters with their default values.

    For example `m, g = parameters(m=1, g=9.81)`, or with units `parameters(m=(1, "kg"), g=(9.81, "m/s**2"))`. Raises
    SymbolError when a value is not a finite real number.
    """
    return tuple(parameter(name, value) for name, value in values.items())


def free_parameter(
    name: str, guess: Any, lower: Any = None, upper: Any = None, *, unit: str | None = None
) -> FreeParameter:
    """Declare a number that is optimised along with the motion, such as a duration, with its unit if it has one.

    The first guess and the bounds are numbers or expressions of parameters; None stands for no bound.
    """
    symbol = FreeParameter(name)
    symbol.guess, symbol.lower, symbol.upper = guess, lower, upper
    return _with_units((symbol,), unit)[0]


def body_number() -> BodyNumber:
    """Declare the number 0, 1, ... of a body, by which boundary values, guesses and bounds of bodies may differ."""
    return BodyNumber("body")


def each_body(*values: float) -> sympy.Expr:
    """A boundary value, guess or bound that is `values[0]` for body 0, `values[1]` for body 1, and so on.

    As many as there are bodies. Raises SymbolError when a value is not a finite real number.
    """
    numbers = [finite_number(value, f"value {index} of each_body") for index, value in enumerate(values)]
    if not numbers:
        raise SymbolError("each_body() has no values", "give one for each body")
    return EachBodyBase(body_number(), *map(sympy.Float, numbers))


def time(name: str = "t", *, unit: str | None = None) -> Time:
    """Declare the time, for Lagrangians, forces, costs and guesses that depend on it explicitly.

    Where quantities have units, time is in seconds unless it has a `unit` of its own.
    """
    return _with_units((Time(name),), unit)[0]


def finite_number(value: Any, what: str) -> float:
    """Turn a number (Python's, numpy's or sympy's) into a float; SymbolError names `what` when it is not finite."""
    try:
        # float() would also take text and truth values, which are never meant.
        number = float("" if isinstance(value, (str, bytes, bytearray, bool)) or np.ndim(value) else value)
    except (TypeError, ValueError, OverflowError):
        raise SymbolError(f"{what} is {value!r}", "give a real number") from None
    if not abs(number) < float("inf"):
        raise SymbolError(f"{what} is {number}", "give a finite number")
    return number


def _split(names: str) -> list[str]:
    if not isinstance(names, str) or not names.replace(",", " ").split():
        raise SymbolError(f"{names!r} declares no symbol", 'give names separated by blanks, as in "r phi"')
    return [one for name in names.replace(",", " ").split() for one in _expanded(name)]


def _expanded(name: str) -> list[str]:
    """The names that a range such as x1:4 stands for, as sympy.symbols writes it; others stand for themselves."""
    if ":" not in name:
        return [name]
    try:
        return [symbol.name for symbol in sympy.symbols(name, seq=True)]
    except ValueError as error:
        raise SymbolError(f"{name!r} is no range of names ({error})", "write x1:4 for x1, x2 and x3") from None


def _with_units(symbols: tuple[_Declared, ...], unit: str | None) -> tuple[_Declared, ...]:
    """The symbols, with one unit for all or one for each; what units are is seen when a problem is made of them."""
    if unit is None:
        return symbols
    if not isinstance(unit, str):
        raise SymbolError(f"the unit of {symbols[0]} is {unit!r}", 'give a text, as in unit="m/s"')
    units = unit.replace(",", " ").split() or [""]
    if len(units) not in (1, len(symbols)):
        raise SymbolError(
            f"{len(units)} units ({unit}) of {len(symbols)} quantities",
            'give one for all or one for each, without blanks inside, as in "kg*m/s"',
        )
    for symbol, own in zip(symbols, units if len(units) > 1 else units * len(symbols), strict=True):
        symbol.unit = own
    return symbols


def _pairs(qs: list[str], partners: list[str], kind: type[Any]) -> tuple[tuple[Coordinate, ...], tuple[Any, ...]]:
    if len(qs) != len(partners):
        raise SymbolError(
            f"{len(qs)} coordinates ({' '.join(qs)}) but {len(partners)} partners ({' '.join(partners)})",
            "give one velocity or momentum for each coordinate",
        )
    first = tuple(Coordinate(name) for name in qs)
    second = tuple(kind(name) for name in partners)
    for q, partner in zip(first, second, strict=True):
        assert isinstance(q, Coordinate)
        q.partner, partner.partner = partner, q
    return first, second
