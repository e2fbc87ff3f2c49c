"""Costs of the generated solver tend to the maximum principle's optimum, at least at the order of the scheme.

That is 2 at most, because controls that are constant on each interval, or averaged over it, are no better. Costs may
tend faster: where time reversal maps the problem to itself, odd powers of h cancel in the cost.

The second-order condition: a solution is a minimum, and no saddle point, where the KKT matrix has the right inertia.

At a strict local minimum the Hessian of the Lagrangian is positive definite on the null space of the equations, and
then the KKT matrix has exactly one negative eigenvalue for every equation (Nocedal and Wright, 2006, theorem 16.3). An
unknown at its bound is held there by a multiplier z, which adds z / distance to the diagonal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import LinearOperator, onenormest, splu

from codegen.analysis.maximum_principle import beyond_maximum_principle, exact_optimum
from codegen.analysis.reference_optimum import reference_optimum
from codegen.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.errors import CodegenError
from codegen.runtime.search import callbacks
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.transcribe.program import ControlProgram

_OF_CONTROLS = 2
"""The order of piecewise constant controls."""
_ALLOWED = 0.15
_ROUND_OFF = 1e-9
_LARGEST = 10_000
_TOLERANCE = 1e-9
_SECONDS = 30.0
"""Processor time for the optimum of the continuous problem."""


def check_optimum(context: Context) -> Iterator[Finding]:
    """Solve on N, 2N and 4N intervals, more if need be, and compare with the optimum of the continuous problem."""
    reason = beyond_maximum_principle(context.model)
    if reason:
        yield does_not_apply(
            "optimum", f"the maximum principle is derived here for plain problems, this one has {reason}"
        )
        return
    try:
        cost, source = optimal_cost(context)
    except CodegenError as error:
        yield not_measured("optimum", "convergence to the optimum", " ".join(str(error).split()))
        return
    yield _convergence(context, cost, source)


def optimal_cost(context: Context) -> tuple[float, str]:
    """The cost of the continuous optimum and where it comes from: in closed form, or by collocation nearby.

    Collocation starts from the discrete motion, so that it ends in the same one of several local optima, unless that
    motion cannot be trusted, as with controls on nodes.
    """
    model, solution = context.model, context.solution
    exact = exact_optimum(model)
    if exact is not None:
        return exact.cost_at(), "in closed form"
    guess = None
    if solution.status == "solved" and context.choices.controls == "interval":
        rates = solution.p if model.form == "hamiltonian" else np.gradient(solution.q, solution.t, axis=0)
        states = np.hstack([solution.q, rates])
        guess = solution.t, states, np.zeros_like(states)
    return reference_optimum(model, tolerance=_TOLERANCE, guess=guess, seconds=_SECONDS).cost, "by collocation"


def _convergence(context: Context, optimum: float, source: str) -> Finding:
    order, steps = min(context.scheme.order, _OF_CONTROLS), context.model.steps
    subject = "convergence to the optimum"
    errors: list[tuple[int, float]] = []
    while steps <= _LARGEST or len(errors) < 3:
        solution = context.module.solve(steps)
        if solution.status != "solved":
            return not_measured("optimum", subject, f"N = {steps}: {solution.message}")
        errors.append((steps, abs(solution.cost - optimum)))
        steps *= 2
        if len(errors) >= 3:
            rate = _rate(errors)
            if rate > order - _ALLOWED or errors[-1][1] < _ROUND_OFF * max(1.0, abs(optimum)):
                break
    listed = ", ".join(f"{error:.3g} (N = {n})" for n, error in errors[-3:])
    rate = _rate(errors)
    passed = rate > order - _ALLOWED or errors[-1][1] < _ROUND_OFF * max(1.0, abs(optimum))
    detail = f"J* = {optimum:.12g} {source}; errors {listed}; order {rate:.2f}, {order} is expected"
    return Finding("optimum", subject, passed, detail)


def _rate(errors: list[tuple[int, float]]) -> float:
    """The observed order from the two finest grids."""
    (_, coarse), (_, fine) = errors[-2:]
    return math.log2(coarse / fine) if coarse > 0.0 and fine > 0.0 else math.inf


_NOTHING = (1e-9, 1e-8, 1e-7)
"""Parts of the second derivatives below which a curvature may be rounding of the elimination."""
_HELD, _FAST = 1.0, 1e12
"""From the first on z / distance counts as holding an unknown (inside the bounds it is as small as the tolerance); no
more than the second is needed to hold it fast, and it would be infinite on the bound itself."""
_REGULAR = 1e13
"""Condition numbers below it are those of regular matrices."""


def check_second_order(context: Context) -> Iterator[Finding]:
    """Count the negative eigenvalues at the solution by a symmetric elimination, which is exact."""
    module, solution = context.module, context.solution
    subject = f"solution on {solution.t.size - 1} intervals"
    if solution.status != "solved":
        yield not_measured("second-order condition", subject, solution.message)
        return
    grid = module.make_grid((solution.t.size - 1) // max(1, len(context.control.phases)))
    diagonal = held_by_bounds(module, grid, solution.unknowns)
    sizes = sizes_of_curvature(module, grid, solution.unknowns)
    sizes[slacks(context.control, module, grid)] = 0.0  # they follow from other unknowns
    judged = _judged(module, grid, solution.unknowns, diagonal, sizes)
    if judged is None and is_determined(module, grid, solution.unknowns, diagonal):
        yield does_not_apply("second-order condition", "the equations alone determine the solution, whatever it costs")
        return
    if judged is None:
        yield not_measured("second-order condition", subject, "equations depend on each other at the solution")
        return
    passed, detail = judged
    if module.metadata["inequalities"]:
        detail += f" ({np.count_nonzero(diagonal > _HELD)} unknowns are held by bounds)"
    yield Finding("second-order condition", subject, passed, detail)


def is_determined(module: Any, grid: Any, unknowns: NDArray[np.float64], diagonal: NDArray[np.float64]) -> bool:
    """Whether there are as many equations as unknowns that no bound holds, and their Jacobian is regular.

    Regular to rounding, that is, after rows and columns are brought to sizes of one.
    """
    free = diagonal[module.primal_unknowns(grid)] <= _HELD
    rows, columns, values = callbacks.jacobian(grid, unknowns)
    shape = (module.multiplier_unknowns(grid).size, free.size)
    matrix = coo_array((values, (rows, columns)), shape=shape).tocsc()[:, free]
    if matrix.shape[0] != matrix.shape[1]:
        return False
    for axis in (1, 0):  # rows, then columns
        largest = abs(matrix).max(axis=axis).toarray()
        if not largest.all():
            return False
        matrix = matrix.multiply(1.0 / (largest[:, None] if axis == 1 else largest)).tocsc()
    try:
        factors = splu(matrix)
    except RuntimeError:  # exactly singular
        return False
    inverse = LinearOperator(matrix.shape, factors.solve, rmatvec=lambda vector: factors.solve(vector, "T"))
    return bool(onenormest(matrix) * onenormest(inverse) < _REGULAR)


def held_by_bounds(module: Any, grid: Any, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The diagonal z / distance of the unknowns that push against a bound; z is the gradient of the Lagrangian."""
    diagonal = np.zeros(unknowns.size)
    if not module.metadata["inequalities"]:
        return diagonal
    gradient = np.where(grid.is_multiplier, 0.0, module.evaluate(grid, unknowns).gradient)
    lower, upper = module.variable_bounds(grid)
    for z, distance in ((gradient, unknowns - lower), (-gradient, upper - unknowns)):
        pushes = np.isfinite(distance) & (z > 0.0)
        diagonal[pushes] += np.minimum(z[pushes] / np.maximum(distance[pushes], 1e-100), _FAST)
    return diagonal


def slacks(program: ControlProgram, module: Any, grid: Any) -> NDArray[np.bool_]:
    """Which unknowns of nodes and intervals are slacks of inequalities."""
    marked = np.zeros(grid.is_multiplier.size)
    nodes, intervals = module.views(grid, marked)
    of_interval = intervals.shape[2] - len(program.slacks)
    intervals[:, :, of_interval:] = 1.0
    for end in (program.start, program.end):
        nodes[:, :, [slack for slack, _ in end.slacks]] = 1.0
    return marked > 0.0


def _judged(
    module: Any, grid: Any, unknowns: NDArray[np.float64], diagonal: NDArray[np.float64], sizes: NDArray[np.float64]
) -> tuple[bool, str] | None:
    """Whether it is a minimum, and how that is known; None where the KKT matrix is singular whatever the curvature."""
    equations, system = module.multiplier_unknowns(grid).size, allocate_system(grid)
    excess = factor_kkt(grid, unknowns, 1.0, diagonal, system)
    if excess == 0 and factor_kkt(grid, unknowns, 1.0, diagonal - _NOTHING[0] * sizes, system) == 0:
        return True, f"a strict local minimum: {equations} negative eigenvalues for {equations} equations"
    # Where a symmetry moves an optimum to another one, the curvature is zero along it, and its sign is rounding.
    for part in _NOTHING:
        if factor_kkt(grid, unknowns, 1.0, diagonal + part * sizes, system) == 0:
            return (
                True,
                f"a minimum, isolated or not: a curvature is zero up to rounding, above -{part:g} of its terms",
            )
    if excess is not None and excess > 0:
        return False, f"no minimum: the cost decreases to second order in {excess} or more independent directions"
    return None


def sizes_of_curvature(module: Any, grid: Any, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
    """For every unknown but multipliers the size of its second derivatives, or of a typical one if it has none."""
    rows, _, values = callbacks.hessian(grid, unknowns)
    free, sizes = module.primal_unknowns(grid), np.zeros(unknowns.size)
    np.maximum.at(sizes, free[rows], np.abs(values))
    present = sizes[sizes > 0.0]
    sizes[free[sizes[free] == 0.0]] = np.median(present) if present.size else 1.0
    return sizes
