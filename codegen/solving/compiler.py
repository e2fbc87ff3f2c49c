"""The story of a build: problem file -> model -> program -> derivatives -> strings -> module.

    author           model        transcribe        derive             lower          emit
    Problem  --->    Model --->   Program   --->    derivatives --->   Module  --->   text of one .py

`generate_from_model` is that line. Before the text is written, `verify` compares its derivatives with an independent
differentiation of the program. `build` runs the line, or takes the text from the cache, whose key is everything that
the text depends on; a hit needs no sympy at all.

The build cache: texts by a digest of everything that they depend on; a hit needs no sympy at all.
"""

from __future__ import annotations

import hashlib
import json
import marshal
import math
import os
import re
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.util import cache_from_source
from pathlib import Path
from typing import TYPE_CHECKING

from codegen.emit import rendering
from codegen.emit.deadline import BUILD, Stages, described, extent, rare_collections
from codegen.emit.naming import Choices, choice_texts, chosen, module_name, origin_of, versions
from codegen.errors import ArgumentError, FileError
from codegen.problem.points import digest_of, recorded_files
from codegen.problem.sources import Source, input_digest, settings_of, source_of

if TYPE_CHECKING:
    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.pairwise import PairwiseModel
    from codegen.emit.lower.module import Origin

GENERATED = Path("generated")
"""The folder, below the current one, in which modules are kept that someone wants to read."""


@dataclass(frozen=True)
class Entry:
    """The text of a module, where the cache keeps it, and whether it has just been derived."""

    path: Path
    text: str
    is_new: bool

    def as_found(self) -> Path:
        """The file in ./generated that holds the very same text, else the one in the cache."""
        kept = GENERATED / self.path.name
        return kept if kept.is_file() and kept.read_bytes() == self.text.encode() else self.path

    def written_to(self, folder: Path) -> tuple[Path, bool]:
        """The file in a folder that was asked for, and whether it had to be written."""
        target = folder / self.path.name
        written = rendering.write(target, self.text)
        with suppress(OSError):  # where it may not be removed, Python may not have written it either
            _remove_partial_bytecode(Path(cache_from_source(target)))
        return target, written


def _remove_partial_bytecode(file: Path) -> None:
    """Remove the bytecode that Python keeps of a module where it could not be read to its end; there may be none.

    Where the disk is full, Python before 3.13 keeps a part, which would end every later import.
    """
    header = 16  # bytes before the code itself
    try:
        marshal.loads(file.read_bytes()[header:])
    except (EOFError, ValueError, TypeError):
        file.unlink(missing_ok=True)
    except FileNotFoundError:
        pass


_DERIVING = threading.Lock()
"""Problem files are run with their folder on the path and their output redirected, which threads cannot do at once."""


def entry_of(source: Source, settings: Mapping[str, str], choices: Choices, derived: Callable[[], str]) -> Entry:
    """What the cache holds for a problem; where it holds nothing, what is `derived` now, and kept from then on.

    Raises FileError where a text cannot be kept, and what `derived` raises.
    """
    path = path_of(source, settings, choices)
    text = kept_text(path)
    if text:
        return Entry(path, text, is_new=False)
    with _DERIVING:
        path = path_of(source, settings, choices)  # another thread may have derived it meanwhile
        text = kept_text(path)
        if text:
            return Entry(path, text, is_new=False)
        text = derived()
        return Entry(_keep(source, settings, choices, text), text, is_new=True)


def _keep(source: Source, settings: Mapping[str, str], choices: Choices, text: str) -> Path:
    """Write a text into the cache, and say where."""
    try:
        path = path_of_text(source, settings, choices, text)
        rendering.write(path, text)
        return path
    except FileError as error:
        raise FileError(error.finding, "make room there, or let CODEGEN_CACHE_DIR name another folder") from error


def stored(problem: Source | Path | str, arguments: Mapping[str, str], *, scheme: str | None = None) -> Path:
    """Where the cache keeps the module of a problem once it has been built."""
    return path_of(problem, arguments, chosen(scheme))


def cache_folder() -> Path:
    """The build cache: $CODEGEN_CACHE_DIR, or a folder in the user's cache directory."""
    given = os.environ.get("CODEGEN_CACHE_DIR")
    if given:
        return Path(given)
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "variational-codegen"


def path_of(problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices) -> Path:
    """Where the cache keeps the module of a problem with these arguments and choices, if it has been built.

    What further files the problem reads is known from the last build; what they hold now is part of the place.
    """
    source = source_of(problem)
    digest = input_digest(source, arguments, *choice_texts(choices), *versions(), _own_digest())
    name = f"{module_name(source, arguments, choices)}.py"
    return _with_files(digest, name, [(read, digest_of(source.folder / read)) for read in _files_read(digest, name)])


def path_of_text(problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, text: str) -> Path:
    """Where the cache is to keep a text that was just derived; what files it was made from is noted there."""
    digest = input_digest(problem, arguments, *choice_texts(choices), *versions(), _own_digest())
    name = f"{module_name(problem, arguments, choices)}.py"
    files = _READ.findall(text.partition('"""')[0])
    if files or _files_read(digest, name):
        rendering.write(_note(digest, name), json.dumps([read for read, _ in files]) + "\n")
    return _with_files(digest, name, files)


_READ = re.compile(r"^# Reads (.+), sha256 ([0-9a-f]{64})$", re.MULTILINE)
"""A line in the header of a module that tells of a further file that it was made from."""


def _with_files(digest: str, name: str, files: Iterable[tuple[str, str]]) -> Path:
    """The place that belongs to a digest and to what further files hold."""
    parts = [part for pair in files for part in pair]
    if parts:
        digest = hashlib.sha256("\0".join([digest, *parts]).encode()).hexdigest()
    return cache_folder() / digest[:20] / name


def _note(digest: str, name: str) -> Path:
    return cache_folder() / digest[:20] / f"{name}.reads.json"


def _files_read(digest: str, name: str) -> list[str]:
    """The files that the last build of a problem has read beside the problem file."""
    try:
        return [str(file) for file in json.loads(_note(digest, name).read_text(encoding="utf-8"))]
    except (OSError, UnicodeDecodeError, ValueError, TypeError):  # without a note it is derived, and noted anew
        return []


def kept_text(store: Path) -> str:
    """What the cache holds; nothing where it holds nothing, or what is not whole."""
    try:
        text = store.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
    return text if rendering.is_whole(text) else ""


GENERATORS = (
    "symbolic",
    "problem",
    "discretise",
    "emit",
    "runtime",
    "drawing.py",
    "identifiers.py",
    "solving/compiler.py",
)
"""The parts of this package on which generated texts depend."""


@cache
def _own_digest() -> str:
    """Hash of the sources that generate, so that a changed generator never serves what an older one made."""
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for file in sorted([*folder.rglob("*.py"), *folder.rglob("*.j2")]):
        name = file.relative_to(folder).as_posix()
        if name in GENERATORS or name.split("/")[0] in GENERATORS:
            digest.update(name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


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

    entry = entry_of(source, settings, choices, derived)
    if standalone:
        from codegen.emit.standalone import bundle

        entry = entry_of(source, settings, replace(choices, standalone=True), partial(bundle, entry.text))
    path, written = (entry.as_found(), entry.is_new) if out is None else entry.written_to(Path(out))
    return Build(path, entry.path.stem, time.perf_counter() - begin, not entry.is_new, written)


def generate(
    problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, time_limit: float = BUILD
) -> str:
    """The text of the module of a problem, derived anew within so many seconds of processor time."""
    stages = Stages(time_limit)
    with rare_collections(), stages.limited():
        from codegen.discretise.model.from_file import load_problem

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
