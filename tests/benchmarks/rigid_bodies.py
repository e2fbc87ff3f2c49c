"""Simulations of a heavy top as a rotation against MuJoCo and DOP853: error against run time, and long motions.

    python tests/benchmarks/rigid_bodies.py [--long SECONDS]

The top is that of `problems/heavy_top.py`; in MuJoCo it is a body on a ball joint, whose steps are made by
`mujoco.rollout` in one call. The error is the angle between the attitude at t = 2 and that of DOP853 for Euler's
equations to 1e-13. Seconds are the least of five runs; all programs take turns. `drift` is the largest change of the
energy, relative to the kinetic energy at the start, over the last tenth of a long motion with 1000 steps a second.
Needs mujoco.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import codegen

ROOT = Path(__file__).resolve().parents[2]

INERTIA, SPIN, WEIGHT = np.array([1.2, 1.2, 0.3]), np.array([0.0, 0.0, 30.0]), 9.81
START = Rotation.from_rotvec([0.5, 0.0, 0.0])
DURATION, RUNS = 2.0, 5
MODEL = """
<mujoco>
  <option gravity="0 0 -9.81" integrator="{integrator}" timestep="{step}"/>
  <worldbody>
    <body>
      <joint type="ball" damping="0"/>
      <inertial pos="0 0 1" mass="1" diaginertia="0.2 0.2 0.3"/>
    </body>
  </worldbody>
</mujoco>
"""


def energy(attitudes: Rotation, spins: np.ndarray) -> np.ndarray:
    """Return the energy for attitudes and angular velocities (M, 3) in the frame of the body."""
    return spins**2 @ INERTIA / 2 + WEIGHT * attitudes.as_matrix()[:, 2, 2]


def by_dop853(tolerance: float, duration: float = DURATION) -> tuple[Rotation, int]:
    """Return the attitude at the end by Euler's equations and those of the quaternion, and the number of steps."""

    def field(_: float, state: np.ndarray) -> np.ndarray:
        w, x, y, z, a, b, c = state
        down = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]) * -WEIGHT
        spin = state[4:]
        torque = np.array([-down[1], down[0], 0.0])
        turning = np.array(
            [-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]
        )
        return np.concatenate([turning / 2, (torque - np.cross(spin, INERTIA * spin)) / INERTIA])

    start = np.concatenate([START.as_quat(scalar_first=True), SPIN])
    found = solve_ivp(field, (0, duration), start, "DOP853", rtol=tolerance, atol=tolerance)
    return Rotation.from_quat(found.y[:4, -1], scalar_first=True), found.t.size - 1


def by_mujoco(integrator: str, steps: int, duration: float = DURATION) -> tuple[Rotation, np.ndarray]:
    """Return attitudes and angular velocities of the nodes after the first."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(integrator=integrator, step=duration / steps))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = START.as_quat(scalar_first=True), SPIN
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.empty(size)
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states, _ = mujoco.rollout.rollout(model, data, state[None], nstep=steps)
    return Rotation.from_quat(states[0, :, 1:5], scalar_first=True), states[0, :, 5:8]


def by_codegen(solver: Any, steps: int, duration: float = DURATION) -> Any:
    """Return the grid of the module, whose motion is followed without the reports of `solve`."""
    return solver.module.solve(steps, duration=duration)


def attitudes(result: Any) -> Rotation:
    """Return the attitudes of a solution of a module."""
    return Rotation.from_quat(result.q, scalar_first=True)


def seconds(run: Callable[[], object]) -> float:
    """Return the least time of some runs."""
    times = []
    for _ in range(RUNS):
        begin = perf_counter()
        run()
        times.append(perf_counter() - begin)
    return min(times)


def rows(exact: Rotation) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield the rows of the first table: program, steps, error, milliseconds, nanoseconds for a step."""

    def row(name: str, steps: int, last: Rotation, time: float) -> tuple[str, str, str, str, str]:
        error = (last.inv() * exact).magnitude()
        return name, str(steps), f"{error:.1e}", f"{1e3 * time:.2f}", f"{1e9 * time / steps:.0f}"

    for scheme in ("midpoint", "suzuki-4-of-midpoint"):
        solver = codegen.compile(ROOT / "problems" / "heavy_top.py", scheme=scheme)
        for steps in (500, 2000, 8000):
            last = attitudes(by_codegen(solver, steps))[-1]
            yield row(scheme, steps, last, seconds(lambda: by_codegen(solver, steps)))  # noqa: B023 (called at once)
    for integrator in ("Euler", "implicitfast", "RK4"):
        for steps in (500, 2000, 8000):
            last = by_mujoco(integrator, steps)[0][-1]
            run = lambda: by_mujoco(integrator, steps)  # noqa: B023, E731 (called at once)
            yield row(f"MuJoCo {integrator}", steps, last, seconds(run))
    for tolerance in (1e-6, 1e-9):
        last, steps = by_dop853(tolerance)
        yield row(f"DOP853, {tolerance:.0e}", steps, last, seconds(lambda: by_dop853(tolerance)))  # noqa: B023


def long_rows(duration: float) -> Iterator[tuple[str, str]]:
    """Yield program and drift of the energy over a long motion."""
    steps, kinetic = int(1000 * duration), SPIN**2 @ INERTIA / 2

    def drift(energies: np.ndarray) -> str:
        return f"{np.abs(energies - energies[0])[-steps // 10 :].max() / kinetic:.1e}"

    solver = codegen.compile(ROOT / "problems" / "heavy_top.py")
    yield "midpoint", drift(by_codegen(solver, steps, duration).energy)
    start = energy(Rotation.concatenate([START]), SPIN[None])
    for integrator in ("Euler", "implicitfast", "RK4"):
        places, spins = by_mujoco(integrator, steps, duration)
        yield f"MuJoCo {integrator}", drift(np.concatenate([start, energy(places, spins)]))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--long", type=float, default=1000.0, help="duration of the long motion")
    arguments = parser.parse_args()
    console = Console(width=100)
    table = Table("program", "steps", "error", "ms", "ns a step", title="Heavy top, t = 2", title_justify="left")
    for row in rows(by_dop853(1e-13)[0]):
        table.add_row(*row)
    console.print(table)
    table = Table(
        "program", "drift", title=f"Heavy top, t = {arguments.long:g}, 1000 steps a unit", title_justify="left"
    )
    for pair in long_rows(arguments.long):
        table.add_row(*pair)
    console.print(table)


if __name__ == "__main__":
    main()
