"""The message on how a search has ended: status, row and location of the worst equation, and a remedy."""

import numpy as np

from codegen.runtime.record import phrase
from codegen.runtime.search.bounds import (
    HOLDS,
    at_bounds,
    bounds_of,
    contradictory_bounds,
    prescribed_beyond,
    units_of,
    with_violations,
)
from codegen.runtime.search.curvature import negative_curvature_direction
from codegen.runtime.search.grid import least_duration, multiplier_unknowns, node_times, plain_grid, primal_unknowns
from codegen.runtime.search.point import fill, hessian, interval_parts, jacobian
from codegen.runtime.search.termination import GROWTH

OUTSIDE_TABLE = "outside a table"  # the status of an optimum that uses values outside the range of a table
TABLE_MARGIN = 1e-8  # an input outside by at most this part of the range is a rounding error
REMEDIES = {
    "iteration limit": "raise max_iterations, or start from a better guess",
    "time limit": "raise time_limit, take fewer steps, or start from a better guess",
    "non-finite": "change the guess or the parameters, or keep away from there by bounds",
    "rank-deficient": "leave out a condition that follows from others, give every control a cost; run codegen check",
    "saddle point": "this point is stationary, but no minimum; start from another guess",
    "unbounded": "nothing stops it; check the sign of a cost, add bounds, or start from a better guess",
    "stalled": "no step makes progress; start from a better guess, loosen the tolerance or rescale the problem",
    "infeasible": "nothing nearby satisfies the equations; relax a condition or bound, change the duration or the"
    " steps, or start from another guess",
    OUTSIDE_TABLE: "keep it inside by bounds or the guess, or give the table outside='clamp' or 'extend'",
}
LONGEST = 80  # largest number of characters of a condition that a message quotes
NAMED = 3  # largest number of equations that a message names


def describe(grid, guess, point, status):
    """Return the final status, and a message on it; `guess` and `point` are in the problem's own units."""
    if grid.problem.variable_bounds is not None:
        violation = prescribed_beyond(grid, point.unknowns)
        if violation:
            return "infeasible", f"infeasible: {violation}; change the value or the bound"
        index = contradictory_bounds(grid) if status != "solved" else -1
        if index >= 0:
            least, greatest = (float(bound[index] * units_of(grid)[index]) for bound in bounds_of(grid))
            name = unknown_name(grid, point.unknowns, index)
            limits = f"at least {least:g} and at most {greatest:g}"
            return "infeasible", f"infeasible: {name} is to be {limits}; change one of the bounds"
    if grid.problem.inputs is not None and status == "solved":
        excess = tables_beyond(grid, point.unknowns)
        if excess:
            return OUTSIDE_TABLE, f"{OUTSIDE_TABLE}: {excess}; {REMEDIES[OUTSIDE_TABLE]}"
    if status == "solved":
        return status, solved_message(point.residual, point.stationarity)
    if grid.sizes.size:
        grid = plain_grid(grid)
    if grid.problem.structure.slacks.size:
        point = with_violations(grid, point)
    return status, f"{status}: {finding(grid, guess, point, status)}; {REMEDIES[status]}"


def solved_message(residual, stationarity):
    """Return the message on a solution with these norms."""
    return f"all equations hold to {residual:.1e}, optimality conditions to {stationarity:.1e}"


def reached(point):
    """Return a text on the accuracy of the equations and of the optimality conditions at a point."""
    return f"equations hold to {point.residual:.1e}, optimality conditions to {point.stationarity:.1e}"


def tables_beyond(grid, unknowns):
    """Return a text on the table input that is farthest outside its range at an optimum, or "" if all are inside.

    The text has the value, the node or interval, and the range. The loop `inputs` fills (bodies, N + 2, inputs, 2): the
    least and the greatest values of all inputs at the start, on all intervals, and at the end. `unknowns` are in the
    problem's own units.
    """
    problem = grid.problem
    s, ranges = problem.structure, np.asarray(problem.ranges)
    inputs = np.empty((s.bodies, grid.steps + 2, 2 * len(ranges)))
    fill(problem.inputs.address, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, inputs.reshape(-1))
    inputs = inputs.reshape(s.bodies, grid.steps + 2, len(ranges), 2)
    ends = grid.parameters[:, ranges][:, None]
    excess = np.maximum(ends[..., 0] - inputs[..., 0], inputs[..., 1] - ends[..., 1]) / (ends[..., 1] - ends[..., 0])
    body, k, j = np.unravel_index(int(np.argmax(excess)), excess.shape)
    if not excess[body, k, j] > TABLE_MARGIN:
        return ""
    least, greatest = ends[body, 0, j]
    low, high = inputs[body, k, j]
    value, k = low if least - low >= high - greatest else high, k - 1
    node = min(max(k, 0), grid.steps)
    where = f"on interval {k}" if 0 <= k < grid.steps else f"at node {node}"
    at = f"(t = {max(0.0, node_time(grid, unknowns, node)):.3g}){of_body(grid, body)}"
    return f"{problem.range_names[j]} is {value:g} {where} {at}, outside {least:g} to {greatest:g}"


def finding(grid, guess, point, status):
    """Return a text on the reason of a status, with the names of the author."""
    if status == "non-finite":
        return not_finite(grid, point) if np.isfinite(guess).all() else guess_not_finite(grid, guess)
    if status == "infeasible" or (status == "rank-deficient" and point.residual > HOLDS):
        return violated(grid, point)
    if status == "rank-deficient":
        return dependent(grid, point)
    if status == "saddle point":
        return f"the cost falls along {negative_curvature_unknown(grid, point)}"
    if status == "unbounded":
        return diverging_unknown(grid, guess, point)
    if status == "time limit":
        return f"{reached(point)} so far; {worst_row(grid, point)}"
    return worst_row(grid, point)


def worst_row(grid, point):
    """Return a text on the equation with the largest residual.

    If all equations hold, the text is on the largest entry of the stationarity.
    """
    size = np.where(grid.is_multiplier == (point.residual > HOLDS), np.abs(point.gradient), -1.0)
    return row_text(grid, point, int(np.argmax(size)))


def row_text(grid, point, index):
    """Return the name and the value of one row of the optimality conditions."""
    value = point.gradient[index]
    if grid.is_multiplier[index]:
        return f"{equation_name(grid, point.unknowns, index)} is off by {value:.1e}"
    return f"the derivative of the Lagrangian by {unknown_name(grid, point.unknowns, index)} is {value:.1e}"


def violated(grid, point):
    """Return a text on the equations with the largest residuals, and on active bounds.

    The text names each equation once, where its residual is largest.
    """
    rows, columns = multiplier_unknowns(grid), primal_unknowns(grid)
    text = ", ".join(row_text(grid, point, index) for index in largest_by_name(grid, point.gradient, rows))
    if grid.problem.variable_bounds is not None:
        names, metadata = {}, grid.problem.metadata
        for index in columns[at_bounds(grid, point.unknowns)[columns]]:
            name = local_name(grid, index)
            meaning = metadata.meanings.get(name)
            names[name if meaning is None else phrase(meaning, role=False, where="", longest=LONGEST)] = None
        if names:
            text += f", with bounds active on {', '.join(names)}"
    if rows.size > columns.size:
        text += f"; there are {rows.size} equations for {columns.size} unknowns"
    return text


def dependent(grid, point):
    """Return a text on the equations with the largest multipliers, or on other reasons of a singular KKT matrix."""
    rows, columns = multiplier_unknowns(grid), primal_unknowns(grid)
    indices = largest_by_name(grid, point.unknowns, rows)
    if indices and abs(point.unknowns[indices[0]]) > 1e3:
        names = " and ".join(equation_name(grid, point.unknowns, index) for index in indices)
        return f"equations depend on each other, or have no slope where they hold: {names}"
    if rows.size > columns.size:
        return f"there are {rows.size} equations for {columns.size} unknowns"
    name = negative_curvature_unknown(grid, point)
    return f"the cost does not change along {name}, so that its least value is not unique"


def largest_by_name(grid, values, rows):
    """Return the indices of the largest values among `rows`, at most NAMED, with one index for each name.

    Values below a thousandth of the largest are left out. Values that differ from the largest by less than a thousandth
    keep their order.
    """
    size, indices = np.abs(values[rows]), {}
    order = rows[np.argsort(-np.minimum(size, 0.999 * size.max(initial=0.0)), kind="stable")]
    for index in order:
        if abs(values[index]) < 1e-3 * abs(values[order[0]]) or len(indices) == NAMED:
            break
        indices.setdefault(local_name(grid, index), int(index))
    return list(indices.values())


def diverging_unknown(grid, guess, point):
    """Return a text on the reason why a problem is unbounded.

    The reason is a duration that is not positive, the unknown that has grown most, or the unknown along which the cost
    falls without limit.
    """
    if grid.problem.structure.shared and not least_duration(grid, point.unknowns) > 0.0:
        return f"a duration has become {least_duration(grid, point.unknowns):.1e}, and needs a lower bound"
    growth = np.where(grid.is_multiplier, 0.0, np.abs(point.unknowns) / np.maximum(1.0, np.abs(guess)))
    shared = growth.size - grid.problem.structure.root
    index = int(np.argmax(growth))
    if growth[shared:].max(initial=0.0) > GROWTH:
        index = shared + int(np.argmax(growth[shared:]))
    if growth[index] > GROWTH:
        return f"{unknown_name(grid, point.unknowns, index)} has grown to {point.unknowns[index]:.1e}"
    return f"the cost falls for ever along {negative_curvature_unknown(grid, point)}"


def negative_curvature_unknown(grid, point):
    """Return the name of the unknown that changes most along the direction of most negative curvature."""
    direction = np.where(grid.is_multiplier, 0.0, negative_curvature_direction(grid, point.unknowns))
    return unknown_name(grid, point.unknowns, int(np.argmax(np.abs(direction))))


def guess_not_finite(grid, guess):
    """Return a text on the first unknown whose initial guess is infinite or NaN."""
    index = int(np.flatnonzero(~np.isfinite(guess))[0])
    return f"the initial guess of {unknown_name(grid, guess, index)} is {guess[index]}"


def not_finite(grid, point):
    """Return a text on the first derivative or cost that is infinite or NaN, and on the kernel that computes it."""
    s = grid.problem.structure
    bad = np.flatnonzero(~np.isfinite(point.gradient))
    if bad.size:
        index, chain = int(bad[0]), grid.steps * s.stride + s.node
        text = f"the derivative of the Lagrangian by {unknown_name(grid, point.unknowns, index)}"
        if grid.is_multiplier[index]:
            text = equation_name(grid, point.unknowns, index)
        # The kernels that contribute to the row.
        local, kernel = index % chain, "interval_gradient"
        if index >= grid.is_multiplier.size - s.couplings:
            kernel = "coupling_term"
        elif index < s.bodies * chain and not s.node <= local < chain - s.node:
            kernel = f"interval_gradient or {'start' if local < s.node else 'end'}_gradient"
        return f"{text} is {point.gradient[index]} (kernel {kernel})"
    if not np.isfinite(point.cost):
        costs = interval_parts(grid, point.unknowns)[..., -1]
        bad = np.argwhere(~np.isfinite(costs))
        if bad.size:
            body, k = bad[0]
            where = f"interval {k}{of_body(grid, body)}"
            return f"the cost is {costs[body, k]} on {where} (kernel interval_gradient)"
        return f"the cost is {point.cost} at the end (kernel end_gradient)"
    for entries, rows in ((hessian, primal_unknowns(grid)), (jacobian, multiplier_unknowns(grid))):
        row, _, values = entries(grid, point.unknowns)
        bad = row[~np.isfinite(values)]
        if bad.size:
            name = unknown_name(grid, point.unknowns, int(rows[bad[0]]))
            return f"a second derivative by {name} is not finite (kernel interval_hessian)"
    return worst_row(grid, point)


def unknown_name(grid, unknowns, index):
    """Return the name and the location of an unknown, as in `r at node 3 (t = 0.2)`.

    A slack is named by its condition.
    """
    name, metadata = local_name(grid, index), grid.problem.metadata
    where = whereabouts(grid, unknowns, index)
    if metadata.is_slack(name):
        return f"the {phrase(metadata.meanings[name], where=where, longest=LONGEST)}"
    return f"{name}{where}"


def equation_name(grid, unknowns, index):
    """Return the name of an equation and its location, as in `x + v <= 1 at 1/2 of interval 3 (t = 0.2)`."""
    name, where = local_name(grid, index), whereabouts(grid, unknowns, index)
    meaning = grid.problem.metadata.meanings.get(name)
    return f"{name}{where}" if meaning is None else phrase(meaning, role=False, where=where, longest=LONGEST)


def local_name(grid, index):
    """Return the name of an unknown without its location; the name of a linking variable includes its body."""
    s, metadata = grid.problem.structure, grid.problem.metadata
    chain = grid.steps * s.stride + s.node
    if index >= s.bodies * chain:
        return metadata.shared[index - s.bodies * chain]
    return (*metadata.node, *metadata.interval)[index % chain % s.stride]


def whereabouts(grid, unknowns, index):
    """Return a text on the node or interval, the time and the body of an unknown; "" for a linking variable."""
    s = grid.problem.structure
    chain = grid.steps * s.stride + s.node
    if index >= s.bodies * chain:
        return ""
    body, (k, local) = index // chain, divmod(index % chain, s.stride)
    kind = "at node" if local < s.node else "on interval"
    return f" {kind} {k} (t = {node_time(grid, unknowns, k):.3g}){of_body(grid, body)}"


def node_time(grid, unknowns, k):
    """Return the time of node k."""
    if grid.problem.structure.phases:
        return node_times(grid, unknowns)[k]
    return grid.problem.duration_of(grid, unknowns) * grid.nodes[k] / grid.steps


def of_body(grid, body):
    """Return ` of body 2`, for example, or "" for a problem with one body."""
    return f" of body {body}" if grid.problem.structure.bodies > 1 else ""
