"""The symbols that an author declares: coordinates, velocities, momenta, states, controls, parameters, time.

Each symbol has a class of its own, so that its role in an expression is known, and an undeclared `sympy.Symbol` is
recognised. Two declarations are two symbols even if they share a name, so that a repeated name is detected.
`recorded_declarations` collects declarations.
"""

from __future__ import annotations

import itertools
import secrets
import sys
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, ClassVar, NoReturn, TypeVar

import numpy as np
import sympy

from codegen.errors import ExpressionError, SymbolError, clause
from codegen.identifiers import MARK
from codegen.symbolic.checks import checked, tidied
from codegen.symbolic.terms import EachBodyBase

_serial_numbers = itertools.count(secrets.randbits(60) << 32)
"""The numbers begin at a random value in every process, so that unpickled symbols of another process are distinct."""
_NUMPY_FUNCTIONS = {name for name, value in vars(np).items() if isinstance(value, np.ufunc) and value.nin == 1}
"""The functions of one argument of numpy, which call the method of that name of an object."""
_recorder: ContextVar[list[Quantity] | None] = ContextVar("declared quantities", default=None)


class Quantity(sympy.Symbol):  # type: ignore[misc]  # sympy is untyped
    """A declared real symbol; `declared` orders symbols as their author wrote them.

    A symbol that is not `own` follows from another symbol and need not be used. `unit` exists if it was declared.
    """

    __slots__ = ("declared", "unit")
    name: str
    declared: int
    unit: str
    own: ClassVar[bool] = True

    @property
    def rate_remedy(self) -> str:
        """The remedy for a derivative of this symbol by time; empty for a constant symbol."""
        return ""

    def __new__(cls, name: str) -> Quantity:
        """Make a new symbol, different from all others; SymbolError for an unusable name."""
        if not isinstance(name, str) or not name.isidentifier() or MARK in name:
            raise SymbolError(f"{name!r} is not an identifier", "use letters, digits and underscores")
        # As Python reads identifiers, where several characters stand for one letter.
        symbol: Quantity = sympy.Symbol.__xnew__(cls, unicodedata.normalize("NFKC", name), real=True)
        symbol.declared = next(_serial_numbers)
        recorded = _recorder.get()
        if recorded is not None and cls.own:
            recorded.append(symbol)
        return symbol

    def __getattr__(self, name: str) -> Callable[[], NoReturn]:
        """Return a method that refuses a function of numpy, whose own message has no remedy."""
        if name not in _NUMPY_FUNCTIONS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)

        def refuse() -> NoReturn:
            raise ExpressionError(f"numpy.{name}({self})", "take functions from sympy: from sympy import cos, sin")

        return refuse

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        """Return what recreates the same symbol, with all its attributes, from a pickle or for a copy."""
        kinds = [kind for kind in type(self).__mro__ if issubclass(kind, Quantity)]
        slots = [name for kind in kinds for name in vars(kind).get("__slots__", ()) if hasattr(self, name)]
        return _restored, (type(self), self.name, self.declared), {name: getattr(self, name) for name in slots}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)

    def _hashable_content(self) -> tuple[Any, ...]:
        return (*super()._hashable_content(), self.declared)

    def delayed(self, tau: Any) -> Delayed:
        """Raise SymbolError, because the symbol does not move."""
        raise SymbolError(f"{self}.delayed({tau})", f"{self} does not move: delay states, coordinates or controls")


def _restored(kind: type[Quantity], name: str, declared: int) -> Quantity:
    """A symbol as it was declared once; what else is known of it follows, since partners know each other."""
    symbol: Quantity = sympy.Symbol.__xnew__(kind, name, real=True)
    symbol.declared = declared
    return symbol


class Parameter(Quantity):
    """A number that is an argument of the generated module; `value` is its default."""

    __slots__ = ("value",)
    value: float


class Moving(Quantity):
    """A quantity that changes with time, and has a past."""

    __slots__ = ("past",)
    past: dict[sympy.Expr, Delayed]

    def __new__(cls, name: str) -> Moving:
        """Make a new symbol without delayed values."""
        symbol = super().__new__(cls, name)
        assert isinstance(symbol, Moving), "it is of this class"
        symbol.past = {}
        return symbol

    def delayed(self, tau: Any) -> Delayed:
        """Return the value at the time t - tau.

        Parameters
        ----------
        tau : number or expression of parameters
            A positive, constant delay.

        Returns
        -------
        Delayed
            The same symbol for the same delay. `history={...}` of the problem defines its values before t = 0.

        Raises
        ------
        SymbolError
            For a delay that is not positive, or not constant.
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
        """The remedy for the partner, with the delay added."""
        return f"{self.partner.rate_remedy}, and delay that"

    def __new__(cls, partner: Moving, lag: sympy.Expr) -> Delayed:
        """Make a new symbol, which no author declares."""
        symbol: Delayed = sympy.Symbol.__xnew__(cls, f"{partner.name}.delayed({lag})", real=True)
        symbol.declared = next(_serial_numbers)
        symbol.partner, symbol.lag = partner, lag
        return symbol

    def delayed(self, tau: Any) -> Delayed:
        """Return the value at a still earlier time."""
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
    """A coordinate or a state; each of several bodies has one."""

    __slots__ = ("end_values",)
    end_values: dict[int, EndValue]

    def __new__(cls, name: str) -> _Variable:
        symbol = super().__new__(cls, name)
        assert isinstance(symbol, _Variable), "it is of this class"
        symbol.end_values = {}
        return symbol

    def of(self, body: int) -> EndValue:
        """Return the value for one body, for `end_conditions`, and for `path` at every time.

        Parameters
        ----------
        body : int
            Number of the body: 0, 1, ...

        Returns
        -------
        EndValue
            The same symbol each time, named `<name>_<body>`.

        Raises
        ------
        SymbolError
            If `body` is no such number.
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
        """The remedy for the same quantity of all bodies."""
        return self.partner.rate_remedy


class Coordinate(_Variable):
    """A generalised coordinate; `partner` is the velocity or the momentum that was declared with it."""

    __slots__ = ("partner",)
    partner: Velocity | Momentum

    @property
    def rate_remedy(self) -> str:
        """The velocity is declared, or follows from the Hamiltonian."""
        if isinstance(self.partner, Velocity):
            return f"use its velocity {self.partner}"
        return f"use the derivative of the Hamiltonian by {self.partner}"


class State(_Variable):
    """A state x of a first-order system x' = f(x, u, t)."""

    __slots__ = ()

    @property
    def rate_remedy(self) -> str:
        """The author has the expression of the rate."""
        return f"write the expression that dynamics={{{self}: ...}} gives"


class Velocity(Moving):
    """The time derivative of its `partner`, a coordinate."""

    __slots__ = ("partner",)
    partner: Coordinate

    @property
    def rate_remedy(self) -> str:
        """Accelerations follow from the equations of motion, unless they are controls."""
        x = self.partner
        return f"make the acceleration the control a of states {x} and {self}: dynamics={{{x}: {self}, {self}: a}}"


class Momentum(Moving):
    """The momentum conjugate to its `partner`, a coordinate."""

    __slots__ = ("partner",)
    partner: Coordinate

    @property
    def rate_remedy(self) -> str:
        """The rate follows from the Hamiltonian and the force."""
        return f"use the force less the derivative of the Hamiltonian by {self.partner}"


class ControlInput(Moving):
    """A control, which the optimiser chooses at every time."""

    __slots__ = ()

    @property
    def rate_remedy(self) -> str:
        """The rate becomes the control, and the old control a state."""
        return f"declare the rate as the control and {self} as a state: dynamics={{{self}: d{self}, ...}}"


class FreeParameter(Quantity):
    """A number that is optimised along with the motion: its initial guess and its bounds, None for no bound."""

    __slots__ = ("guess", "lower", "upper")
    guess: Any
    lower: Any
    upper: Any


class _Common(Quantity):
    """A symbol that exists once: a repeated declaration with the same name is the same symbol."""

    __slots__ = ()

    def _hashable_content(self) -> tuple[Any, ...]:
        return tuple(sympy.Symbol._hashable_content(self))


class BodyNumber(_Common):
    """The number 0, 1, ... of a body among several identical ones."""

    __slots__ = ()


class Time(_Common):
    """The independent variable; with another unit it is another symbol."""

    __slots__ = ()

    @property
    def _diff_wrt(self) -> bool:
        """Refuse the time derivative of a moving quantity, which sympy evaluates to zero: its symbols are constants.

        sympy reads this attribute before it evaluates a derivative, but does not pass the expression. Functions of time
        are differentiated as usual.
        """
        caller = sys._getframe(1)
        if caller.f_code is sympy.Derivative.__new__.__code__:
            expression = caller.f_locals["expr"]
            moving = [s for s in expression.free_symbols if isinstance(s, Quantity) and s.rate_remedy]
            if moving:
                first = min(moving, key=lambda symbol: symbol.declared)
                finding = f"the derivative of {clause(str(expression))} by {self}: sympy takes {first} for a constant"
                raise ExpressionError(finding, first.rate_remedy)
        return True

    def _hashable_content(self) -> tuple[Any, ...]:
        return (*super()._hashable_content(), getattr(self, "unit", ""))


def coordinate(name: str, velocity: str | None = None, *, unit: str | None = None) -> tuple[Coordinate, Velocity]:
    """Declare one coordinate and its velocity.

    Parameters
    ----------
    name : str
        An identifier.
    velocity : str
        Name of the velocity, by default `d<name>`.
    unit : str
        Unit as pint reads it, such as "rad" or "kg*m/s**2", for axes, tables and data sets.

    Returns
    -------
    Coordinate, Velocity
    """
    (q,), (v,) = coordinates(name, velocity, unit=unit)
    return q, v


def coordinates(
    names: str, velocities: str | None = None, *, unit: str | None = None
) -> tuple[tuple[Coordinate, ...], tuple[Velocity, ...]]:
    """Declare several coordinates and their velocities.

    Parameters
    ----------
    names : str
        Names separated by blanks. "x1:4" means x1, x2 and x3, as in sympy.symbols.
    velocities : str
        Names of the velocities, by default `d<name>`.
    unit : str
        One unit for all, or one for each as in "m rad". Units of velocities follow with the unit of time.

    Returns
    -------
    tuple of Coordinate, tuple of Velocity
        For example `(r, phi), (dr, dphi) = coordinates("r phi")`.

    Raises
    ------
    SymbolError
        If a name is no identifier or two lists differ in length.
    """
    qs = _split(names)
    vs = [f"d{name}" for name in qs] if velocities is None else _split(velocities)
    pairs = _pairs(qs, vs, Velocity)
    _with_units(pairs[0], unit)
    return pairs


def canonical_pair(
    coordinate: str, momentum: str, *, unit: str | None = None, momentum_unit: str | None = None
) -> tuple[Coordinate, Momentum]:
    """Declare one coordinate and its conjugate momentum.

    Parameters
    ----------
    coordinate, momentum : str
        Names.
    unit, momentum_unit : str
        Units of the coordinate and of the momentum.

    Returns
    -------
    Coordinate, Momentum
        For example `q, p = canonical_pair("q", "p")`.
    """
    (q,), (p,) = canonical_pairs(coordinate, momentum, unit=unit, momentum_unit=momentum_unit)
    return q, p


def canonical_pairs(
    coordinates: str, momenta: str, *, unit: str | None = None, momentum_unit: str | None = None
) -> tuple[tuple[Coordinate, ...], tuple[Momentum, ...]]:
    """Declare several coordinates and their conjugate momenta.

    Parameters
    ----------
    coordinates, momenta : str
        Names separated by blanks.
    unit, momentum_unit : str
        One unit for all, or one for each.

    Returns
    -------
    tuple of Coordinate, tuple of Momentum
        For example `(r, phi), (pr, pphi) = canonical_pairs("r phi", "pr pphi")`.
    """
    pairs = _pairs(_split(coordinates), _split(momenta), Momentum)
    _with_units(pairs[0], unit)
    _with_units(pairs[1], momentum_unit)
    return pairs


def state(name: str, *, unit: str | None = None) -> State:
    """Declare one state of a first-order system.

    Parameters
    ----------
    name : str
        An identifier.
    unit : str
        Unit as for `coordinate`.
    """
    return _with_units((State(name),), unit)[0]


def states(names: str, *, unit: str | None = None) -> tuple[State, ...]:
    """Declare the states of a first-order system; `dynamics={x: ..., v: ...}` defines their derivatives.

    Parameters
    ----------
    names : str
        Names separated by blanks.
    unit : str
        One unit for all, or one for each.

    Returns
    -------
    tuple of State
        For example `x, v = states("x v", unit="m m/s")`.
    """
    return _with_units(tuple(State(name) for name in _split(names)), unit)


def control(name: str, *, unit: str | None = None) -> ControlInput:
    """Declare one control.

    Parameters
    ----------
    name : str
        An identifier.
    unit : str
        Unit as for `coordinate`.
    """
    return _with_units((ControlInput(name),), unit)[0]


def controls(names: str, *, unit: str | None = None) -> tuple[ControlInput, ...]:
    """Declare several controls.

    Parameters
    ----------
    names : str
        Names separated by blanks.
    unit : str
        One unit for all, or one for each, as in "N N*m".

    Returns
    -------
    tuple of ControlInput
        For example `f1, f2 = controls("f1 f2")`.
    """
    return _with_units(tuple(ControlInput(name) for name in _split(names)), unit)


def parameter(name: str, value: Any, *, unit: str | None = None) -> Parameter:
    """Declare one parameter.

    Parameters
    ----------
    name : str
        An identifier.
    value : float
        Default value, a finite real number, or a pair of a number and a unit.
    unit : str
        Unit as for `coordinate`.
    """
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[1], str):
        value, unit = value
    symbol = Parameter(name)
    symbol.value = finite_number(value, f"parameter {name}")
    return _with_units((symbol,), unit)[0]


def parameters(**values: Any) -> tuple[Parameter, ...]:
    """Declare several parameters.

    Parameters
    ----------
    **values : float
        Default values by name, or pairs of a number and a unit.

    Returns
    -------
    tuple of Parameter
        For example `m, g = parameters(m=1, g=9.81)` or `parameters(m=(1, "kg"), g=(9.81, "m/s**2"))`.

    Raises
    ------
    SymbolError
        If a value is not a finite real number.
    """
    return tuple(parameter(name, value) for name, value in values.items())


def free_parameter(
    name: str, guess: Any, lower: Any = None, upper: Any = None, *, unit: str | None = None
) -> FreeParameter:
    """Declare a number that is optimised along with the motion, such as a duration.

    Parameters
    ----------
    name : str
        An identifier.
    guess, lower, upper : number or expression of parameters
        Initial guess and bounds; None means no bound.
    unit : str
        Unit as for `coordinate`.
    """
    symbol = FreeParameter(name)
    symbol.guess, symbol.lower, symbol.upper = guess, lower, upper
    return _with_units((symbol,), unit)[0]


def body_number() -> BodyNumber:
    """Declare the number 0, 1, ... of a body, on which boundary values, guesses and bounds of bodies may depend."""
    return BodyNumber("body")


def each_body(*values: float) -> sympy.Expr:
    """Return a boundary value, guess or bound with a separate value for each body.

    Parameters
    ----------
    *values : float
        The values for body 0, body 1, ..., as many as there are bodies.

    Raises
    ------
    SymbolError
        If a value is not a finite real number.
    """
    numbers = [finite_number(value, f"value {index} of each_body") for index, value in enumerate(values)]
    if not numbers:
        raise SymbolError("each_body() has no values", "give one for each body")
    return EachBodyBase(body_number(), *map(sympy.Float, numbers))


def time(name: str = "t", *, unit: str | None = None) -> Time:
    """Declare the time, for Lagrangians, forces, costs and guesses that depend on it explicitly.

    Parameters
    ----------
    name : str
        An identifier.
    unit : str
        Unit of time, by default seconds if other quantities have units.
    """
    return _with_units((Time(name),), unit)[0]


def finite_number(value: Any, what: str) -> float:
    """Return a number of Python, numpy or sympy as a float; SymbolError names `what` if it is not finite."""
    try:
        # float() would also take text and truth values, which are never meant.
        number = float("" if isinstance(value, (str, bytes, bytearray, bool)) or np.ndim(value) else value)
    except (TypeError, ValueError, OverflowError):
        raise SymbolError(f"{what} is {value!r}", "give a real number") from None
    if not abs(number) < float("inf"):
        raise SymbolError(f"{what} is {number}", "give a finite number")
    return number


def _split(names: str) -> list[str]:
    """Return the names in a text; a range such as x1:4 stands for x1, x2 and x3, as in sympy.symbols."""
    if not isinstance(names, str) or not names.replace(",", " ").split():
        raise SymbolError(f"{names!r} declares no symbol", 'give names separated by blanks, as in "r phi"')
    separate: list[str] = []
    for name in names.replace(",", " ").split():
        try:
            separate += [symbol.name for symbol in sympy.symbols(name, seq=True)] if ":" in name else [name]
        except ValueError as error:
            raise SymbolError(f"{name!r} is no range of names ({error})", "write x1:4 for x1, x2 and x3") from None
    return separate


def _with_units(symbols: tuple[_Declared, ...], unit: str | None) -> tuple[_Declared, ...]:
    """Set one unit for all symbols, or one for each; units are parsed when a problem is made of the symbols."""
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
