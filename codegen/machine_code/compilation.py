"""Compile the machine code of a generated module in two processes at once.

numba compiles one function after the other. The KKT factorisation of a control problem, or the loop over the steps of
a simulation, takes about half of that time, so one process compiles it, and another one everything else; numba's cache
on disk brings their work together. `python -m codegen.machine_code.compilation SHARE`, which `processes` starts, loads
numba while the module is still being derived, and reads the path of the module from its standard input. Where a process
can fork, it becomes the two only then, so that numba is loaded once; elsewhere two are started.

What they leave out are the entries by which Python and C would call functions that only compiled functions call, and
machine code of those functions beside that of their callers (see `linking`).
"""

from __future__ import annotations

import gc
import inspect
import io
import os
import sys
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np
from numba import typeof

from codegen.interfaces import GeneratedModule, few_steps, is_of_particles
from codegen.loading import load
from codegen.machine_code.processes import UNFINISHED
from codegen.runtime.packing import packed_operations
from codegen.tasks import task_of


def compile_all(module: Any) -> None:
    """Call all that a solution calls, so that it is compiled, or read where it has been."""
    task = task_of(module)
    with np.errstate(all="ignore"), packed_operations():
        for call in task.parts(module):
            call()
        task.small(module)


LONG = 1000
"""Bytes of bytecode from which on a function is worth optimising and keeping by itself.

At 3000 LLVM takes some functions into their callers that it had better shortened first: a factorisation of the orbital
transfer then takes 28 microseconds and one of the cart pendulum 7.5, and 21 and 6 at 1000; builds take as long.
"""


def compile_for_callers(module: GeneratedModule) -> None:
    """Have functions that only compiled functions call compiled as parts of these, in this process from now on.

    Long ones are kept by themselves as well, so that the process that needs one later finds it.
    """
    from codegen.machine_code import linking

    functions = _compiled_functions(module)
    inner = [function for function in functions if function.stats.cache_path is None]
    long = [function for function in inner if len(function.py_func.__code__.co_code) > LONG]
    if linking.applies(functions):
        linking.link_inner_functions(functions, [function.py_func.__name__ for function in long])
    for function in long:
        function.enable_caching()


def _compiled_functions(module: GeneratedModule) -> list[Any]:
    return [value for value in vars(module).values() if hasattr(value, "py_func")]


def main(share: str) -> int:
    """Get numba ready, wait for the path of a module, compile a share of it; the exit status."""
    from numba import njit

    gc.disable()  # what compilation leaves behind is little, and looking for it takes time
    njit(lambda x: x)(0.0)  # the first compilation takes long, whatever it compiles
    path = os.fsdecode(sys.stdin.buffer.read())
    if not path:
        return 0
    with redirect_stderr(io.StringIO()) as said:  # of damaged machine code
        module = load(Path(path))
    os.write(sys.stdout.fileno(), said.getvalue().encode())
    if not _compiled_functions(module):  # numba is switched off, by NUMBA_DISABLE_JIT
        return 0
    if not is_of_particles(module):
        compile_for_callers(module)
    if share == "both":
        return compile_in_two(module)
    return compile_share(module, share)


def compile_in_two(module: Any) -> int:
    """Compile a module in this process and in a copy of it, each taking the next part that is left; the exit status."""
    first, *others = task_of(module).parts(module)
    calls = [first, lambda: compile_substitution(module), *others]
    left, numbers = os.pipe()
    os.write(numbers, bytes(range(len(calls))))
    os.close(numbers)
    other = os.fork()
    status = 1
    try:
        with np.errstate(all="ignore"), packed_operations():
            while number := os.read(left, 1):
                calls[number[0]]()
        status = 0
    except Exception as error:
        status = failed(error)
    finally:
        if not other:
            os._exit(status)
    if status:
        return status
    return os.waitstatus_to_exitcode(os.waitpid(other, 0)[1]) or status_of(module)


def compile_substitution(module: Any) -> None:
    """Compile what a linear system calls last, if it is kept by itself, while another process compiles the rest of it.

    The linear system is the longest part by far, and that process finds the substitution when it gets there.
    """
    if not hasattr(module, "substitute") or module.substitute.stats.cache_path is None:
        return
    grid = module.make_grid(few_steps(module, 2))
    factors, _ = module.allocate_system(grid)
    vector = np.zeros(grid.is_multiplier.size)
    names = list(inspect.signature(module.solve_system.py_func).parameters)[-len(factors) - 1 :]
    values = {**dict(zip(names, [*factors, vector], strict=True)), "gradient": vector, "carried": True}
    values["steps"] = grid.steps
    wanted = inspect.signature(module.substitute.py_func).parameters
    module.substitute.compile(tuple(typeof(values[name]) for name in wanted))  # type: ignore[no-untyped-call]


def compile_share(module: Any, share: str) -> int:
    """Compile a share of a module; the exit status."""
    shares = {"the_longest": slice(1), "all_but_the_longest": slice(1, None)}
    with np.errstate(all="ignore"), packed_operations():
        for call in task_of(module).parts(module)[shares.get(share, slice(None))]:
            call()
    return status_of(module)


def failed(error: Exception) -> int:
    """Tell the process that waits, in one line, by which error this one fails; the exit status."""
    os.write(sys.stdout.fileno(), f"{' '.join(f'{type(error).__name__}: {error}'.split())[:300]}\n".encode())
    return 1


def status_of(module: Any) -> int:
    """The exit status of a process that has compiled its share of a module."""
    return 0 if task_of(module).is_whole else UNFINISHED


if __name__ == "__main__":
    try:
        status = main(sys.argv[1])
    except Exception as error:  # the process that waits says what has become of it
        status = failed(error)
    os._exit(status)  # at once: to take everything down that numba and LLVM have built takes half a second
