"""Machine code of modules that have none yet, made by processes that are quick at it before anything is called."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.machine_code.processes import Compilers, compilers

if TYPE_CHECKING:
    from codegen.errors import FileError
    from codegen.interfaces import GeneratedModule

_COMPILING: dict[Path, threading.Lock] = {}
"""Threads that want the same module wait for the first of them, and find what it has made."""


def require(
    path: Path, module: GeneratedModule, is_new: bool, working: Callable[[str], AbstractContextManager[Any]]
) -> tuple[float, list[str]]:
    """Have a module compiled that has no machine code; return the seconds, and what there is to say about it."""
    from codegen.loading import has_machine_code

    with _COMPILING.setdefault(path.resolve(), threading.Lock()):
        if not is_new and has_machine_code(path, module):
            return 0.0, []
        with working("Compiling"), compilers() as processes:
            return prepare(path, processes), processes.said


def prepare(path: Path, processes: Compilers) -> float:
    """Have all that `newton` needs of a module compiled, so that processes find machine code; return the seconds."""
    begin = time.perf_counter()
    if not processes.compile(path):
        _compile_here(path)
    return time.perf_counter() - begin


def _compile_here(path: Path) -> None:
    """Have all that `newton` needs of a module compiled in this process."""
    from codegen.loading import load  # only now: importing arrays takes a fifteenth of a build
    from codegen.machine_code.compilation import compile_all

    module = load(path)
    try:
        compile_all(module)  # which tells what is wrong, or compiles what is missing
    except OSError as error:
        raise unwritable_cache_error(module, error) from error


def unwritable_cache_error(module: GeneratedModule, error: OSError) -> FileError:
    """The error that says where machine code of a module cannot be written, and what to do about it."""
    from codegen.files import refused
    from codegen.loading import code_folders

    folder = ", ".join(sorted(code_folders(module))) or "the folder of machine code"
    return refused(error, folder, "make room there, or let NUMBA_CACHE_DIR name a folder that may be written to")
