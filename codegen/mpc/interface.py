"""What a controller needs of a module: the names of states, inputs and run-time values, and what it cannot control.

The grids of sampling times: what stays from one to the next, bounds and a solver's storage, is made once.

The shifted solution: what a plan says of the time that follows, as the start of the next solve. By a whole number of
intervals values move to earlier nodes and intervals; by another, they are interpolated, linearly between nodes, and in
the mean where controls are constant. Beyond the end nodes follow the last interval's straight line, and controls stay.
Source: Diehl, Bock and Schloeder (2005), A real-time iteration scheme for nonlinear optimization in optimal feedback
control, SIAM J. Control Optim. 43.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from codegen.errors import ArgumentError, NumericsError, clause
from codegen.runtime.record import Sites, Task
from codegen.runtime.search.bounds import contradictory_bounds
from codegen.runtime.search.iterates import on_grid, search_on
from codegen.solving import compiler, loading
from codegen.solving.interfaces import ControlModule, Grid, Indices, Vector
from codegen.solving.machine_code import ahead_of_time
from codegen.solving.request import SCALINGS, Request
from codegen.solving.results.overrides import as_number, parameter_arguments
from codegen.solving.results.result import component_names

_SITES = {"nodal": "nodes", "stages": "stages"}
WHOLE_STATE = "write the state that is measured into start={...}"


@dataclass(frozen=True)
class Interface:
    """The names by which a module is given values: states at the start, inputs (controls), and parameters.

    `keys` maps parameters to arguments of the module's functions, which are called otherwise where Python has a word of
    that name; `ends` are prescribed values at the end, given as `end.x`.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    keys: Mapping[str, str]
    ends: tuple[str, ...]

    def place(self, given: dict[str, Any], name: str, value: float) -> None:
        """Put a run-time value among the arguments of the module's functions."""
        if name in self.keys:
            given[self.keys[name]] = value
        else:
            given.setdefault("end", {})[name.removeprefix("end.")] = value

    def require_known(self, names: Iterable[str], what: str) -> None:
        """Refuse names that are no run-time values; ArgumentError tells which are close."""
        known = (*self.keys, *(f"end.{name}" for name in self.ends))
        for name in names:
            if name not in known:
                close = difflib.get_close_matches(str(name), known, 1)
                remedy = f"did you mean {close[0]}?" if close else f"use one of {', '.join(known) or 'none'}"
                raise ArgumentError(clause(f"{what} has no parameter {name!r}"), clause(remedy))

    @property
    def start(self) -> slice:
        """Where the values at the start of a grid stand: behind its parameters, before those at the end."""
        return slice(len(self.keys), len(self.keys) + len(self.states))

    def start_of(self, grid: Grid) -> Vector:
        """The values (states,) at the start of a grid."""
        return np.array(grid.parameters[0, self.start])

    def state_vector(self, state: Any, what: str = "the state") -> Vector:
        """A state as an array (states,), from one or from a mapping by names; NumericsError for another one."""
        return vector(state, self.states, what)


def vector(values: Any, names: tuple[str, ...], what: str) -> Vector:
    """Numbers in the order of names as an array, from one or from a mapping; NumericsError where they are none."""
    remedy = f"give {', '.join(names)}, in this order or by name"
    if isinstance(values, Mapping):
        if values.keys() != set(names):
            wrong = sorted({*values} ^ {*names}, key=str)[0]
            raise NumericsError(clause(f"{what} {'lacks' if wrong in names else 'has no'} {wrong}"), clause(remedy))
        values = [values[name] for name in names]
    try:
        found = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise NumericsError(clause(f"{what} is {values!r}"), clause(remedy)) from None
    if found.shape != (len(names),):
        raise NumericsError(f"{what} has shape {found.shape}, expected ({len(names)},)", clause(remedy))
    if not all(map(math.isfinite, found.tolist())):  # of few numbers, in a third of the time of numpy
        wrong = names[int(np.flatnonzero(~np.isfinite(found))[0])]
        raise NumericsError(f"{what} is not finite: {wrong} is {found[names.index(wrong)]}", "give finite numbers")
    return found


def number(value: Any, what: str) -> float:
    """A finite number; NumericsError for what is none."""
    found = as_number(value)
    if not math.isfinite(found):
        raise NumericsError(clause(f"{what} is {value!r}"), "give a finite number")
    return found


def require_count(name: str, value: Any, least: int) -> None:
    """Refuse what is no whole number from `least` on, zero or one, with a NumericsError."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        remedy = "a positive integer" if least else "a whole number that is not negative"
        raise NumericsError(f"{name} is {value!r}", f"give {remedy}")


def interface_of(module: Any) -> Interface:
    """The interface of a module of an optimisation over a horizon of given length; ArgumentError for another one."""
    metadata: Any = getattr(module, "metadata", None)
    problem = metadata.problem if metadata else "it"
    if metadata is None or metadata.task != Task.CONTROL:
        what = f"{problem} is a {metadata.task} problem" if metadata else f"{type(module).__name__} is no module"
        raise ArgumentError(f"{what}, and a controller needs an optimisation", "give a problem that returns Control")
    for is_there, what, remedy in _unfit(module):
        if is_there:
            raise ArgumentError(f"{problem} {what}, which a controller cannot shift in time", remedy)
    if not metadata.start:
        raise ArgumentError(f"{problem} prescribes nothing at the start", WHOLE_STATE)
    inputs = component_names(metadata)["u"]
    if not inputs:
        raise ArgumentError(f"{problem} has no controls", "give a problem with codegen.control(...)")
    return Interface(metadata.start, inputs, parameter_arguments(module), metadata.end)


def _unfit(module: Any) -> tuple[tuple[bool, str, str], ...]:
    """What a controller has no notion of, and what to do about it."""
    metadata = module.metadata
    keywords = inspect.signature(module.make_grid).parameters
    return (
        (metadata.bodies > 1, "has several bodies", "write each as states and controls of its own"),
        (metadata.phases > 1, "has several phases", "give a problem of one phase"),
        (metadata.segments is not None, "has values of the past", "write them as states of their own"),
        (bool(metadata.inner_times), "has conditions at inner times", "write them as path=, or as a cost"),
        ("duration" not in keywords, "has a free duration", "give duration= a number, or solve it once"),
        (
            metadata.controls != Sites.INTERVAL, f"has controls at {_SITES.get(metadata.controls, 'other places')}",
            "build it with controls='interval'",
        ),
    )  # fmt: skip


def module_of(problem: Any, arguments: Mapping[str, Any], scheme: str | None, method: str | None) -> ControlModule:
    """A module, loaded, with machine code: from a problem, from the file of a module, or as it is given.

    Raises what `codegen.solve` does for a problem that cannot be read, derived or stored.
    """
    request = Request(problem, arguments=arguments, scheme=scheme, method=method)
    if request.is_built and not isinstance(problem, Path | str):
        return problem  # type: ignore[no-any-return]
    if request.is_built:
        path, is_new = Path(problem), False
    else:
        made = compiler.build(
            request.source, request.arguments, scheme=request.scheme, method=request.method, controls=request.controls
        )
        path, is_new = made.path, made.written
    module: Any = loading.load(path)
    ahead_of_time.require(path, module, is_new, nullcontext)
    return module  # type: ignore[no-any-return]


WHOLE = 1e-9
"""Parts of an interval by which a sampling time may miss a whole number of them."""


@dataclass(frozen=True)
class Options:
    """What is asked of a controller; see Controller, whose default a None stands for. Times are in seconds."""

    steps: int | None
    horizon: float | None
    sample: float | None
    tolerance: float
    newton_steps: int | None
    deadline: float | None
    scaling: str
    delay: int

    def __post_init__(self) -> None:
        """Refuse what is unusable whatever the problem is."""
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

    @staticmethod
    def intervals_of(sample: float, horizon: float, steps: int) -> float:
        """How many intervals a sampling time lasts, a whole number where it nearly is one.

        Raises NumericsError where it is longer than the horizon.
        """
        intervals = sample * steps / horizon
        if intervals > steps * (1.0 + WHOLE):
            finding = f"the sampling time {sample:g} is longer than the horizon {horizon:g}"
            raise NumericsError(finding, "give a shorter sample, or a longer horizon")
        whole = round(intervals)
        return float(whole) if abs(intervals - whole) <= WHOLE else intervals


Moving: TypeAlias = float | Callable[[float], float]
"""A run-time value: a number, or a function of the present time."""


class Values:
    """The values that a controller, or `what` is called so, was given: parameters and prescribed ends, as `end.x`.

    Raises ArgumentError for a name that there is not or a value that is neither a number nor a function, NumericsError
    for a number that is not finite.
    """

    def __init__(
        self,
        interface: Interface,
        values: Mapping[str, Moving],
        of_solves: Mapping[str, Any],
        what: str = "the problem",
    ) -> None:
        if not isinstance(values, Mapping):
            finding = clause(f"run-time values of {what} are {values!r}")
            raise ArgumentError(finding, 'give names and values, such as {"place": 1.0}')
        self._interface, self._of_solves, self._what = interface, dict(of_solves), what
        interface.require_known(values, what)
        self._constants = {n: number(v, f"parameter {n}") for n, v in values.items() if not callable(v)}
        self._moving = {n: v for n, v in values.items() if callable(v)}

    def given(self, t: float, own: Mapping[str, float] | None = None) -> dict[str, Any]:
        """The arguments of the module's functions at a time, with values that hold at this time alone."""
        given = dict(self._of_solves)
        for name, value in self._constants.items():
            self._interface.place(given, name, value)
        for name, function in self._moving.items():
            self._interface.place(given, name, number(function(t), f"parameter {name} at t = {t:g}"))
        if own:
            self._interface.require_known(own, self._what)
            for name, value in own.items():
                self._interface.place(given, name, number(value, f"parameter {name}"))
        return given


class Grids:
    """Makes grids of so many steps of a module, and keeps the last one, whose state alone most often changes.

    `search` is what a search on the last grid can take over from those before, or None. Grids on which
    nothing `is_searched` have no bounds either.
    """

    def __init__(self, module: Any, interface: Interface, steps: int, is_searched: bool = True) -> None:
        self._module, self._steps, self._interface, self._is_searched = module, steps, interface, is_searched
        self._is_bounded = is_searched and bool(module.metadata.inequalities)
        self._given: dict[str, Any] | None = None
        self._last: Any = None
        self.search: Any = None

    def at(self, given: dict[str, Any], start: Vector | None = None) -> Grid:
        """The grid with run-time values, and with its bounds; it holds until the next one is asked for.

        The state is `start` (states,), by default the problem's own. Raises NumericsError for values that are unusable.
        """
        if start is None or self._given != given:
            self._keep(self.separate(given))
            self._given = None if start is None else given
        if start is not None:
            self._last.parameters[0, self._interface.start] = start
        return self._last  # type: ignore[no-any-return]

    def separate(self, given: dict[str, Any]) -> Grid:
        """A grid of its own with run-time values, among which the state may be."""
        try:
            return self._module.make_grid(self._steps, **given)  # type: ignore[no-any-return]
        except ValueError as error:  # modules know nothing of errors of this package
            raise NumericsError(str(error), "correct the run-time values") from error

    def _keep(self, grid: Any) -> None:
        """Keep a grid; where its bounds are those of the last one, with these, and with the search that has them."""
        module, same = self._module, self.search is not None
        if self._is_bounded:
            bounds = module.variable_bounds(grid)
            same = same and all(map(_are_same, bounds, self._last.bounds))
            grid = grid._replace(bounds=self._last.bounds if same else bounds)
        self._last = grid
        if self._is_searched:
            is_contradictory = not same and self._is_bounded and contradictory_bounds(grid) >= 0
            self.search = on_grid(self.search, grid) if same else None if is_contradictory else search_on(grid)


def _are_same(one: Vector, other: Vector) -> bool:
    """Return True if two arrays hold the same bits, in a tenth of the time of `array_equal`."""
    return one.tobytes() == other.tobytes()


@dataclass(frozen=True, eq=False)
class Shift:
    """A linear map of unknowns (n,): each is a sum of two others, `one` and `two`, with weights.

    `is_single` says that it is the first of them alone.
    """

    one: Indices
    two: Indices
    weight_one: Vector
    weight_two: Vector
    is_single: bool

    def __call__(self, unknowns: Vector) -> Vector:
        """The unknowns (n,) of the plan as it is at the next sampling time."""
        if self.is_single:
            return self.weight_one * unknowns.take(self.one)
        return self.weight_one * unknowns[self.one] + self.weight_two * unknowns[self.two]


def shift_by(module: Any, grid: Grid, intervals: float) -> Shift:
    """The shift by so many intervals of a grid, a number that need not be whole; intervals are equally long.

    What only the ends have, such as their velocities, stays where it is, since it is zero at inner nodes; so do
    unknowns that no node has.
    """
    numbers = np.arange(grid.is_multiplier.size, dtype=float)
    of_nodes, of_intervals = module.views(grid, numbers)
    one, two, first, second = numbers.copy(), numbers.copy(), np.ones(numbers.size), np.zeros(numbers.size)
    (one_node, one_interval), (two_node, two_interval) = (module.views(grid, indices) for indices in (one, two))
    (node_first, interval_first), (node_second, interval_second) = (
        module.views(grid, weights) for weights in (first, second)
    )
    # Nodes lie on the line through two neighbours, which beyond the end is that of the last interval.
    places, last = np.arange(grid.steps + 1) + intervals, grid.steps - 1
    left = np.minimum(places.astype(int), last)
    one_node[:], two_node[:] = of_nodes[:, left], of_nodes[:, left + 1]
    node_second[:] = (places - left)[:, None]
    node_first[:] = 1.0 - node_second
    # Intervals have the mean of what two of them have.
    places = places[:-1]
    left = places.astype(int)
    one_interval[:], two_interval[:] = (of_intervals[:, np.minimum(which, last)] for which in (left, left + 1))
    interval_second[:] = np.where(left < last, places - left, 0.0)[:, None]
    interval_first[:] = 1.0 - interval_second
    for only in module.problem.structure.only_at_ends:
        one_node[:, :, only] = of_nodes[:, :, only]
        node_first[:, :, only] = node_second[:, :, only] = 0.0
        node_first[:, [0, -1], only] = 1.0
    return Shift(one.astype(np.intp), two.astype(np.intp), first, second, not second.any())
