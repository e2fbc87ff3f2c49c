"""A long motion of every scheme: the symplecticity of one emitted step, and the trend of the energy's error in time.

The derivative S of a step is found by central differences of order ten of the emitted step itself, in double
precision, so that |S'JS - J| is known down to about 1e-13. Whether the energy drifts is a statistical question: its
error swings, and rounding makes it a random walk. A straight line is fitted to the means over blocks of time; the
standard error of its slope comes from the residuals, made larger where neighbours are correlated (Priestley 1981,
Spectral analysis and time series, section 5.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from codegen.errors import CodegenError
from codegen.evidence.report.building import SURVEYS, Variant, Workshop
from codegen.evidence.report.page import Section, Table, number
from codegen.evidence.report.settings import Extent
from codegen.evidence.report.store import Case, Store, Values
from codegen.solving import api
from codegen.solving.loading import SimulateModule, Vector, is_simulation

STORED, BLOCKS = 2000, 50
"""Stored states of a long motion, and blocks over which they are averaged."""
SIGNIFICANT, BY_ROUNDING = 3.0, 10.0
"""A slope with a t value below the first is not told from zero; a trend below so many random walks is rounding."""
GROWN = 2.0
"""An error that swings by more than so many times what it does in the problem's own duration has grown."""
_OFFSETS = np.array([-5, -4, -3, -2, -1, 1, 2, 3, 4, 5])
_WEIGHTS = np.array([-2, 25, -150, 600, -2100, 2100, -600, 150, -25, 2]) / 2520.0
_DISTANCE = 0.02
_MOST_FREEDOM = 8
"""Only with so many coordinates is the derivative of a step found."""


@dataclass(frozen=True)
class Trend:
    """What a straight line through means over blocks rises in the whole time, and its standard error."""

    rise: float
    error: float

    @property
    def t(self) -> float:
        """The rise in standard errors."""
        return self.rise / self.error if self.error else 0.0


def trend_of(times: Vector, values: Vector, blocks: int = BLOCKS) -> Trend:
    """The rise of values that may swing, by block means; residuals of lag one correct the standard error."""
    size = len(values) // blocks
    x, y = (np.reshape(column[: blocks * size], (blocks, size)).mean(axis=1) for column in (times, values))
    x = (x - x.mean()) / (times[-1] - times[0])
    slope = float(x @ (y - y.mean()) / (x @ x))
    left = y - y.mean() - slope * x
    square = float(left @ left)
    correlation = max(0.0, float(left[1:] @ left[:-1]) / square) if square else 0.0
    error = np.sqrt(square / (blocks - 2) / float(x @ x) * (1.0 + correlation) / (1.0 - correlation))
    return Trend(slope, float(error))


def symplecticity_defect(module: SimulateModule, h: float, state: Vector) -> float:
    """The largest entry of S'JS - J of the emitted step of length h at (q, p), by central differences of order ten."""
    half, columns = state.size // 2, []
    for i in range(state.size):
        distance = _DISTANCE * max(1.0, abs(state[i]))
        ends = []
        for offset in _OFFSETS:
            start = state.copy()
            start[i] += offset * distance
            solution = module.solve(1, duration=h, start=start)
            ends.append(np.concatenate([np.ravel(solution.q[-1]), np.ravel(solution.p[-1])]))
        columns.append(_WEIGHTS @ np.array(ends) / distance)
    derivative = np.array(columns).T
    form = np.block([[np.zeros((half, half)), np.eye(half)], [-np.eye(half), np.zeros((half, half))]])
    return float(np.abs(derivative.T @ form @ derivative - form).max())


def random_walk(module: SimulateModule, states: Any, steps: int) -> float:
    """The energy's error by rounding alone: half a unit in the last place of every state, in each of so many steps."""
    parameters, change = module.make_grid(1).parameters, []
    for z in states:
        slopes = []
        for i in range(z.size):
            moved = z.copy()
            moved[i] += 1e-6 * max(1.0, abs(z[i]))
            rise = module.energy(moved, 0.0, parameters) - module.energy(z, 0.0, parameters)
            slopes.append(rise / (moved[i] - z[i]) * z[i])
        change.append(float(np.sum(np.square(slopes))))
    return float(2.0**-53 * np.sqrt(np.mean(change)) * np.sqrt(steps))


def drift_values(module: SimulateModule, steps: int) -> Values:
    """Over so many steps of the problem's own length: trend, oscillation, rounding, and the defect of a step."""
    grid = module.make_grid(int(module.metadata.steps))
    try:
        defect = (
            symplecticity_defect(module, grid.h, np.ravel(grid.start)) if grid.start.size <= _MOST_FREEDOM else None
        )
        first: Any = module.solve(grid.steps, duration=grid.h * grid.steps)
        solution: Any = module.solve(steps, duration=grid.h * steps, every=max(1, steps // STORED))
    except (CodegenError, ValueError) as error:
        return {"status": f"refused: {error}"}
    if solution.status != "solved":
        return {"status": solution.status, "defect": defect}
    shape = (len(solution.t), -1)
    states = np.hstack([np.reshape(solution.q, shape), np.reshape(solution.p, shape)])
    wrong = solution.energy - solution.energy[0]
    found = trend_of(solution.t, wrong)
    return {
        "status": "solved", "steps": steps, "h": grid.h, "defect": defect, "energy": float(solution.energy[0]),
        "oscillation": float(np.ptp(wrong)), "first": float(np.ptp(first.energy)),
        "rise": found.rise, "standard error": found.error, "t": found.t,
        "rounding": random_walk(module, states[:: max(1, len(states) // 20)], steps),
    }  # fmt: skip


def drifts_of(problem: Path) -> str:
    """The section of the store that holds long motions."""
    return f"{problem.stem}: long motion"


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """One for each scheme, where the extent asks for it."""
    for variant in workshop.built(variants) if extent.drift_steps else []:
        yield Case(drifts_of(problem), variant.label, lambda v=variant: _long(workshop, v, extent.drift_steps))  # type: ignore[misc]


def _long(workshop: Workshop, variant: Variant, steps: int) -> Values:
    module = workshop.module(variant)
    assert is_simulation(module)
    api.solve(module, steps=1)  # compiles
    return drift_values(module, steps)


def section(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """A table of all schemes; none if nothing was measured."""
    found = [(v, values) for v in variants if (values := store.get(drifts_of(problem), v.label)) is not None]
    if not found:
        return []
    symplectic = {(m, s) for m, s, _, claimed in (store.get(SURVEYS, problem.stem) or {})["schemes"] if claimed}
    rows = tuple((v.label, *row(values, (v.method, v.scheme) in symplectic)) for v, values in found)
    steps = next((values["steps"] for _, values in found if values["status"] == "solved"), 0)
    h = next((values["h"] for _, values in found if values["status"] == "solved"), 0.0)
    text = (
        "A straight line is fitted to the energy's error, averaged over "
        f"{BLOCKS} blocks of time; t is its rise over the whole time in standard errors. The trend is not told from "
        f"zero for |t| < {SIGNIFICANT:g}. A larger t with a rise below {BY_ROUNDING:g} times the random walk that "
        "rounding makes of the energy is put down to rounding, which no scheme escapes. |S'JS − J| is the defect of "
        "symplecticity of the emitted step, whose derivative is known to about 10⁻¹³. An error that swings by more "
        f"than {GROWN:g} times what it does in the problem's own duration has left its first swing, whatever t is."
    )
    caption = f"Energy over {steps:,} steps of length {number(h)}, as the problem has them."
    return [Section(title, (text,), (Table(caption, HEAD, rows),))]


HEAD = ("scheme", "symplectic", "|S'JS − J|", "energy swings by", "in the problem's time",
        "rise of the trend", "its standard error", "t",
        "random walk by rounding", "trend")  # fmt: skip


def row(values: Values, symplectic: bool) -> tuple[str, ...]:
    """The cells of one scheme."""
    claim = "yes" if symplectic else "no"
    defect = number(values.get("defect"), 2)
    if values["status"] != "solved":
        return (claim, defect, *["–"] * 6, values["status"])
    keys = ("oscillation", "first", "rise", "standard error", "t", "rounding")
    return (claim, defect, *(number(values[key], 2) for key in keys), answer(values))


def answer(values: Values) -> str:
    """In words whether the energy drifts."""
    walk = BY_ROUNDING * values["rounding"]
    if values["oscillation"] > GROWN * values["first"] + walk:
        return "leaves its first swing"
    if abs(values["t"] or 0.0) < SIGNIFICANT:
        return "none"
    return "rounding" if abs(values["rise"]) < walk else "drifts"
