"""The statuses that a case of a sweep may end with: those of solves, and those that only a sweep has."""

from __future__ import annotations

from codegen.engines.tally import LOST
from codegen.solutions.result import STATUSES

UNUSABLE, NOT_BUILT = "unusable", "not built"
OF_SWEEPS = {
    UNUSABLE: "a number of the case cannot be used, as a duration that is negative",
    NOT_BUILT: "the module of the case could not be derived",
    LOST: "process after process ended while it solved the case's chunk",
}
"""Statuses that single solves do not have: there they are errors."""
MEANINGS = {**STATUSES, **OF_SWEEPS}
