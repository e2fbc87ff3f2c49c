"""The way of a request: build, load, machine code, runs of a driver on one grid or several, verdict."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from codegen.errors import NumericsError, SchemeError
from codegen.problem.points import PointSet, read_points
from codegen.runtime.record import Kind, Role
from codegen.solving import compiler, loading
from codegen.solving.accuracy import refine, to_accuracy
from codegen.solving.arcs import discretisation_error
from codegen.solving.drivers import DRIVERS, Driver
from codegen.solving.drivers.shared import quiet_single_thread
from codegen.solving.loading import GeneratedModule, Matrix, Vector, is_control, machine_code_counts
from codegen.solving.machine_code import processes as machine_code
from codegen.solving.machine_code.compilation import seconds_of_machine_code
from codegen.solving.machine_code.processes import Compilers, compilers, unwritable_cache_error
from codegen.solving.request import Request, with_observations, with_tables, with_values
from codegen.solving.results import output
from codegen.solving.results.between_nodes import excursions, poles, stages_beyond
from codegen.solving.results.display import Background
from codegen.solving.results.result import UNKNOWN_ERROR, Result, Run, Watch
from codegen.solving.results.segments import put_together, segments_of
from codegen.solving.results.sensitivities import require_sensitive, with_sensitivities
from codegen.solving.tasks import Task, task_of
from codegen.solving.warm_start import best_of, start_of, transferred

LEAST_TIME = 1e-9
"""Seconds in which a search does not begin."""
ACCURATE_SCHEME = "gauss-4"
"""The scheme where accuracy is asked for, and no path inequality: of a higher order it is there for every method.

With controls that are constant on intervals it has no false optima on singular arcs, where midpoints alternate.
"""
LEAST_TOLERANCE, LARGEST_TOLERANCE, NEGLIGIBLE_PART = 1e-15, 1e-10, 1e-4
"""Tolerances where accuracy is asked for, and what part of it an interval that lasts all the time may leave."""


Working: TypeAlias = Callable[[str], AbstractContextManager[Any]]
"""A sign of life while something takes long."""


@dataclass(frozen=True)
class Outcome:
    """What became of a request: the module, its result, how long both took, and what is to be said about it.

    `build_seconds` are those of derivation and compilation, `load_seconds` of reading the module and its machine code.
    """

    module: GeneratedModule
    result: Result
    build_seconds: float
    load_seconds: float
    said: list[str]

    @property
    def record(self) -> dict[str, Any]:
        """The JSON object of `--json`."""
        return output.as_record(self.result, self.build_seconds, self.load_seconds)


def outcome_of(
    request: Request,
    working: Working = nullcontext,
    following: Callable[[], AbstractContextManager[Watch | None]] = nullcontext,
) -> Outcome:
    """Do what is asked; see `codegen.solve`. What is wrong with the request is said before anything takes long.

    Only names that a module has to know, of parameters, tables and measurements, are looked up once there is one.

    `working` and `following` show signs of life where there is a terminal: of what takes long, and of the iterates of a
    driver that can be watched, as the table of drivers says.
    """
    with compilers() as processes:
        return _outcome(request, working, following, processes)


def _outcome(
    request: Request,
    working: Working,
    following: Callable[[], AbstractContextManager[Watch | None]],
    processes: Compilers,
) -> Outcome:
    """The outcome, with processes that compile."""
    start = start_of(request.warm)
    path, is_new, build_seconds = _built(request, working, processes)
    begin = time.perf_counter()
    module: Any = request.problem if path is None else loading.load(path)
    load_seconds = time.perf_counter() - begin
    values = dict(request.parameters or {})
    module = with_values(with_observations(with_tables(module, request.tables), request.observations), values)
    driver, warm, points = request.driver_for(module), start(module), points_of(request, module)
    if request.sensitivities:
        require_sensitive(module)
    said: list[str] = []
    if path is not None and driver.generated:
        seconds, said = machine_code.require(path, module, is_new, working, processes)
        build_seconds += seconds
    said = [*said, *_rounded(request, module)]
    is_watched = driver.takes(task_of(module).name, "watch")
    with following() if is_watched else working("Solving") as watch:
        result = _solved(request, module, driver, warm, points, request.watch or (watch if is_watched else None))
    result = _with_notes(module, _with_error(request, module, driver, result))
    found = put_together(with_sensitivities(result, module) if request.sensitivities else result, module.metadata)
    result = replace(found, parameters=values, background=_background(request, module))
    if result.compiled:
        return Outcome(module, result, build_seconds + result.seconds_code, load_seconds, said)
    return Outcome(module, result, build_seconds, load_seconds + result.seconds_code, said)


def _with_error(request: Request, module: GeneratedModule, driver: Driver, result: Result) -> Result:
    """The result of an optimal-control problem with its estimated discretisation error, and a note where it is large.

    Where accuracy was asked for there is an estimate already. Other drivers than the generated solver, which take
    longer and are there for comparisons, get none.
    """
    if not (is_control(module) and result.solved and result.unknowns is not None):
        return result
    if result.accuracy or not driver.generated:
        return result
    left = math.inf if request.time_limit is None else request.time_limit - result.seconds_solve

    def search(steps: int, start: Vector, grid: Vector | None) -> Vector | None:
        run = Run(
            steps, guess=start, max_iterations=max(LEAST_ITERATIONS, result.iterations), scaling=request.scaling,
            time_limit=max(LEAST_TIME, left), grid=grid,
        )  # fmt: skip
        attempt = driver.function("control")(module, run)
        return attempt.unknowns if attempt.status == "solved" else None

    error = discretisation_error(module, result, search)
    if error is None:
        return replace(result, notes=(*result.notes, UNKNOWN_ERROR))
    summary = {**result.summary, "state_error": error.states, "cost_error": error.cost}
    notes = (*result.notes, *([error.note] if error.is_large else []))
    return replace(result, error=error, summary=summary, notes=notes, labels={**result.labels, **_ERROR_LABELS})


LEAST_ITERATIONS = 50
"""Iterations that a search for the optimum on double steps has at least."""
_ERROR_LABELS = {"state_error": "relative error of states", "cost_error": "relative error of the cost"}


def _with_notes(module: GeneratedModule, result: Result) -> Result:
    """The result with what is to be said of its motion between nodes."""
    if not (is_control(module) and result.solved and result.unknowns is not None):
        return result
    where = module, result.unknowns, result.steps, result.grid
    gross = [one.note for one in excursions(*where) if one.is_gross]
    beyond = [stage.note for stage in stages_beyond(*where)]
    return replace(result, notes=(*result.notes, *gross, *beyond, *(pole.note for pole in poles(*where))))


def _background(request: Request, module: Any) -> Background:
    """What pictures of the result need."""
    file = getattr(module, "__file__", None)
    path = None if file is None else Path(file)
    if request.is_built:
        return Background(module, path)
    return Background(module, path, request.source, request.settings)


def _built(request: Request, working: Working, processes: Compilers) -> tuple[Path | None, bool, float]:
    """The file of the module, whether it is new, and the seconds of its derivation; no file of a loaded one."""
    if request.is_built:
        return (Path(request.problem) if isinstance(request.problem, Path | str) else None), False, 0.0
    with working("Deriving"):
        made = _made(request, processes.start if DRIVERS[request.driver].generated else lambda: None)
    return made.path, made.written, made.seconds


def _made(request: Request, deriving: Callable[[], None]) -> compiler.Build:
    """The module by the scheme that is asked for; where accuracy is, by one of order four if the problem allows it."""
    build = partial(
        compiler.build, request.source, request.settings, method=request.method, controls=request.controls,
        out=request.out, sensitivities=request.sensitivities, deriving=deriving,
    )  # fmt: skip
    if request.accuracy is not None and request.scheme is None:
        with suppress(SchemeError):
            made = build(scheme=ACCURATE_SCHEME)
            if not _has_path_inequalities(made.path):
                return made
    return build(scheme=request.scheme)


def _has_path_inequalities(path: Path) -> bool:
    """Whether a module imposes inequalities inside intervals.

    With a control that is constant on an interval they hold where they are strictest, and that error is of order one
    where there are several stages.
    """
    kinds = (meaning.kind for meaning in getattr(loading.load(path).metadata, "meanings", {}).values())
    return any(kind.role == Role.SLACK and kind not in (Kind.INTEGRAL_SLACK, Kind.BOUND_SLACK) for kind in kinds)


def _tolerance(request: Request, grid: Matrix | None) -> float | None:
    """The tolerance of the equations: where accuracy is asked for, what is left on the shortest interval is negligible.

    Slopes by a control are in proportion to the length of its interval, and so is the weight with which a barrier may
    still move it.
    """
    if request.tolerance is not None or request.accuracy is None or grid is None:
        return request.tolerance
    return max(LEAST_TOLERANCE, min(LARGEST_TOLERANCE, NEGLIGIBLE_PART * request.accuracy * float(grid.min())))


_TOO_TIGHT = ("inaccurate", "stalled")
"""How solves end whose tolerance is below what rounding allows."""


def _looser(run: Run) -> float:
    return min(LARGEST_TOLERANCE, 100.0 * (run.tolerance or LARGEST_TOLERANCE))


def points_of(request: Request, module: GeneratedModule) -> PointSet | None:
    """The points that are given, or those of the problem file, where there are any."""
    file, own = request.points, module.metadata.points
    if file is None and own and not request.is_built:
        file = request.settings.points or request.source.folder / own
    if isinstance(file, Path | str):
        return read_points(Path(file), len(module.metadata.coordinates))
    return file


def _steps(request: Request, module: Any) -> int:
    """The number of intervals, of each segment where the motion was cut into several."""
    own: int = module.metadata.steps
    segments = segments_of(module.metadata)
    if request.steps is None:
        return own
    return segments.steps(request.steps) if segments else request.steps


def _rounded(request: Request, module: Any) -> list[str]:
    """What is to be said where there are more steps than were asked for."""
    segments, asked = segments_of(module.metadata), request.steps
    if segments is None or asked is None or asked % segments.number == 0:
        return []
    made = segments.number * segments.steps(asked)
    why = f"as many in each of the {segments.number} segments between multiples of the delay"
    return [f"codegen: note: {made} steps instead of {asked}, {why}"]


def _solved(
    request: Request, module: Any, driver: Driver, warm: Vector | None, points: PointSet | None, watch: Watch | None
) -> Result:
    """The result of all runs, which share the time: of several guesses, and on grids of which each is twice as fine."""
    left = math.inf if request.time_limit is None else request.time_limit

    def solve_from(steps: int, start: Vector | None, near: bool, grid: Vector | None = None) -> Result:
        nonlocal left
        run = Run(
            steps, request.every, start, points, _tolerance(request, grid), near, request.max_iterations,
            max(left, LEAST_TIME), watch, request.scaling, grid,
        )  # fmt: skip
        result = run_and_verify(module, driver, run, request.repeat)
        left -= result.seconds_solve
        while request.accuracy is not None and result.status in _TOO_TIGHT and _looser(run) != run.tolerance:
            run = replace(run, tolerance=_looser(run), guess=result.unknowns)
            result = run_and_verify(module, driver, run, request.repeat)
            left -= result.seconds_solve
        return result

    def solve_on(steps: int, start: Vector | None, grid: Vector | None = None) -> Result:
        if start is None and request.guesses > 1:
            return best_of(lambda guess: solve_from(steps, guess, False, grid), module, steps, request.guesses)
        return solve_from(steps, start, True, grid)

    steps = _steps(request, module)
    if request.accuracy is not None:
        return to_accuracy(solve_on, module, steps, request.accuracy, warm)
    if request.doublings:
        return refine(solve_on, module, steps, request.doublings, warm)
    return solve_on(steps, None if warm is None else transferred(module, warm, steps))


def run_and_verify(module: GeneratedModule, driver: Driver, run: Run, repeat: int) -> Result:
    """Run a driver `repeat` times, and assess the last solution; see `codegen.solve`.

    The time is the least of the runs. The time in which numba compiles or reads functions during a run is left
    out: a driver may call functions for the first time.
    """
    task = task_of(module)
    require_memory(task.numbers(module.metadata, run), run.steps)
    function = driver.function(task.name)
    compiled_before = machine_code_counts(module)[0]
    begin = time.perf_counter()
    try:
        _get_ready(module, driver, task, run.steps)
        code_seconds = time.perf_counter() - begin
        attempt, seconds, late = _timed(lambda: function(module, run), repeat)
    except ValueError as error:
        # Generated modules know nothing of codegen's errors.
        raise NumericsError(str(error), "correct the problem's numbers or the options") from error
    except OSError as error:
        raise unwritable_cache_error(module, error) from error
    result: Result = task.result(module, driver.name, run, attempt, seconds)
    compiled = machine_code_counts(module)[0] > compiled_before
    return replace(result, seconds_code=code_seconds + late, compiled=compiled)


def _get_ready(module: GeneratedModule, driver: Driver, task: Task, steps: int) -> None:
    """Load the functions of a driver in this process before a run is timed, by calls of a smaller problem."""
    if not driver.generated:  # the others call what this one does not
        with quiet_single_thread():
            task.touch(module, steps)
        return
    if machine_code_counts(module) == (0, 0):
        with quiet_single_thread():
            task.small(module)


def require_memory(numbers: int, steps: int) -> None:
    """Refuse what would not fit into memory, before the operating system kills the process without a word."""
    if not hasattr(os, "sysconf"):
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if 8 * numbers > memory:
        raise NumericsError(
            f"{steps} steps need about {8e-9 * numbers:.0f} GB of memory, and there are {1e-9 * memory:.0f}",
            "take fewer steps, or store only every so many-th of a simulation",
        )


def _timed(solve: Callable[[], Any], repeat: int) -> tuple[Any, float, float]:
    """The last attempt, the least time of the runs, and the seconds of machine code in all of them."""
    best, code_seconds = math.inf, 0.0
    for _ in range(repeat):
        with seconds_of_machine_code() as spent:
            begin = time.perf_counter()
            attempt = solve()
            seconds = time.perf_counter() - begin
        code_seconds += spent.seconds
        best = min(best, max(seconds - spent.seconds, 0.0))
    return attempt, best, code_seconds
