"""Generated modules with machine code, for tests that solve at size, and machine code that all tests share."""

import fcntl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pytest
from numba import config
from served_builds import ONE_SYSTEM, Served, numba_settings

from codegen.runtime.kkt.specialised import compiled_system, is_made
from codegen.runtime.search import problem
from codegen.solving.compiler import cache_folder
from codegen.solving.loading import GeneratedModule, load
from codegen.solving.machine_code import processes
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
            with processes.compilers() as made:
                assert made.compile(path), made.failure
    return module


SETTINGS = numba_settings()

SEARCH = """
from types import SimpleNamespace
from codegen.runtime.search import solution
from codegen.solving.machine_code.compilation import link_runtime, search_functions
functions = list(search_functions(SimpleNamespace(variable_bounds=(), data=())))
link_runtime()
for function, signature in functions:
    function.compile(signature)
"""


@cache
def compiled_once(shape):
    """A linear system. The first process that wants that of all shapes compiles the search as well, as builds do."""
    if not config.DISABLE_JIT and shape is None and not is_made(None):
        cache_folder().mkdir(parents=True, exist_ok=True)
        with (cache_folder() / "search.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not is_made(None):
                search = subprocess.Popen([sys.executable, "-c", SEARCH], cwd=Path(__file__).parent.parent)
                compiled_system(None)
                assert search.wait() == 0
    return compiled_system(shape)


problem.compiled_system = compiled_once


@contextmanager
def served_builds() -> Iterator[None]:
    """Let builds compile in processes that need not load numba, see `served_builds.py`."""
    ordinary = processes.Compilers.start

    def start(compilers: processes.Compilers) -> None:
        if numba_settings() == SETTINGS:
            compilers.processes = compilers.processes or [Served()]
        ordinary(compilers)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes.Compilers, "start", start)
        yield


@contextmanager
def one_system() -> Iterator[None]:
    """Let compiled problems of every shape use one linear system, whose numbers of unknowns are no constants.

    That of a new shape takes two seconds of processor time, and the kernels of a small problem take one.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problem, "compiled_system", lambda shape: compiled_once(None))
        patch.setenv(ONE_SYSTEM, "1")
        yield
