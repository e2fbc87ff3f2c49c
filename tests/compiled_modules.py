"""Generated modules with machine code, for tests that solve at size, and machine code that all tests share."""

import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import pytest
from served_builds import Served

from codegen.runtime.kept_code import code_folder
from codegen.runtime.kkt import specialised
from codegen.solving.compiler import cache_folder
from codegen.solving.loading import GeneratedModule, load
from codegen.solving.machine_code import compilation, processes
from codegen.solving.machine_code.compilation import has_machine_code


def compiled(path: Path) -> GeneratedModule:
    """A module with machine code of all that `solve` calls, made as `codegen build` makes it, which is quicker.

    Of several processes that want the same one, the first compiles it, and the others wait.
    """
    module = load(path)
    cache_folder().mkdir(parents=True, exist_ok=True)
    with (cache_folder() / f"{path.stem}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not has_machine_code(module):
            command = [sys.executable, "-m", "codegen.solving.machine_code.compilation", "0/1"]
            subprocess.run(command, input=os.fsencode(path.absolute()), check=True, capture_output=True)
    return module


SEARCH = """
from types import SimpleNamespace
from codegen.runtime.search import solution
from codegen.solving.machine_code.compilation import link_runtime, search_functions
functions = list(search_functions(SimpleNamespace(variable_bounds=(), data=())))
link_runtime()
for function, signature in functions:
    function.compile(signature)
"""
SYSTEM = """
from codegen.runtime.kkt.specialised import compiled_any_shape
from codegen.runtime.search import solution
from codegen.solving.machine_code.compilation import link_runtime
link_runtime()
compiled_any_shape()
"""
compiled_any_shape = specialised.compiled_any_shape


@lru_cache(maxsize=1)
def compiled_once():
    """The linear system of interpreted problems; it and the search are compiled by the first process that wants it.

    Compiled as builds do it, in processes that link functions into their callers, this takes a third of the time.
    """
    kept = code_folder(specialised.__file__)
    if kept is None:  # numba is switched off
        return compiled_any_shape()
    cache_folder().mkdir(parents=True, exist_ok=True)
    with (cache_folder() / "search.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not any(Path(kept).glob("specialised.compiled_any_shape.*.nbc")):
            commands = [[sys.executable, "-c", program] for program in (SYSTEM, SEARCH)]
            processes = [subprocess.Popen(command, cwd=Path(__file__).parent.parent) for command in commands]
            assert [process.wait() for process in processes] == [0, 0]
    return compiled_any_shape()


specialised.compiled_any_shape = compiled_once


@contextmanager
def quick_builds() -> Iterator[None]:
    """Let builds compile nothing but kernels, in processes that need not load numba.

    Compiled problems of every shape use one linear system, whose numbers of unknowns are no constants. That of a new
    shape takes nine seconds of processor time, and the kernels of a small problem take one.
    """
    parts_of = compilation.parts_of

    def start(compilers: processes.Compilers) -> None:
        compilers.processes = compilers.processes or [Served()]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("codegen.runtime.search.problem.system_address", lambda shape: specialised.any_shape_address())
        patch.setattr(compilation, "parts_of", lambda m: [part for part in parts_of(m) if part.serves != "shape"])
        patch.setattr(processes.Compilers, "start", start)
        yield
