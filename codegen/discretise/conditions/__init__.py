"""The table of kinds of conditions, in the order in which they are read and reported."""

from __future__ import annotations

from codegen.discretise.conditions.base import ConditionKind
from codegen.discretise.conditions.ends import AtEnd, AtStart
from codegen.discretise.conditions.holonomic import Holonomic
from codegen.discretise.conditions.inner_times import AtTimes, Waypoints
from codegen.discretise.conditions.integral import Integrals
from codegen.discretise.conditions.measurements import Observations
from codegen.discretise.conditions.path import Path
from codegen.discretise.conditions.periodic import PeriodicKind
from codegen.discretise.conditions.rolling import Rolling
from codegen.discretise.conditions.unilateral import Unilateral

SIMULATED: tuple[Holonomic | Rolling, ...] = (Holonomic(), Rolling())
"""The kinds of conditions that simulations have."""

CONDITIONS: tuple[ConditionKind, ...] = (
    Path(),
    *SIMULATED,
    Unilateral(),
    Integrals(),
    AtTimes(),
    Waypoints(),
    AtStart(),
    AtEnd(),
    PeriodicKind(),
    Observations(),
)
"""The kinds of conditions on a motion, one for each argument of `Control` with conditions."""
