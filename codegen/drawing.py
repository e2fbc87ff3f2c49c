"""Items of the drawing of a system: rods, masses, boxes, arrows, trails, circles, marks and ground.

The `drawing` of a problem is a list of items. Every number of an item may be an expression of coordinates (or states),
controls, parameters, time and the number of the body. Lengths have the unit of the problem. A point in space (x, y, z)
is projected onto a plane: z points upwards, x to the right, and y away from the viewer. The optional `label` names an
item in legends. In a Scene the same classes have arrays (bodies, times) in place of expressions. This module does not
import sympy.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from math import cos, radians, sin
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ExpressionError

Expression = Any
"""A sympy expression or a number; in a scene an array (bodies, times)."""

Point: TypeAlias = tuple[Expression, Expression]
"""A position or a vector in the plane; items also take those in space, three expressions or a matrix (3, 1)."""

AZIMUTH, ELEVATION = radians(-60), radians(20)
"""The direction from which positions in space are seen."""

_Item = TypeVar("_Item", bound="Item")


class _Kind(type):
    """The metaclass of items: a call with a wrong argument raises an error that lists the valid arguments."""

    def __call__(cls, *values: Any, **named: Any) -> Any:
        signature = inspect.signature(vars(cls)["__init__"])
        try:
            signature.bind(None, *values, **named)
        except TypeError as error:
            own = [p.replace(annotation=p.empty) for p in list(signature.parameters.values())[1:]]
            points = [part.name for part in fields(cls) if part.type == "Point"]  # type: ignore[arg-type]
            raise ExpressionError(
                f"{cls.__name__}(...) in the drawing: {error}",
                f"write {cls.__name__}{inspect.Signature(own)} with (x, y) or (x, y, z) as {' and as '.join(points)}",
            ) from None
        item = super().__call__(*values, **named)
        for part in fields(item):
            if part.type == "Point":
                object.__setattr__(item, part.name, _projected(getattr(item, part.name)))
        return item


def _projected(point: Any) -> Any:
    """Return a point of three coordinates in the plane of the drawing, and any other value unchanged."""
    try:
        x, y, z = point
    except (TypeError, ValueError):
        return point
    right = -sin(AZIMUTH) * x + cos(AZIMUTH) * y
    return right, cos(ELEVATION) * z - sin(ELEVATION) * (cos(AZIMUTH) * x + sin(AZIMUTH) * y)


@dataclass(frozen=True)
class Item(metaclass=_Kind):
    """The base class of items of a drawing; an item that depends on the body is drawn for each body."""

    label: str = field(default="", kw_only=True)

    def parts(self) -> Iterator[tuple[str, Expression | Point]]:
        """Yield the names and values of all fields except the label; values are points or single expressions."""
        return ((part.name, getattr(self, part.name)) for part in fields(self) if part.name != "label")

    def expressions(self) -> Iterator[tuple[str, Expression]]:
        """Yield the name of the field and the expression for every expression of the item; a point has two."""
        for name, value in self.parts():
            yield from ((name, part) for part in (value if isinstance(value, tuple) else (value,)))

    def mapped(self: _Item, function: Callable[[Expression], Expression]) -> _Item:
        """Return a copy of the item in which every expression is replaced by `function(expression)`."""
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
    """A rectangle that is rotated about its centre by `angle` in radians."""

    centre: Point
    width: Expression
    height: Expression
    angle: Expression = 0


@dataclass(frozen=True)
class Arrow(Item):
    """An arrow from the point `start` for a vector, such as a force, a velocity or a heading."""

    start: Point
    vector: Point


@dataclass(frozen=True)
class Trail(Item):
    """The path of a moving point."""

    point: Point


@dataclass(frozen=True)
class Circle(Item):
    """A dashed circle: an orbit, a reach or a target."""

    centre: Point
    radius: Expression


@dataclass(frozen=True)
class Mark(Item):
    """A position of interest: a pivot or a target."""

    place: Point


@dataclass(frozen=True)
class Ground(Item):
    """A straight line that represents the ground or a wall, hatched on its right side seen from start to end."""

    start: Point
    end: Point


ITEMS = (Rod, Mass, Box, Arrow, Trail, Circle, Mark, Ground)
"""All kinds of items; tests run over this table."""


@dataclass(frozen=True)
class Scene:
    """A drawing at the times `t`, whose items have arrays in place of expressions.

    The arrays have the shape (bodies, times). An axis has length 1 if the expression does not depend on it.
    """

    t: NDArray[np.float64]
    items: tuple[Item, ...]
