"""What a controller acts upon: a function of the state, or a generated module that follows the motion for a while.

A module may be a simulation, whose velocities are found from its momenta, or an optimisation in which nothing is left
to be chosen, as for systems of first order. Inputs and disturbances are parameters of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.horizons.interface import Interface, Moving, Values, module_of
from codegen.horizons.motion import velocities_of
from codegen.interfaces import Vector, is_control, is_of_particles, is_simulation
from codegen.solutions.given_values import parameter_arguments

Plant: TypeAlias = Callable[[Vector, Vector, float, float], Vector]
"""The state (states,) after a state, inputs (controls,), the time, and how long they act."""


class PlantFailed(Exception):
    """The plant's equations were not solved, as where a motion runs away."""


def plant_of(
    plant: Any,
    arguments: Mapping[str, Any],
    names: tuple[tuple[str, ...], tuple[str, ...]],
    disturbances: Mapping[str, Moving],
) -> Plant:
    """The plant of a controller's states and inputs, by their `names`: a function, a problem, a module or its file.

    Raises ArgumentError for one whose start has other names than the states, or that has no parameters called like the
    inputs or the disturbances.
    """
    if callable(plant):
        if disturbances:
            finding = "disturbances beside a plant that is a function"
            raise ArgumentError(finding, "have the function disturb itself, or give a module")
        return FunctionPlant(plant, names[0])
    module: Any = module_of(plant, arguments, None, None)
    states, inputs = names
    starts = _start_names(module)
    if set(starts) != set(states):
        finding = f"the plant starts from {', '.join(starts) or 'nothing'}, the controller from {', '.join(states)}"
        raise ArgumentError(clause(finding), "give both the same names")
    parameters = tuple(module.metadata["parameters"])
    if missing := [name for name in inputs if name not in parameters]:
        finding = f"the plant has no parameter {missing[0]}, which is an input of the controller"
        raise ArgumentError(finding, f'declare it there, as in {missing[0]} = parameter("{missing[0]}", 0)')
    if both := [name for name in inputs if name in disturbances]:
        raise ArgumentError(f"{both[0]} is an input of the plant", "disturb another parameter")
    return ModulePlant(module, states, inputs, disturbances)


@dataclass(frozen=True)
class FunctionPlant:
    """A function of the state, the inputs, the time and how long they act, whose results are looked at."""

    function: Callable[[Vector, Vector, float, float], Any]
    states: tuple[str, ...]

    def __call__(self, state: Vector, inputs: Vector, t: float, seconds: float) -> Vector:
        """The next state; NumericsError for what is none, PlantFailed where it is not finite."""
        returned = self.function(state.copy(), inputs.copy(), t, seconds)
        try:
            found = np.array(returned, dtype=float)
        except (TypeError, ValueError):
            finding = clause(f"the plant returned {returned!r}")
            raise NumericsError(finding, f"return {', '.join(self.states)}") from None
        if found.shape != state.shape:
            finding = f"the plant returned an array of shape {found.shape}, expected {state.shape}"
            raise NumericsError(finding, f"return {', '.join(self.states)}")
        if not np.isfinite(found).all():
            raise PlantFailed("its state is not finite")
        return found


def _start_names(module: Any) -> tuple[str, ...]:
    metadata = module.metadata
    is_free = is_control(module) and (metadata["control_names"] or metadata["form"] == "lagrangian")
    if is_of_particles(module) or is_free:
        finding = f"{metadata['problem']} is no plant: it has controls, or particles"
        raise ArgumentError(finding, "give a Simulate, or for dynamics a Control without controls and cost")
    if is_simulation(module):
        return tuple(metadata["start"])
    return tuple(name.removeprefix("start ") for name in metadata["boundary"] if name.startswith("start "))


class ModulePlant:
    """A generated module as a plant; its own time begins anew at every sampling time."""

    def __init__(
        self, module: Any, states: tuple[str, ...], inputs: tuple[str, ...], disturbances: Mapping[str, Moving]
    ) -> None:
        self.module, self.states, self.inputs = module, states, inputs
        self._values = Values(Interface(states, inputs, parameter_arguments(module), ()), disturbances, {}, "the plant")
        metadata = module.metadata
        self._rates = tuple(name for name in _start_names(module) if name not in metadata["coordinates"])
        self._has_velocities = metadata["form"] == "lagrangian"

    def __call__(self, state: Vector, inputs: Vector, t: float, seconds: float) -> Vector:
        """The next state; PlantFailed where the motion could not be followed."""
        given = self._values.given(t, dict(zip(self.inputs, inputs.tolist(), strict=True)))
        given |= {"start": dict(zip(self.states, state.tolist(), strict=True)), "duration": seconds}
        try:
            found = self.module.solve(int(self.module.metadata["steps"]), **given)
        except ValueError as error:
            raise NumericsError(str(error), "correct the plant's numbers") from error
        if found.status != "solved":
            raise PlantFailed(found.message)
        return self._end_of(found, given)

    def _end_of(self, found: Any, given: Mapping[str, Any]) -> Vector:
        values = dict(zip(self.module.metadata["coordinates"], found.q[-1].tolist(), strict=True))
        if self._rates:
            rates = self._velocities(found, given) if self._has_velocities else found.p[-1]
            values |= zip(self._rates, rates.tolist(), strict=True)
        return np.array([values[name] for name in self.states])

    def _velocities(self, found: Any, given: Mapping[str, Any]) -> Vector:
        """The velocities (coordinates,) with the momenta at the end."""
        q = found.q[-1]
        place = dict(zip(self.module.metadata["coordinates"], q.tolist(), strict=True))

        def momenta(v: Vector) -> Vector:
            start = place | dict(zip(self._rates, v.tolist(), strict=True))
            return np.asarray(self.module.make_grid(1, **{**given, "start": start}).start[q.size :])

        return velocities_of(momenta, found.p[-1], np.array([given["start"][name] for name in self._rates]))
