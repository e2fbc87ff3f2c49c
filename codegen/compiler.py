"""The story of a build: problem file -> model -> program -> derivatives -> strings -> module.

    author           model        transcribe        derive             lower          emit
    Problem  --->    Model --->   Program   --->    derivatives --->   Module  --->   text of one .py

Before the text is written, `verify` compares its derivatives with an independent differentiation of the program.

`build` runs it, or takes the text from the cache, whose key is everything that the text depends on; a hit needs no
sympy at all.
"""

from __future__ import annotations

import gc
import math
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import cache_from_source
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen import cache, emit
from codegen.author.data_files import recorded_files
from codegen.author.sources import Source, source_of, split_points
from codegen.deadline import BUILD, Stages, described, extent
from codegen.errors import ArgumentError, FileError
from codegen.naming import Choices, chosen, origin_of
from codegen.runtime.machine_code_cache import remove_partial_bytecode
from codegen.tasks import TASKS

if TYPE_CHECKING:
    from codegen.derive.mixed import ControlSensitivities
    from codegen.lower.module import Module, Origin
    from codegen.model import Model
    from codegen.model.pairwise import PairwiseModel

GENERATED = Path("generated")
"""The folder, below the current one, in which modules are kept that someone wants to read."""


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
    out: Path | str | None = None,
    time_limit: float = BUILD,
) -> Build:
    """Derive, emit and write the module of a problem file, or of an object, into the folder `out`.

    `arguments` are those of problem(), as values or as the text that `--set` takes. With `sensitivities` the module of
    an optimisation has what derivatives of its solutions by parameters and boundary values need. Without `out` the
    module stays in the user's cache, unless ./generated already holds the very same text: then that file is used, and
    with it the machine code that numba keeps beside it. A derivation may take `time_limit` seconds of processor time;
    what takes longer is a SizeError, which names the stage and what is large. Raises a kind of CodegenError when the
    problem or a choice is unusable; then nothing is written.
    """
    begin = time.perf_counter()
    source, choices = source_of(problem), chosen(scheme, method, controls, general, sensitivities)
    settings = split_points(source, arguments or {})[0]
    for key, value in settings.items():
        if not value.isprintable():
            raise ArgumentError(f"--set {key}={value!r} holds control characters", "leave them out")
    store = cache.path_of(source, settings, choices)
    text = cache.kept_text(store)
    is_new = not text
    if is_new:
        with _DERIVING:
            store = cache.path_of(source, settings, choices)  # another thread may have derived it meanwhile
            text = cache.kept_text(store)
            is_new = not text
            if is_new:
                text = generate(source, settings, choices, time_limit)
                store = _kept(source, settings, choices, text)
    target, written = _placed(store, text, out) if out is not None else (_found(store, text), is_new)
    return Build(target, store.stem, time.perf_counter() - begin, not is_new, written)


_DERIVING = threading.Lock()
"""Problem files are run with their folder on the path and their output redirected, which threads cannot do at once."""


def _kept(source: Source, settings: Mapping[str, str], choices: Choices, text: str) -> Path:
    """Where the cache keeps a text from now on."""
    try:
        store = cache.path_of_text(source, settings, choices, text)
        emit.write(store, text)
        return store
    except FileError as error:
        raise FileError(error.finding, "make room there, or let CODEGEN_CACHE_DIR name another folder") from error


def _found(store: Path, text: str) -> Path:
    """The file in ./generated that holds the very same text, else the one in the cache."""
    kept = GENERATED / store.name
    return kept if kept.is_file() and kept.read_bytes() == text.encode() else store


def _placed(store: Path, text: str, out: Path | str) -> tuple[Path, bool]:
    """The file in a folder that was asked for, and whether it had to be written."""
    target = Path(out) / store.name
    written = emit.write(target, text)
    with suppress(OSError):  # where it may not be removed, Python may not have written it either
        remove_partial_bytecode(cache_from_source(target))  # type: ignore[no-untyped-call]
    return target, written


def stored(problem: Source | Path | str, arguments: Mapping[str, str], *, scheme: str | None = None) -> Path:
    """Where the cache keeps the module of a problem once it has been built."""
    return cache.path_of(problem, arguments, chosen(scheme))


def generate(
    problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, time_limit: float = BUILD
) -> str:
    """The text of the module of a problem, derived anew within so many seconds of processor time."""
    stages = Stages(time_limit)
    with _rare_collections(), stages.limited():
        from codegen.model.from_file import load_problem

        with recorded_files() as files:
            model = load_problem(problem, arguments)
        return generate_from_model(model, choices, origin_of(problem, arguments, choices, files), stages)


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Look for cyclic garbage less often: expressions leave little, and looking takes a sixth of the time."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def generate_from_model(
    model: Model | PairwiseModel, choices: Choices, origin: Origin, stages: Stages | None = None
) -> str:
    """The pipeline itself, from a checked problem to the text of its module."""
    from codegen import derive, lower, transcribe, verify

    if choices.general:
        return emit.render(_general_module(model, choices), origin)
    if choices.sensitivities:
        _require_sensitive(model)
    stages = stages or Stages(math.inf)
    stages.begin("writing the equations of an interval", lambda: described(model))
    program = transcribe.transcribe(model, choices.scheme, choices.method, choices.controls)
    stages.begin("differentiating the equations of an interval", lambda: extent(program, described(model)))
    derivatives, by_data = derive.derivatives(program), derivatives_by_data(program) if choices.sensitivities else None
    stages.begin("writing the kernels of the derivatives")
    module = lower.lower(program, derivatives, by_data)
    text = emit.render(module, origin)
    stages.begin("verifying the kernels")
    verify.verify(program, text)
    return text


def _require_sensitive(model: Model | PairwiseModel) -> None:
    """ArgumentError for a problem whose solutions have no sensitivities: samples lie at times, not in parts of any."""
    from codegen.model.pairwise import PairwiseModel

    if model.task != "control":
        noun = TASKS[model.task].noun
        raise ArgumentError(f"sensitivities are those of an optimisation, not of {noun}", "leave them out")
    assert not isinstance(model, PairwiseModel), "particles are no optimisation"
    parts = model.phases or (model,)
    times = [part.duration for part in parts] + [
        i.time for part in parts for i in part.inner_times if i.time is not None
    ]
    if any(part.measurements for part in parts) and any(time.free_symbols & {*model.parameters} for time in times):
        finding = "sensitivities of measurements need times that follow no parameters"
        raise ArgumentError(finding, "give the duration and inner times as numbers, or leave sensitivities out")


def derivatives_by_data(program: Any) -> ControlSensitivities:
    """What the module of an optimisation needs more where sensitivities are asked for."""
    from codegen.derive.mixed import control_sensitivities

    return control_sensitivities(program)


def _general_module(model: Model | PairwiseModel, choices: Choices) -> Module:
    """The same with nothing left out, for measurements; ArgumentError for particles, which have no such form."""
    from codegen import derive, lower, transcribe
    from codegen.derive import general
    from codegen.model import Model
    from codegen.transcribe.program import ControlProgram

    if not isinstance(model, Model):
        raise ArgumentError("particles have no general form", "measure another problem")
    program = transcribe.transcribe(general.general_model(model), choices.scheme, choices.method, choices.controls)
    if isinstance(program, ControlProgram):
        return lower.lower(program, general.general_derivatives(program, derive.control_derivatives(program)))
    program = general.general_step(program)
    return lower.lower(program, derive.step_derivatives(program))
