"""The function `codegen.solve`, and the execution of a request.

The steps are build, loading, machine code, runs of a driver, and evaluation of the residuals. A request may take
several runs, from different initial guesses or on different grids. The time limit applies to all runs together.
"""

from __future__ import annotations

import inspect
import math
import os
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeAlias

import numpy as np

from codegen.errors import ArgumentError, NumericsError, SchemeError
from codegen.problem.points import PointSet, read_points
from codegen.runtime.record import Kind, Role
from codegen.solving import compiler, loading
from codegen.solving.accuracy import refine, simulated_to_accuracy, to_accuracy
from codegen.solving.arcs import discretisation_error, motion_error
from codegen.solving.drivers import DRIVERS, Driver, task_of
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.loading import GeneratedModule, SimulateModule, Vector, is_control, is_simulation
from codegen.solving.machine_code import processes
from codegen.solving.machine_code.compilation import seconds_of_machine_code
from codegen.solving.machine_code.processes import Compilers
from codegen.solving.progress import Working, building, shown_from_call
from codegen.solving.request import Option, Request, require_options, with_observations, with_tables, with_values
from codegen.solving.results import output
from codegen.solving.results.between_nodes import excursions, poles, stages_beyond
from codegen.solving.results.result import (
    UNKNOWN_ERROR,
    DiscretisationError,
    Result,
    Run,
    SimulateAttempt,
    Watch,
    notes_of_parts,
)
from codegen.solving.results.segments import put_together, segments_of
from codegen.solving.results.sensitivities import require_sensitive, with_sensitivities
from codegen.solving.warm_start import best_of, start_of, transferred

if TYPE_CHECKING:
    from codegen.solving.results.result import Result

Arguments = ParamSpec("Arguments")


def _with_signature_of(
    request: Callable[Arguments, Request],
) -> Callable[[Callable[..., Result]], Callable[Arguments, Result]]:
    """Return a decorator that gives a function the signature of `request`, so that it is written only once."""

    def decorated(function: Callable[..., Result]) -> Callable[Arguments, Result]:
        signature = inspect.signature(request).replace(return_annotation="Result")
        setattr(function, "__signature__", signature)  # noqa: B010  functions are not declared to have one
        return function

    return decorated


@_with_signature_of(Request)
def solve(*positional: Any, **options: Any) -> Result:  # noqa: D417  the arguments are the fields of Request
    """Solve a problem; derive and compile its module first where necessary.

    Parameters
    ----------
    problem : path, Control, Simulate, Phases, Connect, Solver or module
        A problem file, a problem object, a compiled problem from `codegen.compile`, or a generated module. A module is
        given by its path, or loaded by `codegen.load`.
    driver : {"newton", "slsqp", "trust-constr", "ipopt", "fsolve", "fmin"}
        "newton" is the generated solver.
    arguments : dict
        Arguments of problem() in a problem file, by name.
    scheme, method, controls, out : str
        Options of the build, see `codegen.build`.
    steps : int
        Number N of intervals in each phase; by default the number in the problem.
    every : int
        A simulation stores every `every`-th step.
    repeat : int
        Number of runs. The time of the fastest run is reported, without the time for compiling machine code.
    warm : Result, array of shape (n,), or path
        Warm start of an optimisation: a result on any grid, its `unknowns`, or a file that `--save` has written.
    doublings : int
        Number of further solves, on 2 N, 4 N, ... intervals, each from the solution before.
    accuracy : float
        Relative error of states and cost; grids are refined, or a simulation takes more steps, until the estimated
        error is smaller. Without the option `scheme` the scheme is gauss-4, or the scheme of the problem if it has path
        inequalities.
    guesses : int
        Number of initial guesses: the guess of the problem, then random variations. The best solution is returned.
    sensitivities : bool
        Compute `result.sensitivities()`; a separate module is built.
    points : path or PointSet
        Starts and targets (n, d) and standard deviations (n,) of particles; by default the file of the problem.
    parameters : dict
        Parameter overrides without a new build, also of durations and prescribed ends, as in
        {"m": 2.0, "duration": 3.0, "start.x": 1.0}. `Solver.parameters` lists the names.
    tables : dict
        Other files for tables by name, with the same columns and the same number of breakpoints.
    observations : path, or dict of arrays of shape (n,)
        Other measurements; for several bodies a list with an entry for each.
    tolerance : float
        Tolerance of equations relative to their scale; for particles the tolerance of the arrival, or of adaptive
        steps.
    max_iterations, time_limit : int, float
        Largest number of iterations of one search; time limit in seconds for all guesses and grids of one run.
    scaling : {"auto", "none"}
        "auto" computes scaling factors for the driver newton; "none" keeps the units of the problem.
    log, watch : bool, callable
        If `log` is True, a driver without a log of iterates raises ArgumentError. `watch` is called at every iterate
        with the number of the iterate and its row of the log.

    Returns
    -------
    Result
        `status` is "solved" only if all equations hold when they are evaluated independently of the driver. A numerical
        failure gives another status and a `message`, not an exception.

    Raises
    ------
    CodegenError
        ArgumentError for an option that does not exist or apply, NumericsError for an unusable number, and other kinds
        for a problem that cannot be read, derived or stored.

    Notes
    -----
    Several threads may call the function at once. Sources: Marsden and West (2001), Discrete mechanics and variational
    integrators, for the equations; Waechter and Biegler (2006) for the optimiser; Betts (2010), section 4.7, for the
    refinement of grids.
    """
    require_options(options)
    try:
        request = Request(*positional, **options)
    except TypeError as error:  # a missing, surplus or repeated argument
        text = str(error).replace("Request.__init__()", "codegen.solve")
        raise ArgumentError(text, "give a problem, a driver if it is not newton, and options by name") from None
    return outcome_of(request, building).for_python


LEAST_TIME = 1e-9
"""Time limit in seconds for a run if no time is left; it ends a search before its first iteration."""
ACCURATE_SCHEME = "gauss-4"
"""The default scheme if an accuracy is requested: its order is four for every method.

The scheme has no false optima on singular arcs if controls are constant on intervals. Controls of the midpoint scheme
may alternate there.
"""
LEAST_TOLERANCE, LARGEST_TOLERANCE, NEGLIGIBLE_PART = 1e-15, 1e-10, 1e-4
"""Limits of the tolerance if an accuracy is requested, and the ratio of tolerance to requested error between them."""
LONGEST_ESTIMATED = 10.0
"""Largest time in seconds of a simulation whose discretisation error is estimated."""
LEAST_ITERATIONS = 50
"""Least iteration limit of a search for the optimum on double steps."""
_TOO_TIGHT = ("inaccurate", "stalled")
"""Statuses that may be caused by a tolerance below the rounding errors."""
_SEARCHES = ("iteration limit", "time limit", "stalled", "infeasible", "saddle point")
"""Statuses for which another initial guess or another discretisation may succeed."""
_ZERO = 1e-10
"""Controls and costs below this magnitude are considered to be zero."""
_OF_TARGETS = (Kind.END_CONDITION, Kind.INNER_CONDITION, Kind.COUPLING, Kind.INTEGRAL)
"""Kinds of multipliers of conditions that a motion shall reach."""
LIMITS = {"iteration limit": "max_iterations", "newton failed": "max_iterations", "time limit": "time_limit"}
"""The option that limits a search, by the status of a search that ended there; messages advise to raise the option."""
_ADVICE = "what may help, in this order"
_IDLE = "all controls are zero, and so is the cost: the free motion meets all conditions; is an end missing?"
_ERROR_LABELS = {"state_error": "relative error of states", "cost_error": "relative error of the cost"}
_LOADED: set[str] = set()
"""The import names of generated modules whose machine code this process has loaded."""

Following: TypeAlias = Callable[[], AbstractContextManager[Watch | None]]
"""A function that returns a context manager, whose value displays the iterates of a driver."""


@dataclass(frozen=True)
class Outcome:
    """The module and the result of a request, with the time for building and loading, and lines for the user.

    `build_seconds` is the time for derivation and compilation, and `load_seconds` the time for reading the module and
    its machine code. `untried` are options that may help after a failed search, in the order in which to try them.
    """

    module: GeneratedModule
    result: Result
    build_seconds: float
    load_seconds: float
    notices: list[str]
    untried: tuple[Option, ...] = ()

    @property
    def for_python(self) -> Result:
        """The result with all notes, which name the untried options as arguments.

        Only results without a solution contain the warnings about the problem. The command line prints them, and the
        notes on estimates and sensitivities, by itself.
        """
        result = self._advised([option.in_python for option in self.untried])
        of_problem = [] if result.solved else output.notes(self.module.metadata)
        return replace(result, notes=(*of_problem, *notes_of_parts(result), *result.notes))

    @property
    def for_command_line(self) -> Outcome:
        """The outcome with a note and messages that name options as on the command line."""

        def named(status: str, message: str) -> str:
            name = LIMITS.get(status, "")
            return message.replace(f"raise {name}", f"raise --{name.replace('_', '-')}") if name else message

        result = self._advised([option.on_command_line for option in self.untried])
        levels = tuple(replace(level, message=named(level.status, level.message)) for level in result.levels)
        return replace(self, result=replace(result, message=named(result.status, result.message), levels=levels))

    def _advised(self, options: list[str]) -> Result:
        if not options:
            return self.result
        return replace(self.result, notes=(*self.result.notes, f"{_ADVICE}: {', '.join(options)}"))

    @property
    def record(self) -> dict[str, Any]:
        """The object that `--json` prints."""
        return output.as_record(self.result, self.build_seconds, self.load_seconds)


def outcome_of(
    request: Request,
    working: Working = nullcontext,
    following: Following = nullcontext,
    solving: Callable[[], AbstractContextManager[Any]] = nullcontext,
) -> Outcome:
    """Execute a request, and return the module and the result; see `codegen.solve`.

    Errors of the request are raised before slow operations. Names of parameters, tables and measurements can be checked
    only after the build of the module. `working` displays the progress of a build. `following` displays the iterates
    of drivers that report them, and `solving` that another driver works.
    """
    with processes.compilers() as compilers:
        start = None if request.warm is None else start_of(request.warm)
        made = module_of(request, working, compilers=compilers)
        module, build_seconds, load_seconds = made.module, made.build_seconds, made.load_seconds
        values = dict(request.parameters or {})
        module = with_values(with_observations(with_tables(module, request.tables), request.observations), values)
        driver, warm, points = request.driver_for(module), start and start(module), points_of(request, module)
        if request.sensitivities:
            require_sensitive(module)
        notices: list[str] = []
        if driver.generated and (made.is_new or module.__name__ not in _LOADED):
            seconds, notices = made.require(working, compilers)
            build_seconds += seconds
        segments, steps = segments_of(module.metadata), request.steps or module.metadata.steps
        if segments and request.steps:
            steps = segments.steps(request.steps)
            if (total := segments.number * steps) != request.steps:
                why = f"as many in each of the {segments.number} segments between multiples of the delay"
                notices = [*notices, f"codegen: note: {total} steps instead of {request.steps}, {why}"]
        is_watched = driver.takes(task_of(module).name, "watch")
        with following() if is_watched else solving() as watch:
            shown = request.watch or (watch if is_watched else None)
            result = _solved(request, module, driver, steps, warm, points, shown)
        result = _with_notes(module, _with_error(request, module, driver, result))
        if request.sensitivities:
            result = with_sensitivities(result, module)
        whole = put_together(result, module.metadata)
        result = replace(whole, parameters=values, background=request.background(module))
        untried = _untried(request, module, result)
        if result.compiled:
            return Outcome(module, result, build_seconds + result.seconds_code, load_seconds, notices, untried)
        return Outcome(module, result, build_seconds, load_seconds + result.seconds_code, notices, untried)


class Made(NamedTuple):
    """The module of a request, its file, and the times for derivation and loading in seconds.

    `path` is None for a loaded module without a build. `is_new` is True if the file is new or has changed.
    """

    module: Any
    path: Path | None = None
    is_new: bool = False
    build_seconds: float = 0.0
    load_seconds: float = 0.0

    def require(self, working: Working, compilers: Compilers | None = None) -> tuple[float, list[str]]:
        """Compile what is not on the disk; return the seconds, and lines for the user. See `processes.require`."""
        if self.path is None:
            return 0.0, []
        return processes.require(self.path, self.module, self.is_new, working, compilers)


def module_of(
    request: Request,
    working: Working,
    what: str = "Deriving",
    varied: Mapping[str, str] | None = None,
    compilers: Compilers | None = None,
) -> Made:
    """Return the module of a request: a loaded module, a compiled problem, the file of a module, or a new build.

    `varied` are values of arguments of problem() in addition to those of the request. `compilers` start at the same
    time as a derivation. `working` displays `what` during a derivation.

    If an accuracy but no scheme is requested, the scheme is `ACCURATE_SCHEME`, unless the problem does not allow it or
    has path inequalities. Path inequalities hold at all stages, so the strictest stage limits a control that is
    constant on an interval. This error has order one.
    """
    module: Any = None if varied else request.compiled
    if module is not None:
        return Made(module, Path(module.__file__))
    if request.is_built and not isinstance(request.problem, Path | str):
        return Made(request.problem)
    path, is_new, build_seconds = Path(str(request.problem)), False, 0.0
    if not request.is_built:
        with shown_from_call(working, what) as show:

            def deriving() -> None:
                show()
                if compilers is not None and DRIVERS[request.driver].generated:
                    compilers.start()

            build = partial(
                compiler.build, request.source, {**request.arguments, **varied} if varied else request.settings,
                method=request.method, controls=request.controls, out=request.out,
                sensitivities=request.sensitivities, deriving=deriving,
            )  # fmt: skip
            made = None
            if request.accuracy is not None and request.scheme is None:
                with suppress(SchemeError):
                    made = build(scheme=ACCURATE_SCHEME)
                    meanings = getattr(loading.load(made.path).metadata, "meanings", {})
                    slacks = {meaning.kind for meaning in meanings.values() if meaning.kind.role == Role.SLACK}
                    made = made if slacks <= {Kind.INTEGRAL_SLACK, Kind.BOUND_SLACK} else None
            made = made or build(scheme=request.scheme)
        path, is_new, build_seconds = made.path, made.written, made.seconds
    begin = time.perf_counter()
    return Made(loading.load(path), path, is_new, build_seconds, time.perf_counter() - begin)


def points_of(request: Request, module: GeneratedModule) -> PointSet | None:
    """Return the points of the request, or else the points that the problem names; None if there are none."""
    file, own = request.points, module.metadata.points
    if file is None and own and not request.is_built:
        file = request.settings.points or request.source.folder / own
    if isinstance(file, Path | str):
        return read_points(Path(file), len(module.metadata.coordinates))
    return file


def _solved(
    request: Request,
    module: Any,
    driver: Driver,
    steps: int,
    warm: Vector | None,
    points: PointSet | None,
    watch: Watch | None,
) -> Result:
    """Return the best result of all runs, from one or several initial guesses and on one or several grids."""
    remaining = math.inf if request.time_limit is None else request.time_limit

    def solve_from(count: int, start: Vector | None, near: bool, grid: Vector | None = None) -> Result:
        nonlocal remaining
        tolerance = request.tolerance
        if tolerance is None and request.accuracy is not None and grid is not None:
            # The derivative with respect to a control, and its barrier term, are proportional to the interval's length.
            shortest = float(grid.min())
            tolerance = max(LEAST_TOLERANCE, min(LARGEST_TOLERANCE, NEGLIGIBLE_PART * request.accuracy * shortest))
        run = Run(
            count, request.every, start, points, tolerance, near, request.max_iterations, max(remaining, LEAST_TIME),
            watch, request.scaling, grid,
        )  # fmt: skip
        while True:
            result = run_and_verify(module, driver, run, request.repeat)
            remaining -= result.seconds_solve
            looser = min(LARGEST_TOLERANCE, 100.0 * (run.tolerance or LARGEST_TOLERANCE))
            if request.accuracy is None or result.status not in _TOO_TIGHT or looser == run.tolerance:
                return result
            run = replace(run, tolerance=looser, guess=result.unknowns)

    def solve_on(count: int, start: Vector | None, grid: Vector | None = None) -> Result:
        if start is None and request.guesses > 1:
            return best_of(lambda guess: solve_from(count, guess, False, grid), module, count, request.guesses)
        return solve_from(count, start, True, grid)

    if request.accuracy is not None and is_simulation(module):
        return simulated_to_accuracy(
            lambda count: run_and_verify(
                module, driver, Run(count, request.every, tolerance=request.tolerance, watch=watch), request.repeat
            ),
            module, steps, request.accuracy,
        )  # fmt: skip
    if request.accuracy is not None:
        return to_accuracy(solve_on, module, steps, request.accuracy, warm)
    if request.doublings:
        return refine(solve_on, module, steps, request.doublings, warm)
    return solve_on(steps, None if warm is None else transferred(module, warm, steps))


def run_and_verify(module: GeneratedModule, driver: Driver, run: Run, repeat: int) -> Result:
    """Run a driver `repeat` times; return the result of the last run, with residuals that are evaluated again.

    The result has the time of the fastest run. The time for compiling or reading machine code is subtracted, because a
    driver may call functions for the first time.
    """
    task = task_of(module)
    require_memory(task.numbers(module.metadata, run), run.steps)
    solve = driver.function(task.name)
    begin, seconds = time.perf_counter(), math.inf
    try:
        with seconds_of_machine_code() as of_code:
            # Load machine code before the timed runs.
            if not driver.generated:
                with quiet_single_thread():
                    task.warm_up(module, run.steps)
            elif module.__name__ not in _LOADED:
                with quiet_single_thread():
                    task.small(module)
            code_seconds = time.perf_counter() - begin - of_code.seconds
            for _ in range(repeat):
                begin, before = time.perf_counter(), of_code.seconds
                attempt = solve(module, run)
                elapsed = time.perf_counter() - begin
                seconds = min(seconds, max(elapsed - (of_code.seconds - before), 0.0))
    except ValueError as error:  # generated modules raise ValueError in place of errors of codegen
        raise NumericsError(str(error), "correct the problem's numbers or the options") from error
    except OSError as error:
        raise processes.unwritable_cache_error(module, error) from error
    result: Result = task.result(module, driver.name, run, attempt, seconds)
    if driver.generated:
        _LOADED.add(module.__name__)
    return replace(result, seconds_code=code_seconds + of_code.seconds, compiled=of_code.is_compiled)


def require_memory(numbers: int, steps: int) -> None:
    """Raise NumericsError if the memory is too small for so many floating-point `numbers`.

    The operating system would end the process. `steps` is only used in the message.
    """
    if not hasattr(os, "sysconf"):
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if 8 * numbers > memory:
        raise NumericsError(
            f"{steps} steps need about {8e-9 * numbers:.0f} GB of memory, and there are {1e-9 * memory:.0f}",
            "take fewer steps, or store only every so many-th of a simulation",
        )


def _with_notes(module: GeneratedModule, result: Result) -> Result:
    """Return a solution with notes on the motion between nodes and on zero controls."""
    if not is_control(module) or result.unknowns is None or not result.solved:
        return result
    solution = module, result.unknowns, result.steps, result.grid
    gross = [excursion.note for excursion in excursions(*solution) if excursion.is_gross]
    beyond = [stage.note for stage in stages_beyond(*solution)]
    sizes = [] if result.u is None or not result.u.size else [np.abs(result.u).max(), abs(result.cost or 0.0)]
    kinds = {meaning.kind for meaning in module.metadata.meanings.values()}
    has_target = bool(module.metadata.end) or not kinds.isdisjoint(_OF_TARGETS)
    idle = [_IDLE] if sizes and max(sizes) <= _ZERO and not has_target else []
    notes = [*idle, *gross, *beyond, *(pole.note for pole in poles(*solution))]
    return replace(result, notes=(*result.notes, *notes)) if notes else result


def _untried(request: Request, module: GeneratedModule, result: Result) -> tuple[Option, ...]:
    """Return the options that may help after a failed search, in the order in which to try them."""
    if not is_control(module) or result.unknowns is None or result.status not in _SEARCHES:
        return ()
    return (
        *([Option("guesses", 10)] if request.guesses == 1 and request.warm is None else []),
        *([Option("scheme")] if request.scheme is None and not request.is_built else []),
        *([Option("scaling", "none")] if request.scaling == "auto" else []),
    )


def _with_error(request: Request, module: GeneratedModule, driver: Driver, result: Result) -> Result:
    """Return the result with its estimated discretisation error, and with a note if the error is large.

    If an accuracy was requested, the result has an estimate already. Other drivers than the generated solver get no
    estimate, which would take long; they serve for comparisons.
    """
    if not result.solved or result.accuracy or not driver.generated:
        return result
    if is_simulation(module):
        return _with_motion_error(request, module, driver, result)
    if not is_control(module) or result.unknowns is None:
        return result
    remaining = math.inf if request.time_limit is None else request.time_limit - result.seconds_solve

    def search(steps: int, start: Vector, grid: Vector | None) -> Vector | None:
        run = Run(
            steps, guess=start, max_iterations=max(LEAST_ITERATIONS, result.iterations), scaling=request.scaling,
            time_limit=max(LEAST_TIME, remaining), grid=grid,
        )  # fmt: skip
        attempt = driver.function("control")(module, run)
        return attempt.unknowns if attempt.status == "solved" else None

    error = discretisation_error(module, result, search)
    if error is None:
        return replace(result, notes=(*result.notes, UNKNOWN_ERROR))
    return _with_estimate(result, error)


def _with_motion_error(request: Request, module: SimulateModule, driver: Driver, result: Result) -> Result:
    """Return a simulation with its error, from a half, a third or a fifth of its steps, else from twice as many.

    Long simulations, and those of an integrator that chooses its steps, get no estimate. Nor does one for whose
    comparison the memory is too small.
    """
    if result.seconds_solve > LONGEST_ESTIMATED or getattr(module.metadata, "adaptive", False):
        return result
    parts = [result.steps // divisor for divisor in (2, 3, 5) if result.steps % divisor == 0]
    for steps in (*parts[:1], 2 * result.steps):
        run = Run(steps, request.every, tolerance=request.tolerance)
        with suppress(NumericsError, ValueError):  # generated modules raise ValueError
            require_memory(task_of(module).numbers(module.metadata, run), steps)
            other: SimulateAttempt = driver.function("simulate")(module, run)
            if other.status == "solved" and (error := motion_error(module, result, other, steps)) is not None:
                return _with_estimate(result, error)
    return result


def _with_estimate(result: Result, error: DiscretisationError) -> Result:
    """Return the result with an estimate, which is noted if it is large."""
    summary = {**result.summary, "state_error": error.states}
    if error.cost is not None:
        summary["cost_error"] = error.cost
    notes = (*result.notes, *([error.note] if error.is_large else []))
    return replace(result, error=error, summary=summary, notes=notes, labels={**result.labels, **_ERROR_LABELS})
