"""What a closed loop leaves: trajectories, what every sampling time came to, and how long it took."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, clause
from codegen.horizons.controller import Controller, Feedback
from codegen.interfaces import Matrix, Vector
from codegen.tasks import Home

if TYPE_CHECKING:
    from codegen.plots.picture import Picture

_PICTURE, _HTML = Home("notebooks.closed_loop", "picture"), Home("notebooks.closed_loop", "html")


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """What came of M sampling times, in the units of the problem, times in seconds.

    `times` (M + 1,) and the plant's `states` (M + 1, states) begin with the start; `measured` (M, states) is what the
    controller was told, `inputs` (M, controls) what acted from each time on. Of each sampling time there are `statuses`
    (M,), `iterations` (M,), `residuals` (M,) and `costs` (M,) of what was planned, `latencies` (M,), the seconds from
    the call to the inputs, `in_time` (M,) and `fell_back` (M,), as in Feedback. `message` says why the loop ended
    early, and is empty where it did not.
    """

    title: str
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    sample: float
    deadline: float | None
    message: str
    times: Vector = field(repr=False)
    states: Matrix = field(repr=False)
    measured: Matrix = field(repr=False)
    inputs: Matrix = field(repr=False)
    statuses: NDArray[np.str_] = field(repr=False)
    iterations: NDArray[np.intp] = field(repr=False)
    residuals: Vector = field(repr=False)
    costs: Vector = field(repr=False)
    latencies: Vector = field(repr=False)
    in_time: NDArray[np.bool_] = field(repr=False)
    fell_back: NDArray[np.bool_] = field(repr=False)

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Those of states and of inputs, in the order of columns."""
        return self.state_names, self.input_names

    @property
    def counts(self) -> dict[str, int]:
        """How many sampling times ended with each status."""
        return dict(Counter(self.statuses.tolist()))

    @property
    def missed(self) -> int:
        """How many deadlines were missed."""
        return int((~self.in_time).sum())

    def latency(self, percent: float) -> float:
        """The seconds within which so many per cent of the sampling times had their inputs."""
        return float(np.percentile(self.latencies, percent)) if self.latencies.size else float("nan")

    def plot(
        self, path: Path | str | None = None, references: Mapping[str, Callable[[float], float]] | None = None
    ) -> Picture:
        """Draw states, inputs and latencies, for a notebook, and into a file, .png, .pdf or .svg, if there is a path.

        `references` are functions of time that states or inputs were to follow, by name. Raises ArgumentError for
        another name.
        """
        wanted, known = references or {}, (*self.state_names, *self.input_names)
        if unknown := [name for name in wanted if name not in known]:
            raise ArgumentError(clause(f"a reference of {unknown[0]!r}"), clause(f"use {', '.join(known)}"))
        picture: Picture = _PICTURE(self, wanted)
        if path is not None:
            picture.save(path)
        return picture

    def _repr_html_(self) -> str:
        return str(_HTML(self))


class Recording:
    """Room for so many sampling times, which are filled one by one."""

    def __init__(self, controller: Controller, samples: int, state: Vector) -> None:
        states, inputs = len(controller.states), len(controller.inputs)
        self.controller, self.count = controller, 0
        self.states, self.measured = np.empty((samples + 1, states)), np.empty((samples, states))
        self.inputs, self.numbers = np.empty((samples, inputs)), np.empty((samples, 4))
        self.feedback: list[tuple[str, bool, bool]] = []
        self.states[0] = state

    def add(self, measured: Vector, applied: Vector, feedback: Feedback, state: Vector) -> None:
        """Note a sampling time and the state at its end."""
        k = self.count
        self.measured[k], self.inputs[k], self.states[k + 1] = measured, applied, state
        self.numbers[k] = feedback.iterations, feedback.residual, feedback.cost, feedback.seconds
        self.feedback.append((feedback.status, feedback.in_time, feedback.fell_back))
        self.count += 1

    def ended(self, message: str = "") -> ClosedLoop:
        """The result; `message` says why it ended early."""
        controller, n = self.controller, self.count
        iterations, residuals, costs, latencies = self.numbers[:n].T
        times = np.asarray(controller.sample * np.arange(n + 1.0))
        statuses, in_time, fell_back = zip(*self.feedback, strict=True) if n else ((), (), ())
        return ClosedLoop(
            controller.module.metadata["title"], controller.states, controller.inputs, controller.sample,
            controller.options.deadline, message, times, self.states[: n + 1], self.measured[:n],
            self.inputs[:n], np.array(statuses, dtype=np.str_), iterations.astype(np.intp),
            residuals, costs, latencies, np.array(in_time, dtype=bool), np.array(fell_back, dtype=bool),
        )  # fmt: skip
