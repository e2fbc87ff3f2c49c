"""Stages of explicit schemes beyond the bounds of states, where the dynamics were evaluated all the same.

A stage of an explicit scheme follows from the node before it less accurately than the step does, so that no bound is
imposed on it. Kinetics that change their sign beyond a bound lead to a motion that does not exist.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.interfaces import ControlModule, Vector, time_grid
from codegen.runtime.record import Kind

NEGLIGIBLE = 1e-6
"""Part of a state's largest value by which a stage may be beyond a bound."""


@dataclass(frozen=True)
class StageBeyond:
    """The stage of a state that is farthest beyond a bound: its value, the bound, and when its interval begins."""

    state: str
    value: float
    limit: float
    time: float
    body: int | None = None

    @property
    def note(self) -> str:
        """The message for the author, with the remedy."""
        of_body = "" if self.body is None else f" of body {self.body}"
        return (
            f"{self.state}{of_body} is {self.value:.4g} at a stage of the interval from t = {self.time:.4g}, "
            f"{abs(self.value - self.limit):.2g} beyond its bound, and the dynamics were evaluated there: the scheme "
            "holds bounds at nodes alone; take gauss-4, or more --steps"
        )


def stages_beyond(
    module: ControlModule, unknowns: Vector, steps: int, fractions: Vector | None
) -> Iterator[StageBeyond]:
    """The worst stage of every state whose stages have no bounds, though the state has, if any is beyond them.

    `unknowns` (n,) are those of `steps` intervals in each phase, equal ones or those of `fractions`.
    """
    generated: Any = module
    metadata = module.metadata
    if not metadata.inequalities or any(m.kind == Kind.BOUND_SLACK for m in metadata.meanings.values()):
        return
    grid, names = time_grid(module, steps, fractions), list(metadata.node)
    nodes, intervals = generated.views(grid, unknowns)
    limits = [generated.views(grid, bound) for bound in module.variable_bounds(grid)]
    stages = dict[str, list[int]]()
    for column, name in enumerate(metadata.interval):
        state = metadata.stages.get(name)
        if state in names and not generated.problem.structure.is_multiplier[len(names) + column]:
            stages.setdefault(state, []).append(column)
    times = module.unpack(grid, unknowns)[0] if stages else np.empty(0)
    for state, columns in stages.items():
        if any(np.isfinite(inside[:, :, columns]).any() for _, inside in limits):
            continue
        of_nodes = [at_nodes[:, :, names.index(state)] for at_nodes, _ in limits]
        lower, upper = (_usual(bound, steps)[:, :, None] for bound in of_nodes)
        values = intervals[:, :, columns]
        beyond = np.maximum(lower - values, values - upper)
        worst = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        if beyond[worst] <= NEGLIGIBLE * max(1e-300, np.abs(nodes[:, :, names.index(state)]).max()):
            continue
        body, interval, _ = map(int, worst)
        limit = (lower if values[worst] < lower[body, interval, 0] else upper)[body, interval, 0]
        own = body if metadata.bodies > 1 else None
        yield StageBeyond(state, float(values[worst]), float(limit), float(times[interval]), own)


def _usual(bounds: np.ndarray, steps: int) -> np.ndarray:
    """For every interval (bodies, intervals) the bound that most nodes of its phase have; ends may have others."""
    phases = (bounds.shape[1] - 1) // steps
    own = [bounds[:, phase * steps + min(phase, 1) : (phase + 1) * steps + 1] for phase in range(phases)]
    middles = [np.sort(part, axis=1)[:, part.shape[1] // 2] for part in own]
    return np.repeat(np.stack(middles, axis=1), steps, axis=1)
