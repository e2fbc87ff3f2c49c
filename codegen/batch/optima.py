"""Optima of many cases of one module, a block of cases for each call of the compiled batch.

A block is solved without the lock of the Python interpreter, see `codegen.runtime.search.batch`. Several threads that
solve a block each work side by side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.batch.executors.chunks import Abandoned
from codegen.errors import ArgumentError, DeviceError, clause, one_line
from codegen.runtime.search.batch import Optima, Options, no_optima, solve_grids, solve_stack
from codegen.runtime.search.solution import Log
from codegen.runtime.search.stacks import Stack, case_of, stack_of
from codegen.solving.drivers.newton import TOLERANCE
from codegen.solving.loading import ControlModule, Vector

BLOCK = 100_000
"""Number of unknowns in a block, which takes tens of milliseconds; the Python code between blocks takes less."""
BLOCK_ON_DEVICE = 20_000_000
"""Number of unknowns in a block on a GPU, which needs many cases at once."""
MOST_ITERATIONS = 3000
"""Default limit of iterations, as for `solve` of a generated module."""


@dataclass(frozen=True)
class Outcomes:
    """The optima of a block of cases, errors of cases with unusable numbers by index, and the Stack if there is one."""

    optima: Optima
    errors: Mapping[int, Exception]
    stack: Stack | None

    def grid(self, case: int) -> Any:
        """Return the grid of a case, or None without a Stack."""
        return None if self.stack is None else self.stack.grid_of(case)


@dataclass(frozen=True)
class Limits:
    """The options of the searches of all cases: see `codegen.solve`; None stands for the default.

    `is_on_device` is True for cases that a GPU solves, and `is_kept` if the states of motions stay in its memory.
    """

    tolerance: float | None = None
    max_iterations: int | None = None
    time_limit: float = math.inf
    scaling: str = "auto"
    is_warm: bool = False
    is_on_device: bool = False
    is_kept: bool = False


THREADS, CUDA = "threads", "cuda"
PLACES = (THREADS, CUDA)
"""Executors of many cases: the threads of this machine, and its GPU."""


def require_place(executor: object) -> bool:
    """Return True for the GPU; raises ArgumentError for an unknown name, and DeviceError without a GPU."""
    if executor not in PLACES:
        raise ArgumentError(f"executor {clause(repr(executor))}", f"use one of {', '.join(PLACES)}")
    if executor == CUDA:
        from codegen.runtime.cuda.memory import NoDevice, require_device

        try:
            require_device()
        except NoDevice as error:
            reason = str(error).removeprefix("Error at driver init: ").partition(". ")[0]
            raise DeviceError(
                clause(f"numba finds no GPU that it can use: {reason}"),
                'use executor "threads", or install a driver of NVIDIA and codegen[cuda]',
            ) from None
    return executor == CUDA


@contextmanager
def errors_of_device() -> Iterator[None]:
    """Raise DeviceError for errors of the GPU: too little memory, functions that it cannot run, or a failed call."""
    from numba.core.errors import NumbaError
    from numba.cuda.cudadrv.driver import CudaAPIError

    from codegen.runtime.cuda.optima import Full

    try:
        yield
    except Full as error:
        raise DeviceError(f"the memory of the GPU does not suffice: {error}", "solve with fewer steps") from None
    except CudaAPIError as error:  # also if other processes have taken the memory since it was measured
        finding = f"the GPU reports an error: {one_line(str(error), 150)}"
        raise DeviceError(clause(finding), 'end other work on the GPU, or use executor "threads"') from None
    except NumbaError as error:
        text = next(iter(str(error).strip().splitlines()[::-1]), "")
        raise DeviceError(clause(f"the GPU cannot run this problem: {text}"), 'use executor "threads"') from None


def optima(
    module: ControlModule, steps: int, arguments: Mapping[str, Any], number: int, guesses: Sequence[Vector | None],
    limits: Limits, is_wanted: Callable[[], bool],
) -> Iterator[Outcomes]:  # fmt: skip
    """Yield, block by block, the outcomes of all cases.

    `arguments` are keyword arguments of `make_grid` of the module, with arrays (`number`,) in place of numbers. A guess
    that is None is the problem's own. Raises Abandoned once `is_wanted` returns False.
    """
    size = max(1, (BLOCK_ON_DEVICE if limits.is_on_device else BLOCK) // _unknowns(module, steps, arguments))

    def log() -> Log:
        if not is_wanted():
            raise Abandoned
        return Log(limits.time_limit)

    for first in range(0, number, size):
        if not is_wanted():
            raise Abandoned
        part = slice(first, min(number, first + size))
        with errors_of_device() if limits.is_on_device else nullcontext():
            yield _solved(module, steps, part_of(arguments, part), guesses[part], limits, log)


def _solved(
    module: ControlModule, steps: int, arguments: Mapping[str, Any], guesses: Sequence[Vector | None], limits: Limits,
    log: Callable[[], Log],
) -> Outcomes:  # fmt: skip
    """Return the outcomes of a block of cases."""
    on_device = None
    if limits.is_on_device:
        from codegen.runtime.cuda import optima as of_device

        on_device = of_device.solve_cases
    options = Options(
        limits.tolerance or TOLERANCE, limits.max_iterations or MOST_ITERATIONS, limits.is_warm, limits.scaling,
        on_device,
    )  # fmt: skip
    number, errors = len(guesses), dict[int, Exception]()
    stack = stack_of(module, steps, arguments, number) if all(guess is None for guess in guesses) else None
    optima = None if stack is None else solve_stack(stack, options, log)
    rest = range(number) if optima is None else np.flatnonzero(optima.status == "").tolist()
    grids, starts, alone = list[Any](), list[Vector](), list[int]()
    for case in rest:
        try:
            grid = module.make_grid(steps, **case_of(arguments, case))
            guess = guesses[case]
            start = module.initial_guess(grid) if guess is None else module.with_pinned_values(grid, guess)
        except (ValueError, ArithmeticError) as error:  # generated modules raise built-in exceptions
            errors[case] = error
            continue
        grids.append(grid)
        starts.append(start)
        alone.append(case)
    if optima is None:
        optima = no_optima(number, starts[0].size if starts else 0)
    for case, result in zip(alone, solve_grids(grids, starts, options, log), strict=True):
        optima.put(case, result)
    return Outcomes(optima, errors, stack)


def _unknowns(module: ControlModule, steps: int, arguments: Mapping[str, Any]) -> int:
    """Return the number of unknowns of a case, from the problem's own numbers if those of the first case have none."""
    own: Mapping[str, Any]
    for own in (case_of(arguments, 0), {}):
        with suppress(ValueError, ArithmeticError):
            return int(module.make_grid(steps, **own).is_multiplier.size)
    return BLOCK


def part_of(arguments: Mapping[str, Any], part: slice) -> dict[str, Any]:
    """Return the arguments of some cases."""
    return {
        name: part_of(values, part) if isinstance(values, Mapping) else values[part]
        for name, values in arguments.items()
    }
