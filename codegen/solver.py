"""The class `Solver` of compiled problems, and the function `codegen.compile`, which creates a Solver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.emit.deadline import BUILD, CHECK
from codegen.emit.naming import Choices, chosen
from codegen.problem.sources import ProblemObject, Settings, Source, settings_of, source_of
from codegen.solving import compiler

if TYPE_CHECKING:
    from xarray import Dataset

    from codegen.evidence.checks.base import Findings
    from codegen.mpc.controller import Controller
    from codegen.problem.problem import Phases, Problem
    from codegen.show.equations import Equations
    from codegen.solving.compiler import Build
    from codegen.solving.loading import GeneratedModule
    from codegen.solving.results.result import Result


@dataclass(frozen=True)
class ModuleSource:
    """The `text` and the `path` of a generated module; `str` returns the text."""

    path: Path
    text: str = field(repr=False)

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False, repr=False)
class Solver:
    """A compiled problem, which can be solved any number of times.

    A solver can be pickled if the parts of its problem can be pickled.

    Attributes
    ----------
    problem : ProblemFile or ProblemObject
        The source of the problem, with its name.
    arguments : dict
        Arguments of problem() in a problem file.
    choices : Choices
        Scheme, method, controls and sensitivities of the build.
    out : Path or None
        Folder of the module; None means the cache.
    build : Build
        Information on the build, such as the path of the module; `build.cached` is True for a cache hit.
    """

    problem: Source
    arguments: Mapping[str, object]
    choices: Choices
    out: Path | None
    build: Build

    @property
    def name(self) -> str:
        """Name of the problem."""
        return self.problem.name

    @property
    def title(self) -> str:
        """Title of the problem in one line."""
        return str(self.module.metadata.title)

    @cached_property
    def module(self) -> GeneratedModule:
        """The generated module."""
        from codegen.solving.loading import load

        return load(self.build.path)

    @property
    def source(self) -> ModuleSource:
        """Text and path of the module."""
        return ModuleSource(self.build.path, self.build.path.read_text(encoding="utf-8"))

    @property
    def parameters(self) -> dict[str, float | None]:
        """Names that `parameters={...}` of `solve` may override, with their default values.

        The default value is None for durations and prescribed boundary values, which the problem may define by
        formulas.
        """
        from codegen.solving.request import overridable

        defaults = self.module.metadata.parameters
        return {name: defaults.get(name) for name in overridable(self.module)}

    @cached_property
    def build_options(self) -> dict[str, object]:
        """The options of `codegen.solve`, `codegen.sweep` or `codegen.Controller` that lead to the same module."""
        choices = self.choices
        named = {"scheme": choices.scheme, "method": choices.method, "controls": choices.controls, "out": self.out}
        sensitivities = {"sensitivities": True} if choices.sensitivities else {}
        return {"problem": self.problem, "arguments": self._settings, **named, **sensitivities}

    def solve(self, driver: str = "newton", **options: Any) -> Result:
        """Solve the problem.

        Parameters
        ----------
        driver : str
            As for `codegen.solve`.
        **options
            Options of `codegen.solve` except options of the build. The option `accuracy` without a scheme and the
            option `sensitivities` may need another module, which is built on first use.

        Returns
        -------
        Result

        Raises
        ------
        CodegenError
            As `codegen.solve`.
        """
        from codegen.solving.api import solve

        return solve(self, driver, **options)

    def check(self, *, steps: int | None = None, time_limit: float = CHECK) -> Findings:
        """Run the checks of `codegen check`.

        Parameters
        ----------
        steps : int
            Number of intervals of the checked solution, by default that of the problem.
        time_limit : float
            Limit in seconds.

        Returns
        -------
        Findings
            A notebook displays them as a table. A failed check is a finding, not an exception.
        """
        from codegen.evidence import checks

        choices = self.choices
        return checks.run(
            self.problem, self._settings, scheme=choices.scheme, method=choices.method, controls=choices.controls,
            sensitivities=choices.sensitivities, module=self.build.path, time_limit=time_limit,
            steps=steps,
        )  # fmt: skip

    def show(self) -> Equations:
        """Return the derived equations, continuous and discrete, as text, as LaTeX, and as formulas in a notebook."""
        from codegen.show.equations import derived_equations

        choices = self.choices
        return derived_equations(self.problem, self._settings, choices.scheme, choices.method, choices.controls)

    def sweep(self, vary: Mapping[str, object] | None = None, **options: Any) -> Dataset:
        """Solve the problem for many values of its parameters.

        Parameters
        ----------
        vary : dict
            Values by name, as for `codegen.sweep`.
        **options
            Options of `codegen.sweep`.

        Returns
        -------
        xarray.Dataset
        """
        from codegen.batch.sweep import sweep

        return sweep(self, vary, **options)

    def controller(self, **options: Any) -> Controller:
        """Return a model-predictive controller with a moving horizon.

        Parameters
        ----------
        **options
            Options of `codegen.Controller` except options of the build.
        """
        from codegen.mpc.controller import Controller

        return Controller(self, **options)

    @cached_property
    def _settings(self) -> Settings:
        return settings_of(self.problem, self.arguments)

    def __getstate__(self) -> dict[str, object]:
        """Return the attributes without the module, which another process loads from its file."""
        return {name: value for name, value in vars(self).items() if name != "module"}

    def __repr__(self) -> str:
        return f"Solver({self.name!r}, {str(self.build.path)!r})"

    def _repr_html_(self) -> str:
        from codegen.show.notebook import table

        metadata = self.module.metadata
        rows = [
            ("problem", f"{self.name} ({metadata.task})"),
            ("discretisation", f"{metadata.method}, {metadata.scheme}, {metadata.steps} steps"),
            ("module", str(self.build.path)),
            ("built", "from the cache" if self.build.cached else f"in {self.build.seconds:.2f} s"),
        ]
        summary = table(rows, caption=self.title)
        if not isinstance(self.problem, ProblemObject):  # formulas of a problem file would require running it
            return summary
        from html import escape

        from codegen.show.notebook import displayed

        return summary + escape(displayed(self.problem.problem), quote=False)


def compile(
    problem: Problem | Phases | Path | str,
    *,
    name: str | None = None,
    title: str | None = None,
    arguments: Mapping[str, object] | None = None,
    scheme: str | None = None,
    method: str | None = None,
    controls: str = "interval",
    sensitivities: bool = False,
    out: Path | str | None = None,
    time_limit: float = BUILD,
) -> Solver:
    """Derive and compile the module of a problem, or load it from the cache; return the compiled problem.

    Parameters
    ----------
    problem : Control, Simulate, Phases, Connect or path
        A problem object, or the path of a problem file.
    name : str
        Name of a problem object, an identifier; by default "problem". A problem file is named by its path.
    title : str
        Title of a problem object in one line; by default its name.
    arguments : dict
        Arguments of problem() in a problem file.
    scheme, method, controls, out, time_limit
        As for `codegen.build`.
    sensitivities : bool
        If True, all solutions have sensitivities.

    Returns
    -------
    Solver
        The compiled problem.

    Raises
    ------
    CodegenError
        ArgumentError for an unusable name, title or choice, and other kinds for an unusable problem. Messages begin
        with the name of the object or file.

    Notes
    -----
    The cache identifies an object by its content, in any process. Paths of tables and measurements of an object are
    relative to the current folder.
    """
    from codegen.solving.machine_code import processes
    from codegen.solving.progress import building, shown_from_call

    source, values = source_of(problem, name, title), dict(arguments or {})
    with shown_from_call(building, "Deriving") as deriving:
        made = compiler.build(
            source, values, scheme=scheme, method=method, controls=controls, sensitivities=sensitivities, out=out,
            time_limit=time_limit, deriving=deriving,
        )  # fmt: skip
    choices = chosen(scheme, method, controls, sensitivities=sensitivities)
    solver = Solver(source, values, choices, None if out is None else Path(out), made)
    processes.require(made.path, solver.module, made.written, building)
    return solver
