"""Compile the machine code of a generated module in two processes.

numba compiles one function after the other. `python -m codegen.solving.machine_code.compilation` is started by
`processes`. It loads numba during the derivation of the module, and reads the path of the module from its standard
input. A process that can fork becomes two then, so that numba is loaded once; each takes the next free part.
Elsewhere two processes are started, and each takes every other part. numba's cache on disk joins their work.

In these processes functions that only compiled functions call are not made machine code of, see `runtime.linking`.
"""

from __future__ import annotations

import gc
import io
import math
import os
import sys
from collections.abc import Iterable
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np
from numba import carray, cfunc, config, float64, int64, njit, types

from codegen.runtime.kept_code import add_checksums, code_folder, runtime_folders
from codegen.runtime.kernels import packed_operations
from codegen.solving.loading import load
from codegen.solving.machine_code.parts import Part, parts_of
from codegen.solving.machine_code.processes import COUNT, DONE
from codegen.solving.tasks import task_of


def compile_all(module: Any) -> None:
    """Compile all that a solution calls, or read it where it has been compiled, and solve a small problem."""
    with np.errstate(all="ignore"), packed_operations():
        for part in parts_of(module):
            part.make()
            protect(part)
    task_of(module).small(module)


def main(share: str) -> int:
    """Get numba ready, wait for the path of a module, compile a share of its parts; return the exit status.

    The share is "both" of a process that becomes two, or as "0/2" for the first of two.
    """
    gc.disable()  # what compilation leaves behind is little, and looking for it takes time
    is_compiling = not config.DISABLE_JIT  # type: ignore[attr-defined]
    if is_compiling:
        warm_up()
    path = os.fsdecode(sys.stdin.buffer.read())
    if not (path and is_compiling):
        return 0
    with redirect_stderr(io.StringIO()) as said:  # of damaged machine code
        module = load(Path(path))
    os.write(sys.stdout.fileno(), said.getvalue().encode())
    parts = [part for part in parts_of(module) if part.serves == "problem" or not part.is_kept]
    link_runtime()
    if share == "both":
        return compile_in_two(parts)
    number, count = map(int, share.split("/"))
    compile_parts(parts[number::count], len(parts))
    return 0


def warm_up() -> None:
    """Compile a little of what loops and kernels consist of: the first compilation takes long, whatever it compiles."""
    import codegen.runtime.search.solution  # noqa: F401  what modules import

    assert cfunc(float64(types.CPointer(float64), int64))(_loop).address


_PLACES = np.array([0, 1])


def _loop(values: Any, count: Any) -> Any:
    """Go through intervals as loops of modules do."""
    array, part, total = carray(values, (count,)), np.zeros(2), 0.0
    for k in range(count):
        part[:] = 0.0
        total += _kernel(array[k : k + 2], (array[k + 1] - array[k]) * 2.0, part)
        _add(part, k, 2, array)
        for i in _PLACES:
            array[i] = 0.0
    return total


@njit(error_model="numpy")
def _kernel(values: Any, t: Any, part: Any) -> Any:
    """Fill an array as kernels of modules do."""
    x = 0.5 * values[0] ** 2 + math.sin(t) / values[1]
    part[0] = 2 * x / math.sqrt(t) - x**3
    return -x


@njit(error_model="numpy", inline="always")
def _add(part: Any, first: Any, size: Any, array: Any) -> None:
    """Add a part to an array."""
    for i in range(size):
        array[first + i] += part[i]


def link_runtime() -> None:
    """Have inner functions of the runtime become parts of their callers, in this process from now on."""
    from codegen.runtime.linking import compile_for_any_value, link_inner_functions

    runtime = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("codegen.runtime.")]
    functions = {id(value): value for space in runtime for value in space.values() if hasattr(value, "py_func")}
    is_kept = {key: function.stats.cache_path is not None for key, function in functions.items()}
    link_inner_functions(function for key, function in functions.items() if not is_kept[key])
    compile_for_any_value(function for key, function in functions.items() if is_kept[key])


def compile_in_two(parts: list[Part]) -> int:
    """Compile parts in this process and in a copy of it, each taking the next one that is left; the exit status."""
    left, numbers = os.pipe()
    os.write(numbers, bytes(range(len(parts))))
    os.close(numbers)
    other = os.fork() if len(parts) > 1 else None
    status = 1
    try:
        compile_parts((parts[number[0]] for number in iter(lambda: os.read(left, 1), b"")), len(parts))
        status = 0
    except Exception as error:
        status = failed(error)
    finally:
        if other == 0:
            os._exit(status)
    if status or other is None:
        return status
    return os.waitstatus_to_exitcode(os.waitpid(other, 0)[1])


def compile_parts(parts: Iterable[Part], count: int) -> None:
    """Compile parts, and tell the process that waits of each."""
    os.write(sys.stdout.fileno(), f"{COUNT}{count}\n".encode())
    with np.errstate(all="ignore"), packed_operations():
        for part in parts:
            part.make()
            protect(part)
            os.write(sys.stdout.fileno(), f"{DONE}\n".encode())


def protect(part: Part) -> None:
    """Add checksums to the machine code of the folders that a part may have added to."""
    folders = [] if part.serves == "problem" else [code_folder(part.function.__code__.co_filename)]
    for folder in {*folders, *(runtime_folders() if part.serves == "runtime" else [])}:
        add_checksums(folder)


def failed(error: Exception) -> int:
    """Tell the process that waits, in one line, by which error this one fails; return the exit status."""
    os.write(sys.stdout.fileno(), f"{' '.join(f'{type(error).__name__}: {error}'.split())[:300]}\n".encode())
    return 1


if __name__ == "__main__":
    try:
        status = main(sys.argv[1])
    except Exception as error:  # the process that waits says what has become of it
        status = failed(error)
    os._exit(status)  # at once: to take everything down that numba and LLVM have built takes half a second
