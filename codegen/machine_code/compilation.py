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
import io
import os
import sys
from collections.abc import Callable
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import numpy as np

from codegen.loading import GeneratedModule, load
from codegen.machine_code.processes import UNFINISHED


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
        lambda: module.push_inside(*module.variable_bounds(grid), unknowns, 0.1),
        lambda: module.prescribed_beyond(grid, unknowns),
        lambda: module.remaining_gap(unknowns, gradient, *module.variable_bounds(grid)),
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
    with np.errstate(all="ignore"), module.packed_operations():
        for call in parts(module):
            call()


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
    if linking.applies():
        linking.link_inner_functions(functions, [function.py_func.__name__ for function in long])
    for function in long:
        function.enable_caching()


def _compiled_functions(module: GeneratedModule) -> list[Any]:
    return [value for value in vars(module).values() if hasattr(value, "py_func")]


def main(share: str) -> int:
    """Get numba ready, wait for the path of a module, compile a share of it; the exit status."""
    from numba import njit

    gc.disable()  # what compilation leaves behind is little, and looking for it takes time
    njit(_nothing)(0.0)  # the first compilation takes long, whatever it compiles
    path = os.fsdecode(sys.stdin.buffer.read())
    if not path:
        return 0
    with redirect_stderr(io.StringIO()) as said:  # of damaged machine code
        module = load(Path(path))
    os.write(sys.stdout.fileno(), said.getvalue().encode())
    if module.metadata["task"] != "connect" and not is_simulation_of_particles(module):
        compile_for_callers(module)
    if share == "both":
        return compile_in_two(module)
    return compile_share(module, share)


def compile_in_two(module: Any) -> int:
    """Compile a module in this process and in a copy of it, each taking the next part that is left; the exit status."""
    calls = parts(module)
    left, numbers = os.pipe()
    os.write(numbers, bytes(range(len(calls))))
    os.close(numbers)
    other = os.fork()
    status = 1
    try:
        with np.errstate(all="ignore"), module.packed_operations():
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
    shares = {"the_longest": slice(1), "all_but_the_longest": slice(1, None)}
    with np.errstate(all="ignore"), module.packed_operations():
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
