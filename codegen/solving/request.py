"""What is asked of a solve, and what is refused about it: here, and nowhere else.

A solve with other values of parameters than the problem's own, which need no build.

What of a module may have other values without a build: parameters, given durations, prescribed ends, by name.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import cached_property, partial
from numbers import Integral, Real
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from codegen.errors import ArgumentError, NumericsError, TableError, clause
from codegen.problem.sources import AuthorObject, ProblemFile, ProblemObject, Settings, Source, settings_of, source_of
from codegen.runtime.record import TableRecord
from codegen.solving.drivers import DRIVERS, Driver, find
from codegen.solving.loading import (
    GeneratedModule,
    Matrix,
    Vector,
    few_steps,
    is_connect,
    is_of_particles,
    is_simulation,
)
from codegen.solving.results.segments import segments_of
from codegen.solving.tasks import TASKS, Task, task_of
from codegen.symbolic.measurements import Layout, given_measurements, read_measurements
from codegen.symbolic.tables import read_table

if TYPE_CHECKING:
    from codegen.problem.points import PointSet
    from codegen.solving.results.result import Watch

START = "start."
"""What names of prescribed values at the start begin with."""


def as_number(value: Any) -> float:
    """A value as a number; nan where it is none, or larger than any."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def parameter_arguments(module: Any) -> dict[str, str]:
    """The arguments of a module's functions by the names of parameters, which they may not have in Python."""
    # Where particles begin, or sigma of their targets, and what each of them has for itself, come first.
    before = 1 + len(module.metadata.own) if is_of_particles(module) else 0
    return dict(zip(module.metadata.parameters, _keywords(module)[before:], strict=False))


def duration_arguments(module: Any) -> tuple[str, ...]:
    """The arguments for durations that are given; where there are delays, of which it is made, that of a segment."""
    of_parameters = parameter_arguments(module).values()
    return tuple(name for name in _keywords(module) if name.startswith("duration") and name not in of_parameters)


def apart_from_delays(module: Any) -> tuple[str, ...]:
    """The arguments for durations that may have other values: none where delays are parts of them."""
    return () if segments_of(module.metadata) else duration_arguments(module)


def prescribed_ends(module: Any) -> dict[str, tuple[str, str]]:
    """Prescribed values by names such as `end.x`: which end, and the name that the module's functions know.

    Of a simulation these are all values that it starts from; particles have none, since they start from an array.
    """
    if is_simulation(module):
        return {f"{START}{name}": ("start", name) for name in module.metadata.start}
    ends = (("start", module.metadata.start), ("end", module.metadata.end))
    return {f"{end}.{name}": (end, name) for end, names in ends for name in names}


def require_apart_from_arrays(module: Any, names: Iterable[str]) -> None:
    """Refuse, as an ArgumentError, names of what particles start from: an array, which has no value for each name."""
    if not (is_simulation(module) and is_of_particles(module)):
        return
    for name in names:
        if name.startswith(START):
            finding = clause(f"{module.metadata.problem} has no {name}: its particles start from an array")
            raise ArgumentError(finding, "call solve(start=...) of its module, which takes all positions and momenta")


def require_apart_from_delays(module: Any, names: Iterable[str]) -> None:
    """Refuse, as an ArgumentError, names of a duration of which delays are parts: it would change them as well."""
    if segments_of(module.metadata) is None:
        return
    durations = duration_arguments(module)
    for name in names:
        if name in durations:
            finding = f"{module.metadata.problem} has delays, which another {name} would change as well"
            raise ArgumentError(finding, "change it in the problem, and build that")


def _keywords(module: Any) -> list[str]:
    maker = module.make_case if is_connect(module) else module.make_grid
    arguments = inspect.signature(maker).parameters.values()
    return [argument.name for argument in arguments if argument.kind is inspect.Parameter.KEYWORD_ONLY]


SCALINGS = ("auto", "none")
"""Whether an optimiser works in parts of the sizes that it finds in a problem, or in the problem's own units."""
_OF_BUILDS = ("arguments", "scheme", "method", "controls", "out")
_LEAST = {"steps": 1, "every": 1, "repeat": 1, "guesses": 1, "max_iterations": 1, "doublings": 0}
_GENERATED = b"# Generated by codegen"


@dataclass(frozen=True, eq=False)
class Request:
    """A problem and how it is to be solved; see `codegen.solve`, whose arguments these are.

    Raises ArgumentError for a choice that does not exist, and NumericsError for a number that is unusable.
    """

    problem: Path | str | Source | GeneratedModule | Any
    driver: str = "newton"
    _: KW_ONLY
    arguments: Mapping[str, object] = field(default_factory=dict)
    scheme: str | None = None
    method: str | None = None
    controls: str = "interval"
    out: Path | str | None = None
    steps: int | None = None
    every: int = 1
    repeat: int = 1
    warm: Vector | Path | str | None = None
    doublings: int = 0
    accuracy: float | None = None
    guesses: int = 1
    sensitivities: bool = False
    points: PointSet | Path | str | None = None
    parameters: Mapping[str, float] | None = None
    tables: Mapping[str, Path | str] | None = None
    observations: Any = None
    tolerance: float | None = None
    max_iterations: int | None = None
    time_limit: float | None = None
    scaling: str = "auto"
    log: bool = False
    watch: Watch | None = None

    def __post_init__(self) -> None:
        """Refuse what is unusable whatever the problem is."""
        self._take_what_is_compiled()
        find(self.driver)
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value is None and name in ("steps", "max_iterations"):
                continue
            if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
                remedy = "a positive integer" if least else "a whole number that is not negative"
                raise NumericsError(f"{name} is {value!r}", f"give {remedy}")
        if self.tolerance is not None and not 0.0 < as_number(self.tolerance) < 1.0:
            raise ArgumentError(f"--tolerance {self.tolerance}", "give a number between 0 and 1")
        if self.accuracy is not None and not 0.0 < as_number(self.accuracy) < 1.0:
            raise ArgumentError(f"--accuracy {self.accuracy}", "give a relative error between 0 and 1")
        if self.accuracy is not None and self.doublings:
            raise ArgumentError("--accuracy beside --doublings", "leave one of them out")
        if self.time_limit is not None and not as_number(self.time_limit) > 0.0:
            raise ArgumentError(f"--time-limit {self.time_limit}", "give a positive number of seconds")
        if self.scaling not in SCALINGS:
            raise ArgumentError(f"--scaling {self.scaling}", f"use one of {', '.join(SCALINGS)}")
        if not isinstance(self.sensitivities, bool):
            raise ArgumentError(f"sensitivities is {self.sensitivities!r}", "give True or False")
        if self.warm is not None and self.guesses > 1:
            raise ArgumentError("several guesses beside a warm start", "leave one of them out")
        for name in ("scheme", "method", "controls"):
            if not isinstance(getattr(self, name), str | None):
                raise ArgumentError(f"{_option(name)} {getattr(self, name)!r} is no name", "give one as text")
        if not (self.points is None or isinstance(self.points, Path | str) or hasattr(self.points, "target")):
            raise ArgumentError(f"--points {type(self.points).__name__}", "give a file, or a PointSet")
        if self.parameters is not None and not _are_named(self.parameters):
            raise ArgumentError(f"parameters are {self.parameters!r}", 'give names and values, such as {"m": 2.0}')
        for name, value in (self.parameters or {}).items():
            if not math.isfinite(as_number(value)):
                raise NumericsError(clause(f"parameter {name} is {value!r}"), "give a finite number")
        if self.tables is not None and not _are_files(self.tables):
            raise ArgumentError(f"tables are {self.tables!r}", 'give names and files, such as {"thrust": "other.csv"}')
        if not _are_named(self.arguments):
            raise ArgumentError(f"arguments are {self.arguments!r}", 'give names and values, such as {"craft": 3}')
        if not isinstance(self.out, str | Path | None):
            raise ArgumentError(f"--out {self.out!r} is no folder", "give its path")
        if self.watch is not None and not callable(self.watch):
            raise ArgumentError(f"watch is {self.watch!r}", "give a function of an iterate's number and row")
        self._require_problem()

    def _take_what_is_compiled(self) -> None:
        """Put what `codegen.compile` has returned, or an author's object, in terms of a source and its choices."""
        made: Mapping[str, Any] | None = getattr(self.problem, "build_options", None)
        if made is not None:
            if given := next(filter(self._is_given, _OF_BUILDS), None):
                finding = f"{_option(given)} is a choice of a build, and the problem is compiled already"
                raise ArgumentError(finding, "leave it out, or compile the problem with it")
            for name, value in made.items():
                object.__setattr__(self, name, value)
        elif isinstance(self.problem, AuthorObject):
            object.__setattr__(self, "problem", source_of(self.problem))

    def _require_problem(self) -> None:
        """Refuse what is neither a problem nor a module, and choices of a build where there is nothing to build."""
        is_source = isinstance(self.problem, Path | str | ProblemFile | ProblemObject)
        if not is_source and not hasattr(getattr(self.problem, "metadata", None), "task"):
            what = type(self.problem).__name__
            remedy = "give the path of a problem file, a Control or the like, or a generated module"
            raise ArgumentError(f"a solve begins with a problem, not with this {what}", remedy)
        given = next(filter(self._is_given, _OF_BUILDS), None)
        if given and self.is_built:
            finding = f"{_option(given)} is a choice of a build, and the problem is a generated module already"
            raise ArgumentError(finding, "leave it out, or give the problem file")

    @property
    def source(self) -> Source:
        """Where the problem comes from, which is no module."""
        assert not self.is_built, "a module has been made already"
        return source_of(self.problem)

    @cached_property
    def settings(self) -> Settings:
        """What the arguments of a problem that is no module say, taken apart once."""
        return settings_of(self.source, self.arguments)

    @property
    def is_built(self) -> bool:
        """Whether the problem is a generated module, loaded or in a file."""
        if not isinstance(self.problem, Path | str):
            return not isinstance(self.problem, ProblemFile | ProblemObject)
        try:
            with Path(self.problem).open("rb") as file:
                return file.read(len(_GENERATED)) == _GENERATED
        except OSError:  # what is wrong with it is said where it is read
            return False

    def driver_for(self, module: GeneratedModule) -> Driver:
        """The driver, if it and all options that are given mean something for a module's task, else ArgumentError."""
        task = task_of(module)
        driver = find(self.driver, task.name)
        for name in filter(self._is_given, _DEFAULTS):
            if name not in task.options and not driver.takes(task.name, name) and _is_of_tasks(name):
                raise _meaningless(name, task, driver)
        return driver

    def _is_given(self, name: str) -> bool:
        value, default = getattr(self, name), _DEFAULTS[name]
        return value is not default and (default is None or value != default)


_DEFAULTS: dict[str, Any] = {f.name: {} if f.name == "arguments" else f.default for f in fields(Request)}


def require_known(names: Iterable[str]) -> None:
    """Refuse names that are no option of a solve; ArgumentError tells which is meant."""
    for name in names:
        if name not in _DEFAULTS:
            close = difflib.get_close_matches(name, _DEFAULTS, 1)
            listed = f"use one of {', '.join(_DEFAULTS)}; a parameter of the problem is given by parameters={{...}}"
            remedy = f"did you mean {close[0]}?" if close else listed
            raise ArgumentError(f"codegen.solve has no option {name}", remedy)


def _is_of_tasks(name: str) -> bool:
    """Whether an option means something for some tasks, or drivers, only."""
    return any(_takers(name, task) for task in TASKS.values())


def _takers(name: str, task: Task) -> list[str]:
    return [d.name for d in DRIVERS.values() if name in task.options or d.takes(task.name, name)]


def _meaningless(name: str, task: Task, driver: Driver) -> ArgumentError:
    if takers := _takers(name, task):
        finding = f"driver {driver.name} takes no {_option(name)} for a {task.name} problem"
        return ArgumentError(finding, f"leave it out, or use {', '.join(takers)}")
    others = " and ".join(other.noun for other in TASKS.values() if _takers(name, other))
    return ArgumentError(f"{_option(name)} does not apply to a {task.name} problem, only to {others}", "leave it out")


def _option(name: str) -> str:
    return "--set" if name == "arguments" else f"--{name.replace('_', '-')}"


def _are_named(value: Any) -> bool:
    return isinstance(value, Mapping) and all(isinstance(name, str) for name in value)


def _are_files(value: Any) -> bool:
    """Whether a value maps names to paths."""
    return isinstance(value, Mapping) and all(
        isinstance(name, str) and isinstance(file, Path | str) for name, file in value.items()
    )


def with_tables(module: GeneratedModule, files: Mapping[str, Path | str] | None) -> Any:
    """The module with the tables of some files in place of its own, by their names, or itself where there are none.

    Raises ArgumentError for a name that is no table's, and TableError for a file that is no such table.
    """
    if not files:
        return module
    known = module.metadata.tables
    numbers = {name: _numbers(name, Path(file), known) for name, file in files.items()}
    return with_arguments(module, tables=numbers)


def with_arguments(module: Any, **given: Any) -> Any:
    """The module with arguments given to whatever makes its grids, or its cases."""
    other = ModuleType(getattr(module, "__name__", "generated"))
    other.__dict__.update(vars(module))
    makers = ("make_case", "solve") if is_connect(module) else ("make_grid", "nlp", "solve")
    other.__dict__.update({name: partial(getattr(module, name), **given) for name in makers if hasattr(module, name)})
    return other


def _numbers(name: str, file: Path, known: Mapping[str, TableRecord]) -> Vector:
    if name not in known:
        remedy = f"name one of {', '.join(known)}" if known else "leave it out"
        raise ArgumentError(f"--table {name}={file}: the problem has no table {name}", remedy)
    own = known[name]
    columns = (own.inputs, own.output, own.kind, own.outside)
    table = read_table(file, file.as_posix(), name, *columns)
    if table.shape.sizes != own.sizes:
        found, wanted = (" and ".join(map(str, sizes)) for sizes in (table.shape.sizes, own.sizes))
        raise TableError(
            f"{file}: table {name} has {found} breakpoints, and the module is built for {wanted}",
            "give as many, or change the problem's own file",
        )
    return np.array(table.numbers)


def with_values(module: Any, values: Mapping[str, float]) -> Any:
    """The module with other values of parameters, of given durations, and of prescribed ends (`start.x`), by name.

    Raises ArgumentError for a name that is none of them, and NumericsError for values that no grid can have.
    """
    if not values:
        return module
    known = {} if is_connect(module) else _known(module)
    require_apart_from_delays(module, values)
    require_apart_from_arrays(module, values)
    given: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            raise ArgumentError(clause(f"{module.metadata.problem} has no parameter {name}"), _remedy(name, known))
        end, quantity = known[name]
        if quantity:
            given.setdefault(end, {})[quantity] = float(value)
        else:
            given[end] = float(value)
    other = with_arguments(module, **given)
    try:
        other.make_grid(few_steps(module, 1))
    except ValueError as error:
        raise NumericsError(f"{module.metadata.problem}: {error}", "give other values") from error
    return other


def _known(module: Any) -> dict[str, tuple[str, str]]:
    """Arguments by the names of what they are for, beside the quantity where they map names to values.

    A parameter comes before a duration or an end of the same name.
    """
    durations = {name: (name, "") for name in apart_from_delays(module)}
    own = {name: (argument, "") for name, argument in parameter_arguments(module).items()}
    return {**own, **{name: key for name, key in (durations | prescribed_ends(module)).items() if name not in own}}


def _remedy(name: str, known: Mapping[str, Any]) -> str:
    if not known:
        return "leave it out"
    close = difflib.get_close_matches(name, known, 1)
    return clause(f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}")


def with_observations(module: GeneratedModule, given: Any) -> Any:
    """The module with other measurements in place of its own, or itself where none are given.

    `given` is a file, or a mapping of columns to arrays of shape (n,), and of several bodies a list of these. Raises
    ArgumentError where nothing was measured or their number is another, and TableError for what are no measurements.
    """
    if given is None:
        return module
    observations = module.metadata.observations
    if observations is None:
        raise ArgumentError("--observations: the problem has no measurements", "leave it out")
    listed, bodies = list(given) if isinstance(given, (list, tuple)) else [given], module.metadata.bodies
    if len(listed) != bodies:
        finding = f"--observations gives {len(listed)} sets of measurements, and there are {bodies} bodies"
        raise ArgumentError(finding, "give one for each")
    layout = Layout(observations.time, observations.columns, observations.sigmas)
    return with_arguments(module, observations=tuple(_rows(one, layout) for one in listed))


def _rows(given: Any, layout: Layout) -> Matrix:
    if isinstance(given, Path | str):
        return read_measurements(Path(given), Path(given).as_posix(), layout).array
    if isinstance(given, Mapping):
        return given_measurements(given, layout).array
    raise ArgumentError(f"observations are {given!r}", "give a file, or a mapping of columns to arrays")
