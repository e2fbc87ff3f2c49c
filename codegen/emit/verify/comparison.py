"""Comparison of emitted values with exact values: arithmetics, points of comparison, and a second opinion.

Complex steps differentiate functions of complex arrays that continue real ones. With a tiny imaginary part,
f(x + i d) = f(x) + i d f'(x) to all digits (Squire and Trapp, 1998, Using complex variables to estimate derivatives of
real functions, SIAM Review 40). Real parts decide branches. Outside the real domain of a function the result is NaN, as
in machine code.

If values differ in floating-point arithmetic, a second opinion computes both with many digits. Kernels then use numbers
that carry the size of their terms. This separates an error from the rounding of coefficients in the text, which is the
only permitted difference. References are finite differences, with 400 digits, of the expressions themselves.

Some points of comparison are random. Others are near the initial guess, where a solver begins: the module's own guess
with default parameters and steps, and unknowns moved by fractions of their magnitudes. Multipliers have no guess and
are random.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from functools import cache, reduce

import mpmath
import numpy as np
from sympy import Symbol

from codegen.discretise.interval import LENGTHS, STEP
from codegen.emit.verify.execution import Arithmetic, Function, Operand, defect
from codegen.symbolic.functions import by_name

DIGITS = 400
_INCREMENTS = ("1e-35", "1e-40")
Exact = Callable[[Mapping[Symbol, Operand]], Operand]
"""A function of numbers with many digits, by symbol."""
Complex = type[np.complex128] | type[np.clongdouble]
"""A complex type of numpy, which sets the precision."""
TOLERANCE = 1e-11
"""Tolerance relative to the size of a value's terms; coefficients in a text have 17 digits."""


class Sized:
    """A number and the size of its terms: a first-order bound of its rounding error, divided by machine epsilon."""

    __slots__ = ("size", "value")

    def __init__(self, value: Operand, size: Operand = None) -> None:
        self.value = mpmath.mpf(value)
        self.size = abs(self.value) if size is None else max(size, abs(self.value))

    def __add__(self, other: Operand) -> Sized:
        other = sized(other)
        return Sized(self.value + other.value, self.size + other.size)

    def __neg__(self) -> Sized:
        return Sized(-self.value, self.size)

    def __sub__(self, other: Operand) -> Sized:
        return self + -sized(other)

    def __rsub__(self, other: Operand) -> Sized:
        return sized(other) + -self

    def __mul__(self, other: Operand) -> Sized:
        other = sized(other)
        return Sized(self.value * other.value, abs(self.value) * other.size + abs(other.value) * self.size)

    def __truediv__(self, other: Operand) -> Sized:
        other = sized(other)
        quotient = self.value / other.value
        return Sized(quotient, (self.size + abs(quotient) * other.size) / abs(other.value))

    def __rtruediv__(self, other: Operand) -> Sized:
        return sized(other) / self

    __radd__, __rmul__ = __add__, __mul__


def sized(value: Operand) -> Sized:
    """Return a value as a `Sized` number; unless it has a size, its size is its magnitude."""
    return value if isinstance(value, Sized) else Sized(value)


def _applied(function: Operand, *arguments: Operand) -> Sized:
    """Return a function's value at sized numbers; its size includes effects of argument changes by their sizes."""
    operands = [sized(argument) for argument in arguments]
    values = [argument.value for argument in operands]
    value, size, little = function(*values), mpmath.mpf(0), mpmath.mpf(10) ** -30
    if not isinstance(value, mpmath.mpf) or not mpmath.isfinite(value):
        raise ValueError("no real value")
    for index, argument in enumerate(operands):
        moved = [*values[:index], argument.value + little * argument.size, *values[index + 1 :]]
        size += abs(mpmath.re(function(*moved)) - value) / little
    return Sized(value, abs(value) + size)


def _real(value: Operand) -> Operand:
    return value.value if isinstance(value, Sized) else value


def _required_real(value: Operand) -> Operand:
    if not isinstance(value, mpmath.mpf):
        raise ValueError("no real value")
    return value


SIZED = Arithmetic(
    number=Sized,
    function=lambda name: lambda *x: _applied(by_name(name), *x),
    power=lambda b, e: _applied(lambda base: base ** _real(e), b),
    maximum=lambda *x: max(map(sized, x), key=_real),
    minimum=lambda *x: min(map(sized, x), key=_real),
    absolute=lambda x: -sized(x) if _real(x) < 0 else sized(x),
    sign=lambda x: Sized(mpmath.sign(_real(x))),
    where=lambda condition, one, other: one if condition else other,
    real=_real,
)
EXACT = Arithmetic(
    number=mpmath.mpf,
    function=lambda name: lambda *x: _required_real(by_name(name)(*x)),
    power=lambda b, e: _required_real(b**e),
    maximum=max,
    minimum=min,
    absolute=abs,
    sign=mpmath.sign,
    where=lambda condition, one, other: one if condition else other,
    real=lambda x: x,
)


def difference(value: Exact, point: Mapping[Symbol, float], by: Sequence[Symbol]) -> tuple[Operand, Operand]:
    """Return a value at a point, or its derivative with respect to one or two symbols `by`, and the result's error."""
    exact = {symbol: mpmath.mpf(float(number)) for symbol, number in point.items()}

    def quotient(increment: Operand) -> Operand:
        steps = {symbol: increment * (abs(exact[symbol]) or 1) for symbol in by}

        def at(*moved: Symbol) -> Operand:
            values = dict(exact)
            for symbol in moved:
                values[symbol] += steps[symbol]
            return value(values)

        if not by:
            return at()
        if len(by) == 1:
            return (at(by[0]) - at()) / steps[by[0]]
        a, b = by
        return (at(a, b) - at(a) - at(b) + at()) / (steps[a] * steps[b])

    far, near = (quotient(mpmath.mpf(increment)) for increment in _INCREMENTS)
    # Rounding errors of far larger terms may hide a derivative.
    smallest = mpmath.mpf(_INCREMENTS[1]) ** len(by)
    return near, abs(far - near) + abs(value(exact)) * mpmath.mpf(10) ** (5 - DIGITS) / smallest


def power(base: Operand, exponent: Operand) -> Operand:
    """Return a power of numbers or arrays; NaN for a negative base with a non-integer exponent."""
    if isinstance(exponent, int):
        return np.asarray(base) ** exponent
    exponent = np.asarray(exponent)
    whole = (exponent.real == np.round(exponent.real)) & (exponent.imag == 0)
    if whole.all() and exponent.ndim == 0:
        return np.asarray(base) ** int(exponent.real)
    base = np.asarray(base)
    return np.where((base.real >= 0) | whole, _complex(base) ** exponent, np.nan)


def named(name: str) -> Function:
    """Return the function on complex arrays with a name of `math` or `mpmath`, of one variable or two (atan2)."""
    if name in _INSIDE:
        function, inside = _INSIDE[name]
        return lambda x: np.where(inside(np.asarray(x).real), function(_complex(x)), np.nan)
    if name in _ENTIRE:
        return lambda x: _ENTIRE[name](_complex(x))
    return _arctangent if name == "atan2" else _by_digits(by_name(name))


def _extended(number: Operand) -> Operand:
    """Return a number of mpmath in extended precision; outside the range of this type it is zero or infinite."""
    size = abs(number)
    if size < _SMALLEST or not size < 1 / _SMALLEST:
        return np.longdouble(0) if size < 1 else np.longdouble(mpmath.sign(number)) * np.inf
    return np.longdouble(mpmath.nstr(number, 25))


_SMALLEST = mpmath.mpf(10) ** -4900


def _complex(value: Operand) -> Operand:
    array = np.asarray(value)
    return array if np.iscomplexobj(array) else array.astype(np.clongdouble)


def _arctangent(y: Operand, x: Operand) -> Operand:
    y, x = _complex(y), _complex(x)
    square = x.real**2 + y.real**2
    return np.arctan2(y.real, x.real) + 1j * ((x.real * y.imag - y.real * x.imag) / square)


def _by_digits(function: Function) -> Function:
    """Return a function extended to complex arrays by its value and derivative, computed with 30 digits per number."""

    def continued(x: Operand) -> Operand:
        values = _complex(x)
        results = np.empty(values.shape, values.dtype)
        for index, value in np.ndenumerate(values):
            height, slope = value_and_slope(value.real)
            results[index] = height + 1j * (slope * value.imag)
        return results

    @cache
    def value_and_slope(at: Operand) -> tuple[Operand, Operand]:
        with mpmath.workdps(30):
            try:
                point = mpmath.mpf(str(at))
                return _extended(function(point)), _extended(mpmath.diff(function, point))
            except (TypeError, ValueError, ArithmeticError):
                return np.nan, np.nan

    return continued


_INSIDE: dict[str, tuple[Function, Function]] = {
    "sqrt": (np.sqrt, lambda x: x >= 0),
    "log": (np.log, lambda x: x > 0),
    "log1p": (np.log1p, lambda x: x > -1),
    "asin": (np.arcsin, lambda x: abs(x) < 1),
    "acos": (np.arccos, lambda x: abs(x) < 1),
    "acosh": (np.arccosh, lambda x: x > 1),
    "atanh": (np.arctanh, lambda x: abs(x) < 1),
}
_ENTIRE: dict[str, Function] = {
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "expm1")},
    "atan": np.arctan,
    "asinh": np.arcsinh,
}


_RELATIVE = 1e-9
_ROUNDING = 100.0
"""A difference counts if it exceeds the change from extended to double precision by this factor."""
_OPINIONS = 12

Evaluate = Callable[[Complex], tuple[Operand, Operand]]
"""A function that returns emitted and exact values, arrays (points, entries), in a complex type of numpy."""
Opinion = Callable[[int, int], tuple[Sized, Operand, Operand]]
"""A function of entry and point that returns, with many digits, the emitted value, the exact value and its error."""


def complex_numbers(kind: Complex) -> Arithmetic:
    """Return the arithmetic of complex arrays of a given type."""
    real = np.longdouble if kind is np.clongdouble else np.float64

    def chosen(is_better: Function) -> Function:
        def choice(one: Operand, other: Operand) -> Operand:
            return np.where(is_better(one.real, other.real), one, other)

        return lambda *values: reduce(choice, map(np.asarray, values))

    return Arithmetic(
        number=lambda digits: real(digits),
        function=named,
        power=power,
        maximum=chosen(operator.ge),
        minimum=chosen(operator.le),
        absolute=lambda value: value * np.sign(np.asarray(value).real),
        sign=lambda value: np.sign(np.asarray(value).real),
        where=np.where,
        real=lambda value: np.asarray(value).real,
    )


def step_of(kind: Complex) -> Operand:
    """Return the imaginary step for a complex type: its square is negligible, and small slopes do not underflow."""
    limits = np.finfo(kind)
    return limits.tiny ** limits.dtype.type(0.25)


def judge(names: Sequence[str], evaluate: Evaluate, opinion: Opinion) -> None:
    """Raise VerificationError for an entry that is wrong at some point; `names` are the names of the entries.

    `evaluate` finds entries that differ, and `opinion` decides. Entries that differ at most points come first, each at
    the points of its largest differences. A point where an entry has no value decides nothing.
    """
    with np.errstate(all="ignore"):
        emitted, exact = evaluate(np.clongdouble)
        size = np.maximum(abs(emitted), abs(exact))
        odd = abs(emitted - exact) > _RELATIVE * size
        odd = (odd & np.isfinite(size)) | (np.isfinite(emitted) != np.isfinite(exact))
        if not odd.any():
            return
        rough, roughly = evaluate(np.complex128)
        odd &= ~(abs(emitted - exact) <= _ROUNDING * (abs(emitted - rough) + abs(exact - roughly)))
        relative = np.nan_to_num(abs(emitted - exact) / size, nan=1.0)
    for entry in sorted(np.flatnonzero(odd.any(axis=0)), key=lambda e: -odd[:, e].sum())[:_OPINIONS]:
        for point in sorted(np.flatnonzero(odd[:, entry]), key=lambda p: -relative[p, entry])[:2]:
            try:
                with mpmath.workdps(DIGITS):
                    value, right, error = opinion(int(entry), int(point))
                    differs = not abs(value.value - right) <= TOLERANCE * value.size + 10 * error
                    numbers = mpmath.nstr(value.value, 8), mpmath.nstr(right, 8)
            except (ValueError, TypeError, ArithmeticError):  # no value at the point with more digits
                continue
            if differs:
                raise defect(
                    f"the emitted code gives {numbers[0]} for {names[int(entry)]}, where {numbers[1]} is right"
                )


Values = dict[Symbol, Operand]
"""The values of each symbol at some points, shape (points,)."""
_MOVED = (0.004, 0.03, 0.2, 0.5)
"""Relative displacements from the guess; kinks, which have no derivative, often lie at the guess itself."""
_BESIDE = 0.0137
_KEPT = 5
"""Number of points of each set at which kernels are compared."""
_STEPS = 24
"""Largest number of steps; a guess on more intervals shows nothing new."""


def random_points(symbols: Sequence[Symbol], defaults: Mapping[Symbol, float], count: int, seed: int) -> Values:
    """Return random values: parameters near nonzero `defaults`, steps near 1/4, others near 1 or from 1e-3 to 1e3."""
    generator = np.random.default_rng(seed)
    wide = np.arange(count) % 3 == 2
    values: Values = {}
    for symbol in symbols:
        near = generator.uniform(0.4, 1.6, count)
        far = generator.choice((-1.0, 1.0), count) * 10.0 ** generator.uniform(-3, 3, count)
        if defaults.get(symbol):
            values[symbol] = defaults[symbol] * near
        elif symbol in (STEP, *LENGTHS):
            values[symbol] = 0.25 * near
        else:
            values[symbol] = np.where(wide, far, near)
    return values


class GuessedPoints:
    """A source of points near the initial guess of a control module, on a grid of at least `least` steps."""

    def __init__(self, module: Mapping[str, Operand], steps: int, least: int = 1) -> None:
        self.module = module
        self.grid = module["make_grid"](max(least, min(steps, _STEPS)))
        with np.errstate(all="ignore"):
            self.unknowns = module["initial_guess"](self.grid)
        if "read_shared" in module:
            for body in range(module["BODIES"]):
                module["read_shared"](self.unknowns, body, self.grid.parameters)
        self.generator = np.random.default_rng(3)

    def on_intervals(self, local: Sequence[Symbol], others: Sequence[Symbol], within: tuple[float, float]) -> Values:
        """Return values of unknowns `local` and parameters `others` on three intervals; `within` are grid fractions."""
        count = self.grid.steps
        first, last = int(within[0] * count), max(int(within[0] * count), round(within[1] * count) - 1)
        intervals = sorted({first, (first + last) // 2, last})
        rows = [interval * self.module["STRIDE"] for interval in intervals for _ in _MOVED]
        values = self._moved(rows, local, others)
        t = np.array([(interval + _BESIDE) * self.grid.h for interval in intervals for _ in _MOVED])
        return values | {_TIME: t, STEP: np.full(t.size, self.grid.h)}

    def at_node(self, last: bool, local: Sequence[Symbol], others: Sequence[Symbol]) -> Values:
        """Return values of unknowns `local` and parameters `others` at the first or the last node."""
        row = self.grid.steps * self.module["STRIDE"] if last else 0
        values = self._moved([row for _ in _MOVED], local, others)
        t = np.full(len(_MOVED), self.grid.steps * self.grid.h if last else 0.0)
        return values | {_TIME: t, STEP: np.full(t.size, self.grid.h)}

    def _moved(self, rows: Sequence[int], local: Sequence[Symbol], others: Sequence[Symbol]) -> Values:
        moved = np.tile(_MOVED, len(rows) // len(_MOVED))
        values: Values = {}
        for offset, symbol in enumerate(local):
            indices = np.array(rows) + offset
            at = self.unknowns[indices]
            noise = self.generator.uniform(-1.0, 1.0, at.size)
            multiplier = self.grid.is_multiplier[indices[0]]
            values[symbol] = noise if multiplier else at + moved * noise * self._size(offset)
        shared = len(others) - self.module.get("SHARED", 0)
        for column, symbol in enumerate(others):
            at = np.full(len(rows), self.grid.parameters[0, column])
            noise = self.generator.uniform(-1.0, 1.0, at.size)
            values[symbol] = at * (1 + 0.1 * moved * noise)
            if column >= shared:
                values[symbol] += np.where(at == 0, noise, 0.0)
        return values

    def _size(self, offset: int) -> float:
        """Return the largest magnitude of an unknown in the guess, or 1 if this is zero or infinite."""
        stride = self.module["STRIDE"]
        size = float(np.abs(self.unknowns[offset % stride :: stride]).max(initial=0.0))
        return size if 0.0 < size < np.inf else 1.0


_TIME = Symbol("t")
"""A placeholder for the model's symbol for time, which may have another name."""


def with_time(values: Values, time: Symbol) -> Values:
    """Return the values with the model's own symbol for time instead of the placeholder."""
    return {time if symbol is _TIME else symbol: value for symbol, value in values.items()}


def finite_points(evaluate: Function, candidates: Sequence[Values]) -> tuple[Values, int]:
    """Return the first points of each candidate set at which all expressions are finite, and their total number."""
    kept: list[tuple[Values, Operand]] = []
    for values in candidates:
        complex_values = {symbol: array.astype(np.clongdouble) for symbol, array in values.items()}
        with np.errstate(all="ignore"):
            results = evaluate(complex_values, complex_numbers(np.clongdouble))
        size = len(next(iter(values.values())))
        finite = np.logical_and.reduce([np.isfinite(np.broadcast_to(array, size)) for array in results])
        kept.append((values, np.flatnonzero(finite)[:_KEPT]))
    count = sum(len(indices) for _, indices in kept)
    return {s: np.concatenate([values[s][indices] for values, indices in kept]) for s in candidates[0]}, count
