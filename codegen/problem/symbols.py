"""The symbols that users declare: coordinates, velocities, momenta, states, controls, parameters, time.

Each kind of symbol has its own class. Hence the role of a symbol in an expression is known, and an undeclared
`sympy.Symbol` is recognised. Two declarations with the same name create different symbols, so that a repeated name is
detected. `recorded_declarations` collects declarations.
"""

from __future__ import annotations

import itertools
import secrets
import sys
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import ClassVar, NoReturn, TypeVar

import numpy as np
import sympy

from codegen.errors import ExpressionError, SymbolError, clause
from codegen.identifiers import MARK
from codegen.symbolic.checks import checked, tidied
from codegen.symbolic.terms import EachBodyBase

_serial_numbers = itertools.count(secrets.randbits(60) << 32)
"""Numbers of symbols in the order of declaration.

They begin at a random value in every process, so that symbols from pickles of other processes have other numbers.
"""
_NUMPY_FUNCTIONS = {name for name, value in vars(np).items() if isinstance(value, np.ufunc) and value.nin == 1}
"""The names of numpy functions of one argument; for an object numpy calls the object's method of the same name."""
_recorder: ContextVar[list[Quantity] | None] = ContextVar("declared quantities", default=None)


class Quantity(sympy.Symbol):  # type: ignore[misc]  # sympy is untyped
    """A declared real symbol.

    `declared` is a number that increases in the order of declaration. `own` is False for symbols that follow from
    another symbol, and need not be used. `unit` exists only if a unit was declared.
    """

    __slots__ = ("declared", "unit")
    name: str
    declared: int
    unit: str
    own: ClassVar[bool] = True

    @property
    def rate_remedy(self) -> str:
        """The remedy for a time derivative of this symbol in an expression; empty for a constant symbol."""
        return ""

    def __new__(cls, name: str) -> Quantity:
        """Return a new symbol, different from all others; raise SymbolError for an unusable name."""
        if not isinstance(name, str) or not name.isidentifier() or MARK in name:
            raise SymbolError(f"{name!r} is not an identifier", "use letters, digits and underscores")
        # Python normalises identifiers in the same way, because different characters may represent the same letter.
        symbol: Quantity = sympy.Symbol.__xnew__(cls, unicodedata.normalize("NFKC", name), real=True)
        symbol.declared = next(_serial_numbers)
        recorded = _recorder.get()
        if recorded is not None and cls.own:
            recorded.append(symbol)
        return symbol

    def __getattr__(self, name: str) -> Callable[[], NoReturn]:
        """Return a method that raises ExpressionError if `name` is a function of numpy.

        A call such as numpy.sin(q) calls this method. The message of numpy itself would have no remedy.
        """
        if name not in _NUMPY_FUNCTIONS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)

        def refuse() -> NoReturn:
            raise ExpressionError(f"numpy.{name}({self})", "take functions from sympy: from sympy import cos, sin")

        return refuse

    def __reduce_ex__(self, protocol: object) -> tuple[object, ...]:
        """Return the function, arguments and attributes that restore the same symbol from a pickle or for a copy."""
        kinds = [kind for kind in type(self).__mro__ if issubclass(kind, Quantity)]
        slots = [name for kind in kinds for name in vars(kind).get("__slots__", ()) if hasattr(self, name)]
        return _restored, (type(self), self.name, self.declared), {name: getattr(self, name) for name in slots}

    def __setstate__(self, state: dict[str, object]) -> None:
        for name, value in state.items():
            setattr(self, name, value)

    def _hashable_content(self) -> tuple[object, ...]:
        return (*super()._hashable_content(), self.declared)

    def delayed(self, tau: sympy.Expr | float) -> Delayed:
        """Raise SymbolError, because the symbol does not change with time."""
        raise SymbolError(f"{self}.delayed({tau})", f"{self} does not move: delay states, coordinates or controls")


def _restored(kind: type[Quantity], name: str, declared: int) -> Quantity:
    """Return a symbol from a pickle, with the number of its first declaration.

    Its other attributes are set later, because partners refer to each other.
    """
    symbol: Quantity = sympy.Symbol.__xnew__(kind, name, real=True)
    symbol.declared = declared
    return symbol


class Parameter(Quantity):
    """A parameter: a number that is an argument of the generated module; `value` is its default."""

    __slots__ = ("value",)
    value: float


class Moving(Quantity):
    """A quantity that changes with time; `past` has its delayed values by their delays."""

    __slots__ = ("past",)
    past: dict[sympy.Expr, Delayed]

    def __new__(cls, name: str) -> Moving:
        """Return a new symbol without delayed values."""
        symbol = super().__new__(cls, name)
        assert isinstance(symbol, Moving), "it is of this class"
        symbol.past = {}
        return symbol

    def delayed(self, tau: sympy.Expr | float) -> Delayed:
        """Return the value at the time t - tau.

        Parameters
        ----------
        tau : number or expression of parameters
            A positive, constant delay.

        Returns
        -------
        Delayed
            Symbol of the delayed value; repeated calls with the same delay return the same symbol. The argument
            `history={...}` of the problem defines its values before t = 0.

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
        """The remedy of the partner, and the advice to delay the result."""
        return f"{self.partner.rate_remedy}, and delay that"

    def __new__(cls, partner: Moving, lag: sympy.Expr) -> Delayed:
        """Return a new symbol, which is not recorded as a declaration."""
        symbol: Delayed = sympy.Symbol.__xnew__(cls, f"{partner.name}.delayed({lag})", real=True)
        symbol.declared = next(_serial_numbers)
        symbol.partner, symbol.lag = partner, lag
        return symbol

    def delayed(self, tau: sympy.Expr | float) -> Delayed:
        """Return the value of the partner at a still earlier time, t - lag - tau."""
        return self.partner.delayed(self.lag + tau)


@contextmanager
def recorded_declarations() -> Iterator[list[Quantity]]:
    """Record all quantities that are declared during a with block; the value of the block is the list of quantities.

    Messages can then name quantities that are declared but not used.
    """
    declared: list[Quantity] = []
    token = _recorder.set(declared)
    try:
        yield declared
    finally:
        _recorder.reset(token)


_Declared = TypeVar("_Declared", bound=Quantity)
_Partner = TypeVar("_Partner", "Velocity", "Momentum")


class _Variable(Moving):
    """A coordinate or a state; `end_values` has the symbols of its values for single bodies by their numbers."""

    __slots__ = ("end_values",)
    end_values: dict[int, EndValue]

    def __new__(cls, name: str) -> _Variable:
        symbol = super().__new__(cls, name)
        assert isinstance(symbol, _Variable), "it is of this class"
        symbol.end_values = {}
        return symbol

    def of(self, body: int) -> EndValue:
        """Return the value of the quantity for one of several identical bodies.

        In `end_conditions` the symbol is the value at the end; in `path` it is the value at every time.

        Parameters
        ----------
        body : int
            Number of the body: 0, 1, ...

        Returns
        -------
        EndValue
            Symbol with the name `<name>_<body>`; repeated calls return the same symbol.

        Raises
        ------
        SymbolError
            If `body` is not 0, 1, ...
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
    """The value of the coordinate or state `partner` for the body with the number `body`.

    In `path` the symbol is the value at every time; elsewhere it is the value at the end.
    """

    __slots__ = ("body", "partner")
    partner: Coordinate | State
    body: int
    own = False

    @property
    def rate_remedy(self) -> str:
        """The remedy of the partner."""
        return self.partner.rate_remedy


class Coordinate(_Variable):
    """A generalised coordinate; `partner` is the velocity or the momentum that was declared together with it."""

    __slots__ = ("partner",)
    partner: Velocity | Momentum

    @property
    def rate_remedy(self) -> str:
        """The remedy: use the velocity, which is declared or follows from the Hamiltonian."""
        if isinstance(self.partner, Velocity):
            return f"use its velocity {self.partner}"
        return f"use the derivative of the Hamiltonian by {self.partner}"


class State(_Variable):
    """A state x of a first-order system x' = f(x, u, t)."""

    __slots__ = ()

    @property
    def rate_remedy(self) -> str:
        """The remedy: write the expression of the derivative, which the problem has in `dynamics`."""
        return f"write the expression that dynamics={{{self}: ...}} gives"


class Velocity(Moving):
    """The time derivative of its `partner`, a coordinate."""

    __slots__ = ("partner",)
    partner: Coordinate

    @property
    def rate_remedy(self) -> str:
        """The remedy: make the acceleration a control; otherwise it follows from the equations of motion."""
        x = self.partner
        return f"make the acceleration the control a of states {x} and {self}: dynamics={{{x}: {self}, {self}: a}}"


class Momentum(Moving):
    """The momentum conjugate to its `partner`, a coordinate."""

    __slots__ = ("partner",)
    partner: Coordinate

    @property
    def rate_remedy(self) -> str:
        """The remedy: write the derivative of the momentum, which follows from the Hamiltonian and the force."""
        return f"use the force less the derivative of the Hamiltonian by {self.partner}"


class ControlInput(Moving):
    """A control, which the optimiser chooses at every time."""

    __slots__ = ()

    @property
    def rate_remedy(self) -> str:
        """The remedy: make the derivative the control, and the old control a state."""
        return f"declare the rate as the control and {self} as a state: dynamics={{{self}: d{self}, ...}}"


class FreeParameter(Quantity):
    """A number that is optimised together with the motion, with its initial guess and bounds; None means no bound."""

    __slots__ = ("guess", "lower", "upper")
    guess: sympy.Expr | float
    lower: sympy.Expr | float | None
    upper: sympy.Expr | float | None


class _Common(Quantity):
    """A symbol that may be declared repeatedly: all symbols of the class with the same name are equal."""

    __slots__ = ()

    def _hashable_content(self) -> tuple[object, ...]:
        return tuple(sympy.Symbol._hashable_content(self))


class BodyNumber(_Common):
    """The number 0, 1, ... of a body among several identical bodies."""

    __slots__ = ()


class Time(_Common):
    """The time, the independent variable; times with different units are different symbols."""

    __slots__ = ()

    @property
    def _diff_wrt(self) -> bool:
        """Return True, which permits derivatives with respect to time; raise ExpressionError for moving quantities.

        sympy would evaluate the time derivative of a moving quantity to zero, because it treats symbols as constants.
        sympy reads this attribute before it evaluates a derivative, but does not pass the expression, which is
        therefore read from the caller's frame. Explicit functions of time are differentiated as usual.
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

    def _hashable_content(self) -> tuple[object, ...]:
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
        For example `q, dq = coordinate("q")`.
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
        One unit for all coordinates, or a unit for each as in "m rad". Velocities have these units divided by the unit
        of time.

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
        Names of the two symbols.
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
        Units of the coordinates and of the momenta: one unit for all, or a unit for each.

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
    """Declare the states of a first-order system, whose derivatives `dynamics={x: ..., v: ...}` of a problem defines.

    Parameters
    ----------
    names : str
        Names separated by blanks.
    unit : str
        One unit for all states, or a unit for each.

    Returns
    -------
    tuple of State
        For example `x, v = states("x v", unit="m m/s")`.
    """
    return _with_units(tuple(State(name) for name in _split(names)), unit)


def control(name: str, *, unit: str | None = None) -> ControlInput:
    """Declare one control of an optimal-control problem.

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
        One unit for all controls, or a unit for each, as in "N N*m".

    Returns
    -------
    tuple of ControlInput
        For example `f1, f2 = controls("f1 f2")`.
    """
    return _with_units(tuple(ControlInput(name) for name in _split(names)), unit)


def parameter(name: str, value: float | tuple[float, str], *, unit: str | None = None) -> Parameter:
    """Declare one parameter, a number that can be changed without a new build.

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


def parameters(**values: float | tuple[float, str]) -> tuple[Parameter, ...]:
    """Declare several parameters, numbers that can be changed without a new build.

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
    name: str,
    guess: sympy.Expr | float,
    lower: sympy.Expr | float | None = None,
    upper: sympy.Expr | float | None = None,
    *,
    unit: str | None = None,
) -> FreeParameter:
    """Declare a number that is optimised together with the motion, such as a duration.

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
    """Return the symbol for the number 0, 1, ... of a body.

    Boundary values, guesses and bounds of several identical bodies may depend on this number.
    """
    return BodyNumber("body")


def each_body(*values: float) -> sympy.Expr:
    """Return an expression for a boundary value, guess or bound with a separate value for each body.

    Parameters
    ----------
    *values : float
        The values for body 0, body 1, ..., one for each body.

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


def finite_number(value: sympy.Expr | float, what: str) -> float:
    """Return a number of Python, numpy or sympy as a float.

    Raise SymbolError, which begins with the name `what`, for other values and for numbers that are not finite.
    """
    try:
        # float() would also accept text and truth values, which are certainly mistakes.
        number = float("" if isinstance(value, (str, bytes, bytearray, bool)) or np.ndim(value) else value)
    except (TypeError, ValueError, OverflowError):
        raise SymbolError(f"{what} is {value!r}", "give a real number") from None
    if not abs(number) < float("inf"):
        raise SymbolError(f"{what} is {number}", "give a finite number")
    return number


def _split(names: str) -> list[str]:
    """Return the names in a text, separated by blanks or commas; x1:4 means x1, x2 and x3, as in sympy.symbols."""
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
    """Set the units of symbols, and return the symbols.

    The text `unit` has one unit for all symbols, or a unit for each. The units are checked later, in the problem.
    """
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


def _pairs(
    qs: list[str], partners: list[str], kind: type[_Partner]
) -> tuple[tuple[Coordinate, ...], tuple[_Partner, ...]]:
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
