"""The way of a request: build, load, machine code, runs of a driver on one grid or several, verdict."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from codegen import compiler, loading
from codegen.author.points import PointSet, read_points
from codegen.author.problem_file import split_points
from codegen.drivers import Driver
from codegen.loading import GeneratedModule, Vector
from codegen.machine_code import ahead_of_time
from codegen.solutions import output
from codegen.solutions.result import Result, Run, Watch
from codegen.solving.multistart import best_of
from codegen.solving.other_tables import with_tables
from codegen.solving.refinement import refine, transferred
from codegen.solving.request import Request
from codegen.solving.run import run_and_verify
from codegen.solving.warm_start import start_of

LEAST_TIME = 1e-9
"""Seconds in which a search does not begin."""


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

    `working` and `following` show signs of life, of building and of solving, where there is a terminal.
    """
    start = start_of(request.warm)
    path, is_new, build_seconds = _built(request, working)
    begin = time.perf_counter()
    module: Any = request.problem if path is None else loading.load(path)
    load_seconds = time.perf_counter() - begin
    module = with_tables(module, request.tables)
    driver, warm, points = request.driver_for(module), start(module), _points(request, module)
    said: list[str] = []
    if path is not None and driver.name == "newton":
        seconds, said = ahead_of_time.require(path, module, is_new, working)
        build_seconds += seconds
    with following() as watch:
        result = _solved(request, module, driver, warm, points, request.watch or watch)
    if result.compiled:
        return Outcome(module, result, build_seconds + result.seconds_first, load_seconds, said)
    return Outcome(module, result, build_seconds, load_seconds + result.seconds_first, said)


def _built(request: Request, working: Working) -> tuple[Path | None, bool, float]:
    """The file of the module, whether it is new, and the seconds of its derivation; no file of a loaded one."""
    if not isinstance(request.problem, Path | str):
        return None, False, 0.0
    if request.is_built:
        return Path(request.problem), False, 0.0
    with working("Deriving"):
        made = compiler.build(
            request.problem, request.arguments, scheme=request.scheme, method=request.method, controls=request.controls,
            out=request.out,
        )  # fmt: skip
    return made.path, made.written, made.seconds


def _points(request: Request, module: GeneratedModule) -> PointSet | None:
    """The points that are given, or those of the problem file, where there are any."""
    file, own = request.points, module.metadata.get("points")
    if file is None and own and isinstance(request.problem, Path | str) and not request.is_built:
        file = split_points(request.problem, request.arguments)[1] or Path(request.problem).parent / own
    if isinstance(file, Path | str):
        return read_points(Path(file), len(module.metadata["coordinates"]))
    return file


def _solved(
    request: Request, module: Any, driver: Driver, warm: Vector | None, points: PointSet | None, watch: Watch | None
) -> Result:
    """The result of all runs, which share the time: of several guesses, and on grids of which each is twice as fine."""
    left = math.inf if request.time_limit is None else request.time_limit

    def solve_from(steps: int, start: Vector | None, near: bool) -> Result:
        nonlocal left
        run = Run(
            steps, request.every, start, points, request.tolerance, near, request.max_iterations, max(left, LEAST_TIME),
            watch, request.scaling,
        )  # fmt: skip
        result = run_and_verify(module, driver, run, request.repeat)
        left -= result.seconds_solve
        return result

    def solve_on(steps: int, start: Vector | None) -> Result:
        if start is None and request.guesses > 1:
            return best_of(lambda guess: solve_from(steps, guess, False), module, steps, request.guesses)
        return solve_from(steps, start, True)

    steps = request.steps or module.metadata["steps"]
    if request.doublings:
        return refine(solve_on, module, steps, request.doublings, warm)
    return solve_on(steps, None if warm is None else transferred(module, warm, steps))
