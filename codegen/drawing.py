"""What an author may draw of a system: rods, masses, boxes, arrows, trails, circles, marks and ground.

A problem's `drawing` is a list of these. Every number may be an expression of coordinates (or states), controls,
parameters, time and the body's number; a motion in space is drawn by projecting it onto the plane. Lengths are those
of the problem. The optional `label` names an item in legends. Nothing here needs sympy: the same classes hold arrays
(bodies, times) instead of expressions once a motion is known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Expression = Any
"""A sympy expression or a number; in a scene an array (bodies, times)."""

Point: TypeAlias = tuple[Expression, Expression]
"""A place or a vector in the plane."""

_Item = TypeVar("_Item", bound="Item")


@dataclass(frozen=True)
class Item:
    """Something to be drawn, once for each body if it depends on the body."""

    label: str = field(default="", kw_only=True)

    def parts(self) -> Iterator[tuple[str, Any]]:
        """The names and values of all that is no label: points and single expressions."""
        return ((part.name, getattr(self, part.name)) for part in fields(self) if part.name != "label")

    def expressions(self) -> Iterator[tuple[str, Expression]]:
        """Every single expression, with the name of its part."""
        for name, value in self.parts():
            yield from ((name, part) for part in (value if isinstance(value, tuple) else (value,)))

    def mapped(self: _Item, function: Callable[[Expression], Any]) -> _Item:
        """The same item with every expression replaced by a function of it."""
        changes: dict[str, Any] = {
            name: tuple(map(function, value)) if isinstance(value, tuple) else function(value)
            for name, value in self.parts()
        }
        return replace(self, **changes)


@dataclass(frozen=True)
class Rod(Item):
    """A straight link, a rope or a lever between two points."""

    start: Point
    end: Point


@dataclass(frozen=True)
class Mass(Item):
    """A round body."""

    centre: Point
    radius: Expression


@dataclass(frozen=True)
class Box(Item):
    """A rectangle, turned by an angle in radians about its centre."""

    centre: Point
    width: Expression
    height: Expression
    angle: Expression = 0


@dataclass(frozen=True)
class Arrow(Item):
    """A force, a velocity or a heading: a vector that starts at a point."""

    start: Point
    vector: Point


@dataclass(frozen=True)
class Trail(Item):
    """The path that a point leaves behind."""

    point: Point


@dataclass(frozen=True)
class Circle(Item):
    """A dashed circle: an orbit, a reach or a target."""

    centre: Point
    radius: Expression


@dataclass(frozen=True)
class Mark(Item):
    """A place of interest: a pivot or a target."""

    place: Point


@dataclass(frozen=True)
class Ground(Item):
    """A straight line that nothing passes, hatched to its right when one looks from start to end."""

    start: Point
    end: Point


ITEMS = (Rod, Mass, Box, Arrow, Trail, Circle, Mark, Ground)
"""Every kind of item; tests run over this table."""


@dataclass(frozen=True)
class Scene:
    """A drawing at given times: items of arrays (bodies, times), with one entry where an item depends on neither."""

    t: NDArray[np.float64]
    items: tuple[Item, ...]
