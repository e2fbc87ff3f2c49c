"""What is special about an optimal control problem, as its generated module states it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numba import config

from codegen.runtime.addresses import LOOP, callback
from codegen.runtime.kernels import Addressed, problem_of
from codegen.runtime.kkt.specialised import any_shape_address, system_address
from codegen.runtime.linking import link_inner_functions
from codegen.runtime.search.structure import Structure

MOST_KEPT = 4  # searches whose storage is kept, for as many threads


class Loop(Addressed):
    """A loop over intervals."""

    @cached_property
    def compiled(self):
        """The compiled function, or the callback."""
        if self.is_interpreted or config.DISABLE_JIT:
            return callback(LOOP, self.function)
        # Functions of the runtime may be called from Python elsewhere.
        space = self.function.__globals__
        own = [value for value in space.values() if is_inner(value) and value.py_func.__globals__ is space]
        link_inner_functions(own)
        return self.compiled_as(LOOP)


def is_inner(value):
    """Return True for a compiled function that only loops call: a kernel, or a part of a loop."""
    return hasattr(value, "py_func") and value.stats.cache_path is None


@dataclass(frozen=True, eq=False)
class DataDerivatives:
    """How the Lagrangian and the formulas of a problem depend on its data, for sensitivities.

    Data are all parameters but linking variables, time and length of an interval, and numbers of its left node, which
    are those of conditions at inner times. Of an end, the unknowns of its node come behind them, as some are pinned.

    Attributes
    ----------
    quantities : tuple of str
        Names of what derivatives of solutions are by.
    count, parametric : int
        Number of data, and of those among the parameters.
    acting, bounding : array of int
        Parameters on which intervals depend, and those that move bounds.
    rows, columns : array of int
        Unknowns of an interval, and data, of its mixed second derivatives; `start_rows` and so on of the ends.
    loop : Loop
        Fills the gradient (n,) of both ends and of conditions between linking variables; first derivatives by data,
        then mixed ones, of all intervals, of all starts, of all ends; and both (1 + root, count) of the conditions.
    rates, pins : callable
        (grid, given) -> rates (m, bodies, parametric), duration (m,): derivatives of the parameters and the duration.
        (grid, rates) -> moves (m, n): derivatives of pinned unknowns.
    durations : callable
        (grid, unknowns, moves, rates, duration) -> (m, D): derivatives of the durations of D phases.
    bounds : callable or None
        (grid, rates of one quantity) -> lower, upper: derivatives of bounds, where these depend on parameters.
    clock : int or None
        The time of a node among its unknowns.
    """

    quantities: tuple[str, ...]
    count: int
    parametric: int
    acting: Any
    rows: Any
    columns: Any
    start_rows: Any
    start_columns: Any
    end_rows: Any
    end_columns: Any
    loop: Loop
    rates: Callable[..., Any]
    pins: Callable[..., Any]
    durations: Callable[..., Any]
    bounds: Callable[..., Any] | None = None
    bounding: Any = ()
    clock: int | None = None

    def tables(self, structure):
        """Return rows, columns and counts for `sensitivities.change_along`, and the length of what the loop fills.

        The length has two parts: of each interval, and of all others.
        """
        s, sizes = structure, [part.size for part in (self.rows, self.start_rows, self.end_rows)]
        counts = np.array([self.count, self.parametric, s.shared, s.inner_first, s.inner_times, *sizes])
        of_ends = s.bodies * (2 * (self.count + s.node) + sizes[1] + sizes[2])
        return (
            s.in_element(self.rows, self.start_rows, self.end_rows),
            np.concatenate([self.columns, self.start_columns, self.end_columns]), counts,
            (s.bodies * (self.count + sizes[0]), of_ends + (1 + s.root) * self.count),
        )  # fmt: skip


class Storage:
    """Arrays of searches that have ended, for the next searches with as many intervals and bounds.

    Threads may take and keep at any time: methods of lists are atomic.
    """

    def __init__(self):
        self.kept = []

    def take(self, key):
        """Return what was kept last under a key, which nobody else then has, or None."""
        try:
            kept, arrays = self.kept.pop()
        except IndexError:
            return None
        return arrays if kept == key else None

    def keep(self, key, arrays):
        """Keep arrays under a key, unless enough are kept."""
        if len(self.kept) < MOST_KEPT:
            self.kept.append((key, arrays))


@dataclass(frozen=True, eq=False)
class ControlProblem:
    """An optimal control problem: its structure, its loops over intervals, and what depends on the author's formulas.

    Attributes
    ----------
    structure : Structure
    metadata : Record
        Names and meanings.
    gradient, hessians, parts : Loop
        Fill the gradient (n,) of the Lagrangian and return the cost; fill all second derivatives; fill the gradients
        (bodies N, element + shared + 1) of all intervals by themselves, each followed by its cost.
    duration_of : callable
        Length of the time interval: (grid, unknowns) -> float.
    initial_guess, pin_values : callable
        (grid) -> unknowns, and (grid, unknowns, nodes) -> None, which gives what boundary conditions fix its values.
    unpack : callable
        (grid, unknowns) -> times, positions, momenta, controls, multipliers.
    variable_bounds : callable or None
        (grid) -> lower, upper.
    phase_durations : callable or None
        (grid, unknowns) -> lengths of all phases.
    inputs : Loop or None
        Fill the least and greatest inputs of tables with ranges; `ranges` and `range_names` say which these are.
    data : DataDerivatives or None
        Derivatives by data, if the module was built with sensitivities.
    """

    structure: Structure
    metadata: Any
    gradient: Loop
    hessians: Loop
    parts: Loop
    duration_of: Callable[..., Any]
    initial_guess: Callable[..., Any]
    pin_values: Callable[..., Any]
    unpack: Callable[..., Any]
    variable_bounds: Callable[..., Any] | None = None
    phase_durations: Callable[..., Any] | None = None
    inputs: Loop | None = None
    data: DataDerivatives | None = None
    ranges: Any = ()
    range_names: tuple[str, ...] = ()
    tables: Mapping[str, Any] = field(default_factory=dict)
    observations: tuple[Any, ...] = ()

    def __reduce__(self):
        """Pickle the problem as the name of its module, which another process imports."""
        return problem_of, (self.initial_guess.__module__,)

    @cached_property
    def storage(self):
        """The storage of searches that have ended."""
        return Storage()

    @cached_property
    def mixed(self):
        """The tables of mixed second derivatives by unknowns and data."""
        return self.data.tables(self.structure)

    @cached_property
    def system(self):
        """The address of the linear system of Newton's method; interpreted problems share one for all shapes."""
        if self.gradient.is_interpreted or config.DISABLE_JIT:
            return any_shape_address()
        return system_address(self.structure.shape)

    def kernels(self):
        """Return the loops, those that take longest to compile first."""
        of_data = self.data.loop if self.data else None
        loops = self.hessians, of_data, self.gradient, self.parts, self.inputs
        return tuple(loop for loop in loops if loop is not None)

    def compile(self):
        """Compile what is special about the problem: the loops, and the linear system of its shape."""
        for loop in self.kernels():
            loop.address  # noqa: B018
        self.system  # noqa: B018
