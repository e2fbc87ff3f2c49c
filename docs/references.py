"""What is known of the problems of the gallery, from the references of the tests; and where records are."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from gallery_references import REFERENCES
from published_references import PUBLISHED

ROOT = Path(__file__).resolve().parents[1]
PROBLEMS = ROOT / "problems"
STORED = ROOT / "docs" / "gallery" / "stored"

DISCRETE = 1e-8
"""Relative; by as much a cost may differ from another program's optimum of the same discrete problem."""
UNSOLVED = {"truck_with_trailers": "stalled"}
"""Problems that the solver does not find with default options, and how it ends; their pages say so."""
LOWER = frozenset({"crane"})
"""Problems where this project finds a lower optimum of the discrete problem than CasADi and IPOPT."""

DIFFERENT = {
    "coulomb_friction": "40 nodes do not resolve the layers in which velocities change their sign; see the file",
}
"""Problems whose published value this project does not find, each with the reason that its file gives at length."""


@dataclass(frozen=True)
class Known:
    """A value from elsewhere: `factor` times the cost is at most `allowed` away from `value`.

    `optimum` is the least cost of the same discrete program on `steps` intervals, by CasADi and IPOPT. Where the value
    is known to be another one, `differs` says why; where a lower optimum is found than theirs, it `is_lower`.
    """

    value: float
    allowed: float
    source: str
    factor: float = 1.0
    optimum: float | None = None
    steps: int | None = None
    scheme: str | None = None
    arguments: Mapping[str, str] = field(default_factory=dict)
    differs: str = ""
    is_lower: bool = False
    status: str = "solved"

    @property
    def title(self) -> str:
        """The options with which the problem is solved, as on the command line."""
        words = [f"--set {key}={value}" for key, value in self.arguments.items()]
        words += [f"--scheme {self.scheme}"] if self.scheme else []
        words += [f"--steps {self.steps}"] if self.steps else []
        return " ".join(words) or "as it is"


def known_of(problem: str) -> list[Known]:
    """All that is known of a problem."""
    ours = [
        Known(
            own.value, own.error, own.source, optimum=own.optima[max(own.optima)], steps=max(own.optima),
            scheme=own.scheme, arguments=own.arguments, is_lower=problem in LOWER,
        )
        for own in REFERENCES
        if own.problem == problem
    ]  # fmt: skip
    published = [
        Known(
            own.value, own.tolerance * abs(own.value), own.source, own.factor, arguments=own.arguments,
            differs=DIFFERENT.get(problem, ""), status=UNSOLVED.get(problem, "solved"),
        )
        for own in PUBLISHED
        if own.problem == problem
    ]  # fmt: skip
    return ours + published


def problem_files() -> list[Path]:
    """The files of the gallery, those of the project first."""
    return [*sorted(PROBLEMS.glob("*.py")), *sorted((PROBLEMS / "published").glob("*.py"))]


def digest(path: Path) -> str:
    """A digest of a problem file, which changes when the problem does."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def misses(known: Known, case: dict[str, Any]) -> str:
    """Why a value does not agree with what is known, or nothing."""
    if case["status"] != known.status:
        return f"is {case['status']}"
    if known.status != "solved":
        return ""
    is_near = abs(known.factor * case["cost"] - known.value) <= known.allowed
    if known.differs and is_near:
        return "agrees, although DIFFERENT says that it does not"
    if not known.differs and not is_near:
        return f"gives {known.factor * case['cost']}, known is {known.value}"
    if known.optimum is None:
        return ""
    excess = (case["cost"] - known.optimum) / abs(known.optimum)
    if (excess >= 0) if known.is_lower else (abs(excess) > DISCRETE):
        return f"gives {case['cost']}, CasADi and IPOPT {known.optimum}"
    return ""
