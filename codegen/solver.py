"""A compiled problem: what `codegen.compile` makes of a file or of an object, and all that can be done with it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
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
    from codegen.solving.interfaces import GeneratedModule
    from codegen.solving.results.result import Result


@dataclass(frozen=True)
class ModuleSource:
    """The generated module as `text`, in the file `path`; `str` of it is the text."""

    path: Path
    text: str = field(repr=False)

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False, repr=False)
class Solver:
    """A problem that is derived and compiled, and solved as often as one likes.

    `problem` is where it comes from, with its `name` and `title`; `arguments` are those of problem() in a file, and
    `choices` those of the build; `build` tells the module's path, and whether the cache had it. Solvers can be pickled
    if what their author wrote can be; a `module` is loaded where it is used.
    """

    problem: Source
    arguments: Mapping[str, object]
    choices: Choices
    out: Path | None
    build: Build

    @property
    def name(self) -> str:
        """What the problem is called."""
        return self.problem.name

    @property
    def title(self) -> str:
        """What the problem is about, on one line."""
        return str(self.module.metadata.title)

    @property
    def module(self) -> GeneratedModule:
        """The generated module, loaded."""
        from codegen.solving.loading import load

        return load(self.build.path)

    @property
    def source(self) -> ModuleSource:
        """The module's text and path; it needs numpy and numba alone, and may be taken elsewhere."""
        return ModuleSource(self.build.path, self.build.path.read_text(encoding="utf-8"))

    @cached_property
    def build_options(self) -> dict[str, Any]:
        """What a solve, a sweep or a controller is given in place of this solver."""
        own = self.choices
        named = {"scheme": own.scheme, "method": own.method, "controls": own.controls, "out": self.out}
        wanted = {"sensitivities": True} if own.sensitivities else {}
        return {"problem": self.problem, "arguments": dict(self.arguments), **named, **wanted}

    def solve(self, driver: str = "newton", **options: Any) -> Result:
        """Solve the problem; the options are those of `codegen.solve` but for choices of the build.

        The module of this solver is used, but for `accuracy` without a scheme and for `sensitivities`: modules of their
        own are derived for these when they are asked for first. Raises as `codegen.solve` does.
        """
        from codegen.solving.api import solve

        return solve(self, driver, **options)

    def check(self, *, time_limit: float = CHECK) -> Findings:
        """The evidence of `codegen check`, which a notebook shows as a table; it takes `time_limit` seconds at most.

        A check that fails is a finding, not an exception.
        """
        from codegen.evidence import checks

        own = self.choices
        return checks.run(
            self.problem, self._settings, scheme=own.scheme, method=own.method, controls=own.controls,
            sensitivities=own.sensitivities, module=self.build.path, time_limit=time_limit,
        )  # fmt: skip

    def show(self) -> Equations:
        """The derived equations, continuous and discrete: text, LaTeX, and mathematics in a notebook."""
        from codegen.show.equations import derived_equations

        own = self.choices
        return derived_equations(self.problem, self._settings, own.scheme, own.method, own.controls)

    def sweep(self, vary: Mapping[str, Any] | None = None, **options: Any) -> Dataset:
        """Solve the problem for many values; the options are those of `codegen.sweep`, and so is the data set."""
        from codegen.batch.sweep import sweep

        return sweep(self, vary, **options)

    def controller(self, **options: Any) -> Controller:
        """A controller with a moving horizon; the options are those of `codegen.Controller` but for a build's."""
        from codegen.mpc.controller import Controller

        return Controller(self, **options)

    @cached_property
    def _settings(self) -> Settings:
        return settings_of(self.problem, self.arguments)

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
        return table(rows, caption=self.title) + self._mathematics()

    def _mathematics(self) -> str:
        """What the author wrote, where that is at hand without running a file."""
        if not isinstance(self.problem, ProblemObject):
            return ""
        from html import escape

        from codegen.show.notebook import displayed

        return escape(displayed(self.problem.problem), quote=False)


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
    """Derive and compile a problem, or find it in the cache, and return its solver.

    `problem` is a Control, Simulate, Phases or Connect, or the path of a problem file. An object is called `name`, an
    identifier, "problem" unless said, and is about `title`, one line, its name unless said; a file has its own. The
    cache knows an object by all that it says, in any process; changes in a notebook are seen, and an old state is found
    again. Files that tables and measurements of an object name lie in the current folder.

    `arguments` of problem() are those of a file alone. `scheme`, `method`, `controls`, `sensitivities`, `out` and
    `time_limit` are as for `codegen.build`; with `sensitivities` all solutions have them.

    Raises ArgumentError for a name, title or choice that is unusable, and another kind of CodegenError when the problem
    is; messages begin with the object's name, or with the file.
    """
    from codegen.solving.loading import load
    from codegen.solving.machine_code import ahead_of_time

    source, given = source_of(problem, name, title), dict(arguments or {})
    made = compiler.build(
        source, given, scheme=scheme, method=method, controls=controls, sensitivities=sensitivities, out=out,
        time_limit=time_limit,
    )  # fmt: skip
    ahead_of_time.require(made.path, load(made.path), made.written, nullcontext)
    choices = chosen(scheme, method, controls, sensitivities=sensitivities)
    return Solver(source, given, choices, None if out is None else Path(out), made)
