"""The loop of a controller and a plant that differs from its model: disturbances, noise, a delay."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.mpc.controller import Controller, Feedback
from codegen.mpc.interface import Moving, number, require_count, vector
from codegen.mpc.motion import PlantFailed, plant_of
from codegen.solving.interfaces import Matrix, Vector

if TYPE_CHECKING:
    from codegen.show.figures.picture import Picture


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
        from codegen.show.notebook import loop_picture

        picture = loop_picture(self, wanted)
        if path is not None:
            picture.save(path)
        return picture

    def _repr_html_(self) -> str:
        from codegen.show.notebook import loop_html

        return loop_html(self)


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
            controller.module.metadata.title, controller.states, controller.inputs, controller.sample,
            controller.options.deadline, message, times, self.states[: n + 1], self.measured[:n],
            self.inputs[:n], np.array(statuses, dtype=np.str_), iterations.astype(np.intp),
            residuals, costs, latencies, np.array(in_time, dtype=bool), np.array(fell_back, dtype=bool),
        )  # fmt: skip


def close_loop(
    controller: Controller,
    plant: Any,
    *,
    samples: int = 100,
    start: Any = None,
    arguments: Mapping[str, Any] | None = None,
    disturbances: Mapping[str, Moving] | None = None,
    noise: Any = 0.0,
    delay: int | None = None,
    inputs: Any = None,
    seed: int = 0,
) -> ClosedLoop:
    """Let a controller act upon a plant for so many sampling times, and return the ClosedLoop that came of it.

    The controller begins without a plan, whatever it did before.

    `plant` is a problem file (with `arguments` of its problem()), a generated module or its file, with the controller's
    states in its start and a parameter for each input: a `Simulate`, or for `dynamics` a `Control` without controls and
    cost. Or it is a function (state, inputs, t, seconds) of arrays (states,) and (controls,) that returns the state
    after so many seconds. `start` is the first state, (states,) or by name, by default the problem's own.

    `disturbances` are parameters of the plant by name, numbers or functions of time, of which the controller does not
    know; what it is to know are its own `parameters`. To what it measures, `noise` adds normally distributed errors of
    that standard deviation, a number, an array (states,) or a mapping by name, from the random `seed`. With a `delay`
    of n sampling times inputs act so much later than what they follow from was measured; before, `inputs` (controls,)
    act, an array or by name, zero unless given, which a controller with a delay knows. The delay is the controller's
    own unless it is given; one that is longer disturbs the loop.

    A plant that runs away ends the loop; `message` of the result says so. Raises ArgumentError for a plant or a delay
    that does not fit the controller, NumericsError for unusable numbers, and what `codegen.build` does for a problem
    file.
    """
    if not isinstance(controller, Controller):
        raise ArgumentError(f"close_loop of a {type(controller).__name__}", "give a codegen.Controller and a plant")
    require_count("samples", samples, 1)
    delay = _delay_of(controller, delay)
    names = controller.states, controller.inputs
    acts_on = plant_of(plant, arguments or {}, names, disturbances or {})
    state = controller.first_state() if start is None else vector(start, controller.states, "the start")
    deviations = _deviations(controller, noise)
    inputs = np.zeros(len(controller.inputs)) if inputs is None else inputs
    inputs = vector(inputs, controller.inputs, "the array of inputs")
    waiting = [inputs] * delay
    random, recording = np.random.default_rng(seed), Recording(controller, samples, state)
    controller.reset(inputs if controller.delay else None)
    for k in range(samples):
        t = k * controller.sample
        measured = state + deviations * random.standard_normal(state.size)
        waiting.append(controller.step(measured, t))
        applied = waiting.pop(0)
        try:
            state = acts_on(state, applied, t, controller.sample)
        except PlantFailed as failure:
            return recording.ended(f"the plant failed after t = {t:g}: {failure}")
        assert controller.last is not None, "a step leaves its feedback"
        recording.add(measured, applied, controller.last, state)
    return recording.ended()


def _delay_of(controller: Controller, delay: Any) -> int:
    """The delay of a loop in sampling times; ArgumentError where inputs would act before their plan begins."""
    if delay is None:
        return controller.delay
    require_count("delay", delay, 0)
    if delay < controller.delay:
        finding = f"the controller plans for a delay of {controller.delay}, and the loop has one of {delay}"
        raise ArgumentError(finding, "leave delay out here, or give the controller no longer one")
    return int(delay)


def _deviations(controller: Controller, noise: Any) -> Vector:
    """The standard deviations (states,) of errors of measurement; those that a mapping leaves out are zero."""
    if isinstance(noise, Mapping):
        if unknown := [name for name in noise if name not in controller.states]:
            finding = clause(f"noise of {unknown[0]!r}, which is no state")
            raise ArgumentError(finding, clause(f"use {', '.join(controller.states)}"))
        noise = [noise.get(name, 0.0) for name in controller.states]
    elif np.ndim(noise) == 0:
        noise = [number(noise, "noise")] * len(controller.states)
    found = vector(noise, controller.states, "noise")
    if (found < 0.0).any():
        raise NumericsError("noise has a negative standard deviation", "give numbers that are not negative")
    return found
