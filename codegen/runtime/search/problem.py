"""The definition of an optimal control problem: the structure, loops and formulas of a generated module."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numba import config

from codegen.runtime.addresses import LOOP, callback
from codegen.runtime.formulas import translate_formulas
from codegen.runtime.kernels import Addressed, is_kept, problem_of
from codegen.runtime.kkt.specialised import compiled_system
from codegen.runtime.linking import link_inner_functions
from codegen.runtime.record import ControlRecord
from codegen.runtime.search.structure import Structure

MOST_KEPT = 4  # largest number of searches whose storage is kept: one for each of four threads


class Loop(Addressed):
    """A compiled function that loops over all intervals and fills an array."""

    @cached_property
    def compiled(self):
        """The compiled function, or the callback if the loop is interpreted."""
        if self.is_interpreted or config.DISABLE_JIT:
            return callback(LOOP, self.function)
        space = self.function.__globals__
        if not is_kept(self.function):
            translate_formulas(space)
        # Only functions of the generated module are linked. Python may call functions of the runtime directly.
        link_inner_functions(
            value for value in space.values() if is_inner(value) and value.py_func.__globals__ is space
        )
        return self.compiled_as(LOOP)


def is_inner(value):
    """Return True for a compiled function that is called by loops only: a kernel, or a part of a loop."""
    return hasattr(value, "py_func") and value.stats.cache_path is None


@dataclass(frozen=True, eq=False)
class DataDerivatives:
    """Derivatives of the Lagrangian and of the formulas of a problem with respect to its data, for sensitivities.

    The data of an interval are all parameters except linking variables, and the time of its left node and its length.
    If the left node is at an inner time, the values of the conditions there are data, too. The data of an end also
    contain the unknowns of its node, because some of these are prescribed.

    Attributes
    ----------
    quantities : tuple of str
        Names of the quantities with respect to which solutions are differentiated.
    count, parametric : int
        The number of data, and the number of data that are parameters.
    acting, bounding : array of int
        Indices of the parameters on which intervals depend, and of the parameters that move bounds.
    rows, columns : array of int
        For each mixed second derivative of an interval, the local unknown (row) and the datum (column).
    start_rows, start_columns, end_rows, end_columns : array of int
        The same for both ends.
    loop : Loop
        Fills the gradient (n,) of both ends and of conditions between linking variables. Then follow, for all
        intervals, all starts and all ends, the first derivatives with respect to data, and the mixed derivatives. Last
        are both kinds (1 + root, count) for the conditions.
    rates : callable
        (grid, given) -> rates (m, bodies, parametric), duration (m,): derivatives of the parameters and of the duration
        with respect to the m quantities.
    pins : callable
        (grid, rates) -> moves (m, n): derivatives of prescribed unknowns.
    durations : callable
        (grid, unknowns, moves, rates, duration) -> (m, D): derivatives of the durations of D phases.
    bounds : callable or None
        (grid, rates of one quantity) -> lower, upper: derivatives of the bounds, if these depend on parameters.
    clock : int or None
        Index of the unknown of a node that is its time, if the time is an unknown.
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
    rates: Callable[..., tuple[np.ndarray, np.ndarray]]
    pins: Callable[..., np.ndarray]
    durations: Callable[..., np.ndarray]
    bounds: Callable[..., tuple[np.ndarray, np.ndarray]] | None = None
    bounding: np.ndarray | tuple[int, ...] = ()
    clock: int | None = None

    def tables(self, structure):
        """Return (rows, columns, counts, lengths) for the functions in `sensitivities`.

        `rows` and `columns` (k,) belong to the mixed second derivatives of an interval and of both ends. Rows are local
        indices of an element. `counts` are the numbers that `sensitivities.change_along` reads. `lengths` are the
        number of values that the loop fills for each interval, and the number of all other values.
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
    """The arrays of finished searches, for later searches with as many intervals and bounds.

    Several threads may call `take` and `keep` at any time, because methods of lists are atomic.
    """

    def __init__(self):
        self.kept = []

    def take(self, key):
        """Remove the arrays that were kept last, and return them if their key is `key`.

        Return None if the key differs, or if no arrays are kept.
        """
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
    """An optimal control problem: its structure, loops over intervals, and functions from the author's formulas.

    Attributes
    ----------
    structure : Structure
        Numbers and indices of the unknowns.
    metadata : ControlRecord
        Names and meanings.
    gradient : Loop
        Fills the gradient (n,) of the Lagrangian and returns the cost.
    hessians : Loop
        Fills all second derivatives of the Lagrangian.
    parts : Loop
        Fills the contributions (bodies, N, element + shared + 1) of all intervals to the gradient, each followed by the
        cost of the interval.
    duration_of : callable
        (grid, unknowns) -> the duration of the motion.
    initial_guess : callable
        (grid) -> the unknowns of the initial guess.
    pin_values : callable
        (grid, unknowns, nodes) -> None. Sets the prescribed boundary values; `nodes` is the view of all nodes.
    unpack : callable
        (grid, unknowns) -> times, positions, momenta, controls, multipliers.
    variable_bounds : callable or None
        (grid) -> lower, upper.
    phase_durations : callable or None
        (grid, unknowns) -> lengths of all phases.
    inputs : Loop or None
        Fills the least and greatest inputs of those tables that must not be read outside their ranges.
    data : DataDerivatives or None
        Derivatives with respect to data, if the module was built with sensitivities.
    ranges, range_names : array of int, tuple of str
        For each input of these tables, the indices of the limits of its range among the parameters, and its name.
    tables : mapping
        The default numbers of each table.
    observations : tuple of array
        The default measurements of each body: rows of time, values, standard deviations.
    shooting : Shooting or None
        Loops without stages, if the scheme is explicit.
    """

    structure: Structure
    metadata: ControlRecord
    gradient: Loop
    hessians: Loop
    parts: Loop
    duration_of: Callable[..., float]
    initial_guess: Callable[..., np.ndarray]
    pin_values: Callable[..., None]
    unpack: Callable[..., tuple[np.ndarray, ...]]
    variable_bounds: Callable[..., tuple[np.ndarray, np.ndarray]] | None = None
    phase_durations: Callable[..., np.ndarray] | None = None
    inputs: Loop | None = None
    data: DataDerivatives | None = None
    ranges: np.ndarray | tuple[int, ...] = ()
    range_names: tuple[str, ...] = ()
    tables: Mapping[str, np.ndarray] = field(default_factory=dict)
    observations: tuple[np.ndarray, ...] = ()
    shooting: object = None

    def __reduce__(self):
        """Pickle the problem as the name of its module, which another process imports."""
        return problem_of, (self.initial_guess.__module__,)

    @cached_property
    def storage(self):
        """The Storage for arrays of finished searches."""
        return Storage()

    @cached_property
    def searched(self):
        """The problem that a search solves: for an explicit scheme without stages, see `shooting`."""
        return self if self.shooting is None else self.shooting.without_stages(self)

    @cached_property
    def mixed(self):
        """The tables of mixed second derivatives with respect to unknowns and data, see `DataDerivatives.tables`."""
        return self.data.tables(self.structure)

    @cached_property
    def system(self):
        """The address of the compiled linear system of a Newton step.

        Interpreted problems share one system for all shapes.
        """
        is_interpreted = self.gradient.is_interpreted or config.DISABLE_JIT
        return compiled_system(None if is_interpreted else self.structure.shape).address

    def kernels(self):
        """Return the loops of the problem, beginning with the loops that take longest to compile."""
        of_data = self.data.loop if self.data else None
        loops = self.hessians, of_data, self.gradient, self.parts, self.inputs
        if self.shooting is not None:
            loops = self.shooting.hessians, *loops, self.shooting.gradient, self.shooting.stages
        return tuple(loop for loop in loops if loop is not None)

    def compile(self):
        """Compile the loops of the problem and the linear system of its shape."""
        for loop in self.kernels():
            loop.address  # noqa: B018
        self.searched.system  # noqa: B018
