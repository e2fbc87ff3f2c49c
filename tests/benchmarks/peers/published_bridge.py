"""The published problems by the generated solver and by IPOPT, on the same program: the module's own callbacks."""

from pathlib import Path
from typing import Any

import cyipopt
import numpy as np

from codegen.runtime.search import point
from codegen.solving.compiler import build
from codegen.solving.drivers.ipopt import _Callbacks
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.loading import load
from codegen.solving.machine_code.processes import compilers, prepare

from .casadi_gallery import Array
from .gallery_bridge import PROBLEMS, perturbed

_STATUSES = {0: "solved", 1: "solved", 2: "infeasible", -1: "iteration limit", -4: "time limit"}


class PublishedProblem:
    """One published problem on N intervals, for both solvers with default options, but at most `limit` seconds."""

    def __init__(self, name: str, most_steps: int, limit: float) -> None:
        """Build and load the module; CodegenError when it cannot be built."""
        path: Path = build(PROBLEMS / "published" / f"{name}.py").path
        with compilers() as processes:
            prepare(path, processes)
        self.module: Any = load(path)
        self.steps, self.limit = min(most_steps, self.module.metadata.steps), limit
        self.grid = self.module.make_grid(self.steps)

    def perturbed_guess(self, size: float, seed: int) -> Array:
        """As `GeneratedGallery.perturbed_guess`."""
        return perturbed(self.module, self.grid, size, seed)

    def by_codegen(self, guess: Array) -> dict[str, Any]:
        """The report of the generated solver."""
        solution = self.module.solve(self.steps, guess=guess, time_limit=self.limit)
        return self._report(solution.status, solution.unknowns, solution.iterations)

    def by_ipopt(self, guess: Array) -> dict[str, Any]:
        """The report of IPOPT with its own scaling, relaxed bounds and tolerances."""
        program = self.module.nlp(self.steps, guess=guess)
        calls = _Callbacks(program)
        with quiet_single_thread():
            sizes = program.primal.size, program.dual.size
            solver = cyipopt.Problem(*sizes, calls, *program.bounds, *program.constraint_bounds)
            for name, value in {"print_level": 0, "sb": "yes", "max_cpu_time": self.limit}.items():
                solver.add_option(name, value)
            x, details = solver.solve(program.x0)
        status = _STATUSES.get(int(details["status"]), "stalled")
        return self._report(status, program.unknowns(x, details["mult_g"]), calls.iterations)

    def _report(self, status: str, unknowns: Array, iterations: int) -> dict[str, Any]:
        cost = float(point.cost(self.grid, unknowns))
        residual = self.violation(unknowns)
        return {"status": str(status), "cost": cost, "residual": residual, "iterations": int(iterations)}

    def violation(self, unknowns: Array) -> float:
        """The largest violation of an equation or bound, each in units of its largest term where that exceeds one."""
        rows, columns, values = point.jacobian(self.grid, unknowns)
        primal = unknowns[self.module.primal_unknowns(self.grid)]
        residuals = np.abs(point.constraints(self.grid, unknowns))
        size = np.ones(residuals.size)
        np.maximum.at(size, rows, np.abs(values * primal[columns]))
        worst = float((residuals / size).max(initial=0.0))
        if self.module.metadata.inequalities:
            lower, upper = self.module.variable_bounds(self.grid)
            beyond = np.maximum(lower - unknowns, unknowns - upper) / np.maximum(1.0, np.abs(unknowns))
            worst = max(worst, float(beyond[self.module.primal_unknowns(self.grid)].max(initial=0.0)))
        return worst if np.isfinite(worst) else float("inf")
