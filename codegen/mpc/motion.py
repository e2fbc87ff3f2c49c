"""The motion of a module's own model under inputs that are given, by the discrete equations of which plans are made.

Where nothing disturbs it, the state at the end is therefore the one that a plan with these inputs has there. A
controller whose inputs act later than at the time of the measurement: it begins where the state will be by then.

Source: Findeisen and Allgoewer (2004), Computational delay in nonlinear model predictive control, IFAC Proceedings
Volumes 37(1).

What a controller acts upon: a function of the state, or a generated module that follows the motion for a while. A
module may be a simulation, whose velocities are found from its momenta, or an optimisation in which nothing is left to
be chosen, as for systems of first order. Inputs and disturbances are parameters of it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.mpc.interface import WHOLE, Grids, Interface, Moving, Values, module_of, vector
from codegen.runtime.record import Form
from codegen.runtime.search.linear_system import allocate_system, filled_entries
from codegen.runtime.search.point import evaluate
from codegen.solving.interfaces import Grid, Indices, Vector, is_control, is_of_particles
from codegen.solving.results.overrides import parameter_arguments

VELOCITY_NEWTON_STEPS, VELOCITY_CLOSE = 20, 1e-12
"""One step is enough where kinetic energy is quadratic in velocities."""


def velocities_of(momenta: Callable[[Vector], Vector], wanted: Vector, guess: Vector) -> Vector:
    """The velocities (coordinates,) with the momenta `wanted`, by Newton's method from a guess.

    Its matrix is that of differences over one, exact for a kinetic energy that is quadratic in velocities.
    """
    v = guess
    for _ in range(VELOCITY_NEWTON_STEPS):
        found = momenta(v)
        missing = wanted - found
        if not np.abs(missing).max() > VELOCITY_CLOSE * max(1.0, np.abs(wanted).max()):
            break
        v = v + np.linalg.solve(np.column_stack([momenta(v + unit) - found for unit in np.eye(v.size)]), missing)
    return v


NEWTON_STEPS, CLOSE = 20, 1e-10
"""On one interval, and the part of what is solved for that the last of them may be."""


class Motion:
    """What a state becomes within `seconds`, which are so many `intervals` of a plan.

    They are divided into intervals that are no longer than those of the plan. Raises ArgumentError for a module whose
    states do not follow from its start and its inputs.
    """

    def __init__(self, module: Any, interface: Interface, seconds: float, intervals: float) -> None:
        self._module, self._seconds = module, {"duration": seconds}
        steps = max(1, math.ceil(intervals - WHOLE))
        self._grids = Grids(module, interface, steps, is_searched=False)
        self._starts = Grids(module, interface, 1, is_searched=False)
        coordinates = module.metadata.coordinates
        self._places = [interface.states.index(name) for name in coordinates if name in interface.states]
        self._rates = [i for i in range(len(interface.states)) if i not in self._places]
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
        self._entries = self._entries_of_matrix()
        self._system = allocate_system(module.make_grid(steps))

    def __call__(self, state: Vector, inputs: Vector, given: dict[str, Any], later: dict[str, Any]) -> Vector | None:
        """The state (states,) after a state under inputs (controls,); None where it cannot be followed.

        The run-time values `given` hold on the way, those of `later` at its end.
        """
        grid = self._grids.at(given | self._seconds, state)
        unknowns = self._module.initial_guess(grid)
        try:
            for k in range(grid.steps):
                here = k * self._stride
                unknowns[here + self._controls] = inputs
                unknowns[here + self._stride + self._node] = unknowns[here + self._node]
                if not self._is_solved(grid, unknowns, k):
                    return None
            _, q, p, _, _ = self._module.unpack(grid, unknowns)
            found = state.copy()
            found[self._places] = q[-1]
            if self._rates:
                found[self._rates] = self._velocities(found, p[-1], later)
        except np.linalg.LinAlgError:
            return None
        return found if np.isfinite(found).all() else None

    def _entries_of_matrix(self) -> tuple[Indices, Indices, Indices]:
        """Which entries of an interval's Hessian belong to its motion, and their rows and columns there."""
        structure = self._module.problem.structure
        row, column = ({int(j): i for i, j in enumerate(kind)} for kind in (self._equations, self._unknowns))
        pairs = list(enumerate(zip(structure.rows, structure.columns, strict=True)))
        found = [(k, row[i], column[j]) for k, (i, j) in pairs if i in row and j in column]
        found += [(k, row[j], column[i]) for k, (i, j) in pairs if j in row and i in column]
        entry, rows, columns = np.array(found, dtype=np.intp).T
        return entry, rows, columns

    def _is_solved(self, grid: Grid, unknowns: Vector, k: int) -> bool:
        """Whether Newton's method finds what interval k leads to, which is put into `unknowns` (n,)."""
        here = k * self._stride
        equations, solved = here + self._equations, here + self._unknowns
        matrix = np.zeros((equations.size, equations.size))
        entry, rows, columns = self._entries
        for _ in range(NEWTON_STEPS):
            residual = evaluate(grid, unknowns).gradient[equations]
            values = filled_entries(grid, unknowns, self._system)  # those of intervals come first
            matrix[rows, columns] = values[k * grid.problem.structure.rows.size + entry]
            step = np.linalg.solve(matrix, residual)
            unknowns[solved] -= step
            largest = np.abs(step).max()
            if not largest < np.inf:
                return False
            if largest <= CLOSE * max(1.0, np.abs(unknowns[solved]).max()):
                return True
        return False

    def _velocities(self, state: Vector, wanted: Vector, later: dict[str, Any]) -> Vector:
        """The rates of a state with its places, and with the momenta (coordinates,) that the motion ended with."""
        module, start = self._module, state.copy()
        of_node = self._equations[self._equations < self._node.size]
        grid = self._starts.at(later | self._seconds, start)
        unknowns = module.initial_guess(grid)

        def momenta(rates: Vector) -> Vector:
            start[self._rates] = rates
            grid = self._starts.at(later | self._seconds, start)
            module.pin_values(grid, unknowns, module.views(grid, unknowns)[0])
            found: Vector = module.unpack(grid, unknowns)[2][0]
            # Discrete equations at the start: what is given there, less the momentum of the first interval.
            if of_node.size:
                found = found + evaluate(grid, unknowns).gradient[of_node]
            return found

        return velocities_of(momenta, wanted, state[self._rates])


class Delay:
    """The inputs of the last `samples` sampling times, which last `seconds`, and the state that they will lead to."""

    def __init__(self, interface: Interface, values: Values, motion: Motion, samples: int, seconds: float) -> None:
        self._interface, self._values, self._motion = interface, values, motion
        self._samples, self._sample = samples, seconds
        self.reset()

    def reset(self, inputs: Any = None) -> None:
        """Have inputs (controls,) on their way that did not come from the controller, zero unless they are given."""
        names = self._interface.inputs
        before = np.zeros(len(names)) if inputs is None else vector(inputs, names, "the array of inputs")
        self._waiting = deque([before] * self._samples, self._samples)

    def append(self, inputs: Vector) -> None:
        """Send inputs (controls,) on their way; the first of the others have acted by then."""
        self._waiting.append(inputs.copy())

    def state_after(self, state: Vector, t: float, own: Mapping[str, float] | None) -> Vector | None:
        """What the state (states,) of a time t is at the end of the delay; None where its motion cannot be followed.

        Run-time values are those of the times on the way; the controller's `own` hold at all of them.
        """
        given = self._values.given(t, own)
        for k, inputs in enumerate(self._waiting, 1):
            later = self._values.given(t + k * self._sample, own)
            found = self._motion(state, inputs, given, later)
            if found is None:
                return None
            state, given = found, later
        return state


def delay_of(
    module: Any, interface: Interface, values: Values, samples: int, seconds: float, intervals: float
) -> Delay | None:
    """The delay of a controller whose sampling time lasts so many seconds, or `intervals` of its plan; None without."""
    if not samples:
        return None
    return Delay(interface, values, Motion(module, interface, seconds, intervals), samples, seconds)


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
    parameters = tuple(module.metadata.parameters)
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
    is_free = is_control(module) and (metadata.control_names or metadata.form == Form.LAGRANGIAN)
    if is_of_particles(module) or is_free:
        finding = f"{metadata.problem} is no plant: it has controls, or particles"
        raise ArgumentError(finding, "give a Simulate, or for dynamics a Control without controls and cost")
    return tuple(metadata.start)


class ModulePlant:
    """A generated module as a plant; its own time begins anew at every sampling time."""

    def __init__(
        self, module: Any, states: tuple[str, ...], inputs: tuple[str, ...], disturbances: Mapping[str, Moving]
    ) -> None:
        self.module, self.states, self.inputs = module, states, inputs
        self._values = Values(Interface(states, inputs, parameter_arguments(module), ()), disturbances, {}, "the plant")
        metadata = module.metadata
        self._rates = tuple(name for name in _start_names(module) if name not in metadata.coordinates)
        self._has_velocities = metadata.form == Form.LAGRANGIAN

    def __call__(self, state: Vector, inputs: Vector, t: float, seconds: float) -> Vector:
        """The next state; PlantFailed where the motion could not be followed."""
        given = self._values.given(t, dict(zip(self.inputs, inputs.tolist(), strict=True)))
        given |= {"start": dict(zip(self.states, state.tolist(), strict=True)), "duration": seconds}
        try:
            found = self.module.solve(int(self.module.metadata.steps), **given)
        except ValueError as error:
            raise NumericsError(str(error), "correct the plant's numbers") from error
        if found.status != "solved":
            raise PlantFailed(found.message)
        values = dict(zip(self.module.metadata.coordinates, found.q[-1].tolist(), strict=True))
        if self._rates:
            rates = self._velocities(found, given) if self._has_velocities else found.p[-1]
            values |= zip(self._rates, rates.tolist(), strict=True)
        return np.array([values[name] for name in self.states])

    def _velocities(self, found: Any, given: Mapping[str, Any]) -> Vector:
        """The velocities (coordinates,) with the momenta at the end."""
        q = found.q[-1]
        place = dict(zip(self.module.metadata.coordinates, q.tolist(), strict=True))

        def momenta(v: Vector) -> Vector:
            start = place | dict(zip(self._rates, v.tolist(), strict=True))
            return np.asarray(self.module.make_grid(1, **{**given, "start": start}).start[q.size :])

        return velocities_of(momenta, found.p[-1], np.array([given["start"][name] for name in self._rates]))
