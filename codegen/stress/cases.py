"""What a stress case is, what is measured on it, and the words for how it may end: data only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Values = tuple[tuple[str, Any], ...]
"""Names and values of keyword arguments; a value may itself be Values, which stands for a dict."""

OUTCOMES = {
    "accurate": "solved, and the error is below what the order of the scheme promises at this step",
    "bounded": "solved; no error is promised (chaos, or steps too long for the fast motion), the energy is bounded",
    "unsuitable": "the steps' equations hold, but the energy has run away, which the summary of `solve` reports",
    "refused": "a named failure, or a typed error, that says what is wrong and what to try",
}
"""How a case may end honestly."""

DEFECTS = {
    "false solved": "reported as solved, though the equations do not hold or the error is beyond what is promised",
    "not a number": "reported as solved with NaN or infinite results",
    "hang": "no answer within the time limit",
    "untyped error": "an exception that names no remedy, a crash, or a status that is not documented",
    "unexpected": "honest, but not what is expected of this case",
}
"""How no case may end."""


@dataclass(frozen=True)
class Setup:
    """What a module is made from: a problem file, arguments of problem(), a scheme and a method (None: default)."""

    file: Path
    scheme: str | None = None
    method: str | None = None
    arguments: Values = ()

    @property
    def label(self) -> str:
        """Scheme as the table shows it, with its method where that is not the Hamiltonian one."""
        name = self.scheme or "midpoint"
        return f"{name}, variational" if self.method == "variational" else name


@dataclass(frozen=True)
class Case:
    """One solve with run-time values on a module, and what is expected of it.

    `reference` names what the answer is compared with (see `references`), `bound` is the largest error that the order
    of the scheme promises, NaN where nothing is promised. `drift` is the largest relative change of energy that counts
    as bounded. `h_omega` is the step times the largest frequency. `textbook` asks for the equations of the steps to be
    evaluated again in extended precision, from the scheme's textbook form, `limit` for the largest stable step. `noise`
    perturbs an optimisation's guess, `allowed` holds outcomes that pass beside the expected one, `seconds` is the time
    limit. `reason` says why the outcome is expected, and why others are allowed.
    """

    name: str
    family: str
    setup: Setup
    expect: str
    reason: str
    steps: int = 100
    values: Values = ()
    every: int = 1
    driver: str = "newton"
    doublings: int = 0
    points: tuple[tuple[float, ...], ...] = ()
    noise: float = 0.0
    reference: str = ""
    bound: float = math.nan
    drift: float = 0.1
    h_omega: float = math.nan
    textbook: bool = False
    limit: bool = False
    allowed: tuple[str, ...] = ()
    seconds: float = 120.0

    @property
    def expected(self) -> tuple[str, ...]:
        """The outcomes that pass; a named failure is at least as honest as an energy that tells."""
        named = ("refused",) if self.expect == "unsuitable" and "refused" not in self.allowed else ()
        return (self.expect, *self.allowed, *named)


@dataclass(frozen=True)
class Measurement:
    """What a worker saw; NaN stands for what was not measured or does not exist.

    `error` is that against the reference, `announced` the relative error that a doubled grid shows, `residual` that of
    all equations outside the solver and `tolerance` what it must not exceed, `textbook` the same in extended precision,
    relative to rounding of double precision. `drift` is the largest relative change of energy, `stable_below` the
    largest stable step times frequency, found by bisection.
    """

    status: str = ""
    message: str = ""
    refusal: str = ""
    exception: str = ""
    finite: bool = True
    error: float = math.nan
    announced: float = math.nan
    residual: float = math.nan
    tolerance: float = math.nan
    textbook: float = math.nan
    drift: float = math.nan
    stable_below: float = math.nan
    failures: int = 0
    iterations: int = 0
    seconds: float = math.nan
    hung: bool = False


@dataclass(frozen=True)
class Row:
    """A case, what was measured, and the verdict: an outcome or defect, whether it passes, and a sentence."""

    case: Case
    measurement: Measurement
    outcome: str
    passed: bool
    text: str = field(default="")
