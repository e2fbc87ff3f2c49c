"""The prediction of the state by a controller that compensates a delay, and the plant on which a controller acts.

A prediction solves the discrete equations of the controller's module for prescribed inputs. So without disturbances the
predicted state equals the state in a plan with the same inputs. With a delay the plan starts at the predicted state.
Source: Findeisen and Allgoewer (2004), Computational delay in nonlinear model predictive control, IFAC Proceedings
Volumes 37(1).

A plant is a function of the state, or a generated module. The module is a simulation, whose velocities follow from its
momenta, or an optimisation without controls and cost, as for systems of first order. Inputs and disturbances are
parameters of the module.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.mpc.interface import WHOLE, Arguments, Grids, Interface, Moving, Values, control_module, vector
from codegen.runtime.record import Form
from codegen.runtime.search.linear_system import allocate_system, filled_entries
from codegen.runtime.search.point import evaluate
from codegen.solving.loading import ControlModule, Indices, Vector, is_control, is_of_particles
from codegen.solving.request import parameter_arguments

VELOCITY_NEWTON_STEPS, VELOCITY_CLOSE = 20, 1e-12
"""Largest number of Newton steps for velocities, and relative tolerance of the momenta."""


def velocities_of(momenta: Callable[[Vector], Vector], wanted: Vector, guess: Vector) -> Vector:
    """Return the velocities (coordinates,) with the momenta `wanted`, by Newton's method from an initial guess.

    `momenta` maps velocities to momenta; its Jacobian has difference quotients with step one. For kinetic energies that
    are quadratic in velocities they are exact, and one Newton step suffices.
    """
    v = guess
    for _ in range(VELOCITY_NEWTON_STEPS):
        p = momenta(v)
        residual = wanted - p
        if not np.abs(residual).max() > VELOCITY_CLOSE * max(1.0, np.abs(wanted).max()):
            break
        v = v + np.linalg.solve(np.column_stack([momenta(v + unit) - p for unit in np.eye(v.size)]), residual)
    return v


NEWTON_STEPS, CLOSE = 20, 1e-10  # largest number of Newton steps on an interval, and the relative size of the last step


class Motion:
    """The motion of the controller's model over `seconds`, under constant inputs.

    The seconds are a number of `intervals` of a plan, not necessarily whole. The motion is solved on intervals that are
    not longer. Raises ArgumentError for a module whose motion does not follow from its start and its inputs.
    """

    def __init__(self, module: ControlModule, interface: Interface, seconds: float, intervals: float) -> None:
        self._module, self._seconds = module, {"duration": seconds}
        steps = max(1, math.ceil(intervals - WHOLE))
        self._grids = Grids(module, interface, steps, is_searched=False)
        self._starts = Grids(module, interface, 1, is_searched=False)
        coordinates = module.metadata.coordinates
        self._positions = [interface.states.index(name) for name in coordinates if name in interface.states]
        self._rates = [i for i in range(len(interface.states)) if i not in self._positions]
        pair = module.make_grid(2)
        numbers = np.arange(pair.is_multiplier.size, dtype=float)
        first, second = module.views(pair, numbers)[0][0, :2].astype(np.intp)
        self._node, self._stride = first, int(second[0])
        self._controls = module.unpack(pair, numbers)[3][0].astype(np.intp)
        multipliers, primal = module.multiplier_unknowns(pair), module.primal_unknowns(pair)
        self._equations: Indices = multipliers[multipliers < self._stride]
        own = np.setdiff1d(primal[primal < self._stride], self._controls)
        states = np.setdiff1d(primal[np.isin(primal, second)], own + self._stride)
        self._unknowns: Indices = np.concatenate([own, states])
        if self._equations.size != self._unknowns.size or module.metadata.free_parameters:
            finding = f"the state of {module.metadata.problem} does not follow from its start and inputs alone"
            raise ArgumentError(finding, "leave delay out, and give step the state that inputs on their way lead to")
        # Find the entries of an interval's Hessian that belong to its equations of motion, with rows and columns.
        structure = module.problem.structure
        row, column = ({int(j): i for i, j in enumerate(kind)} for kind in (self._equations, self._unknowns))
        pairs = list(enumerate(zip(structure.rows, structure.columns, strict=True)))
        entries = [(k, row[i], column[j]) for k, (i, j) in pairs if i in row and j in column]
        entries += [(k, row[j], column[i]) for k, (i, j) in pairs if j in row and i in column]
        self._entries: tuple[Indices, ...] = tuple(np.array(entries, dtype=np.intp).T)
        self._system = allocate_system(module.make_grid(steps))

    def __call__(self, state: Vector, inputs: Vector, given: Arguments, later: Arguments) -> Vector | None:
        """Return the state (states,) at the end of the motion from `state` under `inputs`, or None if the solve fails.

        The run-time values `given` hold during the motion, and `later` for the velocities at its end.
        """
        grid = self._grids.at(given | self._seconds, state)
        unknowns = self._module.initial_guess(grid)
        matrix = np.zeros((self._equations.size, self._equations.size))
        entry, rows, columns = self._entries
        try:
            for k in range(grid.steps):
                offset = k * self._stride
                unknowns[offset + self._controls] = inputs
                unknowns[offset + self._stride + self._node] = unknowns[offset + self._node]
                equations, solved = offset + self._equations, offset + self._unknowns
                for _ in range(NEWTON_STEPS):
                    residual = evaluate(grid, unknowns).gradient[equations]
                    values = filled_entries(grid, unknowns, self._system)  # entries of intervals come first
                    matrix[rows, columns] = values[k * grid.problem.structure.rows.size + entry]
                    step = np.linalg.solve(matrix, residual)
                    unknowns[solved] -= step
                    largest = np.abs(step).max()
                    if not largest < np.inf:
                        return None
                    if largest <= CLOSE * max(1.0, np.abs(unknowns[solved]).max()):
                        break
                else:
                    return None
            _, q, p, _, _ = self._module.unpack(grid, unknowns)
            after = state.copy()
            after[self._positions] = q[-1]
            if self._rates:
                after[self._rates] = self._velocities(after, p[-1], later)
        except np.linalg.LinAlgError:
            return None
        return after if np.isfinite(after).all() else None

    def _velocities(self, state: Vector, wanted: Vector, later: Arguments) -> Vector:
        """Return the velocities with the momenta `wanted` (coordinates,) at the end of the motion."""
        module, start = self._module, state.copy()
        of_node = self._equations[self._equations < self._node.size]
        grid = self._starts.at(later | self._seconds, start)
        unknowns = module.initial_guess(grid)

        def momenta(rates: Vector) -> Vector:
            start[self._rates] = rates
            grid = self._starts.at(later | self._seconds, start)
            module.problem.pin_values(grid, unknowns, module.views(grid, unknowns)[0])
            p: Vector = module.unpack(grid, unknowns)[2][0]
            # The residual at the first node is the prescribed momentum minus the momentum of the first interval.
            if of_node.size:
                p = p + evaluate(grid, unknowns).gradient[of_node]
            return p

        return velocities_of(momenta, wanted, state[self._rates])


class Delay:
    """The inputs of the last `samples` sampling times, each `seconds` long, and the prediction of the later state."""

    def __init__(self, interface: Interface, values: Values, motion: Motion, samples: int, seconds: float) -> None:
        self._interface, self._values, self._motion = interface, values, motion
        self._samples, self._sample = samples, seconds
        self.reset()

    def reset(self, inputs: object = None) -> None:
        """Set all stored inputs to `inputs` (controls,), zero by default, which act before the controller's inputs."""
        names = self._interface.inputs
        before = np.zeros(len(names)) if inputs is None else vector(inputs, names, "the array of inputs")
        self._waiting = deque([before] * self._samples, self._samples)

    def append(self, inputs: Vector) -> None:
        """Append new inputs (controls,), and drop the oldest inputs."""
        self._waiting.append(inputs.copy())

    def state_after(self, state: Vector, t: float, own: Mapping[str, float] | None) -> Vector | None:
        """Return the state (states,) at the end of the delay that starts at time t, or None if the prediction fails.

        Run-time values are evaluated at each sampling time of the delay, but the values in `own` are constant.
        """
        given = self._values.given(t, own)
        for k, inputs in enumerate(self._waiting, 1):
            later = self._values.given(t + k * self._sample, own)
            after = self._motion(state, inputs, given, later)
            if after is None:
                return None
            state, given = after, later
        return state


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
