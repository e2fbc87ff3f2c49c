"""Smooth problems in dymos: Radau collocation of an OpenMDAO component with exact partial derivatives, SLSQP of scipy.

dymos's faster optimisers, IPOPT and SNOPT, need pyoptsparse, which no package index offers.
"""

from __future__ import annotations

import warnings
from typing import Any

import dymos
import numpy as np
import openmdao.api as om
import sympy

from .casadi_shooting import Array
from .gallery_problem import GalleryProblem

warnings.filterwarnings("ignore", category=om.OpenMDAOWarning)  # quantities have no units


class Dynamics(om.ExplicitComponent):
    """Rates of all states, and of the integral of the cost, at all nodes; derived by sympy."""

    def initialize(self) -> None:
        """Declare the number of nodes and the problem."""
        self.options.declare("num_nodes", types=int)
        self.options.declare("problem", types=GalleryProblem)

    def setup(self) -> None:
        """Declare inputs x, u, outputs and the sparse derivatives."""
        problem, nodes = self.options["problem"], self.options["num_nodes"]
        n, m = problem.dimension, problem.controls
        self.given = [*(f"x{i}" for i in range(n)), *(f"u{i}" for i in range(m))]
        self.rates = [*(f"x{i}_rate" for i in range(n)), "cost_rate"]
        symbols = sympy.symbols(self.given)
        x, u = symbols[:n], symbols[n:]
        formulas = sympy.Matrix([*problem.dynamics(sympy, x, u, 0, []), problem.cost(x, None, u, 0)])
        for name in self.given:
            self.add_input(name, shape=nodes)
        rows = np.arange(nodes)
        self.entries, derivatives = [], []
        jacobian = formulas.jacobian(symbols)
        for i, rate in enumerate(self.rates):
            self.add_output(rate, shape=nodes)
            for j, name in enumerate(self.given):
                if jacobian[i, j] != 0:
                    self.declare_partials(rate, name, rows=rows, cols=rows)
                    self.entries.append((rate, name))
                    derivatives.append(jacobian[i, j])
        self.values = sympy.lambdify(symbols, list(formulas), "numpy", cse=True)
        self.slopes = sympy.lambdify(symbols, derivatives, "numpy", cse=True)

    def compute(self, inputs: Any, outputs: Any) -> None:
        """Evaluate the rates."""
        for rate, value in zip(self.rates, self.values(*(inputs[name] for name in self.given)), strict=True):
            outputs[rate] = value

    def compute_partials(self, inputs: Any, partials: Any) -> None:
        """Evaluate the derivatives."""
        for entry, value in zip(self.entries, self.slopes(*(inputs[name] for name in self.given)), strict=True):
            partials[entry] = value


class PreparedDymos:
    """A problem made ready; `run` solves from the problem's guess."""

    def __init__(self, problem: GalleryProblem, segments: int, order: int, tolerance: float) -> None:
        """Set the phase up and solve once, in which OpenMDAO finds the sparsity."""
        self.problem, self.segments = problem, segments
        self.program = om.Problem(model=om.Group(), reports=False)
        driver = om.ScipyOptimizeDriver(optimizer="SLSQP", tol=tolerance, maxiter=500, disp=False)
        driver.declare_coloring(show_summary=False)
        self.program.driver = driver
        phase = dymos.Phase(
            ode_class=Dynamics,
            ode_init_kwargs={"problem": problem},
            transcription=dymos.Radau(num_segments=segments, order=order, compressed=True),
        )
        self.program.model.add_subsystem("trajectory", dymos.Trajectory()).add_phase("phase", phase)
        phase.set_time_options(fix_initial=True, fix_duration=True)
        for i, end in enumerate(problem.end):
            name, is_given = f"x{i}", end is not None
            phase.add_state(name, rate_source=f"{name}_rate", targets=name, fix_initial=True, fix_final=is_given)
        phase.add_state("cost", rate_source="cost_rate", fix_initial=True)
        for i in range(problem.controls):
            phase.add_control(f"u{i}", targets=f"u{i}", continuity=False, rate_continuity=False)
        phase.add_objective("cost", loc="final")
        self.program.setup()
        self.phase = phase
        self.restart()
        self.run()

    def restart(self) -> None:
        """Set the initial guess."""
        first, last = (self.problem.guess(np, s) for s in (0.0, 1.0))
        self.phase.set_time_val(0.0, float(self.problem.duration([])))
        for i, end in enumerate(self.problem.end):
            values = [self.problem.start[i], last[0][i] if end is None else end]
            self.phase.set_state_val(f"x{i}", values)
        self.phase.set_state_val("cost", [0.0, 1.0])
        for i, values in enumerate(zip(first[1], last[1], strict=True)):
            self.phase.set_control_val(f"u{i}", list(values))

    def run(self) -> None:
        """Solve."""
        self.result = self.program.run_driver()

    @property
    def is_solved(self) -> bool:
        """True if SLSQP claims success."""
        return bool(self.result.success)

    @property
    def iterations(self) -> int:
        """Iterations of SLSQP."""
        return int(self.program.driver.iter_count)

    @property
    def cost(self) -> float:
        """The cost."""
        return float(self._series("cost")[-1])

    def states(self) -> Array:
        """States (segments + 1, n) at the ends of segments."""
        at = self._ends()
        return np.column_stack([self._series(f"x{i}")[at] for i in range(self.problem.dimension)])

    def controls(self) -> tuple[Array, Array]:
        """Times and values of the controls at the collocation points."""
        times = self._series("time")
        values = np.column_stack([self._series(f"u{i}") for i in range(self.problem.controls)])
        # The last point of a segment has no equation; its control follows from the polynomial.
        inner = np.append(np.diff(times) > 0.0, False)
        return times[inner], values[inner]

    def _series(self, name: str) -> Array:
        return np.asarray(self.program.get_val(f"trajectory.phase.timeseries.{name}"))[:, 0]

    def _ends(self) -> Array:
        ends = np.linspace(0.0, float(self.problem.duration([])), self.segments + 1)
        return np.abs(self._series("time")[None, :] - ends[:, None]).argmin(axis=1)
