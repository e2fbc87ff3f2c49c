"""Costs of the generated solver tend to the maximum principle's optimum, at least at the order of the scheme.

That is 2 at most, because controls that are constant on each interval, or averaged over it, are no better. Costs may
tend faster: where time reversal maps the problem to itself, odd powers of h cancel in the cost.

The second-order condition: a solution is a minimum, and no saddle point, where the KKT matrix has the right inertia. At
a strict local minimum the Hessian of the Lagrangian is positive definite on the null space of the equations, and then
the KKT matrix has exactly one negative eigenvalue for every equation (Nocedal and Wright, 2006, theorem 16.3). An
unknown at its bound is held there by a multiplier z, which adds z / distance to the diagonal.

Sensitivities of a solution against central differences of the problem solved again, with other data. All quantities
change at once, in proportions drawn at random: first by themselves, then parameters alone, which boundary values and
the duration follow. Where that leaves no solution, as beyond the range of a table or a bound on a prescribed value,
those that cannot change even alone stay as they are, and are named. Differences with three lengths, halved each time,
are extrapolated twice (Richardson): the two results differ by what the reference may be off.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import LinearOperator, onenormest, splu

from codegen.batch.request import Quantity, given_to, quantities
from codegen.discretise.program import ControlProgram
from codegen.errors import CodegenError
from codegen.evidence.analysis.maximum_principle import beyond_maximum_principle, exact_optimum, reference_optimum
from codegen.evidence.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.runtime.search import callbacks
from codegen.runtime.search.linear_system import allocate_system, factor_kkt

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
    if module.metadata.inequalities:
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
    if not module.metadata.inequalities:
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


_NAME = "sensitivities"
_LENGTHS = (1e-2, 1e-3, 1e-4)
"""Of changes to both sides, in parts of quantities."""
_SENSITIVITY_ALLOWED, _ROUGH = 1e-6, 1e-5
"""Parts of the largest entry that differences may be; and that references may be off, beyond which they say nothing."""
_KINK = 1e-3
"""Parts of a derivative by which those to both sides differ where there is none."""
_FLOOR = 1e-3
"""Parts of the largest value below which its derivatives are compared as if they were that large."""
_KINDS = ("cost", "q", "u", "multipliers")
_TOLERANCES = (1e-12, 1e-10)


@dataclass(frozen=True)
class _Direction:
    """Quantities that change, their values, and by how much they do."""

    subject: str
    varied: tuple[Quantity, ...]
    values: tuple[Any, ...]
    changes: Any
    given: tuple[str, ...]


def check_sensitivities(context: Context) -> Iterator[Finding]:
    """Compare along two directions."""
    module, solution = context.module, context.solution
    if module.metadata.sensitivities is None:
        yield does_not_apply(_NAME, "the module has none, unless it is built with --sensitivities")
        return
    subject = f"solution on {solution.t.size - 1} intervals"
    if solution.status != "solved":
        yield not_measured(_NAME, subject, solution.message)
        return
    steps = (solution.t.size - 1) // max(1, len(context.control.phases))
    solution = _solved(module, steps, {}, solution.unknowns) or solution
    for direction in _directions(module, module.make_grid(steps)):
        yield _compared(module, steps, solution, direction)


def _directions(module: Any, grid: Any) -> Iterator[_Direction]:
    """Changes of everything by itself, and of parameters, which all else follows."""
    names, count = module.QUANTITIES, len(module.metadata.parameters)
    values = (*grid.parameters[:, : module.OWN_QUANTITIES].T, grid.steps * grid.h)[: len(names)]
    own = tuple(v if i >= count else float(np.max(v)) for i, v in enumerate(values))
    sizes = np.array([max(float(np.abs(value).max()), 0.1) for value in own])
    signs = np.random.default_rng(11).uniform(0.3, 1.0, len(names)) * np.where(np.arange(len(names)) % 2, 1.0, -1.0)
    known = quantities(names, module, ())
    given = tuple(names[count:])
    yield _Direction("all quantities by themselves", known, own, sizes * signs, given)
    if given and count:
        yield _Direction("parameters, which others follow", known[:count], own[:count], (sizes * signs)[:count], ())


def _compared(module: Any, steps: int, solution: Any, direction: _Direction) -> Finding:
    grid, subject = module.make_grid(steps), f"{direction.subject}, {steps} intervals"
    found = module.sensitivities(grid, solution.unknowns, direction.given)
    if found.failure:
        return not_measured(_NAME, subject, found.failure)
    if found.doubtful.size:
        return not_measured(_NAME, subject, f"strict complementarity fails for {found.doubtful.size} unknowns")
    direction, references, left_out = _references(module, steps, solution, direction)
    if not references:
        return not_measured(_NAME, subject, f"the problem beside the solution is not solved{left_out}")
    subject += left_out
    pairs = [pair[:2] for pair in references]
    if any(_bends(references, kind, _array(solution, kind)) for kind in _KINDS):
        return not_measured(_NAME, subject, "derivatives to both sides differ, as where bounds begin to hold")
    said = _along(module, grid, solution, found, direction)
    worst, beyond, rough, of = 0.0, 0.0, 0.0, ""
    for kind in _KINDS:
        at = np.asarray(getattr(solution, kind), dtype=float)
        if not at.size:
            continue
        floor = _FLOOR * float(np.abs(at).max())
        errors = []
        for coarse, fine in pairs:
            scale = max(float(np.abs(fine[kind]).max()), floor, 1e-300)
            noise = float(np.abs(fine[kind] - coarse[kind]).max()) / scale
            errors.append((noise, float(np.abs(said[kind] - fine[kind]).max()) / scale))
        noise, error = min(errors)
        rough = max(rough, noise)
        worst = max(worst, error)
        if not error - 10.0 * noise <= max(beyond, _SENSITIVITY_ALLOWED):
            beyond, of = error - 10.0 * noise, kind
    if rough > _ROUGH:
        return not_measured(_NAME, subject, f"differences do not converge, only to {rough:.0e}, as where bounds change")
    detail = f"differ by at most {worst:.1e} from central differences, which are good to {rough:.0e}"
    return Finding(_NAME, subject, not of, f"those of {of} {detail}" if of else detail)


def _along(module: Any, grid: Any, solution: Any, found: Any, direction: _Direction) -> dict[str, Any]:
    """The derivatives along a direction by those that were found."""
    total: dict[str, Any] = dict.fromkeys(_KINDS, 0.0)
    for quantity, change in zip(direction.varied, direction.changes, strict=True):
        i = module.QUANTITIES.index(quantity.name)
        _, q, _, u, multipliers = module.unpacked_rates(grid, solution.unknowns, found, i)
        for kind, own in (("cost", found.cost[i]), ("q", q), ("u", u), ("multipliers", multipliers)):
            total[kind] = total[kind] + change * own
    return total


def _references(
    module: Any, steps: int, solution: Any, direction: _Direction
) -> tuple[_Direction, list[tuple[dict[str, Any], ...]], str]:
    """The direction along which there are references of all lengths, these, and words for what it leaves out.

    There are none where the problem is not solved beside the solution, though every quantity can change alone.
    """
    found = [_reference(module, steps, solution, direction, length) for length in _LENGTHS]
    references = [pair for pair in found if pair is not None]
    if len(references) == len(found):
        return direction, references, ""
    count = len(direction.varied)
    can = np.array([_can_change(module, steps, solution, direction, np.arange(count) == i) for i in range(count)])
    if can.all() or not can.any():
        return direction, [], ""
    left_out = ", ".join(direction.varied[i].name for i in np.flatnonzero(~can))
    direction = _part(direction, can)
    found = [_reference(module, steps, solution, direction, length) for length in _LENGTHS]
    references = [pair for pair in found if pair is not None]
    return direction, references if len(references) == len(found) else [], f", without {left_out}"


def _can_change(module: Any, steps: int, solution: Any, direction: _Direction, which: Any) -> bool:
    """Whether there are solutions to both sides of some quantities' values, as far as the longest differences go."""
    alone = _part(direction, which)
    return all(_moved(module, steps, solution, alone, side * _LENGTHS[0]) is not None for side in (1, -1))


def _part(direction: _Direction, which: Any) -> _Direction:
    return replace(direction, changes=np.where(which, direction.changes, 0.0))


def _reference(
    module: Any, steps: int, solution: Any, direction: _Direction, length: float
) -> tuple[dict[str, Any], ...] | None:
    """Extrapolated differences with a length and its half, with its half and quarter, and what both sides differ by."""
    differences, bend = [], dict[str, Any]()
    for part in (length, 0.5 * length, 0.25 * length):
        ends = [_moved(module, steps, solution, direction, side * part) for side in (1, -1)]
        if ends[0] is None or ends[1] is None:
            return None
        above, below = ends
        if part == length:
            for kind in _KINDS:
                sides = _array(above, kind) + _array(below, kind) - 2.0 * _array(solution, kind)
                bend[kind] = float(np.abs(sides).max(initial=0.0)) / length
        differences.append({kind: (_array(above, kind) - _array(below, kind)) / (2 * part) for kind in _KINDS})
    return _extrapolated(differences[:2]), _extrapolated(differences[1:]), bend


def _extrapolated(differences: Sequence[dict[str, Any]]) -> dict[str, Any]:
    coarse, fine = differences
    return {kind: (4.0 * fine[kind] - coarse[kind]) / 3.0 for kind in _KINDS}


def _bends(references: Sequence[tuple[dict[str, Any], ...]], kind: str, values: Any) -> bool:
    """Whether derivatives to both sides differ by more than curvature makes them, which is in proportion to lengths."""
    _, _, longer = references[-2]
    _, fine, bend = references[-1]
    largest = max(float(np.abs(fine[kind]).max(initial=0.0)), _FLOOR * float(np.abs(values).max(initial=0.0)))
    return bool(bend[kind] > max(0.3 * longer[kind], _KINK * largest))


def _array(solution: Any, kind: str) -> Any:
    return np.asarray(getattr(solution, kind), dtype=float)


def _moved(module: Any, steps: int, solution: Any, direction: _Direction, part: float) -> Any:
    """The solution with other data, or None."""
    moved = zip(direction.varied, direction.values, direction.changes, strict=True)
    return _solved(module, steps, given_to({q: v + part * change for q, v, change in moved}), solution.unknowns)


def _solved(module: Any, steps: int, values: dict[str, Any], start: Any) -> Any:
    """What is found near a solution, to the least tolerance that is reached; None where none is."""
    for tolerance in _TOLERANCES:
        found = module.solve(steps, **values, guess=start, warm=True, tolerance=tolerance)
        if found.status == "solved":
            return found
    return None
