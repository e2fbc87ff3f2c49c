"""The function `codegen.solve_many`: arrays of parameters in, arrays of optima out, on threads or on a GPU."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from codegen.batch.executors import team_size
from codegen.batch.executors.local import in_threads
from codegen.batch.motions import Motions, empty_motions, require_motions
from codegen.batch.optima import Solutions, empty_solutions
from codegen.batch.request import quantities
from codegen.batch.results import THREADS, Limits, require_place
from codegen.errors import ArgumentError, NumericsError, clause, one_line
from codegen.problem.problem import Control, Phases, Simulate
from codegen.runtime.search.problem import ControlProblem
from codegen.solving.api import module_of
from codegen.solving.loading import GeneratedModule, Vector, is_control, is_simulation
from codegen.solving.progress import building
from codegen.solving.request import Request, require_options, with_values
from codegen.solving.results.segments import segments_of
from codegen.solving.results.sensitivities import require_sensitive

MOST_AT_ONCE, LEAST_PARTS = 2000, 8
"""Largest number of cases that a thread takes at a time; least number of such parts for each thread."""
_OPTIONS = (
    "arguments scheme method controls out sensitivities tolerance max_iterations time_limit scaling every".split()
)
"""Options of `codegen.solve` that apply to many cases."""


@overload
def solve_many(problem: Simulate, parameters: Mapping[str, ArrayLike], **options: Any) -> Motions: ...
@overload
def solve_many(problem: Control | Phases, parameters: Mapping[str, ArrayLike], **options: Any) -> Solutions: ...
@overload
def solve_many(problem: Any, parameters: Mapping[str, ArrayLike], **options: Any) -> Any: ...
def solve_many(
    problem: object,
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
    made = module_of(request, building)
    module = made.module
    _require_many(request, module)
    columns = _columns(module, parameters)
    if on_device and not (is_on_device and is_simulation(module)):
        raise ArgumentError("on_device keeps states of simulations on a GPU", 'give a simulation and executor="cuda"')
    if is_simulation(module):
        if guess is not None or warm:
            raise ArgumentError("a guess for a simulation", "leave it out")
        require_motions(module, is_on_device)
    varied = dict(zip(quantities(columns, module, ()), columns.values(), strict=True))
    made.require(building)  # an unusable request is refused without compilation
    number = next((column.size for column in columns.values()), 1)
    count = module.metadata.steps if steps is None else steps
    limits = Limits(
        request.tolerance, request.max_iterations, math.inf if request.time_limit is None else request.time_limit,
        request.scaling, warm, is_on_device, on_device,
    )  # fmt: skip
    size = number if is_on_device else min(MOST_AT_ONCE, max(1, -(-number // (LEAST_PARTS * workers))))
    if is_simulation(module):
        found: Motions | Solutions = empty_motions(module, varied, count, request.every, limits, number)
    else:
        if (segments := segments_of(module.metadata)) and steps is not None:
            count = segments.steps(count)
        try:
            unknowns = module.make_grid(count).is_multiplier.size
        except ValueError as error:
            raise NumericsError(f"{module.metadata.problem}: {error}", "give other values") from error
        found = empty_solutions(module, varied, count, limits, number, _guesses(unknowns, guess, warm, number))
    found = replace(found, background=request.background(module))
    if not found.is_ready:
        with building("Compiling what solves many cases, once"):
            found.fill(slice(0, 1), lambda: True)
    parts = [slice(first, min(number, first + size)) for first in range(0, number, size)]
    with building("Solving") as line, in_threads(found.fill, workers) as solved_in:
        for done, _ in enumerate(solved_in(parts), 1):
            if line is not None:
                line.update(f"Solving: {min(number, done * size)} of {number} cases ...")
    return found


def _require_many(request: Request, module: Any) -> None:
    """Raise ArgumentError for a module, or for options, with which only one case can be solved at a time."""
    request.driver_for(module)
    if not (is_control(module) or is_simulation(module)):
        finding = f"{module.metadata.problem} is a {module.metadata.task} problem"
        raise ArgumentError(clause(finding), "use codegen.sweep, which solves all kinds of problems")
    if request.sensitivities:
        require_sensitive(module)
    if not (isinstance(module.problem, ControlProblem) or is_simulation(module)):
        raise ArgumentError("a standalone module solves one case at a time", "build it without --standalone")


def _columns(module: GeneratedModule, parameters: Mapping[str, ArrayLike]) -> dict[str, Vector]:
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


def _in_memory(values: object) -> Any:
    """Return a copy of an array in the memory of a GPU, and other values as they are."""
    if not hasattr(values, "__cuda_array_interface__"):
        return values
    from codegen.runtime.cuda.memory import fetched

    return fetched(values)


def _guesses(size: int, guess: ArrayLike | Solutions | None, warm: bool, number: int) -> list[Vector | None]:
    """Return a guess (`size`,) for each case; None for the problem's own guess, also in place of NaN."""
    if guess is None:
        if warm:
            raise ArgumentError("warm without a guess", "give the unknowns of similar solutions as guess")
        return [None] * number
    table = guess.unknowns if isinstance(guess, Solutions) else np.asarray(_in_memory(guess), dtype=float)
    if table.shape not in ((size,), (number, size)):
        finding = f"guess has shape {table.shape}, expected ({size},) or ({number}, {size})"
        raise NumericsError(finding, "give unknowns of the same problem on as many intervals")
    rows = np.broadcast_to(table, (number, size))
    return [row if np.isfinite(row).all() else None for row in rows]
