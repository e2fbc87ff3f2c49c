"""The units of the author's quantities: check that they agree, and derive the units of other quantities.

Where every quantity of an expression has a unit, pint gives the unit of the expression. Terms must agree in dimension
and in size: metres and kilometres in one sum are an error like metres and seconds. The arguments of functions such as
sin are pure numbers. An angle is a pure number in radians, with which degrees do not agree. An expression with a
quantity without a unit has no unit and is accepted. Numbers in dynamics, forces and costs are pure numbers. Values,
bounds and sides of relations may be plain numbers: they have the unit of the quantity with which they are compared.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from tokenize import TokenError
from typing import TYPE_CHECKING

import sympy

from codegen.discretise.model.relations import Entry
from codegen.errors import UnitError, clause
from codegen.identifiers import written_unit
from codegen.problem.symbols import Coordinate, Delayed, EndValue, Quantity, Time, Velocity

if TYPE_CHECKING:
    from pint import Quantity as Measure
    from pint import UnitRegistry
    from pint.facets.plain import PlainUnit as Unit

_EQUAL = 1e-9
"""Tolerance for rounding errors of pint in the ratio of two equal units."""
_SECONDS = "s"
"""The default unit of the time."""
_UNIT_OF_ARGUMENTS = (sympy.Abs, sympy.Min, sympy.Max)
_NUMBERS = "write a number that has a unit as a parameter, as in parameters(g=(9.81, 'm/s**2'))"
_VALUES = frozenset(
    {"start", "end", "guess", "first guess", "lower bound", "upper bound", "history", "jump", "scale", "duration"}
)
_TIME_AND_ANGLE: tuple[dict[str, int], ...] = ({}, {"[time]": 1})
_DYNAMICS = frozenset({"lagrangian", "hamiltonian", "dynamics", "force", "cost", "terminal_cost"})


@cache
def _registry() -> UnitRegistry[float]:
    """Return the unit registry of pint, made only when needed because the import is slow."""
    import pint

    return pint.UnitRegistry()


def checked_unit(text: str, name: str) -> Unit:
    """Return the unit that a text names; raise UnitError if it is unknown or has an offset, like degrees Celsius."""
    import pint

    registry = _registry()
    try:
        unit = registry.Unit("dimensionless" if text.strip() in ("", "1") else text)
    except (pint.errors.PintError, TokenError, ValueError, TypeError, AttributeError, AssertionError) as error:
        remedy = "write one that pint knows, as in kg*m/s**2"
        if similar := difflib.get_close_matches(text, dir(registry), cutoff=0.8):
            remedy = f"perhaps it is {' or '.join(similar)}; {remedy}"
        raise UnitError(clause(f"the unit {text!r} of {name} is unknown ({error})"), remedy) from None
    if registry.Quantity(0.0, unit).to_base_units().magnitude != 0.0:
        raise UnitError(f"the unit {text!r} of {name} does not begin at zero", "give K or delta_degC")
    return unit


def units_of(
    quantities: Sequence[Quantity], entries: Iterable[Entry], plain: Mapping[Quantity, sympy.Symbol]
) -> tuple[tuple[str, str], ...]:
    """Return pairs (name, text of its unit) in the author's order, then for `t`, momenta, `energy` and `cost`.

    The result is empty if no quantity has a unit. Raises UnitError for units that do not agree.
    """
    if not any(hasattr(symbol, "unit") for symbol in quantities):
        return ()
    units = _Units(quantities)
    for entry in entries:
        units.read(entry)
    pairs = [
        (plain[symbol].name, written_unit(symbol.unit) if hasattr(symbol, "unit") else _text(units.unit(symbol)))
        for symbol in quantities
        if not isinstance(symbol, (Time, EndValue, Delayed))
    ]
    pairs.append(("t", _text(units.time)))
    if (energy := units.energy) is not None:
        for q in quantities:
            if isinstance(q, Coordinate) and isinstance(q.partner, Velocity):
                rate = units.unit(q.partner)
                pairs += [(f"p_{q.name}", _text(energy / rate))] if rate is not None else []
        pairs.append(("energy", _text(energy)))
    pairs.append(("cost", _text(units.running * units.time if units.running is not None else units.terminal)))
    return tuple((name, text) for name, text in pairs if text)


class _Units:
    """The units of the quantities of one problem, of its energy, and of its running and terminal cost."""

    def __init__(self, quantities: Sequence[Quantity]) -> None:
        times = [symbol for symbol in quantities if isinstance(symbol, Time)]
        self.time: Unit = checked_unit(_SECONDS, "the time")
        for symbol in times:
            self.time = checked_unit(getattr(symbol, "unit", _SECONDS), symbol.name)
        self.units = {s: checked_unit(s.unit, s.name) for s in quantities if hasattr(s, "unit")}
        self.energy: Unit | None = None
        self.running: Unit | None = None
        self.terminal: Unit | None = None

    def unit(self, symbol: sympy.Symbol) -> Unit | None:
        """Return the author's unit of a quantity, or the unit that follows from other quantities, or None."""
        if isinstance(symbol, Time):
            return self.time
        if isinstance(symbol, (EndValue, Delayed)):
            return self.unit(symbol.partner)
        if symbol not in self.units and isinstance(symbol, Velocity):
            unit = self.units.get(symbol.partner)
            return None if unit is None else unit / self.time
        return self.units.get(symbol)

    def read(self, entry: Entry) -> None:
        """Check the units of an entry, and store the unit of the energy or of the cost if the entry defines it."""
        unit = self._of(entry.expression, entry.what, entry.role in _DYNAMICS)
        if entry.role in ("lagrangian", "hamiltonian"):
            self.energy = unit
        elif entry.role == "cost":
            self.running = unit
        elif entry.role == "terminal_cost":
            self.terminal = unit
        else:
            # A value has the unit of its quantity, unless it is a plain number.
            key, described = (self.unit(entry.key) if entry.key is not None else None), str(entry.key)
            if entry.role == "duration":
                key, described = self.time, "the time"
            elif entry.role == "force" and key is not None and self.energy is not None:
                key, described = self.energy / key, f"the Lagrangian by {entry.key}"
            elif entry.role == "dynamics" and key is not None:
                key, described = key / self.time, f"the rate of {entry.key}"
            elif entry.role not in _VALUES:
                key = None
            if unit is not None and key is not None and not entry.expression.is_number:
                _require_same(unit, key, entry.what, described)
        if self.running is not None and self.terminal is not None:
            whole = self.running * self.time
            _require_same(whole, self.terminal, "the integral of the cost", "the terminal cost")

    def _of(self, expression: sympy.Expr, where: str, is_strict: bool) -> Unit | None:
        """Return the unit of an expression, None if a part has no unit; `is_strict` counts the numbers in a sum."""
        if isinstance(expression, sympy.Symbol):
            return self.unit(expression)
        if expression.is_number:
            return None if expression.is_zero else _registry().Unit("dimensionless")
        if isinstance(expression, sympy.Add):
            return self._sum(expression.args, where, is_strict)
        parts = [self._of(part, where, True) for part in expression.args]
        if isinstance(expression, sympy.Mul):
            factors = [part for part in parts if part is not None]
            return math.prod(factors[1:], start=factors[0]) if len(factors) == len(parts) else None
        if isinstance(expression, sympy.Pow):
            base, exponent = parts
            if exponent is not None:
                _require_pure(exponent, f"the exponent of {expression}", where)
            if base is None or not expression.exp.is_number:
                if base is not None:
                    _require_pure(base, f"the base of {expression}", where)
                return base
            return base ** float(expression.exp)
        if isinstance(expression, _UNIT_OF_ARGUMENTS):
            return self._sum(expression.args, where, is_strict)
        if isinstance(expression, sympy.Function) and type(expression).__module__.startswith("sympy."):
            if isinstance(expression, sympy.atan2):
                self._sum(expression.args, where, True)
                return _registry().Unit("dimensionless")
            for part, unit in zip(expression.args, parts, strict=True):
                if unit is not None:
                    _require_pure(unit, f"{part} in {expression.func.__name__}", where)
            return _registry().Unit("dimensionless")
        return None  # tables and values of bodies have no units

    def _sum(self, terms: Sequence[sympy.Expr], where: str, is_strict: bool) -> Unit | None:
        """Return the common unit of all terms, None if a term has no unit; `is_strict` counts numbers as terms."""
        counted = terms if is_strict else [term for term in terms if not term.is_number]
        units = [self._of(term, where, True) for term in counted]
        present = [(term, unit) for term, unit in zip(counted, units, strict=True) if unit is not None]
        for term, unit in present[1:]:
            _require_same(unit, present[0][1], f"{where}: {term}", str(present[0][0]))
        return present[0][1] if present and len(present) == len(counted) else None


def _ratio(unit: Unit, other: Unit) -> Measure[float]:
    ratio: Measure[float] = (1.0 * (unit / other)).to_base_units()
    return ratio


def _require_same(unit: Unit, other: Unit, what: str, partner: str) -> None:
    ratio = _ratio(unit, other)
    if not ratio.dimensionless or abs(ratio.magnitude - 1.0) > _EQUAL:
        finding = f"{what} is in {_text(unit) or 'pure numbers'}, {partner} in {_text(other) or 'pure numbers'}"
        raise UnitError(clause(finding), f"let units agree, and {_NUMBERS}")


def _require_pure(unit: Unit, what: str, where: str) -> None:
    ratio = (1.0 * unit).to_base_units()
    if not ratio.dimensionless or abs(ratio.magnitude - 1.0) > _EQUAL:
        raise UnitError(clause(f"{where}: {what} is in {_text(unit)}"), f"let it have no dimension, and {_NUMBERS}")


def _text(unit: Unit | None) -> str:
    """Return the text of a unit for axes, such as kg·m²/s, J, N or W; mechanical units have no radians."""
    if unit is None:
        return ""
    registry = _registry()
    # The rate of an angle keeps the radian in its unit, a moment of inertia does not.
    powers = dict(registry.Quantity(1.0, unit).unit_items())
    if powers.get("radian", 0) and not all(registry.Unit(name).dimensionality in _TIME_AND_ANGLE for name in powers):
        unit = unit / registry.Unit("radian") ** powers["radian"]
    for name in ("joule", "newton", "watt"):
        ratio = _ratio(unit, registry.Unit(name))
        if ratio.dimensionless and abs(ratio.magnitude - 1.0) <= _EQUAL:
            return f"{registry.Unit(name):~P}"
    return f"{unit:~P}"
