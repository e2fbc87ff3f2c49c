"""Long motions: the fastest scheme to a given error of the energy, beside scipy's DOP853 and heyoka in the same run.

    python tests/benchmarks/long_motion.py [kepler pendulum planets] [--repeat R] [--csv FILE]

For every scheme the fewest steps are sought (to 2 per cent) with which the largest relative error of the energy, at
1000 stored states, stays below the target over the whole horizon, also with 3 and 7 per cent more steps, so that no
lucky number counts. DOP853 (its right-hand side compiled by numba) and heyoka (its Taylor method, compiled by LLVM for
the problem) get the loosest tolerance, of four a decade from 1e-6 on, that satisfies the same. Times are the
least processor time, which a busy machine lengthens less, of R warm runs in which the same 1000 states are stored. One
thread. `--schemes` takes some of ours alone.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import heyoka
import numpy as np
from numba import njit
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

import codegen.evidence.stress
from codegen.machine import machine
from codegen.solving.compiler import build
from codegen.solving.loading import load

ROOT = Path(__file__).resolve().parents[2]
STRESS = Path(codegen.evidence.stress.__file__).parent / "problems"
TARGETS = (1e-6, 1e-10)
STORED = 1000
PERIOD = 2 * math.pi
SCHEMES = ("stormer-verlet", "rk4", "yoshida-4", "suzuki-4", "mclachlan-4", "blanes-moan-4", "blanes-moan-6",
           "kahan-li-6", "kahan-li-8", "gauss-4", "gauss-6")  # fmt: skip


@dataclass(frozen=True)
class Motion:
    """A system as each program wants it: problem file and start of ours, field and energy for the others."""

    problem: Path
    schemes: tuple[str, ...]
    duration: float
    fewest: int
    most: float
    start: Any
    field: Any
    energy: Callable[[Any], Any]
    equations: Callable[[], list[Any]]
    scales: Any


@dataclass(frozen=True)
class Row:
    """What one program needed; `steps` is NaN where it does not say."""

    motion: str
    target: float
    program: str
    steps: float
    error: float
    seconds: float


@njit
def kepler_field(t: float, y: Any) -> Any:
    """Derivatives of places and momenta."""
    cube = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return np.array([y[2], y[3], -y[0] / cube, -y[1] / cube])


@njit
def pendulum_field(t: float, y: Any) -> Any:
    """Derivatives of angle and momentum."""
    return np.array([y[1], -math.sin(y[0])])


def kepler_equations() -> list[Any]:
    """The field in heyoka's symbols."""
    x, y, u, v = heyoka.make_vars("x", "y", "u", "v")
    cube = (x * x + y * y) ** 1.5
    return [(x, u), (y, v), (u, -x / cube), (v, -y / cube)]


def pendulum_equations() -> list[Any]:
    """The field in heyoka's symbols."""
    q, p = heyoka.make_vars("q", "p")
    return [(q, p), (p, -heyoka.sin(q))]


def planets() -> Motion:
    """The outer solar system over a million days; data from the problem file's own module."""
    problem = ROOT / "problems" / "outer_solar_system.py"
    grid = load(build(problem, scheme="stormer-verlet").path).make_grid(1)  # type: ignore[attr-defined]
    masses, G = np.ascontiguousarray(grid.own[:, 0]), float(grid.parameters[0])

    @njit
    def field(t: float, y: Any) -> Any:
        rates = np.zeros(36)
        for i in range(6):
            for a in range(3):
                rates[3 * i + a] = y[18 + 3 * i + a] / masses[i]
            for j in range(i):
                x, z, w = y[3 * i] - y[3 * j], y[3 * i + 1] - y[3 * j + 1], y[3 * i + 2] - y[3 * j + 2]
                pull = G * masses[i] * masses[j] / (x * x + z * z + w * w) ** 1.5
                for a, d in enumerate((x, z, w)):
                    rates[18 + 3 * i + a] -= pull * d
                    rates[18 + 3 * j + a] += pull * d
        return rates

    def energy(y: Any) -> Any:
        q, p = y[:, :18].reshape(-1, 6, 3), y[:, 18:].reshape(-1, 6, 3)
        total = ((p**2).sum(-1) / (2 * masses)).sum(-1)
        for i in range(6):
            for j in range(i):
                total = total - G * masses[i] * masses[j] / np.linalg.norm(q[:, i] - q[:, j], axis=-1)
        return total

    def equations() -> list[Any]:
        named = heyoka.model.nbody(6, masses=list(masses), Gconst=G)  # places and velocities
        return list(named)

    schemes = ("stormer-verlet", "rk4", "yoshida-4", "mclachlan-4", "blanes-moan-4", "blanes-moan-6", "kahan-li-6",
               "kahan-li-8")  # fmt: skip
    scales = np.concatenate([np.ones(18), np.repeat(masses, 3) * 1e-3])
    return Motion(problem, schemes, 1e6, 1000, 2e6, None, field, energy, equations, scales)


def motions() -> dict[str, Callable[[], Motion]]:
    """Every system by name."""
    return {
        "kepler": lambda: Motion(
            STRESS / "kepler.py", SCHEMES, 300 * PERIOD, 10_000, 2e7, [0.4, 0.0, 0.0, 2.0], kepler_field,
            lambda y: (y[:, 2] ** 2 + y[:, 3] ** 2) / 2 - 1 / np.hypot(y[:, 0], y[:, 1]), kepler_equations, np.ones(4),
        ),
        "pendulum": lambda: Motion(
            ROOT / "problems" / "pendulum.py", SCHEMES, 3_000.0, 3_000, 2e7, [1.5, 0.0], pendulum_field,
            lambda y: y[:, 1] ** 2 / 2 - np.cos(y[:, 0]) + 1, pendulum_equations, np.ones(2),
        ),
        "planets": planets,
    }  # fmt: skip


def timed(run: Callable[[], Any], repeat: int) -> float:
    """The least processor time of several runs."""
    seconds = math.inf
    for _ in range(repeat):
        begin = process_time()
        run()
        seconds = min(seconds, process_time() - begin)
    return seconds


def ours(motion: Motion, scheme: str, target: float, repeat: int) -> tuple[float, float, float]:
    """Steps, error and seconds of a scheme; NaN where too many steps would be needed."""
    method = None if motion.start is None else "hamiltonian"
    module: Any = load(build(motion.problem, scheme=scheme, method=method).path)
    offset = 1.0 if motion.problem.stem == "pendulum" else 0.0  # its energy counts from the horizontal

    def solve(steps: int) -> Any:
        given = {} if motion.start is None else {"start": motion.start}
        return module.solve(steps, duration=motion.duration, every=max(1, steps // STORED), **given)

    def error(steps: int) -> float:
        solution = solve(steps)
        values = solution.energy + offset
        return float(np.abs(values / values[0] - 1).max()) if solution.status == "solved" else math.inf

    steps = motion.fewest
    while max(error(steps), error(round(1.03 * steps)), error(round(1.07 * steps))) > target:
        steps *= 2
        if steps > motion.most:
            return math.nan, math.nan, math.nan
    low, high = steps // 2, steps
    while high > 1.02 * low and high > motion.fewest:
        middle = round(math.sqrt(low * high))
        if max(error(middle), error(round(1.03 * middle)), error(round(1.07 * middle))) > target:
            low = middle
        else:
            high = middle
    return high, error(high), timed(lambda: solve(high), repeat)


def by_tolerance(run: Callable[[float], tuple[Any, float]], energy: Any, target: float, repeat: int) -> Any:
    """Steps, error and seconds with the loosest tolerance that meets the target."""

    def error(quarter: int) -> float:
        values = energy(run(10.0 ** (-quarter / 4))[0])
        return float(np.abs(values / values[0] - 1).max())

    for decade in range(24, 64, 4):
        if error(decade) <= target:
            quarter = next(q for q in (decade - 3, decade - 2, decade - 1, decade) if error(q) <= target)
            chosen = partial(run, 10.0 ** (-quarter / 4))
            return chosen()[1], error(quarter), timed(chosen, repeat)
    return math.nan, math.nan, math.nan


def dop853(motion: Motion, start: Any) -> Callable[[float], tuple[Any, float]]:
    """Dormand and Prince's method of order 8 in scipy, by tolerance."""
    times = np.linspace(0, motion.duration, STORED + 1)

    def run(tolerance: float) -> tuple[Any, float]:
        found = solve_ivp(motion.field, (0, motion.duration), start, "DOP853", t_eval=times,
                          rtol=max(tolerance, 3e-14), atol=tolerance * motion.scales)  # fmt: skip
        return found.y.T, found.nfev / 12

    return run


def taylor(motion: Motion, start: Any) -> Callable[[float], tuple[Any, float]]:
    """heyoka's Taylor method, by tolerance."""
    times = np.linspace(0, motion.duration, STORED + 1)
    made: dict[float, Any] = {}

    def run(tolerance: float) -> tuple[Any, float]:
        if tolerance not in made:
            made[tolerance] = heyoka.taylor_adaptive(motion.equations(), list(start), tol=max(tolerance, 2.3e-16))
        integrator = made[tolerance]
        integrator.time = 0.0
        integrator.state[:] = start
        result = integrator.propagate_grid(times)
        return result[-1], float(result[3])

    return run


def measure(name: str, motion: Motion, repeat: int) -> list[Row]:
    """Every scheme and program on one system."""
    rows = []
    start = np.array(motion.start) if motion.start is not None else None
    heyoka_start, heyoka_energy = start, motion.energy
    if start is None:
        grid = load(build(motion.problem, scheme="stormer-verlet").path).make_grid(1)  # type: ignore[attr-defined]
        start, masses = grid.start.ravel(), grid.own[:, 0]
        # heyoka's bodies are ordered body by body: place, velocity.
        q, v = start[:18].reshape(6, 3), start[18:].reshape(6, 3) / masses[:, None]
        heyoka_start = np.hstack([q, v]).ravel()

        def heyoka_energy(y: Any) -> Any:
            bodies = y.reshape(-1, 6, 6)
            momenta = bodies[:, :, 3:] * masses[:, None]
            return motion.energy(np.hstack([bodies[:, :, :3].reshape(-1, 18), momenta.reshape(-1, 18)]))

    for target in TARGETS:
        for scheme in motion.schemes:
            rows.append(Row(name, target, scheme, *ours(motion, scheme, target, repeat)))
            print(rows[-1], flush=True)
        found = by_tolerance(dop853(motion, start), motion.energy, target, 1)
        rows.append(Row(name, target, "scipy DOP853", *found))
        print(rows[-1], flush=True)
        found = by_tolerance(taylor(motion, heyoka_start), heyoka_energy, target, repeat)
        rows.append(Row(name, target, "heyoka", *found))
        print(rows[-1], flush=True)
    return rows


def show(rows: list[Row]) -> None:
    """Each system and target as a table, fastest first, with times in parts of the fastest."""
    console = Console(width=110)
    for key in dict.fromkeys((row.motion, row.target) for row in rows):
        chosen = sorted(
            (row for row in rows if (row.motion, row.target) == key),
            key=lambda row: (row.seconds != row.seconds, row.seconds),
        )
        table = Table(
            "program", "steps", "error", "seconds", "times the fastest", title=f"{key[0]}, energy to {key[1]:g}"
        )
        for row in chosen:
            table.add_row(
                row.program,
                f"{row.steps:.0f}",
                f"{row.error:.1e}",
                f"{row.seconds:.4f}",
                f"{row.seconds / chosen[0].seconds:.2f}",
            )
        console.print(table)


def main() -> None:
    """Run the named systems, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("motions", nargs="*", choices=[*motions(), []])
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--schemes", nargs="+")
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    for key, value in {**machine(), "heyoka": heyoka.__version__}.items():
        print(f"{key}: {value}")
    rows = []
    for name in arguments.motions or motions():
        motion = motions()[name]()
        chosen = tuple(s for s in motion.schemes if arguments.schemes is None or s in arguments.schemes)
        rows += measure(name, replace(motion, schemes=chosen), arguments.repeat)
    show(rows)
    if arguments.csv:
        with arguments.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(Row.__dataclass_fields__)
            writer.writerows([getattr(row, field) for field in Row.__dataclass_fields__] for row in rows)


if __name__ == "__main__":
    main()
