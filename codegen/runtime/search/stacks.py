"""Many cases of a problem at once: the formulas of a generated module, evaluated on arrays in place of numbers.

The functions `make_grid`, `initial_guess` and `variable_bounds` of a module work on numbers. They work on arrays as
well if the index of a case is the last one of each array: a parameter is an array (k,), unknowns are (n, k). Then k
cases take hardly longer than one. Some formulas need numbers, such as those with conditions or tables, and some
problems have several bodies or phases. For these, and if a few cases do not agree with those of the module, there is no
stack, and the cases are computed one after the other.

Formulas of parameters are evaluated with the numbers of Python, so that a case has the bits that it has by itself.
"""

import math
from types import FunctionType, SimpleNamespace
from typing import NamedTuple

import numpy as np

from codegen.runtime.search.grid import NONE, Grid, checked_count, checked_nodes
from codegen.runtime.search.messages import solved_message


def _of_each(function):
    """Return a function of arrays that calls a function of numbers for each number; NaN outside its domain."""

    def of_numbers(*numbers):
        try:
            return function(*numbers)
        except ValueError:
            return math.nan

    return lambda *arrays: np.frompyfunc(of_numbers, len(arrays), 1)(*arrays)


OF_ARRAYS = SimpleNamespace(
    **{name: _of_each(value) if callable(value) else value for name, value in vars(math).items() if name[0] != "_"}
)
"""The module math for arrays of Python's numbers: the results have the bits of those of single numbers."""
NUMBERS_ONLY = (ArithmeticError, AttributeError, IndexError, TypeError, ValueError)
"""Errors of formulas that cannot be evaluated on arrays."""
AGREES = 1e-14
"""Largest relative difference between a number of a stack and that of the module."""


class Stack(NamedTuple):
    """The numbers of k cases of a problem.

    Attributes
    ----------
    grid : Grid
        The grid of a case with usable numbers; the cases differ from it in their numbers only.
    is_usable : (k,)
        False for a case whose numbers are not finite, or whose duration is not positive.
    h : (k,)
        Mean lengths of an interval.
    parameters : (k, bodies, P)
        Parameters, see `Grid`.
    guesses, lower, upper : (k, n)
        Initial guesses, least and greatest values of all unknowns; (k, 0) without bounds.
    """

    grid: Grid
    is_usable: np.ndarray
    h: np.ndarray
    parameters: np.ndarray
    guesses: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def grid_of(self, case):
        """Return the Grid of a case."""
        return self.grid._replace(h=float(self.h[case]), parameters=np.array(self.parameters[case]))


class Optimum(NamedTuple):
    """The outcome for one case: all m unknowns, and numbers as in `Optima`."""

    status: str
    message: str
    cost: float
    residual: float
    stationarity: float
    iterations: int
    unknowns: np.ndarray


SOLVED, LONGEST_STATUS = "solved", "<U24"
"""The status of an optimum, and the type of a status in an array."""


class Optima(NamedTuple):
    """The outcomes for k cases.

    Attributes
    ----------
    status : (k,)
        See `workspace.WORDS`; empty for a case without an outcome.
    cost, residual, stationarity, iterations : (k,)
        The costs, corrected to first order for the residuals, the largest moduli of residuals, the stationarities, and
        the numbers of iterations.
    unknowns : (k, m)
        All unknowns.
    messages : dict of int to str
        The messages of cases, except for solved cases with the usual message, see `message`.
    """

    status: np.ndarray
    cost: np.ndarray
    residual: np.ndarray
    stationarity: np.ndarray
    iterations: np.ndarray
    unknowns: np.ndarray
    messages: dict[int, str]

    def message(self, case):
        """Return the message of a case."""
        own = self.messages.get(case)
        return solved_message(self.residual[case], self.stationarity[case]) if own is None else own

    def one(self, case):
        """Return the Optimum of a case."""
        numbers = (float(array[case]) for array in self[1:4])
        return Optimum(
            str(self.status[case]), self.message(case), *numbers, int(self.iterations[case]), self.unknowns[case]
        )

    def put(self, case, optimum):
        """Write the Optimum of a case into the arrays."""
        self.messages[case] = optimum.message
        for name in ("status", "cost", "residual", "stationarity", "iterations", "unknowns"):
            getattr(self, name)[case] = getattr(optimum, name)


def no_optima(k, m):
    """Return Optima for k cases without outcomes, with m unknowns each."""
    cost, residual, stationarity = np.full((3, k), np.nan)
    return Optima(
        np.full(k, "", LONGEST_STATUS), cost, residual, stationarity, np.zeros(k, np.int64), np.full((k, m), np.nan), {}
    )


def stack_of(module, steps, arguments, k):
    """Return the Stack of k cases, or None if the module's formulas need numbers.

    Parameters
    ----------
    module : module
        A generated module with a ControlProblem.
    steps : int
        The number of intervals.
    arguments : dict
        Keyword arguments of `make_grid`, with arrays (k,) in place of numbers, also inside `start` and `end`.
    k : int
        The number of cases.
    """
    problem = module.problem
    s = problem.structure
    if s.bodies > 1 or s.phases or s.inner_times or s.slacks.size or problem.observations:
        return None

    def checked_grid(_, steps, duration, parameters, fractions):
        """Return the Grid of all cases, in place of the function with this name."""
        steps, nodes, is_uniform = checked_nodes(1, checked_count("steps", steps), fractions)
        table = np.zeros((1, len(parameters) + s.shared, k))
        for i, value in enumerate(parameters):
            table[0, i] = value
        h = np.broadcast_to(np.asarray(duration, dtype=float) / steps, k)
        masks = np.broadcast_to(s.layouts(steps).is_multiplier[:, None], (s.size(steps), k))
        return Grid(steps, h, nodes[:, None], is_uniform, table, masks, NONE, NONE, 1.0, (), (), problem)

    names = {"math": OF_ARRAYS, "checked_grid": checked_grid}
    try:
        with np.errstate(all="ignore"):
            whole = with_names(module.make_grid, names)(steps, **as_objects(arguments))
            guesses = with_names(problem.initial_guess, names)(whole)
            bounds = None
            if problem.variable_bounds is not None:
                bounds = with_names(problem.variable_bounds, names)(whole)
        is_usable = (whole.h > 0.0) & np.isfinite(whole.h) & np.isfinite(whole.parameters).all(axis=(0, 1))
        if not is_usable.any():
            return None
        grid = module.make_grid(steps, **case_of(arguments, int(np.argmax(is_usable))))
    except NUMBERS_ONLY:
        return None
    lower, upper = (np.empty((k, 0)),) * 2 if bounds is None else (side.T for side in bounds)
    stack = Stack(grid, is_usable, whole.h, np.moveaxis(whole.parameters, -1, 0), guesses.T, lower, upper)
    samples = samples_of(arguments, np.flatnonzero(is_usable))
    return stack if all(_agrees(module, steps, arguments, stack, case) for case in samples) else None


def case_of(arguments, case):
    """Return the keyword arguments of one case, from arrays of all cases."""
    return {
        name: case_of(values, case) if isinstance(values, dict) else float(values[case])
        for name, values in arguments.items()
    }


def as_objects(arguments):
    """Return arguments with arrays of Python's numbers."""
    return {
        name: as_objects(values) if isinstance(values, dict) else values.astype(object)
        for name, values in arguments.items()
    }


def samples_of(arguments, usable):
    """Return indices of usable cases with the least and the greatest values of each argument, and of the ends."""
    indices = {int(usable[0]), int(usable[-1])}
    for values in arguments.values():
        for column in values.values() if isinstance(values, dict) else (values,):
            indices |= {int(usable[np.argmin(column[usable])]), int(usable[np.argmax(column[usable])])}
    return sorted(indices)


def _agrees(module, steps, arguments, stack, case):
    """Return True if the numbers of one case are those that the module computes."""
    try:
        grid = module.make_grid(steps, **case_of(arguments, case))
    except NUMBERS_ONLY:
        return False
    pairs = [
        (grid.h, stack.h[case]), (grid.parameters, stack.parameters[case]),
        (module.initial_guess(grid), stack.guesses[case]),
    ]  # fmt: skip
    if module.problem.variable_bounds is not None:
        lower, upper = module.problem.variable_bounds(grid)
        pairs += [(lower, stack.lower[case]), (upper, stack.upper[case])]
    return all(np.allclose(one, other, rtol=AGREES, atol=0.0) for one, other in pairs)


def with_names(function, names):
    """Return a copy of a function of a module with other global names, also in the module's functions that it calls."""
    space = dict(function.__globals__)
    for name, value in function.__globals__.items():
        if isinstance(value, FunctionType) and value.__globals__ is function.__globals__:
            space[name] = FunctionType(value.__code__, space, name, value.__defaults__)
            space[name].__kwdefaults__ = value.__kwdefaults__
    space |= {name: value for name, value in names.items() if name in space}
    return space[function.__name__]
