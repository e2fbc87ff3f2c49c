"""The table of kinds of conditions, in the order in which they are read and told."""

from __future__ import annotations

from codegen.model.conditions.base import Kind
from codegen.model.conditions.ends import AtEnd, AtStart
from codegen.model.conditions.holonomic import Holonomic
from codegen.model.conditions.integral import Integrals
from codegen.model.conditions.path import Path
from codegen.model.conditions.periodic import Periodic

CONDITIONS: tuple[Kind, ...] = (Path(), Holonomic(), Integrals(), AtStart(), AtEnd(), Periodic())
"""What holds for a motion, each kind by the argument of `Control` that gives it."""
