"""The reference of an optimum: states and controls as functions of time, and the errors of other motions.

The scheme of the highest order that applies is solved on grids that are doubled, each from the optimum on the grid
before. Between nodes and stages, splines interpolate. The difference of the last two grids is the estimate of the
error. It exceeds the error of the last grid as long as the sequence converges.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from codegen.errors import CodegenError
from codegen.evidence.report.store import Values
from codegen.solving import api
from codegen.solving.loading import ControlModule, Matrix, Vector
from codegen.solving.results.result import Result

DEGREE = 5
COARSEST, MOST_INTERVALS, ENOUGH = 20, 5120, 1e-12
"""The least and the largest number of intervals of a reference, and the estimated error below which it is accurate."""
TOLERANCE = 1e-12
_STORED = ("duration", "nodes", "states", "times", "controls")
SAMPLES = 1001  # the number of equidistant times at which two references are compared


@dataclass(frozen=True)
class Trajectory:
    """States (N + 1, n) at `nodes`, and controls (T, m) at `times`; both times are fractions of the duration."""

    duration: float
    nodes: Vector
    states: Matrix
    times: Vector
    controls: Matrix

    @cached_property
    def splines(self) -> tuple[BSpline, BSpline]:
        """Return states and controls as functions of the fraction of the duration."""
        states, controls = (
            make_interp_spline(x, values, min(DEGREE, x.size - 1))
            for x, values in ((self.nodes, self.states), (self.times, self.controls))
        )
        return states, controls

    def errors(self, other: Trajectory) -> dict[str, float | None]:
        """Return the errors of `other`: of states, the largest, and of controls, the root mean square.

        Errors are relative to the largest value of each component. The error of the duration counts as one of states.
        """
        states, controls = (spline(x) for spline, x in zip(self.splines, (other.nodes, other.times), strict=True))
        of_states = np.abs(other.states - states) / _sizes(self.states)
        of_duration = abs(other.duration / self.duration - 1.0)
        values: dict[str, float | None] = {"states": max(float(of_states.max()), of_duration), "controls": None}
        if self.controls.shape[1]:
            of_controls = (other.controls - controls) / _sizes(self.controls)
            values["controls"] = float(np.sqrt((of_controls**2).mean(axis=0)).max())
        return values

    def resampled(self) -> Trajectory:
        """Return the values at equidistant times."""
        x = np.linspace(0.0, 1.0, SAMPLES)
        states, controls = (spline(x) for spline in self.splines)
        return Trajectory(self.duration, x, states, x, controls)


def _sizes(values: Matrix) -> Vector:
    """Return the largest modulus of each column; of all columns for one that vanishes."""
    sizes = np.abs(values).max(axis=0, initial=0.0)
    largest = sizes.max(initial=0.0) or 1.0
    return np.where(sizes > 1e-9 * largest, sizes, largest)


def trajectory_of(result: Result) -> Trajectory:
    """Return states (q, p) and controls of a result of one phase."""
    assert result.u is not None
    begin, duration = result.t[0], result.t[-1] - result.t[0]
    times = np.unique(result.control_times)
    return Trajectory(
        float(duration), (result.t - begin) / duration, np.hstack([result.q, result.p]), (times - begin) / duration,
        result.controls_at(times),
    )  # fmt: skip


def read_trajectory(values: Values) -> Trajectory:
    """Return a stored trajectory."""
    nodes, states, times, controls = (np.array(values[name]) for name in ("nodes", "states", "times", "controls"))
    return Trajectory(values["duration"], nodes, states, times, controls.reshape(len(times), -1))


def refined(modules: Iterable[tuple[str, ControlModule]], first: int, budget: float) -> Values:
    """Return the reference by the first of the `modules`, with their labels, that has optima on two grids.

    No grid starts after `budget` seconds of processor time since the first grid of a module.
    """
    for label, module in modules:
        steps, earlier, begin = max(first, COARSEST), None, 0.0
        best: Values = {}
        while steps <= MOST_INTERVALS and (earlier is None or time.process_time() - begin < budget):
            result = _solved(module, steps, earlier)
            if result is None:
                break
            begin = begin or time.process_time()  # the first solve may read machine code
            if earlier is not None:
                errors = trajectory_of(result).errors(trajectory_of(earlier).resampled())
                assert result.cost is not None
                assert earlier.cost is not None
                errors["cost"] = abs(result.cost - earlier.cost) / (abs(result.cost) or 1.0)
                largest = max(error for error in errors.values() if error is not None)
                if best and largest >= best["largest"]:
                    break  # rounding, or a limit that the controls of this scheme do not approach
                trajectory = trajectory_of(result)
                best = {
                    **{name: getattr(trajectory, name) for name in _STORED},
                    "cost": result.cost, "errors": errors, "largest": largest, "label": label, "steps": steps,
                }  # fmt: skip
                if largest < ENOUGH:
                    break
            earlier, steps = result, 2 * steps
        if best:
            return best
    return {"label": None}


def _solved(module: ControlModule, steps: int, warm: Result | None) -> Result | None:
    """Return an optimum with the tolerance of references, or with the default tolerance; None if both searches fail."""
    for tolerance in (TOLERANCE, None):
        try:
            result = api.solve(module, steps=steps, warm=warm and warm.unknowns, tolerance=tolerance)
        except CodegenError:  # such as too little memory
            return None
        if result.solved:
            return result
    return None
