"""The build of a module: problem file -> model -> program -> derivatives -> strings -> text.

    problem          discretise                        emit
    Problem  --->    Model --->   Program   --->       derivatives --->   Module  --->   text of one .py

`generate_from_model` runs these stages. Before the text is written, `verify` compares its derivatives with an
independent differentiation of the program. `build` runs the stages, or reads the text from the cache. The key of the
cache is a digest of all inputs of the text. A cache hit does not import sympy.
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
"""The subfolder of the current folder in which users keep modules that they want to read."""
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
"""The folders and files of this package on which the texts of generated modules depend."""
_READ = re.compile(r"^# Reads (.+), sha256 ([0-9a-f]{64})$", re.MULTILINE)
"""Pattern of a line in the header of a module that names a file which was read during the derivation."""
_DERIVING = threading.Lock()
"""Lock of the derivation: only one thread may run a problem file, because sys.path and the output are changed."""


@dataclass(frozen=True)
class Build:
    """A generated module on disk.

    Attributes
    ----------
    path : Path
        File of the module.
    name : str
        Name of the module.
    seconds : float
        Duration of the build.
    cached : bool
        True for a cache hit.
    written : bool
        True if the file is new or has changed.
    """

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
    """Derive, emit and write the module of a problem.

    Parameters
    ----------
    problem : path or object
        A problem file, or a Control, Simulate, Phases or Connect.
    arguments : dict
        Arguments of problem() in a problem file, as values or as the texts that `--set` takes.
    scheme, method : str
        Discretisation; by default the scheme and method for the task.
    controls : {"interval", "linear", "stages", "nodal"}
        Constant on intervals, linear between nodes, with a value at each stage, or averages of values at nodes.
    general : bool
        Write all terms of the equations, including terms that vanish for this problem.
    sensitivities : bool
        Include the code for derivatives of solutions with respect to parameters and boundary values.
    standalone : bool
        Write one file with all numerics, which needs numpy and numba but not this package.
    out : path
        Folder for the module. By default the module stays in the cache of the user. If ./generated has a file with the
        same text, that file and its machine code are used.
    time_limit : float
        Processor time in seconds. A longer derivation raises SizeError, which names the stage and the large quantity.
    deriving : callable
        Called without arguments when a derivation begins; it is not called for a cache hit.

    Returns
    -------
    Build
        The file of the module, and information on the build.

    Raises
    ------
    CodegenError
        If the problem or a choice is unusable; no file is written.
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

    path, text, is_new = _cached(source, settings, choices, derived)
    if standalone:
        from codegen.emit.standalone import bundle

        path, text, is_new = _cached(source, settings, replace(choices, standalone=True), partial(bundle, text))
    name, written = path.stem, is_new
    if out is not None:
        path = Path(out) / path.name
        written = rendering.write(path, text)
        with suppress(OSError):  # no permission for the folder: Python cannot write bytecode there either
            # On a full disk, Python before 3.13 writes incomplete bytecode, and every later import of the module fails.
            file = Path(cache_from_source(path))
            header = 16  # number of bytes before the code
            try:
                marshal.loads(file.read_bytes()[header:])
            except (EOFError, ValueError, TypeError):
                file.unlink(missing_ok=True)
            except FileNotFoundError:
                pass
    elif (kept := GENERATED / path.name).is_file() and kept.read_bytes() == text.encode():
        path = kept
    return Build(path, name, time.perf_counter() - begin, not is_new, written)


def generate(
    problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, time_limit: float = BUILD
) -> str:
    """Return the text of the module of a problem.

    Raise SizeError if the derivation takes more than `time_limit` seconds of processor time.
    """
    stages = Stages(time_limit)
    with rare_collections(), stages.limited():
        from codegen.discretise.model.from_problem import load_problem

        with recorded_files() as files:
            model = load_problem(problem, arguments)
        return generate_from_model(model, choices, origin_of(problem, arguments, choices, files), stages)


def generate_from_model(
    model: Model | PairwiseModel, choices: Choices, origin: Origin, stages: Stages | None = None
) -> str:
    """Return the text of a module that is derived from a validated problem.

    `origin` describes the problem in the header of the module. `stages` limits the time, and records the present stage.
    """
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


# The cache


def _cached(
    source: Source, settings: Mapping[str, str], choices: Choices, derived: Callable[[], str]
) -> tuple[Path, str, bool]:
    """Return the file and the text of a module in the cache, and True if the module is new.

    If the cache has no module for the problem, the function `derived` returns its text. Raise FileError if the text
    cannot be stored.
    """
    path = path_of(source, settings, choices)
    if text := kept_text(path):
        return path, text, False
    with _DERIVING:
        path = path_of(source, settings, choices)  # another thread may have derived the text meanwhile
        if text := kept_text(path):
            return path, text, False
        text = derived()
        try:
            path = path_of_text(source, settings, choices, text)
            rendering.write(path, text)
        except FileError as error:
            raise FileError(error.finding, "make room there, or let CODEGEN_CACHE_DIR name another folder") from error
        return path, text, True


def stored(problem: Source | Path | str, arguments: Mapping[str, str], *, scheme: str | None = None) -> Path:
    """Return the file in the cache for the module of a problem; the file need not exist."""
    return path_of(problem, arguments, chosen(scheme))


def cache_folder() -> Path:
    """Return the folder of the cache: $CODEGEN_CACHE_DIR, or a folder in the cache directory of the user."""
    folder = os.environ.get("CODEGEN_CACHE_DIR")
    if folder:
        return Path(folder)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "variational-codegen"


def workers_folder() -> Path:
    """Return the cache folder that all worker processes of this machine share."""
    return cache_folder() / "workers"


def path_of(problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices) -> Path:
    """Return the file in the cache for a problem with arguments and choices; the file need not exist.

    The last build has recorded which further files the problem reads, such as tables. Their present contents are part
    of the key of the cache.
    """
    source = source_of(problem)
    digest = input_digest(source, arguments, *choice_texts(choices), *versions(), _generator_digest())
    name = f"{module_name(source, arguments, choices)}.py"
    return _with_files(digest, name, [(read, digest_of(source.folder / read)) for read in _files_read(digest, name)])


def path_of_text(problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, text: str) -> Path:
    """Return the file in the cache for a new text, and record which further files the derivation has read."""
    digest = input_digest(problem, arguments, *choice_texts(choices), *versions(), _generator_digest())
    name = f"{module_name(problem, arguments, choices)}.py"
    files = _READ.findall(text.partition('"""')[0])
    if files or _files_read(digest, name):
        rendering.write(_record_of_reads(digest, name), json.dumps([read for read, _ in files]) + "\n")
    return _with_files(digest, name, files)


def _with_files(digest: str, name: str, files: Iterable[tuple[str, str]]) -> Path:
    """Return the file in the cache for a digest of the inputs and for pairs (name, digest) of further `files`."""
    parts = [part for pair in files for part in pair]
    if parts:
        digest = hashlib.sha256("\0".join([digest, *parts]).encode()).hexdigest()
    return cache_folder() / digest[:20] / name


def _record_of_reads(digest: str, name: str) -> Path:
    return cache_folder() / digest[:20] / f"{name}.reads.json"


def _files_read(digest: str, name: str) -> list[str]:
    """Return the names of further files that the last build has read; an empty list if no record is readable."""
    try:
        return [str(file) for file in json.loads(_record_of_reads(digest, name).read_text(encoding="utf-8"))]
    except (OSError, UnicodeDecodeError, ValueError, TypeError):
        return []


def kept_text(store: Path) -> str:
    """Return the text of a file in the cache; empty if the file is missing or incomplete."""
    try:
        text = store.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
    return text if rendering.is_whole(text) else ""


@cache
def _generator_digest() -> str:
    """Return a digest of the source files in GENERATORS, so that a change of these files invalidates the cache."""
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    for file in sorted([*folder.rglob("*.py"), *folder.rglob("*.j2")]):
        name = file.relative_to(folder).as_posix()
        if name in GENERATORS or name.split("/")[0] in GENERATORS:
            digest.update(name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()
