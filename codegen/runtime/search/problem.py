"""The definition of an optimal control problem: structure, loops and formulas that its generated module passes."""

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
from codegen.runtime.record import ControlRecord
from codegen.runtime.search.structure import Structure

MOST_KEPT = 4  # searches whose storage is kept, one for each of four threads


class Loop(Addressed):
    """A loop over intervals."""

    @cached_property
    def compiled(self):
        """The compiled function, or the callback."""
        if self.is_interpreted or config.DISABLE_JIT:
            return callback(LOOP, self.function)
        # Only functions of the module itself are linked: Python may call functions of the runtime elsewhere.
        space = self.function.__globals__
        link_inner_functions(
            value for value in space.values() if is_inner(value) and value.py_func.__globals__ is space
        )
        return self.compiled_as(LOOP)


def is_inner(value):
    """Return True for a compiled function that only loops call: a kernel, or a part of a loop."""
    return hasattr(value, "py_func") and value.stats.cache_path is None


@dataclass(frozen=True, eq=False)
class DataDerivatives:
    """Derivatives of the Lagrangian and of the formulas of a problem by its data, for sensitivities.

    Data are all parameters but linking variables, time and length of an interval, and numbers of its left node from
    conditions at inner times. For an end, the unknowns of its node follow, since some are pinned.

    Attributes
    ----------
    quantities : tuple of str
        Names of the quantities by which solutions are differentiated.
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
        (grid, rates of one quantity) -> lower, upper: derivatives of bounds that depend on parameters.
    clock : int or None
        The time of a node among its unknowns.
    """

    quantities: tuple[str, ...]
    count: int
    parametric: int
    acting: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    start_rows: np.ndarray
    start_columns: np.ndarray
    end_rows: np.ndarray
    end_columns: np.ndarray
    loop: Loop
    rates: Callable[..., Any]
    pins: Callable[..., Any]
    durations: Callable[..., Any]
    bounds: Callable[..., Any] | None = None
    bounding: Any = ()
    clock: int | None = None

    def tables(self, structure):
        """Return rows, columns and counts for `sensitivities.change_along`, and the length of the result of the loop.

        The length has two parts: the numbers of each interval, and all others.
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
    """Arrays of finished searches, used again by searches with as many intervals and bounds.

    Threads may take and keep at any time: methods of lists are atomic.
    """

    def __init__(self):
        self.kept = []

    def take(self, key):
        """Remove and return the arrays that were kept last, or None if their key differs."""
        try:
            kept, arrays = self.kept.pop()
        except IndexError:
            return None
        return arrays if kept == key else None

    def keep(self, key, arrays):
        """Keep arrays under a key, unless the storage is full."""
        if len(self.kept) < MOST_KEPT:
            self.kept.append((key, arrays))


@dataclass(frozen=True, eq=False)
class ControlProblem:
    """An optimal control problem: structure, loops over intervals, and functions made from the author's formulas.

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
        (grid) -> unknowns, and (grid, unknowns, nodes) -> None, which sets prescribed boundary values.
    unpack : callable
        (grid, unknowns) -> times, positions, momenta, controls, multipliers.
    variable_bounds : callable or None
        (grid) -> lower, upper.
    phase_durations : callable or None
        (grid, unknowns) -> lengths of all phases.
    inputs : Loop or None
        Fills the least and greatest inputs of tables with ranges; `ranges` and `range_names` identify the inputs.
    data : DataDerivatives or None
        Derivatives by data, if the module was built with sensitivities.
    """

    structure: Structure
    metadata: ControlRecord
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
    tables: Mapping[str, np.ndarray] = field(default_factory=dict)
    observations: tuple[np.ndarray, ...] = ()

    def __reduce__(self):
        """Pickle the problem as the name of its module, which another process imports."""
        return problem_of, (self.initial_guess.__module__,)

    @cached_property
    def storage(self):
        """The storage of finished searches."""
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
        """Compile the loops of the problem and the linear system of its shape."""
        for loop in self.kernels():
            loop.address  # noqa: B018
        self.system  # noqa: B018
