"""The loop of a controller and a plant that differs from its model: disturbances, noise, a delay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.horizons.controller import Controller
from codegen.horizons.interface import Moving, number, require_count, vector
from codegen.horizons.plants import PlantFailed, plant_of
from codegen.horizons.recording import ClosedLoop, Recording
from codegen.interfaces import Vector


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
