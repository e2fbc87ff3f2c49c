"""The program that compiles the machine code of a generated module in two processes.

The machine code has three kinds of parts: the kernels of the module, the solver of its linear system, and functions of
the runtime. numba compiles only one function at a time in a process. Hence `processes` starts this file as a program,
`python -m codegen.solving.machine_code.compilation`. The program loads numba while the module is still being derived,
and then reads the path of the module from its standard input. If the system supports forks, numba is loaded once, and
the process then forks into two, which take parts from a common queue. On other systems two processes are started, and
each compiles every second part. Both write to numba's cache on disk, from which the module loads its machine code.

In these processes, a function that only compiled functions call gets no machine code of its own. Its code is linked
into its callers, see `runtime.linking`.
"""

from __future__ import annotations

import gc
import io
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import boolean, carray, cfunc, config, float64, int64, njit, typeof, types
from numba.core.event import Event, Listener, install_listener
from numpy.typing import NDArray

from codegen.runtime.kept_code import add_checksums, code_folder, runtime_folders
from codegen.runtime.kernels import is_kept, packed_operations
from codegen.runtime.kkt.shape import Shape
from codegen.runtime.kkt.specialised import compiled_system, is_made
from codegen.runtime.record import Task
from codegen.solving.drivers import task_of
from codegen.solving.loading import Case, ConnectModule, ControlModule, GeneratedModule, SimulateModule, few_steps, load

if TYPE_CHECKING:
    from numba.core.dispatcher import Dispatcher

    from codegen.runtime.particles.problem import PairProblem
    from codegen.runtime.search.problem import ControlProblem
    from codegen.runtime.stepping.problem import StepProblem

COUNT, DONE = "codegen: parts: ", "codegen: part done"
"""Prefix of the output line with the number of parts, and the output line after each compiled part."""

REALS, TABLE, CUBE, FOURFOLD = (types.Array(float64, d, "C") for d in (1, 2, 3, 4))
INTEGERS, INDEX_TABLE = (types.Array(int64, d, "C") for d in (1, 2))
MASK, MASKS, READ_MASK = types.Array(boolean, 1, "C"), types.Array(boolean, 2, "C"), types.Array(boolean, 1, "C", True)

Signature = tuple[types.Type, ...]
"""The numba types of the arguments of a function."""


@dataclass(frozen=True)
class Part:
    """A unit of machine code that one process compiles.

    `make` compiles the Python function `function`. `serves` is "problem" if only one problem uses the code, and
    "runtime" if all problems use it.
    """

    function: Any
    make: Callable[[], object]
    serves: str = "problem"

    @property
    def is_kept(self) -> bool:
        """True if machine code of the function is in the cache on the disk."""
        return bool(is_kept(self.function))

    def protect(self) -> None:
        """Add checksums to the files of machine code in all folders to which the compilation may have written."""
        folders = [] if self.serves == "problem" else [code_folder(self.function.__code__.co_filename)]
        for folder in {*folders, *(runtime_folders() if self.serves == "runtime" else [])}:
            add_checksums(folder)


@dataclass(frozen=True)
class LinearSystem:
    """The unit of machine code that all problems share whose KKT matrix has the same block structure, the `shape`."""

    shape: Shape
    serves: str = "shape"

    @property
    def is_kept(self) -> bool:
        """True if the machine code is in the cache on the disk."""
        return bool(is_made(self.shape))

    def make(self) -> None:
        """Make the machine code, or load it from the disk."""
        compiled_system(self.shape)

    def protect(self) -> None:
        """Do nothing: the file has a checksum."""


def has_machine_code(module: GeneratedModule) -> bool:
    """Return True if all machine code that the solver of a module needs is in the cache on the disk."""
    return all(part.is_kept for part in parts_of(module))


def parts_of(module: Any) -> list[Part | LinearSystem]:
    """Return all parts of the machine code of a module, in the order in which they should be compiled.

    The list is empty if numba is switched off, or if the module does not use the solvers of the runtime.
    """
    functions: dict[str, Callable[[Any], Iterator[tuple[Dispatcher, Signature]]]] = {
        "codegen.runtime.search.problem": search_functions,
        "codegen.runtime.stepping.problem": step_functions,
        "codegen.runtime.particles.problem": particle_functions,
    }
    runtime = functions.get(type(module.problem).__module__)
    if config.DISABLE_JIT or runtime is None:  # type: ignore[attr-defined]
        return []
    first, *others = (
        Part(function.py_func, partial(function.compile, signature), "runtime")
        for function, signature in runtime(module.problem)
    )
    kernels = [Part(kernel.function, partial(getattr, kernel, "address")) for kernel in module.problem.kernels()]
    if hasattr(module.problem, "structure"):
        return [first, LinearSystem(module.problem.searched.structure.shape), *others, *kernels]
    return [first, *kernels, *others]


def search_functions(problem: ControlProblem) -> Iterator[tuple[Dispatcher, Signature]]:
    """Yield the runtime functions that Python calls during an optimisation, with the types of their arguments."""
    from codegen.runtime.search import bounds as box
    from codegen.runtime.search import cascade, descent, first_iterate, iterates, linear_system, point, scaling, solve
    from codegen.runtime.search import sensitivities as changes

    grid = (int64, float64, REALS, TABLE)  # steps, h, nodes, parameters
    factors = (int64, REALS, INTEGERS, int64, INTEGERS)  # equations, factors, orders, inverses, counts
    bounds = types.Tuple((INTEGERS, *[REALS] * 5))
    addresses = types.UniTuple(int64, 3)
    on_grid = types.Tuple((*grid, MASK, REALS, REALS, float64, INDEX_TABLE, READ_MASK, INDEX_TABLE, INTEGERS))
    yield descent.descend, (
        addresses, on_grid,
        types.Tuple((INTEGERS, REALS, INTEGERS, *[REALS] * 3, int64, INTEGERS, int64, INTEGERS, INTEGERS)),
        bounds, float64, int64, int64, REALS, INTEGERS, *[TABLE] * 5,
    )  # fmt: skip
    yield first_iterate.begin_beside, (addresses, on_grid, bounds, float64, REALS, INTEGERS, TABLE, TABLE)
    quantities = scaling.Quantities(
        **{
            name: np.zeros((1, 2) if name == "tied" else 1, kind)
            for name, kind in zip(scaling.Quantities._fields, QUANTITIES, strict=True)
        }
    )
    yield scaling.fill_scaling_factors, (
        typeof(quantities), int64, int64, *grid, MASK, *[REALS] * 3, INDEX_TABLE, INTEGERS, INTEGERS, INTEGERS, MASKS,
        boolean, REALS, typeof(scaling.room_for(quantities, 1)), REALS,
    )  # fmt: skip
    yield point.measured_gradient, (int64, REALS, REALS, float64, *grid, MASK, REALS, REALS)
    yield linear_system.factor_at, (
        int64, int64, *[REALS] * 4, *grid, INTEGERS, *[REALS] * 3, *factors, REALS, boolean, boolean,
    )  # fmt: skip
    yield linear_system.fill_entry_factors, (REALS, REALS, INTEGERS, INTEGERS, MASK, REALS, INTEGERS, TABLE)
    yield linear_system.solve_at, (int64, int64, INTEGERS, REALS, *factors, REALS)
    yield linear_system.multiply_entries, (REALS, INTEGERS, INTEGERS, int64, INTEGERS, REALS, REALS, boolean)
    yield linear_system.call_hessians, (int64, REALS, *grid, INTEGERS, REALS)
    yield point.fill_momenta, (int64, REALS, *grid, INTEGERS, int64, CUBE, CUBE)
    yield solve.correction, (REALS, REALS, MASK, REALS, REALS)
    if problem.variable_bounds is not None:
        yield iterates.finite_bounds, (REALS, REALS)
        yield box.first_beyond, (*[int64] * 4, *[REALS] * 4, float64)
        yield cascade.clip, (
            addresses, on_grid, bounds, types.UniTuple(float64, 5), REALS, REALS, TABLE, REALS, REALS,
        )  # fmt: skip
    if problem.data is not None:
        along = (
            int64, INTEGERS, REALS, INTEGERS, INTEGERS, REALS, INTEGERS, INTEGERS, INTEGERS, INTEGERS, INTEGERS,
        )  # fmt: skip
        yield changes.change_along, (TABLE, CUBE, TABLE, *along, TABLE, REALS)
        yield changes.momenta_along, (REALS, TABLE, REALS, *along, INTEGERS, CUBE)
        yield changes.add_steps, (TABLE, TABLE, REALS, REALS, MASK, TABLE, TABLE)
        yield changes.solve_all, (int64, int64, INTEGERS, TABLE, *factors, TABLE)
        yield changes.largest_residual, (REALS, MASK, TABLE)
        yield changes.multiply, (TABLE, REALS)


QUANTITIES = (
    int, bool, int, bool, float, bool, bool, float, float, int, int, bool, bool, int, int, int, int, int, float, int,
    int,
)  # fmt: skip
"""Python types of the entries of the arrays in the fields of `scaling.Quantities`, in order."""


def step_functions(problem: StepProblem) -> Iterator[tuple[Dispatcher, Signature]]:
    """Yield the runtime functions that Python calls during a simulation, with the types of their arguments."""
    from codegen.runtime import arithmetic
    from codegen.runtime.stepping import events, motion, steps

    scheme = typeof(steps.Scheme(*[0] * len(steps.Scheme._fields)))
    if problem.all_steps is None and problem.events is None:
        yield steps.follow, (
            scheme, REALS, REALS, int64, float64, REALS, float64, int64, int64, TABLE, TABLE, TABLE,
        )  # fmt: skip
    yield steps.largest_residual, (
        scheme, REALS, TABLE, TABLE, int64, int64, float64, REALS, float64, int64, int64, TABLE,
    )  # fmt: skip
    if problem.events is not None:
        watched = motion.watched_of(problem)
        room, memory = events.Room(*[0] * len(events.Room._fields)), REALS
        yield events.follow_watched, (
            scheme, typeof(watched), memory, typeof(room), INTEGERS, int64, float64, REALS, int64, TABLE, TABLE, TABLE,
            INTEGERS,
        )  # fmt: skip
        yield events.residual_with_events, (
            scheme, typeof(watched), memory, typeof(room), INTEGERS, float64, REALS, int64, TABLE, TABLE, TABLE,
            INTEGERS,
        )  # fmt: skip
        yield events.least_gaps, (typeof(watched), TABLE, REALS, REALS, REALS)
    yield steps.energies, (int64, TABLE, REALS, REALS, REALS)
    yield arithmetic.factor_matrix, (TABLE, INTEGERS)
    yield arithmetic.solve_factored, (TABLE, INTEGERS, REALS)


def particle_functions(problem: PairProblem) -> Iterator[tuple[Dispatcher, Signature]]:
    """Yield the runtime functions that Python calls for problems of particles, with the types of their arguments."""
    from codegen.runtime import arithmetic
    from codegen.runtime.particles import motion, shooting, steps, tracers

    pairs, shape = typeof(steps.Pairs(*[0] * len(steps.Pairs._fields))), types.UniTuple(int64, 3)
    own = (TABLE, REALS)  # parameters of each particle, and of all
    if problem.metadata.task == Task.SIMULATE:
        yield motion.follow_particles, (pairs, CUBE, int64, float64, *own, int64, TABLE, TABLE)
        yield motion.largest_difference, (pairs, TABLE, TABLE, int64, float64, *own, shape)
        yield motion.energies_of, (pairs, TABLE, *own, shape, REALS)
        return
    linear = (pairs, CUBE, FOURFOLD, int64, float64, *own, TABLE)
    yield shooting.broyden_steps, (pairs, float64, *own, TABLE, REALS, TABLE, float64, FOURFOLD, FOURFOLD)
    yield steps.follow, (pairs, float64, *own, FOURFOLD, FOURFOLD, float64)
    yield steps.defects, (pairs, float64, *own, FOURFOLD, FOURFOLD, FOURFOLD)
    yield steps.cost_and_energies, (pairs, float64, *own, FOURFOLD, FOURFOLD, REALS, REALS)
    yield steps.discrete_cost, (pairs, float64, *own, FOURFOLD, REALS)
    yield shooting.tangents, linear
    yield steps.advance_directions, (*linear, TABLE)
    yield shooting.extend_basis, (int64, TABLE, TABLE, TABLE, REALS)
    yield steps.fill_curvature, (int64, FOURFOLD, *own, CUBE)
    yield arithmetic.cholesky, (TABLE,)
    yield arithmetic.solve_cholesky, (TABLE, TABLE)
    yield arithmetic.max_norm, (REALS,)
    if problem.tracer_gradient is not None:
        known = typeof(tracers.Tracers(*[0] * len(tracers.Tracers._fields)))
        yield tracers.carry_points, (
            known, TABLE, float64, float64, float64, FOURFOLD, *own, TABLE, CUBE,
        )  # fmt: skip


def small_case(module: ConnectModule, steps: int = 2) -> Case:
    """Return a case that moves thirteen particles near the origin by a small displacement in `steps` time steps.

    The case is solved only to load all machine code.
    """
    dimension = module.metadata.coordinates
    angles = np.linspace(0.0, 2.0 * np.pi, 13, endpoint=False)
    start = np.stack([0.1 * np.cos((axis + 1) * angles + axis) for axis in range(len(dimension))], axis=1)
    start[:, 0] += 0.01 * np.arange(13)
    return module.make_case(start, start + 0.001, steps)


def control_small(module: ControlModule) -> None:
    """Solve an optimal-control problem on a few intervals with one iteration, which loads all machine code."""
    module.solve(few_steps(module, 2), max_iterations=1)


def simulate_small(module: SimulateModule) -> None:
    """Simulate two steps, which loads all machine code."""
    module.solve(2)


def connect_small(module: ConnectModule) -> None:
    """Connect a few particles, which loads all machine code."""
    module.solve_case(small_case(module))


def control_warmed_up(module: ControlModule, steps: int) -> None:
    """Call all functions that an optimiser evaluates once at the initial guess, which loads their machine code.

    The grid has `steps` intervals.
    """
    program = module.nlp(steps)
    for evaluate in (program.cost, program.gradient, program.constraints, program.jacobian, program.hessian):
        evaluate(program.x0)


def simulate_warmed_up(module: SimulateModule, _steps: int) -> None:
    """Simulate one step, which loads the machine code that drivers of scipy call."""
    module.solve(steps=1)


def connect_warmed_up(_module: ConnectModule, _steps: int) -> None:
    """Do nothing: for particles the first call of a driver, which is not timed, loads the machine code."""


def compile_all(module: GeneratedModule) -> None:
    """Compile all functions that the solver of a module calls, or load them from the disk; then solve a small case."""
    with np.errstate(all="ignore"), packed_operations():
        for part in parts_of(module):
            part.make()
            part.protect()
    task_of(module).small(module)


def main(share: str) -> int:
    """Load numba, read the path of a module from standard input, and compile its parts; return the exit status.

    `share` selects the parts. It is "both" for all parts, with a fork, and "i/n" for every n-th part from part i on.
    """
    gc.disable()  # compilation leaves little garbage, and garbage collection takes time
    is_compiling = not config.DISABLE_JIT  # type: ignore[attr-defined]
    if is_compiling:
        warm_up()
    path = os.fsdecode(sys.stdin.buffer.read())
    if not (path and is_compiling):
        return 0
    with redirect_stderr(io.StringIO()) as messages:  # notes about damaged machine code, passed to the parent process
        module = load(Path(path))
    os.write(sys.stdout.fileno(), messages.getvalue().encode())
    parts = [part for part in parts_of(module) if part.serves == "problem" or not part.is_kept]
    link_runtime()
    if share == "both":
        return compile_in_two(parts)
    number, count = map(int, share.split("/"))
    compile_parts(parts[number::count], len(parts))
    return 0


def warm_up() -> None:
    """Compile a small loop and a small kernel, because the first compilation of a process is slow for any function."""
    import codegen.runtime.search.solution  # noqa: F401  imported by generated modules

    assert cfunc(float64(types.CPointer(float64), int64))(_loop).address


_PLACES = np.array([0, 1])


def _loop(values: Any, count: int) -> float:
    """Iterate over intervals like the loops of generated modules; return a sum without meaning."""
    array, part, total = carray(values, (count,)), np.zeros(2), 0.0
    for k in range(count):
        part[:] = 0.0
        total += _kernel(array[k : k + 2], (array[k + 1] - array[k]) * 2.0, part)
        _add(part, k, 2, array)
        for i in _PLACES:
            array[i] = 0.0
    return total


@njit(error_model="numpy")
def _kernel(values: NDArray[np.float64], t: float, part: NDArray[np.float64]) -> float:
    """Fill the array `part` like the kernels of generated modules."""
    x: float = 0.5 * values[0] ** 2 + math.sin(t) / values[1]
    part[0] = 2 * x / math.sqrt(t) - x**3
    return -x


@njit(error_model="numpy", inline="always")
def _add(part: NDArray[np.float64], first: int, size: int, array: NDArray[np.float64]) -> None:
    """Add the first `size` entries of `part` to the entries of `array` from the index `first` on."""
    for i in range(size):
        array[first + i] += part[i]


def link_runtime() -> None:
    """Let numba in this process link functions that only compiled functions call into their callers.

    Functions whose machine code is on the disk keep it. They are only prevented from being compiled again for constant
    arguments.
    """
    from codegen.runtime.linking import compile_for_any_value, link_inner_functions

    runtime = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("codegen.runtime.")]
    functions = {id(value): value for space in runtime for value in space.values() if hasattr(value, "py_func")}
    is_kept = {key: function.stats.cache_path is not None for key, function in functions.items()}
    link_inner_functions(function for key, function in functions.items() if not is_kept[key])
    compile_for_any_value(function for key, function in functions.items() if is_kept[key])


def compile_in_two(parts: list[Part | LinearSystem]) -> int:
    """Compile parts in this process and in a fork of it; return the exit status.

    Both processes read the index of the next part from a common pipe, until the pipe is empty.
    """
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


def compile_parts(parts: Iterable[Part | LinearSystem], count: int) -> None:
    """Compile parts, and report each finished part to the parent process by a line of standard output.

    `count` is the number of parts of all processes.
    """
    os.write(sys.stdout.fileno(), f"{COUNT}{count}\n".encode())
    with np.errstate(all="ignore"), packed_operations():
        for part in parts:
            part.make()
            part.protect()
            os.write(sys.stdout.fileno(), f"{DONE}\n".encode())


def failed(error: Exception) -> int:
    """Report an error to the parent process by a line of standard output; return the exit status 1."""
    os.write(sys.stdout.fileno(), f"{' '.join(f'{type(error).__name__}: {error}'.split())[:300]}\n".encode())
    return 1


class CodeSeconds(Listener):  # type: ignore[misc, unused-ignore]  # numba is annotated in parts
    """A stopwatch for the time that numba spends in one thread on compiling functions or reading them from the disk.

    `seconds` is the time so far. `is_compiled` is True if a function was compiled, and not only read.
    """

    def __init__(self) -> None:
        self.seconds, self.is_compiled = 0.0, False
        self._thread, self._depth, self._begin = threading.get_ident(), 0, 0.0

    def on_start(self, event: Event) -> None:
        """Start the stopwatch, unless it runs already because a function is compiled during another compilation."""
        if threading.get_ident() != self._thread:
            return
        if event.kind == "numba:compile":
            self.is_compiled = True
            return
        if self._depth == 0:
            self._begin = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Event) -> None:
        """Stop the stopwatch at the end of the outermost compilation."""
        if threading.get_ident() != self._thread or event.kind == "numba:compile":
            return
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._begin


@contextmanager
def seconds_of_machine_code() -> Iterator[CodeSeconds]:
    """Measure the time that numba spends on compiling and reading functions in this thread during a with block."""
    listener = CodeSeconds()
    with install_listener("numba:compiler_lock", listener), install_listener("numba:compile", listener):
        yield listener


if __name__ == "__main__":
    try:
        status = main(sys.argv[1])
    except Exception as error:  # reported to the parent process
        status = failed(error)
    os._exit(status)  # without the teardown of numba and LLVM, which takes half a second
