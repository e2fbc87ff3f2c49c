"""The story of a build: problem file -> model -> program -> derivatives -> strings -> module.

    author           model        transcribe        derive             lower          emit
    Problem  --->    Model --->   Program   --->    derivatives --->   Module  --->   text of one .py

`generate_from_model` is that line. Before the text is written, `verify` compares its derivatives with an independent
differentiation of the program. `build` runs the line, or takes the text from the cache, whose key is everything that
the text depends on; a hit needs no sympy at all.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from codegen.emit import rendering
from codegen.emit.deadline import BUILD, Stages, described, extent, rare_collections
from codegen.emit.naming import Choices, chosen, origin_of
from codegen.errors import ArgumentError
from codegen.problem.points import recorded_files
from codegen.problem.sources import Source, settings_of, source_of
from codegen.solving import cache

if TYPE_CHECKING:
    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.pairwise import PairwiseModel
    from codegen.emit.lower.module import Origin


@dataclass(frozen=True)
class Build:
    """A generated module on disk, how long it took, and whether the cache had it."""

    path: Path
    name: str
    seconds: float
    cached: bool
    written: bool


def build(
    problem: Source | Path | str,
    arguments: Mapping[str, object] | None = None,
    *,
    scheme: str | None = None,
    method: str | None = None,
    controls: str = "interval",
    general: bool = False,
    sensitivities: bool = False,
    standalone: bool = False,
    out: Path | str | None = None,
    time_limit: float = BUILD,
    deriving: Callable[[], None] = lambda: None,
) -> Build:
    """Derive, emit and write the module of a problem file, or of an object, into the folder `out`.

    `arguments` are those of problem(), as values or as the text that `--set` takes. With `sensitivities` the module of
    an optimisation has what derivatives of its solutions by parameters and boundary values need. A `standalone` module
    is one file with the numerics that it uses, and runs where this package is not installed. Without `out` the
    module stays in the user's cache, unless ./generated already holds the very same text: then that file is used, and
    with it the machine code that numba keeps beside it. A derivation may take `time_limit` seconds of processor time;
    what takes longer is a SizeError, which names the stage and what is large. `deriving` is called when a derivation
    begins. Raises a kind of CodegenError when the
    problem or a choice is unusable; then nothing is written.
    """
    begin = time.perf_counter()
    source, choices = source_of(problem), chosen(scheme, method, controls, general, sensitivities)
    settings = settings_of(source, arguments)
    for key, value in settings.items():
        if not value.isprintable():
            raise ArgumentError(f"--set {key}={value!r} holds control characters", "leave them out")

    def derived() -> str:
        deriving()
        return generate(source, settings, choices, time_limit)

    entry = cache.entry_of(source, settings, choices, derived)
    if standalone:
        from codegen.emit.standalone import bundle

        entry = cache.entry_of(source, settings, replace(choices, standalone=True), partial(bundle, entry.text))
    path, written = (entry.as_found(), entry.is_new) if out is None else entry.written_to(Path(out))
    return Build(path, entry.path.stem, time.perf_counter() - begin, not entry.is_new, written)


def generate(
    problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, time_limit: float = BUILD
) -> str:
    """The text of the module of a problem, derived anew within so many seconds of processor time."""
    stages = Stages(time_limit)
    with rare_collections(), stages.limited():
        from codegen.discretise.model.from_problem import load_problem

        with recorded_files() as files:
            model = load_problem(problem, arguments)
        return generate_from_model(model, choices, origin_of(problem, arguments, choices, files), stages)


def generate_from_model(
    model: Model | PairwiseModel, choices: Choices, origin: Origin, stages: Stages | None = None
) -> str:
    """The pipeline itself, from a checked problem to the text of its module."""
    from codegen.discretise import transcribe
    from codegen.emit import differentiation, lower, verify

    if choices.general:
        form = differentiation.general_form(model, choices.scheme, choices.method, choices.controls)
        return rendering.render(lower.lower(*form), origin)
    if choices.sensitivities:
        differentiation.require_sensitive(model)
    stages = stages or Stages(math.inf)
    stages.begin("writing the equations of an interval", lambda: described(model))
    program = transcribe.transcribe(model, choices.scheme, choices.method, choices.controls)
    stages.begin("differentiating the equations of an interval", lambda: extent(program, described(model)))
    derivatives = differentiation.derivatives(program)
    by_data = differentiation.control_sensitivities(program) if choices.sensitivities else None
    stages.begin("writing the kernels of the derivatives")
    module = lower.lower(program, derivatives, by_data)
    text = rendering.render(module, origin)
    stages.begin("verifying the kernels")
    verify.verify(program, text)
    return text
