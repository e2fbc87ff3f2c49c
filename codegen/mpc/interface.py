"""The interface of a controller to a generated module: names, run-time values, grids, shift of a plan, prediction.

The grids of successive sampling times share bounds and the storage of the solver.

A plan (the unknowns of a solve) is shifted in time as the initial guess of the next solve. A shift by a whole number of
intervals moves values to earlier nodes and intervals. Other shifts interpolate linearly between nodes, and between the
controls of successive intervals. Beyond the end the nodes follow the straight line of the last interval, and controls
stay constant. Source: Diehl, Bock and Schloeder (2005), A real-time iteration scheme for nonlinear optimization in
optimal feedback control, SIAM J. Control Optim. 43.

A controller that compensates a delay predicts the state. A prediction solves the discrete equations of the module for
prescribed inputs. So without disturbances the predicted state equals the state in a plan with the same inputs. With a
delay the plan starts at the predicted state. Source: Findeisen and Allgoewer (2004), Computational delay in nonlinear
model predictive control, IFAC Proceedings Volumes 37(1).
"""

from __future__ import annotations

import inspect
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from codegen.errors import ArgumentError, NumericsError, clause, is_count, nearest
from codegen.runtime.record import Sites, Task
from codegen.runtime.search.bounds import contradictory_bounds
from codegen.runtime.search.iterates import Search, on_grid, search_on
from codegen.runtime.search.linear_system import allocate_system, filled_entries
from codegen.runtime.search.point import evaluate
from codegen.solving.api import module_of
from codegen.solving.loading import ControlModule, Grid, Indices, Vector
from codegen.solving.progress import building
from codegen.solving.request import SCALINGS, Request, as_number, parameter_arguments
from codegen.solving.results.result import component_names

WHOLE = 1e-9
"""Largest difference, in intervals, of a sampling time from a whole number of intervals, up to which it is rounded."""

Arguments: TypeAlias = dict[str, Any]  # arguments of the functions of a generated module, by name


@dataclass(frozen=True)
class Interface:
    """The names of the values of a module: states at the start, inputs (controls), and parameters.

    `keys` maps parameters to arguments of the module's functions, whose names differ for reserved words of Python.
    `ends` names the states with prescribed values at the end; the run-time value of a state x is named `end.x`.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    keys: Mapping[str, str]
    ends: tuple[str, ...]

    def set_value(self, given: Arguments, name: str, value: float) -> None:
        """Set a run-time value in `given`, the keyword arguments of the module's functions."""
        if name in self.keys:
            given[self.keys[name]] = value
        else:
            given.setdefault("end", {})[name.removeprefix("end.")] = value

    def require_known(self, names: Iterable[str], what: str) -> None:
        """Raise ArgumentError, with a similar name, for names that are no run-time values."""
        known = (*self.keys, *(f"end.{name}" for name in self.ends))
        for name in names:
            if name not in known:
                remedy = nearest(name, known, f"use one of {', '.join(known) or 'none'}")
                raise ArgumentError(clause(f"{what} has no parameter {name!r}"), clause(remedy))

    @property
    def start(self) -> slice:
        """The slice of the states at the start within the parameters of a grid."""
        return slice(len(self.keys), len(self.keys) + len(self.states))

    def start_of(self, grid: Grid) -> Vector:
        """Return the states (states,) at the start of a grid."""
        return np.array(grid.parameters[0, self.start])


def vector(values: object, names: tuple[str, ...], what: str, is_finite: bool = True) -> Vector:
    """Return numbers (names,) in the order of `names`, from an array or a mapping.

    Raises NumericsError for other values, and with `is_finite` also for numbers that are not finite.
    """
    remedy = f"give {', '.join(names)}, in this order or by name"
    if isinstance(values, Mapping):
        if values.keys() != set(names):
            wrong = sorted({*values} ^ {*names}, key=str)[0]
            raise NumericsError(clause(f"{what} {'lacks' if wrong in names else 'has no'} {wrong}"), clause(remedy))
        values = [values[name] for name in names]
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise NumericsError(clause(f"{what} is {values!r}"), clause(remedy)) from None
    if array.shape != (len(names),):
        raise NumericsError(f"{what} has shape {array.shape}, expected ({len(names)},)", clause(remedy))
    if is_finite and not all(map(math.isfinite, array.tolist())):  # three times as fast as numpy for short arrays
        wrong = names[int(np.flatnonzero(~np.isfinite(array))[0])]
        raise NumericsError(f"{what} is not finite: {wrong} is {array[names.index(wrong)]}", "give finite numbers")
    return array


def number(value: object, what: str) -> float:
    """Return `value` as a finite number; raises NumericsError, with a message about `what`, for other values."""
    result = as_number(value)
    if not math.isfinite(result):
        raise NumericsError(clause(f"{what} is {value!r}"), "give a finite number")
    return result


def require_count(name: str, value: object, least: int) -> None:
    """Raise NumericsError if the value of the option `name` is no whole number, or is smaller than `least`."""
    if not is_count(value, least):
        remedy = "a positive integer" if least else "a whole number that is not negative"
        raise NumericsError(f"{name} is {value!r}", f"give {remedy}")


def interface_of(module: Any) -> Interface:
    """Return the interface of a module; raises ArgumentError unless it is an optimisation over a fixed horizon."""
    metadata: Any = getattr(module, "metadata", None)
    problem = metadata.problem if metadata else "it"
    if metadata is None or metadata.task != Task.CONTROL:
        what = f"{problem} is a {metadata.task} problem" if metadata else f"{type(module).__name__} is no module"
        raise ArgumentError(f"{what}, and a controller needs an optimisation", "give a problem that returns Control")
    keywords = inspect.signature(module.make_grid).parameters
    sites = "stages" if metadata.controls == Sites.STAGES else "nodes"
    unsupported = (
        (metadata.bodies > 1, "has several bodies", "write each as states and controls of its own"),
        (metadata.phases > 1, "has several phases", "give a problem of one phase"),
        (metadata.segments is not None, "has values of the past", "write them as states of their own"),
        (bool(metadata.inner_times), "has conditions at inner times", "write them as path=, or as a cost"),
        ("duration" not in keywords, "has a free duration", "give duration= a number, or solve it once"),
        (bool(metadata.contact_forces), "has contact forces among its controls", "write them as forces of springs"),
        (metadata.controls != Sites.INTERVAL, f"has controls at {sites}", "build it with controls='interval'"),
    )
    for is_present, feature, remedy in unsupported:
        if is_present:
            raise ArgumentError(f"{problem} {feature}, which a controller cannot shift in time", remedy)
    if not metadata.start:
        remedy = "write the state that is measured into start={...}"
        raise ArgumentError(f"{problem} prescribes nothing at the start", remedy)
    inputs = component_names(metadata)["u"]
    if not inputs:
        raise ArgumentError(f"{problem} has no controls", "give a problem with codegen.control(...)")
    return Interface(metadata.start, inputs, parameter_arguments(module), metadata.end)


def control_module(
    problem: Any, arguments: Mapping[str, object], scheme: str | None, method: str | None
) -> ControlModule:
    """Return a loaded and compiled module, from a problem, the file of a module, or a module.

    Raises the errors of `codegen.solve` for a problem that cannot be read, derived or stored.
    """
    made = module_of(Request(problem, arguments=arguments, scheme=scheme, method=method), building)
    made.require(building)
    return made.module  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Options:
    """The options of a controller, with times in seconds; for None the default in `Controller` applies."""

    steps: int | None
    horizon: float | None
    sample: float | None
    tolerance: float
    newton_steps: int | None
    deadline: float | None
    scaling: str
    delay: int

    def __post_init__(self) -> None:
        """Raise an error for invalid options."""
        for name in ("steps", "newton_steps"):
            if getattr(self, name) is not None:
                require_count(name, getattr(self, name), 1)
        require_count("delay", self.delay, 0)
        for name in ("horizon", "sample", "deadline"):
            value = getattr(self, name)
            if value is not None and not 0.0 < as_number(value) < float("inf"):
                raise NumericsError(f"{name} is {value!r}", "give a positive number of seconds")
        if not 0.0 < as_number(self.tolerance) < 1.0:
            raise ArgumentError(f"tolerance is {self.tolerance!r}", "give a number between 0 and 1")
        if self.scaling not in SCALINGS:
            raise ArgumentError(f"scaling is {self.scaling!r}", f"use one of {', '.join(SCALINGS)}")


Moving: TypeAlias = float | Callable[[float], float]  # a run-time value: a number, or a function of time


class Values:
    """The run-time values of a controller or plant: parameters, and prescribed values at the end, named `end.x`.

    `of_solves` are further arguments of all solves; `what` names the owner of the values in messages. Raises
    ArgumentError for an unknown name, and NumericsError for a value that is no function and no finite number.
    """

    def __init__(
        self, interface: Interface, values: Mapping[str, Moving], of_solves: Arguments, what: str = "the problem"
    ) -> None:
        if not isinstance(values, Mapping):
            finding = clause(f"run-time values of {what} are {values!r}")
            raise ArgumentError(finding, 'give names and values, such as {"place": 1.0}')
        self._interface, self._of_solves, self._what = interface, dict(of_solves), what
        interface.require_known(values, what)
        self._constants = {n: number(v, f"parameter {n}") for n, v in values.items() if not callable(v)}
        self._moving = {n: v for n, v in values.items() if callable(v)}

    def given(self, t: float, own: Mapping[str, float] | None = None) -> Arguments:
        """Return the keyword arguments of the module's functions at time t; values in `own` replace the stored ones."""
        arguments = dict(self._of_solves)
        for name, value in self._constants.items():
            self._interface.set_value(arguments, name, value)
        for name, function in self._moving.items():
            self._interface.set_value(arguments, name, number(function(t), f"parameter {name} at t = {t:g}"))
        if own:
            self._interface.require_known(own, self._what)
            for name, value in own.items():
                self._interface.set_value(arguments, name, number(value, f"parameter {name}"))
        return arguments


class Grids:
    """The grids of a module with a number of steps; the last grid is used again if only the state changes.

    `search` is the storage of the solver for the last grid. If `is_searched` is False, there are no storage and bounds.
    """

    def __init__(self, module: ControlModule, interface: Interface, steps: int, is_searched: bool = True) -> None:
        self._module, self._steps, self._interface, self._is_searched = module, steps, interface, is_searched
        self._is_bounded = is_searched and bool(module.metadata.inequalities)
        self._given: Arguments | None = None
        self._last: Any = None
        self.search: Search | None = None

    def at(self, given: Arguments, start: Vector | None = None) -> Grid:
        """Return the grid with the run-time values `given` and with bounds; the next call may change the same grid.

        The state is `start` (states,), by default the problem's own. Raises NumericsError for unusable values.
        """
        if start is None or self._given != given:
            grid: Any = self.separate(given)
            same = self.search is not None
            if self._is_bounded:
                bounds = self._module.variable_bounds(grid)
                # The comparison of bytes is ten times as fast as `array_equal`.
                pairs = zip(bounds, self._last.bounds, strict=True) if same else ()
                same = same and all(one.tobytes() == other.tobytes() for one, other in pairs)
                grid = grid._replace(bounds=self._last.bounds if same else bounds)
            self._last = grid
            if self._is_searched and same:  # with unchanged bounds the storage of the last grid is used again
                self.search = on_grid(self.search, grid)
            elif self._is_searched:
                is_contradictory = self._is_bounded and contradictory_bounds(grid) >= 0
                self.search = None if is_contradictory else search_on(grid)
            self._given = None if start is None else given
        if start is not None:
            self._last.parameters[0, self._interface.start] = start
        return self._last  # type: ignore[no-any-return]

    def separate(self, given: Arguments) -> Grid:
        """Return a new grid with the run-time values `given`, which may include the state."""
        try:
            return self._module.make_grid(self._steps, **given)
        except (ValueError, ArithmeticError) as error:  # generated modules raise built-in exceptions
            raise NumericsError(str(error), "correct the run-time values") from error


def shift_by(module: ControlModule, grid: Grid, intervals: float) -> Callable[[Vector], Vector]:
    """Return a function that shifts the unknowns (n,) of a plan by a number of intervals to an earlier time.

    The number may be fractional; intervals have equal length. Each unknown becomes a weighted sum of two unknowns.
    Unknowns of the first and last node alone, such as velocities there, are not shifted, because they are zero at inner
    nodes. Linking variables are not shifted either.
    """
    numbers = np.arange(grid.is_multiplier.size, dtype=float)
    of_nodes, of_intervals = module.views(grid, numbers)
    one, two, first, second = numbers.copy(), numbers.copy(), np.ones(numbers.size), np.zeros(numbers.size)
    (one_node, one_interval), (two_node, two_interval) = (module.views(grid, indices) for indices in (one, two))
    (node_first, interval_first), (node_second, interval_second) = (
        module.views(grid, weights) for weights in (first, second)
    )
    # Interpolate between nodes linearly; beyond the end, continue the line of the last interval.
    positions, last = np.arange(grid.steps + 1) + intervals, grid.steps - 1
    floor = np.minimum(positions.astype(int), last)
    one_node[:], two_node[:] = of_nodes[:, floor], of_nodes[:, floor + 1]
    node_second[:] = (positions - floor)[:, None]
    node_first[:] = 1.0 - node_second
    # Take the weighted mean of two intervals.
    positions = positions[:-1]
    floor = positions.astype(int)
    one_interval[:], two_interval[:] = (of_intervals[:, np.minimum(index, last)] for index in (floor, floor + 1))
    interval_second[:] = np.where(floor < last, positions - floor, 0.0)[:, None]
    interval_first[:] = 1.0 - interval_second
    for only in module.problem.structure.only_at_ends:
        one_node[:, :, only] = of_nodes[:, :, only]
        node_first[:, :, only] = node_second[:, :, only] = 0.0
        node_first[:, [0, -1], only] = 1.0
    at_one, at_two = one.astype(np.intp), two.astype(np.intp)
    if not second.any():
        return lambda unknowns: first * unknowns.take(at_one)
    return lambda unknowns: first * unknowns[at_one] + second * unknowns[at_two]


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
