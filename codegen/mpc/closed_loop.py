"""The closed loop of a controller and a plant, which may differ from the model by disturbances, noise or a delay.

A plant is a function of the state, or a generated module. The module is a simulation, whose velocities follow from its
momenta, or an optimisation without controls and cost, as for systems of first order. Inputs and disturbances are
parameters of the module.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.mpc.controller import Controller, Feedback
from codegen.mpc.interface import (
    Interface,
    Moving,
    Values,
    control_module,
    number,
    require_count,
    vector,
    velocities_of,
)
from codegen.runtime.record import Form
from codegen.solving.loading import Matrix, Vector, is_control, is_of_particles
from codegen.solving.request import parameter_arguments

if TYPE_CHECKING:
    from codegen.show.figures.picture import Picture


Plant: TypeAlias = Callable[[Vector, Vector, float, float], Vector]
"""A function (state (states,), inputs (controls,), time, seconds) -> state (states,) after these seconds."""


class PlantFailed(Exception):
    """The exception of a plant whose solve failed, for example for a diverging motion."""


def plant_of(
    plant: object,
    arguments: Mapping[str, object],
    names: tuple[tuple[str, ...], tuple[str, ...]],
    disturbances: Mapping[str, Moving],
) -> Plant:
    """Return a plant from a function, a problem, a module or its file.

    `names` are the names of the controller's states and inputs. Raises ArgumentError if the start of the plant has
    other names than the states, or if the plant lacks parameters with the names of the inputs or disturbances.
    """
    if callable(plant):
        if disturbances:
            finding = "disturbances beside a plant that is a function"
            raise ArgumentError(finding, "have the function disturb itself, or give a module")
        return _of_function(plant, names[0])
    module: Any = control_module(plant, arguments, None, None)
    metadata, (states, inputs) = module.metadata, names
    is_free = is_control(module) and (metadata.control_names or metadata.form == Form.LAGRANGIAN)
    if is_of_particles(module) or is_free:
        finding = f"{metadata.problem} is no plant: it has controls, or particles"
        raise ArgumentError(finding, "give a Simulate")
    starts = tuple(metadata.start)
    if set(starts) != set(states):
        finding = f"the plant starts from {', '.join(starts) or 'nothing'}, the controller from {', '.join(states)}"
        raise ArgumentError(clause(finding), "give both the same names")
    parameters = tuple(metadata.parameters)
    if missing := [name for name in inputs if name not in parameters]:
        finding = f"the plant has no parameter {missing[0]}, which is an input of the controller"
        raise ArgumentError(finding, f'declare it there, as in {missing[0]} = parameter("{missing[0]}", 0)')
    if both := [name for name in inputs if name in disturbances]:
        raise ArgumentError(f"{both[0]} is an input of the plant", "disturb another parameter")
    values = Values(Interface(states, inputs, parameter_arguments(module), ()), disturbances, {}, "the plant")
    rate_names = tuple(name for name in starts if name not in metadata.coordinates)
    has_velocities = bool(rate_names) and metadata.form == Form.LAGRANGIAN

    def after(state: Vector, inputs_now: Vector, t: float, seconds: float) -> Vector:
        """Return the next state; the time in the module restarts from zero at every sampling time."""
        given = values.given(t, dict(zip(inputs, inputs_now.tolist(), strict=True)))
        start = dict(zip(states, state.tolist(), strict=True))
        given |= {"start": start, "duration": seconds}
        try:
            result = module.solve(int(metadata.steps), **given)
        except (ValueError, ArithmeticError) as error:
            raise NumericsError(str(error), "correct the plant's numbers") from error
        if result.status != "solved":
            raise PlantFailed(result.message)
        q, rates = result.q[-1], result.p[-1]
        found = dict(zip(metadata.coordinates, q.tolist(), strict=True))
        if has_velocities:  # find the velocities from the momenta at the end

            def momenta(v: Vector) -> Vector:
                moved = found | dict(zip(rate_names, v.tolist(), strict=True))
                return np.asarray(module.make_grid(1, **{**given, "start": moved}).start[q.size :])

            rates = velocities_of(momenta, rates, np.array([start[name] for name in rate_names]))
        if rate_names:
            found |= zip(rate_names, rates.tolist(), strict=True)
        return np.array([found[name] for name in states])

    return after


def _of_function(function: Callable[[Vector, Vector, float, float], object], states: tuple[str, ...]) -> Plant:
    """Return a plant that calls a function of state, inputs, time and seconds, and checks the returned state."""

    def after(state: Vector, inputs: Vector, t: float, seconds: float) -> Vector:
        returned = function(state.copy(), inputs.copy(), t, seconds)
        try:
            array = np.array(returned, dtype=float)
        except (TypeError, ValueError):
            finding = clause(f"the plant returned {returned!r}")
            raise NumericsError(finding, f"return {', '.join(states)}") from None
        if array.shape != state.shape:
            finding = f"the plant returned an array of shape {array.shape}, expected {state.shape}"
            raise NumericsError(finding, f"return {', '.join(states)}")
        if not np.isfinite(array).all():
            raise PlantFailed("its state is not finite")
        return array

    return after


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """The result of a closed loop over M sampling times, in the units of the problem and in seconds.

    Attributes
    ----------
    title : str
        Title of the problem.
    state_names, input_names : tuple of str
        Names of the columns of `states` and `inputs`.
    sample, deadline : float
        Sampling time and deadline of the controller in seconds; the deadline may be None.
    message : str
        Reason of an early end, else empty.
    times : array (M + 1,)
        Times of the states, beginning with the first state.
    states : array (M + 1, states)
        States of the plant.
    measured : array (M, states)
        Measurements that the controller received.
    inputs : array (M, controls)
        Inputs that acted from each sampling time on.
    statuses, iterations, residuals, costs : arrays (M,)
        Results of each `Controller.step`, as in Feedback.
    latencies : array (M,)
        Seconds from the call of `Controller.step` to the inputs.
    in_time, fell_back : arrays (M,)
        As in Feedback.
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
    def counts(self) -> dict[str, int]:
        """Number of sampling times with each status."""
        return dict(Counter(self.statuses.tolist()))

    @property
    def missed(self) -> int:
        """Number of missed deadlines."""
        return int((~self.in_time).sum())

    def latency(self, percent: float) -> float:
        """Return the latency in seconds that a percentage of the sampling times does not exceed.

        Parameters
        ----------
        percent : float
            Percentage between 0 and 100.

        Returns
        -------
        float
            The percentile of the latencies in seconds, NaN without sampling times.
        """
        return float(np.percentile(self.latencies, percent)) if self.latencies.size else float("nan")

    def plot(
        self, path: Path | str | None = None, references: Mapping[str, Callable[[float], float]] | None = None
    ) -> Picture:
        """Draw states, inputs and latencies.

        Parameters
        ----------
        path : path, optional
            A file .png, .pdf or .svg to write.
        references : dict of str to function, optional
            Functions of time that states or inputs should follow.

        Returns
        -------
        Picture
            The figure, which a notebook shows.

        Raises
        ------
        ArgumentError
            For a reference with an unknown name.
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


def close_loop(
    controller: Controller,
    plant: object,
    *,
    samples: int = 100,
    start: object = None,
    arguments: Mapping[str, object] | None = None,
    disturbances: Mapping[str, Moving] | None = None,
    noise: ArrayLike = 0.0,
    delay: int | None = None,
    inputs: object = None,
    seed: int = 0,
) -> ClosedLoop:
    """Let a controller act on a plant for some sampling times.

    The controller is reset first. A plant that fails ends the loop early, with a message in the result.

    Parameters
    ----------
    controller : Controller
        The controller.
    plant : path, module or function
        A problem file, a generated module or its file, with a function `problem()` that returns a `Simulate`, or for
        `dynamics` a `Control` without controls and cost. Its start has the controller's states, and each input is a
        parameter. Or a function (state (states,), inputs (controls,), t, seconds) -> state after these seconds.
    samples : int
        Number of sampling times.
    start : array (states,) or dict of str to float, optional
        First state, by default the problem's own.
    arguments : dict, optional
        Arguments of problem(), if the plant is a problem file.
    disturbances : dict of str to float or function of time, optional
        Parameters of the plant that the controller does not know. Known disturbances are `parameters` of Controller.
    noise : float, array (states,) or dict of str to float
        Standard deviations of normally distributed measurement errors.
    delay : int, optional
        Number of sampling times between a measurement and the action of its inputs, by default the controller's delay.
        A longer delay is a disturbance.
    inputs : array (controls,) or dict of str to float, optional
        Inputs that act during the first delay, zero by default. A controller with a delay knows these inputs.
    seed : int
        Seed of the noise.

    Returns
    -------
    ClosedLoop
        States, inputs and the results of all sampling times.

    Raises
    ------
    ArgumentError
        For a plant or a delay that does not fit the controller.
    NumericsError
        For unusable numbers.
    CodegenError
        As `codegen.build`, for the problem file of a plant.
    """
    if not isinstance(controller, Controller):
        raise ArgumentError(f"close_loop of a {type(controller).__name__}", "give a codegen.Controller and a plant")
    require_count("samples", samples, 1)
    if delay is None:
        delay = controller.delay
    require_count("delay", delay, 0)
    if delay < controller.delay:
        finding = f"the controller plans for a delay of {controller.delay}, and the loop has one of {delay}"
        raise ArgumentError(finding, "leave delay out here, or give the controller no longer one")
    names = controller.states, controller.inputs
    next_state = plant_of(plant, arguments or {}, names, disturbances or {})
    state = controller.first_state() if start is None else vector(start, controller.states, "the start")
    if isinstance(noise, Mapping):
        if unknown := [name for name in noise if name not in controller.states]:
            finding = clause(f"noise of {unknown[0]!r}, which is no state")
            raise ArgumentError(finding, clause(f"use {', '.join(controller.states)}"))
        noise = [noise.get(name, 0.0) for name in controller.states]
    elif np.ndim(noise) == 0:
        noise = [number(noise, "noise")] * len(controller.states)
    deviations = vector(noise, controller.states, "noise")
    if (deviations < 0.0).any():
        raise NumericsError("noise has a negative standard deviation", "give numbers that are not negative")
    inputs = np.zeros(len(controller.inputs)) if inputs is None else inputs
    inputs = vector(inputs, controller.inputs, "the array of inputs")
    waiting, random, message = [inputs] * int(delay), np.random.default_rng(seed), ""
    controller.reset(inputs if controller.delay else None)
    states, measurements, applied, results = [state], list[Vector](), list[Vector](), list[Feedback]()
    for k in range(samples):
        t = k * controller.sample
        measured = state + deviations * random.standard_normal(state.size)
        waiting.append(controller.step(measured, t))
        acting = waiting.pop(0)
        try:
            state = next_state(state, acting, t, controller.sample)
        except PlantFailed as failure:
            message = f"the plant failed after t = {t:g}: {failure}"
            break
        assert controller.last is not None, "a step stores its feedback"
        states.append(state)
        measurements.append(measured)
        applied.append(acting)
        results.append(controller.last)
    n = len(results)
    return ClosedLoop(
        controller.module.metadata.title,
        controller.states,
        controller.inputs,
        controller.sample,
        controller.options.deadline,
        message,
        times=np.asarray(controller.sample * np.arange(n + 1.0)),
        states=np.array(states),
        measured=np.array(measurements).reshape(n, len(controller.states)),
        inputs=np.array(applied).reshape(n, len(controller.inputs)),
        statuses=np.array([result.status for result in results], dtype=np.str_),
        iterations=np.array([result.iterations for result in results], dtype=np.intp),
        residuals=np.array([result.residual for result in results], dtype=float),
        costs=np.array([result.cost for result in results], dtype=float),
        latencies=np.array([result.seconds for result in results], dtype=float),
        in_time=np.array([result.in_time for result in results], dtype=bool),
        fell_back=np.array([result.fell_back for result in results], dtype=bool),
    )
