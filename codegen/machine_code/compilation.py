"""Compile the machine code of a generated module in two processes at once.

numba compiles one function after the other. The KKT factorisation of a control problem, or the loop over the steps of
a simulation, takes about half of that time, so one process compiles it, and another one everything else; numba's cache
on disk brings their work together. `python -m codegen.machine_code.compilation SHARE`, which `processes` starts, loads
numba while the module is still being derived, and reads the path of the module from its standard input. Where a process
can fork, it becomes the two only then, so that numba is loaded once; elsewhere two are started.

They let LLVM pack neighbouring operations into one instruction, which numba leaves out by default. Without it the
factorisation takes 1.25 (orbital transfer), 1.4 (quadrotor) and 1.5 times (hovercraft) as long. What they leave out are
the entries by which Python and C would call functions that only compiled functions call, and machine code of those
functions beside that of their callers (see `linking`).
"""

from __future__ import annotations

import gc
import io
import os
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np

from codegen.loading import GeneratedModule, load
from codegen.machine_code.processes import UNFINISHED


@contextmanager
def packed_operations() -> Iterator[None]:
    """Let LLVM pack operations while the block runs."""
    from numba import config

    name = "SLP_VECTORIZE"
    before = getattr(config, name)
    setattr(config, name, 1)
    try:
        yield
    finally:
        setattr(config, name, before)


def parts(module: Any) -> list[Callable[[], Any]]:
    """Calls that compile, together, what a solution calls; those that take longest come first.

    What comes later may use what an earlier one has compiled and kept on the disk.
    """
    if module.metadata["task"] == "connect":
        return _connect_parts(module)
    if is_simulation_of_particles(module):
        return [lambda: module.solve(2)]
    grid = module.make_grid(2)
    if module.metadata["task"] == "simulate":
        path = np.vstack([grid.start, grid.start])
        stored = np.empty((3, grid.start.size))
        return [
            lambda: module.follow(grid.start, 2, grid.h, grid.parameters, 1, 1e-13, 50, stored, stored),
            lambda: module.path_residual(grid, path),
            lambda: module.energies(path, np.zeros(2), grid.parameters, np.empty(2)),
        ]
    unknowns, system = module.initial_guess(grid), module.allocate_system(grid)
    step, zeros = np.zeros_like(unknowns), np.zeros_like(unknowns)
    calls = [
        lambda: module.factor_kkt(grid, unknowns, 1.0, np.zeros_like(unknowns), system),
        lambda: module.solve_kkt(grid, module.allocate_system(grid), zeros, step),  # its factors are zeros
        lambda: module.evaluate(grid, unknowns),
    ]
    if hasattr(module, "fill_sizes"):
        calls.append(lambda: module.scaled_grid(grid, unknowns))
    if hasattr(module, "finite_bounds"):
        calls += _interior_point_parts(module, grid, unknowns, zeros)
    elif hasattr(module, "slope_of"):  # a linear-quadratic problem has none
        calls.append(lambda: module.slope_of(unknowns, zeros, zeros, grid.is_multiplier))
    return [
        *calls,
        lambda: module.unpack(grid, unknowns),
        lambda: module.sizes_of_terms(grid, unknowns),
    ]


def _interior_point_parts(module: Any, grid: Any, unknowns: Any, step: Any) -> list[Callable[[], Any]]:
    """Calls of what only the interior point method calls."""
    bounds = module.finite_bounds(*module.variable_bounds(grid))
    distance, gradient = np.ones(bounds[0].size), np.ones_like(unknowns)
    duals, result = np.ones(distance.size), np.empty(distance.size)
    places = bounds.place, bounds.side, distance
    barrier = grid.is_multiplier, *places, duals, 1.0
    return [
        lambda: module.measure_optimality(gradient, unknowns, grid.is_multiplier, *places, duals),
        lambda: module.measure_step(unknowns, gradient, step, *barrier, 0.99, result),
        lambda: module.add_barrier(gradient, *barrier, 0.0, 0.0, np.empty_like(step), np.empty_like(step)),
        lambda: module.move_duals(duals, duals, 1.0, distance, 1.0, result),
        lambda: module.move(unknowns, step, 0.0, *places, np.empty_like(step), result),
    ]


def _connect_parts(module: Any) -> list[Callable[[], Any]]:
    """Calls for a module that connects points."""
    case = small_case(module)
    points = np.zeros((2 * module.POINTS, 2, *case.start.shape))
    points[:, 0] = case.start
    return [
        lambda: module.Linearised(case, points, None).matrix(),
        lambda: module.path_cost(case, module.guessed_path(case.start, case.target, 2, 1.0, case.own, case.parameters)),
    ]


def is_simulation_of_particles(module: Any) -> bool:
    """Whether a module follows particles, whose functions for pairs are called from Python as well."""
    return bool(module.metadata["task"] == "simulate" and "separable" in module.metadata)


def small_case(module: Any, steps: int = 2) -> Any:
    """Thirteen particles near the origin that move a little, to have functions compiled by."""
    dimension = module.metadata["coordinates"]
    angles = np.linspace(0.0, 2.0 * np.pi, 13, endpoint=False)
    start = np.stack([0.1 * np.cos((axis + 1) * angles + axis) for axis in range(len(dimension))], axis=1)
    start[:, 0] += 0.01 * np.arange(13)
    return module.make_case(start, start + 0.001, steps)


def solve_small(module: Any) -> None:
    """Solve for few particles, so that everything is compiled that a solution calls."""
    module.solve_case(small_case(module))


def compile_all(module: Any) -> None:
    """Call all that a solution calls."""
    with np.errstate(all="ignore"):
        for call in parts(module):
            call()


SELDOM = ("term_sizes", "interval_momenta")
"""Functions that a solution calls once or twice."""
LONG = 3000
"""Bytes of bytecode from which on a function is worth keeping by itself."""


def compile_for_callers(module: GeneratedModule) -> None:
    """Have functions that only compiled functions call compiled as parts of these, in this process from now on."""
    from codegen.machine_code.linking import (
        forget_constants,
        leave_unpacked,
        link_inner_functions,
        optimise_by_themselves,
    )
    from codegen.machine_code.straight_lines import write_directly

    link_inner_functions()
    write_directly(_compiled_functions(module), Path(vars(module)["__file__"]))
    leave_out_entries(module)
    optimise_by_themselves(share_long_functions(module))
    leave_unpacked(SELDOM)
    for function in _compiled_functions(module):
        forget_constants(function)


def leave_out_entries(module: GeneratedModule) -> None:
    """Have functions compiled without the entries by which Python and C call them, where only compiled functions do.

    In this process, Python must not call them any more.
    """
    for function in _compiled_functions(module):
        function.targetoptions["no_cfunc_wrapper"] = True
        if function.stats.cache_path is None:  # not kept by itself, but as part of what calls it
            function.targetoptions["no_cpython_wrapper"] = True


def share_long_functions(module: GeneratedModule) -> list[str]:
    """Keep long functions by themselves as well, so that the process that needs one later finds it; their names."""
    functions = [f for f in _compiled_functions(module) if f.stats.cache_path is None]
    long = [function for function in functions if len(function.py_func.__code__.co_code) > LONG]
    for function in long:
        function.enable_caching()
    return [function.py_func.__name__ for function in long]


def _compiled_functions(module: GeneratedModule) -> list[Any]:
    return [value for value in vars(module).values() if hasattr(value, "targetoptions")]


def main(share: str) -> int:
    """Get numba ready, wait for the path of a module, compile a share of it; the exit status."""
    from numba import njit

    from codegen.machine_code.ahead import compile_ahead, take_over
    from codegen.machine_code.linking import link_inner_functions
    from codegen.machine_code.shortcuts import blas_presumed

    gc.disable()  # what compilation leaves behind is little, and looking for it takes time
    with blas_presumed():
        njit(_nothing)(0.0)  # the first compilation takes long, whatever it compiles
    undo = link_inner_functions()
    if share == "both":
        compile_ahead(lambda: bool(select.select([sys.stdin], [], [], 0.0)[0]))
    path = os.fsdecode(sys.stdin.buffer.read())
    if not path:
        return 0
    with redirect_stderr(io.StringIO()) as said:  # of damaged machine code
        module = load(Path(path))
    os.write(sys.stdout.fileno(), said.getvalue().encode())
    undo()
    if module.metadata["task"] != "connect" and not is_simulation_of_particles(module):
        compile_for_callers(module)
        take_over(_compiled_functions(module))
    if share == "both":
        return compile_in_two(module)
    return compile_share(module, share)


def compile_in_two(module: Any) -> int:
    """Compile a module in this process and in a copy of it, each taking the next part that is left; the exit status."""
    from codegen.machine_code.shortcuts import quick_numba

    calls = parts(module)
    left, numbers = os.pipe()
    os.write(numbers, bytes(range(len(calls))))
    os.close(numbers)
    other = os.fork()
    status = 1
    try:
        with quick_numba(), np.errstate(all="ignore"):
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


def compile_share(module: Any, share: str) -> int:
    """Compile a share of a module; the exit status."""
    from codegen.machine_code.shortcuts import quick_numba

    shares = {"the_longest": slice(1), "all_but_the_longest": slice(1, None)}
    with quick_numba(), np.errstate(all="ignore"):
        for call in parts(module)[shares.get(share, slice(None))]:
            call()
    return status_of(module)


def failed(error: Exception) -> int:
    """Tell the process that waits, in one line, by which error this one fails; the exit status."""
    os.write(sys.stdout.fileno(), f"{' '.join(f'{type(error).__name__}: {error}'.split())[:300]}\n".encode())
    return 1


def status_of(module: Any) -> int:
    """Have machine code carry its digest; the exit status of a process that has compiled its share of a module."""
    module.seal_code(_compiled_functions(module))
    return UNFINISHED if module.metadata["task"] == "connect" else 0


def _nothing(x: Any) -> Any:
    return x


if __name__ == "__main__":
    try:
        status = main(sys.argv[1])
    except Exception as error:  # the process that waits says what has become of it
        status = failed(error)
    os._exit(status)  # at once: to take everything down that numba and LLVM have built takes half a second
