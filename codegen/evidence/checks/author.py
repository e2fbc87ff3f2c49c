"""The problem that an author wrote, with random parameters, and smooth random motions along which it has values.

The expressions are those of the author's object. No part of the canonical model is used, so that the values are an
independent reference for generated modules.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import ModuleType
from typing import TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy.core import relational

from codegen.identifiers import plain
from codegen.problem import symbols
from codegen.problem.description import quantities_in
from codegen.problem.problem import Control, Expression, Phases, Relations, Simulate
from codegen.problem.tables import Measurements
from codegen.runtime.record import Method
from codegen.solving.request import parameter_arguments
from codegen.symbolic.functions import NUMPY

Array: TypeAlias = NDArray[np.float64]
Values: TypeAlias = Mapping[sympy.Symbol, float | Array]

_LEAST_STEPS = 16  # least number of intervals of a phase on the coarsest grid
_NEWTON_STEPS = 30


class NoMotionError(Exception):
    """The error if the author's expressions have no real values along a motion."""


@lru_cache(maxsize=1024)
def _compiled(expression: sympy.Expr) -> tuple[list[sympy.Symbol], Callable[..., float | Array]]:
    arguments = sorted(expression.free_symbols, key=lambda symbol: (str(symbol), getattr(symbol, "declared", 0)))
    return arguments, sympy.lambdify(arguments, expression, modules=NUMPY, cse=True, dummify=True)


def value_at(expression: Expression, values: Values) -> float | Array:
    """Return the value of an author's expression, a number or an array."""
    expression = sympy.sympify(expression)
    body = next((symbol for symbol in expression.free_symbols if isinstance(symbol, symbols.BodyNumber)), None)
    if body is not None:
        expression = expression.xreplace({body: sympy.Integer(values[body])})
    arguments, function = _compiled(expression)
    with np.errstate(all="ignore"):
        return function(*(values[symbol] for symbol in arguments))


def values_along(expression: Expression, values: Values, t: Array) -> Array:
    """Return the values of an expression at all times; raise NoMotionError unless all are finite and real."""
    found = np.asarray(value_at(expression, values))
    if np.iscomplexobj(found) or not np.isfinite(found).all():
        raise NoMotionError(f"{sympy.sympify(expression)} has no real value along random motions"[:200])
    return np.broadcast_to(np.asarray(found, dtype=float), t.shape)


@dataclass(frozen=True)
class Relation:
    """An author's relation: `expression` vanishes, or (`equality` false) is not positive."""

    name: str
    expression: sympy.Expr
    equality: bool


def relations_of(given: Relations) -> list[Relation]:
    """Return the relations of an argument of Control, which are a list or a mapping from names to relations."""
    pairs = list(given.items()) if isinstance(given, Mapping) else [(None, each) for each in given]
    return [_relation(*(each if isinstance(each, tuple) else (name, each))) for name, each in pairs]


def _relation(name: str | None, relation: object) -> Relation:
    if isinstance(relation, relational.Equality):
        return Relation(name or f"{_text(relation.lhs)} = {_text(relation.rhs)}", relation.lhs - relation.rhs, True)
    if isinstance(relation, relational.Relational):
        return Relation(name or _text(relation), relation.lts - relation.gts, False)
    return Relation(name or f"{_text(relation)} = 0", sympy.sympify(relation), True)


def _text(expression: sympy.Basic) -> str:
    return str(sympy.sstr(expression, full_prec=False))


def integral_of(relation: relational.Relational, moving: set[sympy.Symbol]) -> tuple[sympy.Expr, sympy.Expr]:
    """Return (g, c) of a condition on an integral: the integral of g equals c, or (inequalities) does not exceed c."""
    integrand, limit = relation.args
    if not sympy.sympify(integrand).free_symbols & moving:
        integrand, limit = limit, integrand
    if isinstance(relation, relational.Equality) or relation.lts == integrand:
        return integrand, limit
    return -integrand, -limit


@dataclass(frozen=True)
class Motion:
    """Values of all quantities at the times `t`, and the derivatives of coordinates, states and momenta."""

    t: Array
    values: Values
    slopes: Mapping[sympy.Symbol, Array]


Path: TypeAlias = Callable[[Array], Motion]  # a motion of a phase as a function of an array of times
Curve: TypeAlias = Callable[[Array], tuple[Array, Array]]  # values and derivatives of a quantity at an array of times


class Author:
    """The author's problem and the generated module, with random values of parameters and free parameters."""

    def __init__(self, written: Control | Simulate | Phases, module: ModuleType) -> None:
        self.module, self.record = module, module.metadata
        self.phases: tuple[Control | Simulate, ...] = written.phases if isinstance(written, Phases) else (written,)
        self.jumps = [*(written.jumps if isinstance(written, Phases) else ()), *[{}] * len(self.phases)]
        self.first = self.phases[0]
        self.quantities = {s.name: s for s in quantities_in(written) if s.own}
        self.is_first_order = self.first.dynamics is not None
        self.is_hamiltonian = self.first.hamiltonian is not None
        self.parameters = [s for s in self.quantities.values() if isinstance(s, symbols.Parameter)]
        self.free = [s for s in self.quantities.values() if isinstance(s, symbols.FreeParameter)]
        self.time = next((s for s in self.quantities.values() if isinstance(s, symbols.Time)), symbols.time())
        self.controls = [s for s in self.quantities.values() if isinstance(s, symbols.ControlInput)]
        kinds = (symbols.State,) if self.is_first_order else (symbols.Coordinate,)
        self.coordinates = [s for s in self.quantities.values() if isinstance(s, kinds)]
        self.rates = [] if self.is_first_order else [q.partner for q in self.coordinates]
        self.bodies = getattr(self.first, "bodies", 1)

    @cached_property
    def is_linear(self) -> bool:
        """True for a simulation whose Lagrangian is linear in the velocities: its state has no momenta."""
        if not isinstance(self.first, Simulate) or self.first.lagrangian is None:
            return False
        second = (sympy.diff(self.first.lagrangian, v, w) for v in self.rates for w in self.rates)
        return all(sympy.simplify(entry) == 0 for entry in second)

    @property
    def has_momenta(self) -> bool:
        """True if the state of a simulation has momenta."""
        return bool(self.rates) and not self.is_linear

    @property
    def levels(self) -> tuple[int, ...]:
        """Numbers of intervals of a phase from which limits are extrapolated."""
        least = max(_LEAST_STEPS, 2 * (self.record.inner_times + 1))
        return tuple(least * 2**i for i in range(5))

    def reason_without_motion(self) -> str:
        """Return the reason why motions cannot be compared, or ""."""
        if self.record.segments is not None:
            return "delays divide the motion into segments, which have copies of all quantities"
        if self.record.bodies != self.bodies:
            return "conditions between bodies have made every body a system of its own"
        if self.record.tables:
            return "the problem interpolates tables"
        return ""

    @cached_property
    def arguments(self) -> dict[str, float]:
        """Arguments of the module's `make_grid`: random values of the parameters, or the defaults if these fail."""
        names, generator = parameter_arguments(self.module), np.random.default_rng(7)
        defaults = {names[name]: value for name, value in self.record.parameters.items()}
        for size in (0.1, 0.01):
            drawn = {
                name: value * generator.uniform(1.0 - size, 1.0 + size) if value else generator.uniform(0.0, size)
                for name, value in defaults.items()
            }
            values = {s: drawn.get(self._argument(s), float(s.value)) for s in self.parameters}
            try:
                self.module.make_grid(self.levels[0], **drawn)
                constants = {**values, **self._free_values(values), symbols.body_number(): 0}
                parts = ((p.duration, *p.start.values(), *getattr(p, "end", {}).values()) for p in self.phases)
                numbers = [value_at(value, constants) for part in parts for value in part]
            except Exception:  # values outside the domain of a formula
                continue
            if np.isfinite(np.array(numbers, dtype=complex)).all() and np.isrealobj(np.array(numbers)):
                return drawn
        return defaults

    @cached_property
    def constants(self) -> dict[sympy.Symbol, float]:
        """The values of parameters and free parameters."""
        values = {s: self.arguments.get(self._argument(s), float(s.value)) for s in self.parameters}
        return values | self._free_values(values)

    def _argument(self, parameter: sympy.Symbol) -> str:
        """Return the argument of the module's functions for a parameter, "" for an unused parameter."""
        names = {plain(name): argument for name, argument in parameter_arguments(self.module).items()}
        return names.get(parameter.name, "")

    def _free_values(self, parameters: Values) -> dict[sympy.Symbol, float]:
        generator, values = np.random.default_rng(11), dict[sympy.Symbol, float]()
        for symbol in self.free:
            guess = float(value_at(symbol.guess, parameters))
            values[symbol] = guess * generator.uniform(0.9, 1.1) if guess else generator.uniform(0.1, 0.3)
        return values

    @cached_property
    def durations(self) -> list[float]:
        """The duration of each phase."""
        return [float(value_at(phase.duration, self.constants)) for phase in self.phases]

    @cached_property
    def measured_times(self) -> Array:
        """The times of all measurements of all bodies; empty without measurements."""
        observations = getattr(self.first, "observations", ())
        listed = [observations] if isinstance(observations, Measurements) else observations
        return np.unique([time for one in listed for time in one.data.array[:, 0]])

    def numbers_of(self, body: int) -> dict[sympy.Symbol, float | Array]:
        """Return the values of constants, and the number of the body."""
        return {**self.constants, symbols.body_number(): body}

    @property
    def shifts(self) -> Mapping[sympy.Symbol, Expression]:
        """The values at the end less the values at the start of periodic quantities."""
        written = getattr(self.first, "periodic", ())
        return written if isinstance(written, Mapping) else dict.fromkeys(written, 0)

    def prescribed(self, where: str) -> dict[sympy.Symbol, Expression]:
        """Return the author's values at the "start" or "end", also those that follow for periodic quantities."""
        values = dict(getattr(self.phases[0 if where == "start" else -1], where, {}))
        others = getattr(self.first, "end" if where == "start" else "start", {})
        for symbol, shift in self.shifts.items():
            if symbol in others and symbol not in values:
                values[symbol] = others[symbol] + (shift if where == "end" else -shift)
        return values

    def ends(self, where: str, body: int) -> dict[sympy.Symbol, float]:
        """Return the values of a motion at the "start" or "end": those of the author, moved at random if they may be.

        The sign of a velocity matters only if it is not zero. Values that follow free parameters stay as they are, and
        so do the values of a Hamiltonian problem whose module has velocities.
        """
        numbers, generator = self.numbers_of(body), np.random.default_rng(13 if where == "start" else 17)
        values = {symbol: float(value_at(value, numbers)) for symbol, value in self.prescribed(where).items()}
        if self.is_hamiltonian and self.record.method == Method.VARIATIONAL:
            return values
        may_move = {plain(name) for name in getattr(self.record, where, ())} - {symbol.name for symbol in self.shifts}
        for symbol, value in values.items():
            if symbol.name in may_move:
                values[symbol] = value + generator.uniform(0.02, 0.05) * (abs(value) or self._size(symbol, numbers))
        return values

    def _size(self, symbol: sympy.Symbol, numbers: Values) -> float:
        """Return the largest modulus of a quantity at both ends. If it is zero, return a mean velocity, or 1."""
        pairs = [*self.prescribed("start").items(), *self.prescribed("end").items()]

        def largest(quantity: sympy.Symbol) -> float:
            return max((abs(float(value_at(value, numbers))) for name, value in pairs if name == quantity), default=0.0)

        size = largest(symbol)
        if not size and isinstance(symbol, symbols.Velocity):
            size = largest(symbol.partner) / sum(self.durations)
        return size or 1.0

    def moved_ends(self) -> dict[str, dict[str, Array]]:
        """Return the arguments `start` and `end` of the module's functions: the values of `ends` for all bodies."""
        arguments = dict[str, dict[str, Array]]()
        if self.is_hamiltonian and self.record.method == Method.VARIATIONAL:
            return arguments
        for where in ("start", "end"):
            values = [
                {symbol.name: value for symbol, value in self.ends(where, body).items()}
                for body in range(self.record.bodies)
            ]
            arguments[where] = {
                name: np.array([of_body[plain(name)] for of_body in values])
                for name in getattr(self.record, where)
                if plain(name) in values[0]
            }
        return arguments

    def limits(self, phase: Control | Simulate, symbol: sympy.Symbol, body: int) -> tuple[float, float]:
        """Return lower and upper bound of a quantity in a phase, infinite without a bound."""
        pair = getattr(phase, "bounds", {}).get(symbol, (None, None))
        values = self.numbers_of(body)
        lower, upper = (None if each is None else float(value_at(each, values)) for each in pair)
        return -math.inf if lower is None else lower, math.inf if upper is None else upper

    # ---- Random motions ----

    def motions(self, seed: int, amplitude: float, body: int) -> list[Path]:
        """Return a random motion for each phase, as functions of arrays of times.

        Raise NoMotionError if an expression of the author has no real value along the motion.
        """
        generator = np.random.default_rng([seed, body])
        begin, found, numbers = 0.0, list[Path](), self.numbers_of(body)
        start = self.ends("start", body)
        for index, (phase, length) in enumerate(zip(self.phases, self.durations, strict=True)):
            end = {symbol: float(value_at(value, numbers)) for symbol, value in getattr(phase, "end", {}).items()}
            end = self.ends("end", body) if index == len(self.phases) - 1 else end
            motion = self._motion(phase, begin, length, start, end, generator, amplitude, body)
            t = np.linspace(begin, begin + length, 97)
            values = motion(t).values
            for expression in self.expressions(phase):
                values_along(expression, values, t)
            found.append(motion)
            begin += length
            # The next phase begins with the values after the jump.
            last = {symbol: np.asarray(value)[-1] for symbol, value in motion(t).values.items() if np.ndim(value)}
            moving = [*self.coordinates, *self.rates]
            start = {symbol: float(last[symbol]) for symbol in moving}
            jump = dict(self.jumps[index])
            start |= {symbol: float(value_at(value, {**numbers, **last})) for symbol, value in jump.items()}
        return found

    def expressions(self, phase: Control | Simulate) -> Iterator[Expression]:
        """Yield the expressions that must have real values along a motion."""
        yield from (e for e in (phase.lagrangian, phase.hamiltonian) if e is not None)
        yield from (phase.dynamics or {}).values()
        yield from phase.force.values()
        if isinstance(phase, Control):
            yield self.cost(phase)
            yield from (relation.expression for relation in self.path(phase))

    def cost(self, phase: Control) -> sympy.Expr:
        """Return the integrand that is minimised."""
        return sympy.sympify(phase.cost) - sympy.sympify(phase.maximise)

    def path(self, phase: Control) -> list[Relation]:
        """Return the path conditions, which include bounds of velocities of a Lagrangian."""
        found = list[Relation]()
        for v in self.rates if phase.lagrangian is not None else ():
            lower, upper = phase.bounds.get(v, (None, None))
            if lower is not None and lower != -sympy.oo:
                found.append(Relation(f"{v} >= {lower}", lower - v, False))
            if upper is not None and upper != sympy.oo:
                found.append(Relation(f"{v} <= {upper}", v - upper, False))
        return found + relations_of(phase.path)

    def _motion(
        self,
        phase: Control | Simulate,
        begin: float,
        length: float,
        start: Mapping[sympy.Symbol, float],
        end: Mapping[sympy.Symbol, float],
        generator: np.random.Generator,
        amplitude: float,
        body: int,
    ) -> Path:
        """Return a random motion of a phase with the values `start` and `end`."""
        numbers, curves = self.numbers_of(body), dict[sympy.Symbol, Curve]()
        guesses = getattr(phase, "guess", {})
        guesses = guesses if isinstance(guesses, Mapping) else {}
        for symbol in [*self.coordinates, *(self.rates if self.is_hamiltonian else ()), *self.controls]:
            rate = symbol.partner if isinstance(symbol, symbols.Coordinate) and not self.is_hamiltonian else None
            guess = guesses.get(symbol)
            is_formula = isinstance(guess, (int, float, sympy.Expr))
            base = _guess(sympy.sympify(guess), self.time, numbers) if is_formula else None
            limits = self.limits(phase, symbol, body)
            ends = start.get(symbol), end.get(symbol), start.get(rate), end.get(rate)
            curves[symbol] = _curve(begin, length, base, ends, limits, amplitude, generator)

        def motion(t: Array) -> Motion:
            values: dict[sympy.Symbol, float | Array] = {**numbers, self.time: t}
            slopes = dict[sympy.Symbol, Array]()
            for symbol, curve in curves.items():
                values[symbol], slopes[symbol] = curve(t)
            if self.rates and not self.is_hamiltonian:
                values |= {q.partner: slopes[q] for q in self.coordinates}
            return Motion(t, values, slopes)

        if self.is_hamiltonian and self.record.method == Method.VARIATIONAL:
            return self._with_conjugate_momenta(phase, motion)
        return motion

    def _with_conjugate_momenta(self, phase: Control | Simulate, motion: Path) -> Path:
        """Return a motion whose momenta solve q' = dH/dp, by Newton's method at each time."""
        slopes = [sympy.diff(phase.hamiltonian, p) for p in self.rates]
        matrix = [[sympy.diff(slope, p) for p in self.rates] for slope in slopes]

        def conjugate(t: Array) -> Motion:
            found = motion(t)
            values, wanted = dict(found.values), np.array([found.slopes[q] for q in self.coordinates])
            for _ in range(_NEWTON_STEPS):
                error = np.array([values_along(slope, values, t) for slope in slopes]) - wanted
                curvature = np.array([[values_along(entry, values, t) for entry in row] for row in matrix])
                try:
                    change = np.linalg.solve(curvature.transpose(2, 0, 1), error.T[..., None])[..., 0].T
                except np.linalg.LinAlgError:
                    raise NoMotionError("velocities do not determine the momenta of the Hamiltonian") from None
                for p, step in zip(self.rates, change, strict=True):
                    values[p] = values[p] - step
                if np.abs(change).max() <= 1e-13 * max(1.0, *(np.abs(values[p]).max() for p in self.rates)):
                    return Motion(t, values, found.slopes)
            raise NoMotionError("velocities do not determine the momenta of the Hamiltonian")

        return conjugate

    def momenta(self, phase: Control | Simulate, values: Values, t: Array) -> dict[sympy.Symbol, Array]:
        """Return the momenta by coordinate: those of a Hamiltonian, or the derivatives of the Lagrangian."""
        if self.is_hamiltonian:
            return {q: np.asarray(values[q.partner]) for q in self.coordinates}
        slopes = {q: sympy.diff(phase.lagrangian, q.partner) for q in self.coordinates}
        return {q: values_along(slope, values, t) for q, slope in slopes.items()}


def _guess(expression: sympy.Expr, time: sympy.Symbol, numbers: Values) -> Curve | None:
    """Return value and derivative of an author's guess as a function of time; None for other guesses than formulas."""
    if expression.free_symbols - {time, *numbers}:
        return None
    slope = sympy.diff(expression, time)

    def values(t: Array) -> tuple[Array, Array]:
        at = {**numbers, time: t}
        return values_along(expression, at, t), values_along(slope, at, t)

    return values


def _curve(
    begin: float,
    length: float,
    base: Curve | None,
    ends: tuple[float | None, float | None, float | None, float | None],
    limits: tuple[float, float],
    amplitude: float,
    generator: np.random.Generator,
) -> Curve:
    """Return a random smooth function on [begin, begin + length]: a base, a cubic polynomial, and oscillations.

    `ends` are its values and slopes at both ends, where None means any value. Without a base the function oscillates
    about a line. With s = (t - begin)/length the oscillations are factors of sin(j pi s) s^2 (1 - s)^2.
    """
    first, last, first_slope, last_slope = ends
    lower, upper = limits
    is_bounded = math.isfinite(lower) and math.isfinite(upper)
    if base is None:
        middle = (lower + upper) / 2 if is_bounded else 0.0
        a = first if first is not None else last if last is not None else middle
        b = last if last is not None else a

        def base(t: Array) -> tuple[Array, Array]:
            return a + (b - a) * (t - begin) / length, np.full(t.shape, (b - a) / length)

    value, slope = base(np.linspace(begin, begin + length, 33))
    numbers = [abs(float(x)) for x in (*value, *(x for x in (first, last) if x is not None))]
    size = max(np.ptp(value), max(numbers), (upper - lower) / 4 if is_bounded else 0.0) or 1.0
    draw = generator.uniform(0.3, 1.0, 4) * generator.choice((-1.0, 1.0), 4) * amplitude * size
    # Changes of the base at both ends, of values and of slopes by s.
    c0 = first - value[0] if first is not None else draw[0]
    c1 = last - value[-1] if last is not None else draw[1]
    d0 = (first_slope - slope[0]) * length if first_slope is not None else draw[2]
    d1 = (last_slope - slope[-1]) * length if last_slope is not None else draw[3]
    cubic = np.array([2 * (c0 - c1) + d0 + d1, 3 * (c1 - c0) - 2 * d0 - d1, d0, c0])
    waves = 8.0 * amplitude * size * generator.uniform(0.3, 1.0, 2) * generator.choice((-1.0, 1.0), 2)

    def curve(t: Array) -> tuple[Array, Array]:
        s = (t - begin) / length
        value, slope = base(t)
        bump, change = s**2 * (1 - s) ** 2, 2 * s * (1 - s) * (1 - 2 * s)
        total, rate = np.polyval(cubic, s), np.polyval(np.polyder(cubic), s)
        for j, factor in enumerate(waves, start=1):
            total = total + factor * bump * np.sin(j * math.pi * s)
            rate = rate + factor * (change * np.sin(j * math.pi * s) + bump * j * math.pi * np.cos(j * math.pi * s))
        return value + total, slope + rate / length

    return curve
