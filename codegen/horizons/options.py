"""The options of a controller, and what is refused of them."""

from __future__ import annotations

from dataclasses import dataclass

from codegen.errors import ArgumentError, NumericsError
from codegen.horizons.interface import require_count
from codegen.solutions.given_values import as_number
from codegen.solving.request import SCALINGS

WHOLE = 1e-9
"""Parts of an interval by which a sampling time may miss a whole number of them."""


@dataclass(frozen=True)
class Options:
    """What is asked of a controller; see Controller, whose default a None stands for. Times are in seconds."""

    steps: int | None
    horizon: float | None
    sample: float | None
    tolerance: float
    newton_steps: int | None
    deadline: float | None
    scaling: str
    delay: int

    def __post_init__(self) -> None:
        """Refuse what is unusable whatever the problem is."""
        for name in ("steps", "newton_steps"):
            if getattr(self, name) is not None:
                require_count(name, getattr(self, name), 1)
        require_count("delay", self.delay, 0)
        for name in ("horizon", "sample", "deadline"):
            value = getattr(self, name)
            if value is not None and not 0.0 < as_number(value) < float("inf"):
                raise NumericsError(f"{name} is {value!r}", "give a positive number of seconds")
        if not 0.0 < as_number(self.tolerance) < 1.0:
            raise ArgumentError(f"tolerance is {self.tolerance!r}", "give a number between 0 and 1")
        if self.scaling not in SCALINGS:
            raise ArgumentError(f"scaling is {self.scaling!r}", f"use one of {', '.join(SCALINGS)}")

    @staticmethod
    def intervals_of(sample: float, horizon: float, steps: int) -> float:
        """How many intervals a sampling time lasts, a whole number where it nearly is one.

        Raises NumericsError where it is longer than the horizon.
        """
        intervals = sample * steps / horizon
        if intervals > steps * (1.0 + WHOLE):
            finding = f"the sampling time {sample:g} is longer than the horizon {horizon:g}"
            raise NumericsError(finding, "give a shorter sample, or a longer horizon")
        whole = round(intervals)
        return float(whole) if abs(intervals - whole) <= WHOLE else intervals
