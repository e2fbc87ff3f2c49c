"""A long motion by every scheme: the symplecticity of one generated step, and the trend of the energy error in time.

The derivative S of a step is computed by central differences of order ten of the generated step itself. In double
precision |S'JS - J| is then accurate to about 1e-13. A drift of the energy is a statistical question, because the error
oscillates, and rounding makes it a random walk. A straight line is fitted to the means over blocks of time. The
standard error of its slope follows from the residuals. It is larger if neighbouring residuals are correlated (Priestley
1981, Spectral analysis and time series, section 5.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from codegen.errors import CodegenError
from codegen.evidence.report.building import SURVEYS, Variant, Workshop
from codegen.evidence.report.page import Section, Table, number
from codegen.evidence.report.store import Case, Extent, Store, Values, section_of
from codegen.runtime.record import Form
from codegen.solving import api
from codegen.solving.loading import SimulateModule, Vector

STORED, BLOCKS = 2000, 50
"""The number of stored states of a long motion, and the number of time blocks over which they are averaged."""
SIGNIFICANT, BY_ROUNDING = 3.0, 10.0
"""The least significant t value of a slope, and the least ratio of its rise to the random walk by rounding errors."""
GROWN = 2.0  # the error has grown if its range exceeds GROWN times its range in the problem's own duration
_OFFSETS = np.array([-5, -4, -3, -2, -1, 1, 2, 3, 4, 5])
_WEIGHTS = np.array([-2, 25, -150, 600, -2100, 2100, -600, 150, -25, 2]) / 2520.0
_DISTANCE = 0.02
_MOST_FREEDOM = 8  # the largest number of components (q, p) of a state for which the derivative of a step is computed


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield a case for each scheme; none without an energy, or if the extent has no long motion (`drift_steps` = 0)."""

    def measure(variant: Variant) -> Values:
        module = workshop.simulation(variant)
        api.solve(module, steps=1)  # compiles
        return drift_values(module, extent.drift_steps)

    for variant in workshop.built(variants) if extent.drift_steps else []:
        if not hasattr(workshop.simulation(variant), "energy"):
            continue
        yield Case(section_of(problem, "long motion"), variant.label, partial(measure, variant))


def drift_values(module: SimulateModule, steps: int) -> Values:
    """Return trend, oscillation and rounding error of the energy over `steps` steps, and the symplecticity defect."""
    grid = module.make_grid(int(module.metadata.steps))
    try:
        is_canonical = module.metadata.form != Form.FIRST_ORDER and grid.start.size <= _MOST_FREEDOM
        defect = symplecticity_defect(module, grid.h, np.ravel(grid.start)) if is_canonical else None
        first = module.solve(grid.steps, duration=grid.h * grid.steps)
        solution = module.solve(steps, duration=grid.h * steps, every=max(1, steps // STORED))
    except (CodegenError, ValueError) as error:
        return {"status": f"refused: {error}"}
    if solution.status != "solved":
        return {"status": solution.status, "defect": defect}
    shape = (len(solution.t), -1)
    states = np.hstack([np.reshape(solution.q, shape), np.reshape(solution.p, shape)])
    assert solution.energy is not None, "a mechanical system has an energy"
    assert first.energy is not None, "a mechanical system has an energy"
    errors = solution.energy - solution.energy[0]
    trend = trend_of(solution.t, errors)
    # The energy error by rounding alone: half a unit in the last place of every component, in each of the steps.
    parameters, change = module.make_grid(1).parameters, []
    for z in states[:: max(1, len(states) // 20)]:
        slopes = []
        for i in range(z.size):
            shifted = z.copy()
            shifted[i] += 1e-6 * max(1.0, abs(z[i]))
            rise = module.energy(shifted, 0.0, parameters) - module.energy(z, 0.0, parameters)
            slopes.append(rise / (shifted[i] - z[i]) * z[i])
        change.append(float(np.sum(np.square(slopes))))
    return {
        "status": "solved", "steps": steps, "h": grid.h, "defect": defect, "energy": float(solution.energy[0]),
        "oscillation": float(np.ptp(errors)), "first": float(np.ptp(first.energy)),
        "rise": trend.rise, "standard error": trend.error, "t": trend.t,
        "rounding": float(2.0**-53 * np.sqrt(np.mean(change)) * np.sqrt(steps)),
    }  # fmt: skip


def symplecticity_defect(module: SimulateModule, h: float, state: Vector) -> float:
    """Return max |S'JS - J| with the derivative S of the step h at (q, p), by central differences of order ten."""
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


@dataclass(frozen=True)
class Trend:
    """The rise of the fitted straight line over the whole time, and the standard error of the rise."""

    rise: float
    error: float

    @property
    def t(self) -> float:
        """Return the rise in standard errors."""
        return self.rise / self.error if self.error else 0.0


def trend_of(times: Vector, values: Vector) -> Trend:
    """Return the trend of oscillating values by block means; correlated residuals (lag one) enlarge its error."""
    size = len(values) // BLOCKS
    x, y = (np.reshape(column[: BLOCKS * size], (BLOCKS, size)).mean(axis=1) for column in (times, values))
    x = (x - x.mean()) / (times[-1] - times[0])
    slope = float(x @ (y - y.mean()) / (x @ x))
    residuals = y - y.mean() - slope * x
    square = float(residuals @ residuals)
    correlation = max(0.0, float(residuals[1:] @ residuals[:-1]) / square) if square else 0.0
    error = np.sqrt(square / (BLOCKS - 2) / float(x @ x) * (1.0 + correlation) / (1.0 - correlation))
    return Trend(slope, float(error))


def section(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """Return the section with energy drift and symplecticity of all schemes, or an empty list without measurements."""
    measured = {
        v: values for v in variants if (values := store.get(section_of(problem, "long motion"), v.label)) is not None
    }
    if not measured:
        return []
    symplectic = {(m, s) for m, s, _, claimed, _ in (store.get(SURVEYS, problem.stem) or {})["schemes"] if claimed}
    rows = []
    for variant, values in measured.items():
        claim = "yes" if (variant.method, variant.scheme) in symplectic else "no"
        if values["status"] == "solved":
            keys = ("oscillation", "first", "rise", "standard error", "t", "rounding")
            cells = (*(number(values[key], 2) for key in keys), answer(values))
        else:
            cells = (*["–"] * 6, values["status"])
        rows.append((variant.label, claim, number(values.get("defect"), 2), *cells))
    solved = next((values for values in measured.values() if values["status"] == "solved"), {"steps": 0, "h": 0.0})
    text = (
        "A straight line is fitted to the energy's error, averaged over "
        f"{BLOCKS} blocks of time; t is its rise over the whole time in standard errors. The trend is not told from "
        f"zero for |t| < {SIGNIFICANT:g}. A larger t with a rise below {BY_ROUNDING:g} times the random walk that "
        "rounding makes of the energy is put down to rounding, which no scheme escapes. |S'JS − J| is the defect of "
        "symplecticity of the emitted step, whose derivative is known to about 10⁻¹³. An error that swings by more "
        f"than {GROWN:g} times what it does in the problem's own duration has left its first swing, whatever t is."
    )
    head = ("scheme", "symplectic", "|S'JS − J|", "energy swings by", "in the problem's time", "rise of the trend",
            "its standard error", "t", "random walk by rounding", "trend")  # fmt: skip
    caption = f"Energy over {solved['steps']:,} steps of length {number(solved['h'])}, as the problem has them."
    return [Section(title, (text,), (Table(caption, head, tuple(rows)),))]


def answer(values: Values) -> str:
    """Return in a few words whether the energy drifts, and why."""
    walk = BY_ROUNDING * values["rounding"]
    if values["oscillation"] > GROWN * values["first"] + walk:
        return "leaves its first swing"
    if abs(values["t"] or 0.0) < SIGNIFICANT:
        return "none"
    return "rounding" if abs(values["rise"]) < walk else "drifts"
