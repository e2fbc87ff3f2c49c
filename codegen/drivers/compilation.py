"""Compile the machine code of a generated module in two processes at once.

numba compiles one function after the other. The KKT factorisation of a control problem, or the loop over the steps of
a simulation, takes about half of that time, so a second process compiles it, having loaded numba while the module was
still being derived; numba's cache on disk brings both together.
`python -m codegen.drivers.compilation` is that second process: it reads the path of a module from its standard input.

Both let LLVM pack neighbouring operations into one instruction, which numba leaves out by default and which the
elimination of blocks, written four entries at a time, gains a third from.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from codegen.load import GeneratedModule, load


class SecondProcess:
    """A process that has numba ready and compiles the longest function of one module when it is told to."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        if (os.cpu_count() or 1) > 1:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "codegen.drivers.compilation"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "NUMBA_SLP_VECTORIZE": "1"},
            )

    def compile(self, module: GeneratedModule) -> None:
        """Compile a module together with the second process; afterwards `solve` finds everything on disk."""
        if self.process is None:
            return
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # a second process that has died is missed, not needed
            self.process.stdin.write(os.fsencode(os.path.abspath(str(vars(module)["__file__"]))))
            self.process.stdin.close()
        compile_all_but_the_longest(module)
        self.process.wait()


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


@contextmanager
def second_process() -> Iterator[SecondProcess]:
    """Start the second process, and make sure that it ends with the block."""
    helper = SecondProcess()
    try:
        yield helper
    finally:
        if helper.process is not None:
            helper.process.kill()
            helper.process.wait()
            if helper.process.stdin is not None:
                with suppress(BrokenPipeError):
                    helper.process.stdin.close()


def compile_all_but_the_longest(module: Any) -> None:
    """Call what a solution calls, except the longest function; the factors of a control problem are zeros."""
    if module.metadata["task"] == "connect":
        case = small_case(module)
        module.path_cost(case, module.guessed_path(case.start, case.target, 2, 1.0, case.own, case.parameters))
        return
    grid = module.make_grid(2)
    if module.metadata["task"] == "simulate":
        module.path_residual(grid, np.vstack([grid.start, grid.start]))
        return
    unknowns = module.initial_guess(grid)
    gradient = module.evaluate(grid, unknowns).gradient
    system = module.allocate_system(grid)
    with np.errstate(all="ignore"):
        module.solve_kkt(grid, system, gradient, np.empty_like(unknowns))
        module.unpack(grid, unknowns)
        module.term_sizes(unknowns, grid.steps, grid.h, grid.parameters, grid.is_multiplier)
        if hasattr(module, "slope_of"):  # a linear-quadratic problem has none
            module.slope_of(unknowns, gradient, gradient, grid.is_multiplier)


def compile_the_longest(module: Any) -> None:
    """Call the factorisation of a control problem, or the loop of a simulation, once."""
    if module.metadata["task"] == "connect":
        case = small_case(module)
        points = np.zeros((2 * module.POINTS, 2, *case.start.shape))
        points[:, 0] = case.start
        module.Linearised(case, points, None).matrix()
        return
    grid = module.make_grid(2)
    if module.metadata["task"] == "simulate":
        path = np.empty((3, grid.start.size))
        module.follow(grid.start, 2, grid.h, grid.parameters, 1, 1e-13, 50, path, path)
        return
    unknowns = module.initial_guess(grid)
    module.factor_kkt(grid, unknowns, 1.0, np.zeros_like(unknowns), module.allocate_system(grid))


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


def main() -> None:
    """Get numba ready, wait for the path of a module, compile its longest function."""
    from numba import njit

    njit(_nothing)(0.0)  # the first compilation takes long, whatever it compiles
    path = os.fsdecode(sys.stdin.buffer.read())
    if path:
        compile_the_longest(load(Path(path)))


def _nothing(x: Any) -> Any:
    return x


if __name__ == "__main__":
    main()
