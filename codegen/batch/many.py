"""The function `codegen.solve_many`: arrays of parameters in, arrays of optima out, on threads or on a GPU."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from codegen.batch.executors import team_size
from codegen.batch.executors.local import in_threads
from codegen.batch.motions import (
    UNUSABLE,
    Cases,
    Motions,
    empty_motions,
    follow_motions,
    require_motions,
    unusable_message,
)
from codegen.batch.optima import THREADS, Limits, Outcomes, optima, part_of, require_place
from codegen.batch.request import given_to, quantities
from codegen.errors import ArgumentError, NumericsError, clause, one_line
from codegen.problem.problem import Control, Phases, Simulate
from codegen.runtime.search.batch import LONGEST_STATUS, SOLVED, is_ready
from codegen.runtime.search.messages import solved_message
from codegen.runtime.search.problem import ControlProblem
from codegen.runtime.stepping.ensembles import are_motions_ready
from codegen.solving import compiler, loading
from codegen.solving.loading import ControlModule, Matrix, Vector, is_control, is_simulation
from codegen.solving.machine_code import processes
from codegen.solving.progress import building, shown_from_call
from codegen.solving.request import Request, require_options, with_values
from codegen.solving.results.control import control_result
from codegen.solving.results.result import ControlAttempt, Result, Run, component_names
from codegen.solving.results.segments import put_together, segments_of
from codegen.solving.results.sensitivities import rates_at, require_sensitive

MOST_AT_ONCE, LEAST_PARTS = 2000, 8
"""Largest number of cases that a thread takes at a time; least number of such parts for each thread."""
_OPTIONS = (
    "arguments scheme method controls out sensitivities tolerance max_iterations time_limit scaling every".split()
)
"""Options of `codegen.solve` that apply to many cases."""


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
    limits: Limits = field(default_factory=Limits)
    messages: dict[int, str] = field(default_factory=dict)

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
        module = with_values(self.module, self._values(index))
        tolerance = self.limits.tolerance or 1e-10
        run = Run(self.steps, tolerance=tolerance, scaling=self.limits.scaling)
        attempt = ControlAttempt(
            str(self.status[index]), str(self.message[index]), int(self.iterations[index]), self.unknowns[index],
            tolerance, is_explained=True, generated=True,
        )  # fmt: skip
        return put_together(control_result(module, "newton", run, attempt), module.metadata)

    @cached_property
    def _motions(self) -> dict[str, NDArray[np.float64]]:
        """The arrays of all motions by name; they are computed from the unknowns on first use."""
        names, is_whole = ("t", "q", "p", "u", "multipliers"), segments_of(self.module.metadata) is None
        varied = quantities(self.parameters, self.module, ())
        parts: dict[int, Any] = {}
        for i in np.flatnonzero(self.solved).tolist():
            if is_whole:
                own = given_to(dict(zip(varied, self._values(i).values(), strict=True)))
                parts[i] = self.module.unpack(self.module.make_grid(self.steps, **own), self.unknowns[i])
            else:
                parts[i] = [getattr(self[i], name) for name in names]
        arrays = {}
        for j, name in enumerate(names):
            shape = next((part[j].shape for part in parts.values()), (0,) if name == "t" else (0, 0))
            arrays[name] = np.full((len(self), *shape), np.nan)
            for i, part in parts.items():
                arrays[name][i] = part[j]
        return arrays


@overload
def solve_many(problem: Simulate, parameters: Mapping[str, ArrayLike], **options: Any) -> Motions: ...
@overload
def solve_many(problem: Control | Phases, parameters: Mapping[str, ArrayLike], **options: Any) -> Solutions: ...
@overload
def solve_many(problem: Any, parameters: Mapping[str, ArrayLike], **options: Any) -> Any: ...
def solve_many(
    problem: Any,
    parameters: Mapping[str, ArrayLike],
    *,
    steps: int | None = None,
    guess: ArrayLike | Solutions | None = None,
    warm: bool = False,
    executor: str = THREADS,
    threads: int | None = None,
    on_device: bool = False,
    **options: Any,
) -> Solutions | Motions:
    """Solve one problem for many values of its parameters at once, on threads or on a GPU.

    Parameters
    ----------
    problem : path, Control, Phases, Simulate, Solver or module
        A problem of optimal control or a simulation, as for `codegen.solve`.
    parameters : dict of str to array (n,) or float
        The numbers of n cases: parameters, durations and prescribed ends by name, as for `codegen.solve`, such as
        {"m": masses, "start.x": positions}. A number is the same in all cases. Arrays and guesses may be in the memory
        of a GPU (`__cuda_array_interface__`). They are copied, because the processor evaluates formulas.
    steps : int
        Number of intervals in each phase, or of time steps; by default the number in the problem.
    guess : array (n, m) or (m,), or Solutions
        Unknowns of initial guesses; by default each case starts from the problem's own guess.
    warm : bool
        True if the guesses are solutions of similar problems: their multipliers are then used.
    executor : {"threads", "cuda"}
        The threads of this machine, or its GPU by NVIDIA, which solves one case a thread. Cases that need more than one
        search are solved by the processor.
    threads : int
        Number of threads, by default the number of available processors. Results do not depend on it.
    on_device : bool
        True to leave the states of simulations in the memory of the GPU, for torch, JAX and CuPy.
    **options
        `arguments`, `scheme`, `method`, `controls`, `out`, `sensitivities`, `tolerance`, `max_iterations`, `time_limit`
        (of a case), `scaling` and `every` (of a simulation), as for `codegen.solve`.

    Returns
    -------
    Solutions, or Motions of a simulation
        Status, cost, unknowns, motions and events of all cases as arrays. The results are those of `codegen.solve`. A
        case that cannot be solved has another status than "solved", and raises nothing.

    Raises
    ------
    ArgumentError
        For an unknown name or option, arrays of different lengths, a simulation of particles, and a problem of
        connections.
    NumericsError
        For guesses of another shape.
    DeviceError
        Without a GPU that numba can use, or if its memory does not suffice.
    CodegenError
        As `codegen.solve`, for a problem that cannot be read or derived.

    Notes
    -----
    A case that the first search solves costs what its compiled search takes, and some 40 microseconds. Other cases,
    which need a restoration, other scaling factors or a varied guess, are solved again as `codegen.solve` does.
    """
    require_options(options)
    if other := next((name for name in options if name not in _OPTIONS), None):
        raise ArgumentError(f"codegen.solve_many takes no {other}", f"use one of {', '.join(_OPTIONS)}")
    is_on_device, request = require_place(executor), Request(problem, steps=steps, **options)
    workers = 1 if is_on_device else team_size(threads, None)
    module, build = _module(request, building)
    columns = _columns(module, parameters)
    if is_simulation(module):
        if guess is not None or warm:
            raise ArgumentError("a guess for a simulation", "leave it out")
        require_motions(module, is_on_device)
    varied = dict(zip(quantities(columns, module, ()), columns.values(), strict=True))
    if build is not None:  # an unusable request is refused without compilation
        processes.require(build.path, module, build.written, building)
    number = next((column.size for column in columns.values()), 1)
    count = module.metadata.steps if steps is None else steps
    limits = Limits(
        request.tolerance, request.max_iterations, math.inf if request.time_limit is None else request.time_limit,
        request.scaling, warm, is_on_device, on_device,
    )  # fmt: skip
    if on_device and not (is_on_device and is_simulation(module)):
        raise ArgumentError("on_device keeps states of simulations on a GPU", 'give a simulation and executor="cuda"')
    size = number if is_on_device else min(MOST_AT_ONCE, max(1, -(-number // (LEAST_PARTS * workers))))
    if is_simulation(module):
        found: Any = empty_motions(module, varied, count, request.every, limits, number)
        is_compiled = is_on_device or are_motions_ready(module.problem)
    else:
        if (segments := segments_of(module.metadata)) and steps is not None:
            count = segments.steps(count)
        guesses, arguments = _guesses(module, count, guess, warm, number), given_to(varied)
        found, is_compiled = _empty(module, columns, count, limits, number), is_on_device or is_ready()

    def solve(part: slice, is_wanted: Callable[[], bool]) -> None:
        if isinstance(found, Motions):
            follow_motions(found, part, is_wanted)
            return
        own, first = part_of(arguments, part), part.start
        for block in optima(module, count, own, part.stop - first, guesses[part], limits, is_wanted):
            _put(found, first, block)
            first += len(block.optima.status)

    if not is_compiled:
        with building("Compiling what solves many cases, once"):
            solve(slice(0, 1), lambda: True)
    parts = [slice(first, min(number, first + size)) for first in range(0, number, size)]
    with building("Solving") as line, in_threads(solve, workers) as solved_in:
        for done, _ in enumerate(solved_in(parts), 1):
            if line is not None:
                line.update(f"Solving: {min(number, done * size)} of {number} cases ...")
    return found  # type: ignore[no-any-return]


def _module(request: Request, working: Callable[[str], Any]) -> tuple[Any, compiler.Build | None]:
    """Return the module of a request, and the build if there is one; or raise ArgumentError."""
    build = None
    if request.is_built:
        module: Any = request.problem
        if isinstance(module, str | Path):
            module = loading.load(module)
    else:
        with shown_from_call(working, "Deriving") as deriving:
            build = compiler.build(
                request.source, request.settings, scheme=request.scheme, method=request.method,
                controls=request.controls, out=request.out, sensitivities=request.sensitivities, deriving=deriving,
            )  # fmt: skip
        module = loading.load(build.path)
    request.driver_for(module)
    if not (is_control(module) or is_simulation(module)):
        finding = f"{module.metadata.problem} is a {module.metadata.task} problem"
        raise ArgumentError(clause(finding), "use codegen.sweep, which solves all kinds of problems")
    if request.sensitivities:
        require_sensitive(module)
    if not (isinstance(module.problem, ControlProblem) or is_simulation(module)):
        raise ArgumentError("a standalone module solves one case at a time", "build it without --standalone")
    return module, build


def _columns(module: Any, parameters: Mapping[str, ArrayLike]) -> dict[str, Vector]:
    """Return the values (n,) of each parameter for all cases; raises ArgumentError for unusable names or shapes."""
    if not isinstance(parameters, Mapping):
        raise ArgumentError(clause(f"parameters is {parameters!r}"), 'give arrays by name, as {"m": [1.0, 2.0]}')
    columns = {}
    for name, values in parameters.items():
        try:
            columns[name] = np.atleast_1d(np.asarray(_in_memory(values), dtype=float))
        except (TypeError, ValueError):
            raise ArgumentError(clause(f"{name} is {one_line(repr(values))}"), "give an array of numbers") from None
        if columns[name].ndim != 1:
            raise ArgumentError(
                f"{name} has shape {columns[name].shape}", "give an array with one number for each case"
            )
    sizes = {name: column.size for name, column in columns.items() if np.ndim(parameters[name])}
    if len(set(sizes.values())) > 1 or 0 in sizes.values():
        lengths = ", ".join(f"{name} has {size}" for name, size in sizes.items())
        raise ArgumentError(f"the numbers of cases differ or are zero: {lengths}", "give arrays of the same length")
    with suppress(NumericsError):  # the numbers of single cases may be unusable
        with_values(module, {name: float(column[0]) for name, column in columns.items()})
    number = next(iter(sizes.values()), 1)
    return {name: np.ascontiguousarray(np.broadcast_to(column, number)) for name, column in columns.items()}


def _in_memory(values: Any) -> Any:
    """Return a copy of an array in the memory of a GPU, and other values as they are."""
    if not hasattr(values, "__cuda_array_interface__"):
        return values
    from codegen.runtime.cuda.memory import fetched

    return fetched(values)


def _guesses(
    module: ControlModule, steps: int, guess: ArrayLike | Solutions | None, warm: bool, number: int
) -> list[Vector | None]:
    """Return a guess (m,) for each case; None for the problem's own guess, also in place of NaN."""
    if guess is None:
        if warm:
            raise ArgumentError("warm without a guess", "give the unknowns of similar solutions as guess")
        return [None] * number
    table = guess.unknowns if isinstance(guess, Solutions) else np.asarray(_in_memory(guess), dtype=float)
    size = module.make_grid(steps).is_multiplier.size
    if table.shape not in ((size,), (number, size)):
        finding = f"guess has shape {table.shape}, expected ({size},) or ({number}, {size})"
        raise NumericsError(finding, "give unknowns of the same problem on as many intervals")
    rows = np.broadcast_to(table, (number, size))
    return [row if np.isfinite(row).all() else None for row in rows]


def _empty(module: ControlModule, columns: dict[str, Vector], steps: int, limits: Limits, number: int) -> Solutions:
    """Return Solutions without results."""
    try:
        size = module.make_grid(steps).is_multiplier.size
    except ValueError as error:
        raise NumericsError(f"{module.metadata.problem}: {error}", "give other values") from error
    cost, residual, stationarity = (np.full(number, np.nan) for _ in range(3))
    return Solutions(
        np.full(number, "", LONGEST_STATUS), cost, residual, stationarity,
        np.zeros(number, np.int64), np.full((number, size), np.nan), columns, steps, module, limits,
    )  # fmt: skip


def _put(solutions: Solutions, first: int, block: Outcomes) -> None:
    """Write the outcomes of a block of cases, the first of which has the index `first`, into the arrays."""
    optima = block.optima
    part = slice(first, first + len(optima.status))
    solutions.status[part], solutions.iterations[part] = optima.status, optima.iterations
    solutions.cost[part] = np.where(optima.status == SOLVED, optima.cost, np.nan)
    solutions.residual[part], solutions.stationarity[part] = optima.residual, optima.stationarity
    if optima.unknowns.shape[1]:
        solutions.unknowns[part] = optima.unknowns
    messages = {first + case: message for case, message in optima.messages.items()}
    for case, error in block.errors.items():
        index = first + case
        values = {name: column[index] for name, column in solutions.parameters.items()}
        solutions.status[index], messages[index] = UNUSABLE, unusable_message(error, values)
        solutions.cost[index] = solutions.residual[index] = solutions.stationarity[index] = np.nan
        solutions.unknowns[index] = np.nan
    solutions.messages.update(messages)
