"""Units that an author gives: what follows from them, and whether they agree.

Where every quantity of an expression has a unit, the expression has one, by pint: terms must agree in dimension and in
size, so that metres beside kilometres are refused like metres beside seconds, and functions such as sin take pure
numbers. An angle has none, and a degree is no radian. Where a unit is missing nothing is said, and nothing refused.
Numbers are taken as pure numbers in dynamics, forces and costs; values, bounds and sides of relations may be plain
numbers, which count in the units of what they are compared with.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from tokenize import TokenError
from typing import Any

import sympy

from codegen.discretise.model.relations import Entry
from codegen.errors import UnitError, clause
from codegen.identifiers import written_unit
from codegen.problem.symbols import Coordinate, Delayed, EndValue, Quantity, Time, Velocity

_EQUAL = 1e-9
"""Factors between units that differ from one by less are one; pint rounds."""
_SECONDS = "s"
"""The unit of the time where no symbol of time has another one."""
_KEPT = (sympy.Abs, sympy.Min, sympy.Max, sympy.Piecewise)
_NUMBERS = "write a number that has a unit as a parameter, as in parameters(g=(9.81, 'm/s**2'))"
_VALUES = frozenset(
    {"start", "end", "guess", "first guess", "lower bound", "upper bound", "history", "jump", "scale", "duration"}
)
_OF_TIME_AND_ANGLE: tuple[dict[str, int], ...] = ({}, {"[time]": 1})
_DYNAMICS = frozenset({"lagrangian", "hamiltonian", "dynamics", "force", "cost", "terminal_cost"})


@cache
def _registry() -> Any:
    """The units of pint, which takes a while to import."""
    import pint

    return pint.UnitRegistry()


def checked_unit(text: str, name: str) -> Any:
    """The unit that a text names; UnitError for one that is unknown, or whose zero is none, as degrees Celsius."""
    import pint

    registry = _registry()
    try:
        unit = registry.Unit("dimensionless" if text.strip() in ("", "1") else text)
    except (pint.errors.PintError, TokenError, ValueError, TypeError, AttributeError, AssertionError) as error:
        raise UnitError(
            clause(f"the unit {text!r} of {name} is unknown ({error})"), "write one that pint knows, as in kg*m/s**2"
        ) from None
    if registry.Quantity(0.0, unit).to_base_units().magnitude != 0.0:
        raise UnitError(f"the unit {text!r} of {name} does not begin at zero", "give K or delta_degC")
    return unit


def units_of(
    quantities: Sequence[Quantity], entries: Iterable[Entry], plain: Mapping[Quantity, sympy.Symbol]
) -> tuple[tuple[str, str], ...]:
    """Pairs of a name and the text of its unit, in the author's order; then `t`, `cost` and `energy` where they follow.

    Nothing where no quantity has a unit. Raises UnitError for units that do not agree.
    """
    if not any(hasattr(symbol, "unit") for symbol in quantities):
        return ()
    found = _Found(quantities)
    entries = list(entries)
    for entry in entries:
        found.look_at(entry)
    own = [symbol for symbol in quantities if not isinstance(symbol, (Time, EndValue, Delayed))]
    pairs = [
        (plain[symbol].name, written_unit(symbol.unit) if hasattr(symbol, "unit") else _text(found.unit(symbol)))
        for symbol in own
    ]
    pairs += [("t", _text(found.time)), *((name, _text(unit)) for name, unit in found.others())]
    return tuple((name, text) for name, text in pairs if text)


class _Found:
    """Units by quantities, and of what is integrated; all of one problem."""

    def __init__(self, quantities: Sequence[Quantity]) -> None:
        self.time: Any = None
        self.units: dict[Quantity, Any] = {}
        for symbol in quantities:
            if isinstance(symbol, Time):
                self.time = checked_unit(getattr(symbol, "unit", _SECONDS), symbol.name)
        self.time = checked_unit(_SECONDS, "the time") if self.time is None else self.time
        for symbol in quantities:
            if hasattr(symbol, "unit"):
                self.units[symbol] = checked_unit(symbol.unit, symbol.name)
        self.energy: Any = None
        self.running: Any = None
        self.terminal: Any = None
        self.coordinates = [symbol for symbol in quantities if isinstance(symbol, Coordinate)]

    def unit(self, symbol: sympy.Symbol) -> Any:
        """The unit of a quantity, as it was given or as it follows; None where nothing tells."""
        if isinstance(symbol, Time):
            return self.time
        if isinstance(symbol, (EndValue, Delayed)):
            return self.unit(symbol.partner)
        if symbol not in self.units and isinstance(symbol, Velocity):
            own = self.units.get(symbol.partner)
            return None if own is None else own / self.time
        return self.units.get(symbol)

    def look_at(self, entry: Entry) -> None:
        """Check an entry, and note what it says of the energy and of the cost."""
        is_strict = entry.role in _DYNAMICS
        unit = self._of(entry.expression, entry.what, is_strict)
        if entry.role in ("lagrangian", "hamiltonian"):
            self.energy = unit
        elif entry.role == "cost":
            self.running = unit
        elif entry.role == "terminal_cost":
            self.terminal = unit
        else:
            self._compare(entry, unit)
        if self.running is not None and self.terminal is not None:
            whole = self.running * self.time
            _require_same(whole, self.terminal, "the integral of the cost", "the terminal cost")

    def _compare(self, entry: Entry, unit: Any) -> None:
        """Refuse a value in other units than those of what it is the value of."""
        key = self.time if entry.role == "duration" else self.unit(entry.key) if entry.key is not None else None
        if entry.role == "force" and key is not None and self.energy is not None:
            key = self.energy / key
        elif entry.role == "dynamics" and key is not None:
            key = key / self.time
        elif entry.role not in _VALUES:
            return
        if unit is None or key is None or entry.expression.is_number:
            return
        _require_same(unit, key, entry.what, _wanted(entry))

    def others(self) -> list[tuple[str, Any]]:
        """Units of momenta, of the energy and of the cost, as far as they follow."""
        found = []
        if self.energy is not None:
            of_pairs = [q for q in self.coordinates if isinstance(getattr(q, "partner", None), Velocity)]
            rates = [(q, self.unit(q.partner)) for q in of_pairs]
            found += [(f"p_{q.name}", self.energy / rate) for q, rate in rates if rate is not None]
            found.append(("energy", self.energy))
        cost = self.running * self.time if self.running is not None else self.terminal
        return [*found, *([("cost", cost)] if cost is not None else [])]

    def _of(self, expression: sympy.Expr, where: str, is_strict: bool) -> Any:
        """The unit of an expression; None where a part has none that is known."""
        if isinstance(expression, sympy.Symbol):
            return self.unit(expression)
        if expression.is_number:
            return None if expression.is_zero else _registry().Unit("dimensionless")
        if isinstance(expression, sympy.Add):
            return self._sum(expression.args, where, is_strict)
        parts = [self._of(part, where, True) for part in expression.args]
        if isinstance(expression, sympy.Mul):
            return None if any(part is None for part in parts) else _product(parts)
        if isinstance(expression, sympy.Pow):
            return self._power(expression, parts[0], parts[1], where)
        if isinstance(expression, _KEPT[:3]):
            return self._sum(expression.args, where, is_strict)
        if isinstance(expression, sympy.Function) and type(expression).__module__.startswith("sympy."):
            return self._function(expression, parts, where)
        return None  # tables and values of bodies say nothing of their units

    def _sum(self, terms: Sequence[sympy.Expr], where: str, is_strict: bool) -> Any:
        """The unit that all terms have."""
        counted = terms if is_strict else [term for term in terms if not term.is_number]
        units = [self._of(term, where, True) for term in counted]
        known = [(term, unit) for term, unit in zip(counted, units, strict=True) if unit is not None]
        for term, unit in known[1:]:
            _require_same(unit, known[0][1], f"{where}: {term}", str(known[0][0]))
        return known[0][1] if known and len(known) == len(counted) else None

    def _power(self, expression: sympy.Pow, base: Any, exponent: Any, where: str) -> Any:
        if exponent is not None:
            _require_pure(exponent, f"the exponent of {expression}", where)
        if base is None:
            return None
        if expression.exp.is_number:
            return base ** float(expression.exp)
        _require_pure(base, f"the base of {expression}", where)
        return base

    def _function(self, expression: sympy.Function, parts: Sequence[Any], where: str) -> Any:
        if isinstance(expression, sympy.atan2):
            self._sum(expression.args, where, True)
            return _registry().Unit("dimensionless")
        for part, unit in zip(expression.args, parts, strict=True):
            if unit is not None:
                _require_pure(unit, f"{part} in {expression.func.__name__}", where)
        return _registry().Unit("dimensionless")


def _wanted(entry: Entry) -> str:
    """What the units of an entry are compared with."""
    if entry.role == "duration":
        return "the time"
    if entry.role == "force":
        return f"the Lagrangian by {entry.key}"
    return f"the rate of {entry.key}" if entry.role == "dynamics" else str(entry.key)


def _product(units: Sequence[Any]) -> Any:
    product = units[0]
    for unit in units[1:]:
        product = product * unit
    return product


def _ratio(unit: Any, other: Any) -> Any:
    return (1.0 * (unit / other)).to_base_units()


def _require_same(unit: Any, other: Any, what: str, beside: str) -> None:
    ratio = _ratio(unit, other)
    if not ratio.dimensionless or abs(ratio.magnitude - 1.0) > _EQUAL:
        finding = f"{what} is in {_text(unit) or 'pure numbers'}, {beside} in {_text(other) or 'pure numbers'}"
        raise UnitError(clause(finding), f"let units agree, and {_NUMBERS}")


def _require_pure(unit: Any, what: str, where: str) -> None:
    ratio = (1.0 * unit).to_base_units()
    if not ratio.dimensionless or abs(ratio.magnitude - 1.0) > _EQUAL:
        raise UnitError(clause(f"{where}: {what} is in {_text(unit)}"), f"let it have no dimension, and {_NUMBERS}")


def _text(unit: Any) -> str:
    """A unit as it stands on axes, such as kg·m²/s; radians beside others are left out, and newtons are named."""
    if unit is None:
        return ""
    registry = _registry()
    # A rate of an angle keeps its radian, a moment of inertia loses it.
    powers = dict(registry.Quantity(1.0, unit).unit_items())
    if powers.get("radian", 0) and not all(registry.Unit(name).dimensionality in _OF_TIME_AND_ANGLE for name in powers):
        unit = unit / registry.Unit("radian") ** powers["radian"]
    for name in ("joule", "newton", "watt"):
        ratio = _ratio(unit, registry.Unit(name))
        if ratio.dimensionless and abs(ratio.magnitude - 1.0) <= _EQUAL:
            return f"{registry.Unit(name):~P}"
    return f"{unit:~P}"
