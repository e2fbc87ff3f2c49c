"""Emitted values against exact ones: the largest relative error, and where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mpmath

from codegen.checks.base import Finding
from codegen.checks.evaluation import NOTHING

TOLERANCE = 1e-10
_ROUNDING = 1e-13


@dataclass
class Agreement:
    """The largest relative error seen so far, the name of its entry, and how many entries were compared."""

    check: str = "derivatives"
    error: float = 0.0
    name: str = ""
    entries: int = 0

    def compare(self, names: Sequence[str], emitted: Any, exact: Sequence[Any]) -> None:
        """Errors count relative to the entry, above the rounding of the largest entry beside it.

        An entry that vanishes beside the others has no digits to agree with: its error counts relative to the largest.
        Terms that cancel in it leave their rounding: up to 1.4e-11 of the largest in the interior angles of 4 to 7
        hovercraft.
        """
        assert len(names) == len(emitted) == len(exact)
        largest = max((abs(value) for value in exact), default=0)
        self.entries += len(names)
        for name, value, wanted in zip(names, emitted, exact, strict=True):
            excess = abs(mpmath.mpf(float(value)) - wanted) - _ROUNDING * largest
            size = abs(wanted) if abs(wanted) > NOTHING * largest else largest
            error = float(excess / size) if size else 0.0 if excess <= 0 else float("inf")
            if not error <= self.error:
                self.error, self.name = error if error == error else float("inf"), name

    def finding(self, subject: str, against: str) -> Finding:
        """Whether all values agree with what they were compared with, and which does not."""
        passed = self.error <= TOLERANCE
        detail = f"{self.entries} values agree with {against} to {TOLERANCE:g}"
        if not passed:
            detail = f"{self.name} differs from {against} by {self.error:.2g} of its value"
        return Finding(self.check, subject, passed, detail)
