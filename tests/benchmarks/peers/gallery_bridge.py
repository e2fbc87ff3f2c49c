"""Our generated solvers beside CasADi's programs: the same unknowns in the order of either."""

from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from codegen.solving.compiler import build
from codegen.solving.loading import load
from codegen.solving.machine_code.processes import compilers, prepare

from .casadi_gallery import Array, PreparedGallery

PROBLEMS = Path(__file__).resolve().parents[3] / "problems"


def perturbed(module: Any, grid: Any, size: float, seed: int) -> Array:
    """A problem's guess with noise on every unknown that is neither given nor a multiplier.

    The noise is normal, with the deviation `size` times the sum of the unknown's magnitude and of a tenth of the
    greatest one; of an angle that tenth is one radian at most, or a flight of 2000 s would turn it by hundreds of
    radians. Ends that are copies of perturbed unknowns follow them.
    """
    unknowns = module.initial_guess(grid)
    indices = module.free_unknowns(grid) & ~np.asarray(grid.is_multiplier)
    magnitude = np.abs(unknowns[indices])
    noise = np.random.default_rng(seed).standard_normal(magnitude.size)
    radian = module.RADIAN[module.kinds_of(grid.steps)][indices]  # infinite for what is no angle
    part = np.minimum(0.1 * magnitude.max(initial=0.0), radian)
    unknowns[indices] += size * noise * (magnitude + part)
    completed: Array = module.with_pinned_values(grid, unknowns)
    return completed


class GeneratedGallery:
    """The generated solver of one problem, run and reported like a `PreparedGallery`, whose program judges it."""

    def __init__(
        self, name: str, arguments: dict[str, str], steps: int, tolerance: float, judge: PreparedGallery
    ) -> None:
        """Build and load the module, and solve once; CodegenError when it cannot be built."""
        started = perf_counter()
        scheme = "trapezoidal" if judge.problem.trapezoidal else None
        path = build(PROBLEMS / f"{name}.py", arguments, scheme=scheme).path
        with compilers() as processes:
            prepare(path, processes)  # as `codegen build` does
        self.module: Any = load(path)
        self.steps, self.tolerance, self.judge = steps, tolerance, judge
        self.grid = self.module.make_grid(steps)
        self.run()
        self.build_seconds = perf_counter() - started

    def run(self, guess: Array | None = None) -> None:
        """Solve from the given unknowns, or from the problem's guess."""
        self.solution = self.module.solve(steps=self.steps, tolerance=self.tolerance, guess=guess, max_iterations=1000)

    def perturbed_guess(self, size: float, seed: int) -> Array:
        """As `perturbed` says; both solvers see the same guess."""
        return perturbed(self.module, self.grid, size, seed)

    def as_casadi(self, unknowns: Array) -> Array:
        """The coordinates, controls and duration of our unknowns in CasADi's order; the rest as CasADi guesses it."""
        problem, program = self.judge.problem, self.judge.program
        t, q, _, u, _ = self.module.unpack(self.grid, unknowns)
        result = program.guess.copy()
        at_nodes, on_intervals, free, _ = program.size
        by_body = (q.reshape(q.shape[0], problem.bodies, -1), u.reshape(u.shape[0], problem.bodies, -1))
        # States of a first-order system and coordinates come first; momenta are no unknowns of CasADi's program.
        result[:at_nodes] = by_body[0][:, :, : problem.dimension].transpose(1, 0, 2).ravel()
        result[at_nodes : at_nodes + on_intervals] = by_body[1].transpose(1, 0, 2).ravel()
        if free:
            result[at_nodes + on_intervals] = t[-1]
        return result

    def completed(self, unknowns: Array) -> Array:
        """CasADi's vector for a solution of ours, with the end velocities and reactions that fit it best."""
        return self.judge.fitted(self.as_casadi(unknowns))

    def report(self) -> dict[str, Any]:
        """Cost and status of the last run as the module tells them, and the violation as CasADi's program finds it."""
        solution = self.solution
        return {
            "cost": float(solution.cost),
            "residual": self.judge.violation(self.completed(solution.unknowns)),
            "iterations": int(solution.iterations),
            "status": str(solution.status),
        }
