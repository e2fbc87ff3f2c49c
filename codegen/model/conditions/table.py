"""The table of kinds of conditions, in the order in which they are read and told."""

from __future__ import annotations

from codegen.model.conditions.base import Kind
from codegen.model.conditions.ends import AtEnd, AtStart
from codegen.model.conditions.holonomic import Holonomic
from codegen.model.conditions.inner import AtTimes, Waypoints
from codegen.model.conditions.integral import Integrals
from codegen.model.conditions.observations import Observations
from codegen.model.conditions.path import Path
from codegen.model.conditions.periodic import Periodic

CONDITIONS: tuple[Kind, ...] = (
    Path(),
    Holonomic(),
    Integrals(),
    AtTimes(),
    Waypoints(),
    AtStart(),
    AtEnd(),
    Periodic(),
    Observations(),
)
"""What holds for a motion, each kind by the argument of `Control` that gives it."""
