"""Optima of many cases of one module, a block of cases for each call of the compiled batch.

A block is solved without the lock of the Python interpreter, see `codegen.runtime.search.batch`. Several threads that
solve a block each work side by side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors import Abandoned
from codegen.batch.request import Quantity, given_to
from codegen.batch.results import UNUSABLE, Cases, Limits, unusable_message
from codegen.runtime.search.batch import Options, is_ready, solve_grids, solve_stack
from codegen.runtime.search.messages import solved_message
from codegen.runtime.search.solution import Log
from codegen.runtime.search.stacks import LONGEST_STATUS, SOLVED, Optimum, case_of, no_optima, stack_of
from codegen.solving.drivers.newton import TOLERANCE
from codegen.solving.loading import ControlModule, Grid, Matrix, Vector
from codegen.solving.request import with_values
from codegen.solving.results.control import control_result
from codegen.solving.results.display import Background
from codegen.solving.results.result import ControlAttempt, Result, Run, component_names
from codegen.solving.results.segments import put_together, segments_of
from codegen.solving.results.sensitivities import rates_at, require_sensitive

BLOCK = 100_000
"""Number of unknowns in a block, which takes tens of milliseconds; the Python code between blocks takes less."""
BLOCK_ON_DEVICE = 20_000_000  # number of unknowns in a block on a GPU, which needs many cases at once
MOST_ITERATIONS = 3000  # default limit of iterations, as for `solve` of a generated module


@dataclass(frozen=True, eq=False, repr=False)
class Solutions(Cases):
    """The optima of n cases; `solutions[i]` is the Result of case i.

    Attributes
    ----------
    status : ndarray of str, (n,)
        The termination status, such as "solved", as of `codegen.solve`. It is "unusable" for a case whose numbers have
        no grid, such as a negative duration.
    cost, residual, stationarity : ndarray, (n,)
        The cost, and the max-norms of all discrete equations and of the optimality conditions, as of `codegen.solve`.
        The cost of a case that is not solved is NaN.
    iterations : ndarray of int, (n,)
        Numbers of iterations.
    unknowns : ndarray, (n, m)
        All unknowns of each case, which `guess` of another call takes. NaN for an unusable case.
    parameters : dict of str to ndarray (n,)
        The numbers that differ from those of the problem.
    steps : int
        Number of intervals, in each phase or segment.
    module : module
        The generated module.
    limits : Limits
        The options of the searches, and the place: the processor or a GPU.
    messages : dict of int to str
        The messages of cases that failed.
    arguments : dict
        The keyword arguments of `make_grid` of the module, with arrays (n,) in place of numbers.
    guesses : sequence of ndarray (m,) or None
        The guess of each case; None for the problem's own.
    grids : ndarray of object, (n,)
        For each case, a function from the number of the case to its grid; None if grids are made one by one.
    background : Background or None
        The module and the problem, for figures of single cases.
    """

    numbers_of_cases = ("cost", "residual", "stationarity", "iterations")
    status: NDArray[np.str_]
    cost: Vector
    residual: Vector
    stationarity: Vector
    iterations: NDArray[np.int64]
    unknowns: Matrix
    parameters: Mapping[str, Vector]
    steps: int
    module: ControlModule
    limits: Limits
    arguments: Mapping[str, Any]
    guesses: Sequence[Vector | None]
    grids: NDArray[np.object_]
    messages: dict[int, str] = field(default_factory=dict)
    background: Background | None = None

    @property
    def is_ready(self) -> bool:
        """True if the machine code that `fill` needs is on the disk, or if a GPU solves the cases."""
        return self.limits.is_on_device or is_ready()

    def _block(self, number: int) -> int:
        numbers = BLOCK_ON_DEVICE if self.limits.is_on_device else BLOCK
        return max(1, numbers // max(1, int(self.unknowns.shape[1])))

    def _solve(self, own: slice, is_wanted: Callable[[], bool]) -> None:
        def log() -> Log:
            if not is_wanted():
                raise Abandoned
            return Log(limits.time_limit)

        on_device, limits, module = None, self.limits, self.module
        if limits.is_on_device:
            from codegen.runtime.cuda import batches as of_device

            on_device = of_device.solve_cases
        options = Options(
            limits.tolerance or TOLERANCE, limits.max_iterations or MOST_ITERATIONS, limits.is_warm, limits.scaling,
            on_device,
        )  # fmt: skip
        arguments, guesses = part_of(self.arguments, own), self.guesses[own]
        stack = None
        if all(guess is None for guess in guesses):
            stack = stack_of(module, self.steps, arguments, len(guesses))
        if stack is not None:  # grids are made from it, without guesses and bounds
            light = stack._replace(guesses=None, lower=None, upper=None)
            self.grids[own] = lambda case: light.grid_of(case - own.start)
        width = self.unknowns.shape[1]
        found = no_optima(len(guesses), width) if stack is None else solve_stack(stack, options, log)
        grids, starts = list[Grid](), dict[int, Vector]()
        for case in np.flatnonzero(found.status == "").tolist():
            try:
                grid, guess = self.module.make_grid(self.steps, **case_of(arguments, case)), guesses[case]
                guess = (
                    self.module.initial_guess(grid) if guess is None else self.module.with_pinned_values(grid, guess)
                )
                grids.append(grid)
                starts[case] = guess
            except (ValueError, ArithmeticError) as error:  # generated modules raise built-in exceptions
                values = {name: column[own.start + case] for name, column in self.parameters.items()}
                nothing = np.full(found.unknowns.shape[1], math.nan)
                message = unusable_message(error, values)
                found.put(case, Optimum(UNUSABLE, message, math.nan, math.nan, math.nan, 0, nothing))
        results = solve_grids(grids, [*starts.values()], options, log)
        for case, result in zip(starts, results, strict=True):
            found.put(case, result)
        for name in ("status", "residual", "stationarity", "iterations", *(["unknowns"] if width else [])):
            getattr(self, name)[own] = getattr(found, name)
        self.cost[own] = np.where(found.status == SOLVED, found.cost, np.nan)
        self.messages.update({own.start + case: message for case, message in found.messages.items()})

    def grid(self, case: int) -> Grid:
        """Return the grid of a case with usable numbers."""
        make = self.grids[case]
        return self.module.make_grid(self.steps, **case_of(self.arguments, case)) if make is None else make(case)

    def optimum(self, case: int) -> Optimum:
        """Return the outcome of a case."""
        residual, stationarity = float(self.residual[case]), float(self.stationarity[case])
        message = self.messages.get(case) or solved_message(residual, stationarity)
        return Optimum(
            str(self.status[case]), message, float(self.cost[case]), residual, stationarity,
            int(self.iterations[case]), self.unknowns[case],
        )  # fmt: skip

    @cached_property
    def message(self) -> NDArray[np.object_]:
        """The explanation (n,) of each status, as of `codegen.solve`."""
        numbers = zip(self.residual.tolist(), self.stationarity.tolist(), strict=True)
        return np.array([self.messages.get(i) or solved_message(*pair) for i, pair in enumerate(numbers)], object)

    @cached_property
    def free(self) -> dict[str, Vector]:
        """The values (n,) of each free parameter, such as a free duration; NaN for a case that is not solved."""
        names = self.module.metadata.free_parameters
        last = self.unknowns.shape[1] - self.module.problem.structure.couplings
        values = np.where(self.solved[:, None], self.unknowns[:, last - len(names) : last], np.nan)
        return {name: values[:, i] for i, name in enumerate(names)}

    @property
    def t(self) -> Matrix:
        """Times of the nodes, (n, N + 1)."""
        return self._motions["t"]

    @property
    def q(self) -> NDArray[np.float64]:
        """Coordinates or states, (n, N + 1, coordinates); NaN for a case that is not solved."""
        return self._motions["q"]

    @property
    def p(self) -> NDArray[np.float64]:
        """Momenta, (n, N + 1, coordinates)."""
        return self._motions["p"]

    @property
    def u(self) -> NDArray[np.float64]:
        """Controls, (n, rows, controls), with a row for each interval or node as `Result.u` has."""
        return self._motions["u"]

    @property
    def multipliers(self) -> NDArray[np.float64]:
        """Multipliers of the equations, (n, rows, multipliers)."""
        return self._motions["multipliers"]

    @cached_property
    def d_cost(self) -> dict[str, Vector]:
        """Derivatives (n,) of the cost by the name of a parameter, a prescribed value or a duration.

        Parameters that vary are independent of each other, even if formulas of the problem relate them. NaN for a case
        that is not solved, or without derivatives. Raises ArgumentError unless the cases are solved with
        `sensitivities=True`.
        """
        require_sensitive(self.module)
        names = self.module.metadata.sensitivities or ()
        rates = np.full((len(self), len(names)), np.nan)
        fixed = [name for name in self.parameters if name in names]
        for i in np.flatnonzero(self.solved).tolist():
            with suppress(ValueError, ArithmeticError):  # a derivative can be infinite at a finite solution
                own = with_values(self.module, self._values(i))
                rates[i] = rates_at(own, self.steps, self.unknowns[i], fixed).sensitivities.costs
        return {name: rates[:, j] for j, name in enumerate(names)}

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """The names of the columns of q, p and u."""
        return (
            dict(self[int(np.argmax(self.solved))].names)
            if self.solved.any()
            else component_names(self.module.metadata)
        )

    def __getitem__(self, index: int) -> Result:
        """Return the Result of a case, whose equations are evaluated once more; raises IndexError beyond the end."""
        values = self._values(index)
        module = with_values(self.module, values)
        tolerance = self.limits.tolerance or 1e-10
        run = Run(self.steps, tolerance=tolerance, scaling=self.limits.scaling)
        attempt = ControlAttempt(
            str(self.status[index]), str(self.message[index]), int(self.iterations[index]), self.unknowns[index],
            tolerance, is_explained=True, generated=True,
        )  # fmt: skip
        result = put_together(control_result(module, "newton", run, attempt), module.metadata)
        return self._in_background(result, module, values)

    @cached_property
    def _motions(self) -> dict[str, NDArray[np.float64]]:
        """The arrays of all motions by name; they are computed from the unknowns on first use."""
        names, is_whole = ("t", "q", "p", "u", "multipliers"), segments_of(self.module.metadata) is None
        parts: dict[int, Sequence[Vector]] = {}
        for i in np.flatnonzero(self.solved).tolist():
            if is_whole:
                parts[i] = self.module.unpack(self.grid(i), self.unknowns[i])
            else:
                parts[i] = [getattr(self[i], name) for name in names]
        arrays = {}
        for j, name in enumerate(names):
            shape = next((part[j].shape for part in parts.values()), (0,) if name == "t" else (0, 0))
            arrays[name] = np.full((len(self), *shape), np.nan)
            for i, part in parts.items():
                arrays[name][i] = part[j]
        return arrays


def empty_solutions(
    module: ControlModule, columns: Mapping[Quantity, Vector], steps: int, limits: Limits, number: int,
    guesses: Sequence[Vector | None],
) -> Solutions:  # fmt: skip
    """Return Solutions without results; their unknowns have no columns if no case has usable numbers."""
    arguments, size = given_to(columns), 0
    for case in range(-1, number):
        with suppress(ValueError, ArithmeticError):
            own = {} if case < 0 else case_of(arguments, case)
            size = module.make_grid(steps, **own).is_multiplier.size
            break
    cost, residual, stationarity = np.full((3, number), np.nan)
    return Solutions(
        np.full(number, "", LONGEST_STATUS), cost, residual, stationarity, np.zeros(number, np.int64),
        np.full((number, size), np.nan), {own.name: column for own, column in columns.items()}, steps, module, limits,
        arguments, guesses, np.full(number, None),
    )  # fmt: skip


def part_of(arguments: Mapping[str, Any], part: slice) -> dict[str, Any]:
    """Return the arguments of some cases."""
    return {
        name: part_of(values, part) if isinstance(values, Mapping) else values[part]
        for name, values in arguments.items()
    }
