"""Time controllers with a moving horizon against CasADi's IPOPT and sqpmethod with qrqp, on the same programs.

    python tests/benchmarks/moving_horizon.py [--steps N] [--problem NAME] [--json FILE] [--plot FOLDER]

A cart-pole (N = 40) under pushes and a quadrotor (N = 30) on a path are first controlled in a closed loop, with a plant
that differs from the model and with noise, by our controller. The states that were measured, N of them, are then given
to every contestant in turn, in blocks, so that a slow spell of the machine hits all. Each begins from its own last
solution, shifted; all have the tolerance 1e-8. Printed are the median and the 99.9 % of the latencies, from the call to
the inputs, without what is prepared before the measurement; the time of the processor beside that of the clock (which
includes what other programs took), iterations, how often it was solved, and by how much inputs differ from ours. Then
deadlines: how many are kept, and what it costs, and the memory that is allocated by a thousand steps more.
"""

import os

# Before numpy and CasADi load their BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import gc
import json
import math
import platform
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
from peers.casadi_horizon import MovingHorizon
from peers.gallery_table import GALLERY
from rich.console import Console
from rich.table import Table

import codegen

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
BLOCK = 50
"""Sampling times in a row before the next contestant has its turn."""
TOLERANCE = 1e-8


@dataclass(frozen=True)
class Case:
    """A problem with its run-time values, and how the plant differs: disturbances and noise of each state."""

    problem: str
    steps: int
    parameters: dict[str, Any]
    disturbances: dict[str, Any]
    noise: Any
    inputs: Any = None


def push(t: float) -> float:
    """A push of 6 N for a tenth of a second, every three seconds, to either side."""
    return math.copysign(6.0, math.sin(math.pi * t / 3.0 + 0.1)) if t % 3.0 < 0.1 else 0.0


def gust(t: float) -> float:
    """Wind that comes and goes, in m/s^2."""
    return max(0.0, math.sin(2.0 * math.pi * t / 7.0))


CASES = (
    Case(
        "cart_pole_balance", 40, {}, {"m2": 0.35, "push": push},
        {"x": 1e-3, "theta": 2e-3, "dx": 5e-3, "dtheta": 1e-2},
    ),
    Case("quadrotor_path", 30, {"now": lambda t: t}, {"wind_x": gust}, 2e-3),
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A contestant on a case; times in milliseconds. `apart` and `farthest` are the median and the
    largest difference of inputs from ours."""

    problem: str
    solver: str
    steps: int
    median: float
    late: float
    median_processor: float
    late_processor: float
    iterations: float
    solved: float
    apart: float
    farthest: float


class Contestant:
    """A solver made ready, with what it took at every sampling time."""

    def __init__(self, name: str, step: Callable[..., Any], told: Callable[[], tuple[str, int, float]]) -> None:
        self.name, self._step, self._told = name, step, told
        self.inputs: list[Any] = []
        self.clock: list[float] = []
        self.processor: list[float] = []
        self.iterations: list[int] = []
        self.statuses: list[str] = []

    def step(self, state: Any, t: float) -> None:
        """One sampling time."""
        begin = thread_time()
        inputs = self._step(state, t)
        self.processor.append(thread_time() - begin)
        status, iterations, seconds = self._told()
        self.clock.append(seconds)
        self.inputs.append(inputs)
        self.iterations.append(iterations)
        self.statuses.append(status)


def ours(name: str, controller: Any) -> Contestant:
    """A controller of this project."""
    return Contestant(
        name, controller.step, lambda: (controller.last.status, controller.last.iterations, controller.last.seconds)
    )


def theirs(name: str, solver: MovingHorizon) -> Contestant:
    """A solver of CasADi."""
    return Contestant(name, solver.step, lambda: (solver.status, solver.iterations, solver.seconds))


def measured_states(case: Case, samples: int, folder: Path | None) -> Any:
    """The closed loop whose states all are given."""
    file = PROBLEMS / f"{case.problem}.py"
    controller = codegen.Controller(file, steps=case.steps, parameters=case.parameters, tolerance=TOLERANCE)
    loop = codegen.close_loop(
        controller, file, arguments={"plant": True}, samples=samples, disturbances=case.disturbances, noise=case.noise
    )
    if folder is not None:
        loop.plot(folder / f"{case.problem}.png")
    return controller, loop


def compared(case: Case, samples: int, folder: Path | None) -> tuple[list[Row], Any]:
    """All contestants on one case."""
    controller, loop = measured_states(case, samples, folder)
    single = codegen.Controller(
        controller.module, steps=case.steps, parameters=case.parameters, tolerance=TOLERANCE, newton_steps=1
    )
    ahead = codegen.Controller(controller.module, steps=case.steps, parameters=case.parameters, tolerance=TOLERANCE)
    controller.reset()
    problem = GALLERY[case.problem, ()]()
    contestants = [
        ours("codegen", controller), ours("codegen, prepared", ahead), ours("codegen, one Newton step", single),
    ]  # fmt: skip
    for method, name in (("ipopt", "CasADi, IPOPT"), ("sqpmethod", "CasADi, sqpmethod + qrqp")):
        for compiled in (False, True):
            solver = MovingHorizon(problem, case.steps, method, TOLERANCE, compiled)
            contestants.append(theirs(f"{name}{', compiled' if compiled else ''}", solver))
    for first in range(0, len(loop.measured), BLOCK):
        for contestant in contestants:
            for k in range(first, min(first + BLOCK, len(loop.measured))):
                if contestant.name.endswith("prepared"):
                    ahead.prepare(float(loop.times[k]))
                contestant.step(loop.measured[k], float(loop.times[k]))
    return [row_of(case, contestant, contestants[0]) for contestant in contestants], loop


def row_of(case: Case, one: Contestant, own: Contestant) -> Row:
    """What a contestant took; its first solve, which begins from nothing, aside."""
    clock, processor = 1e3 * np.array(one.clock[1:]), 1e3 * np.array(one.processor[1:])
    apart = np.abs(np.array(one.inputs) - np.array(own.inputs)).max(axis=1)
    return Row(
        case.problem, one.name, len(one.clock), float(np.median(clock)), float(np.percentile(clock, 99.9)),
        float(np.median(processor)), float(np.percentile(processor, 99.9)), float(np.mean(one.iterations[1:])),
        float(np.mean([status == "solved" for status in one.statuses])),
        float(np.median(apart)), float(apart.max()),
    )  # fmt: skip


def deadlines(case: Case, loop: Any) -> list[tuple[str, float, int, int, float]]:
    """For deadlines in parts of the median: name, seconds, how many were missed and solved, the error of inputs."""
    found = []
    for part in (4.0, 1.0, 0.7):
        seconds = part * loop.latency(50.0)
        controller = codegen.Controller(
            PROBLEMS / f"{case.problem}.py", steps=case.steps, parameters=case.parameters, tolerance=TOLERANCE,
            deadline=seconds,
        )  # fmt: skip
        missed = solved = 0
        errors = []
        for k, state in enumerate(loop.measured):
            inputs = controller.step(state, float(loop.times[k]))
            missed += not controller.last.in_time
            solved += controller.last.status == "solved"
            errors.append(np.abs(inputs - loop.inputs[k]).max())
        found.append((f"{part:g} medians", seconds, missed, solved, float(np.median(errors))))
    return found


def growth(case: Case, loop: Any, times: int = 1000) -> int:
    """The bytes that Python holds more after so many steps more, without what is garbage."""
    controller = codegen.Controller(PROBLEMS / f"{case.problem}.py", steps=case.steps, parameters=case.parameters)
    states = [loop.measured[k % len(loop.measured)] for k in range(times)]
    tracemalloc.start()
    for k, state in enumerate(states[:50]):
        controller.step(state, 0.05 * k)
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    for k, state in enumerate(states):
        controller.step(state, 0.05 * k)
    gc.collect()
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return after - before


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000, help="sampling times")
    parser.add_argument("--problem", choices=[case.problem for case in CASES])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path, help="a folder for figures of the closed loops")
    options = parser.parse_args()
    console, rows = Console(width=150), []
    for case in (case for case in CASES if options.problem in (None, case.problem)):
        found, loop = compared(case, options.steps, options.plot)
        rows += found
        console.print(table_of(case, found))
        for name, seconds, missed, solved, error in deadlines(case, loop):
            console.print(
                f"deadline {1e3 * seconds:.3f} ms ({name}): {missed} of {len(loop.measured)} missed, {solved} solved, "
                f"inputs off by {error:.1e} in the median"
            )
        console.print(f"1000 steps more hold {growth(case, loop)} bytes more\n")
    if options.json:
        found = {"machine": platform.processor(), "rows": [asdict(row) for row in rows]}
        options.json.write_text(json.dumps(found, indent=1))


def table_of(case: Case, rows: list[Row]) -> Table:
    """The rows of one case."""
    table = Table(title=f"{case.problem}, N = {case.steps}, {rows[0].steps} sampling times, milliseconds")
    columns = "solver,median,99.9 %,processor,99.9 %,iterations,solved,inputs apart,at most,speed"
    for name in columns.split(","):
        table.add_column(name, justify="left" if name == "solver" else "right")
    for row in rows:
        table.add_row(
            row.solver, f"{row.median:.3f}", f"{row.late:.2f}", f"{row.median_processor:.3f}",
            f"{row.late_processor:.2f}", f"{row.iterations:.1f}", f"{100 * row.solved:.1f} %", f"{row.apart:.0e}",
            f"{row.farthest:.0e}", f"{rows[0].median_processor / row.median_processor:.3f}",
        )  # fmt: skip
    return table


if __name__ == "__main__":
    main()
