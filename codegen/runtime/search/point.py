"""Evaluation of the discretised problem at a vector of unknowns: cost, residuals, norms, momenta, sparse derivatives.

Sparse derivatives are tuples (rows, columns, values). Their rows and columns belong to the free primal unknowns, or to
the free multipliers. `primal_unknowns` and `multiplier_unknowns` are the indices of these among all unknowns. An
unknown that a boundary condition prescribes is not free and has no row or column.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.addresses import call_loop
from codegen.runtime.search.grid import multiplier_unknowns, primal_unknowns, views
from codegen.runtime.search.linear_system import allocate_system, filled_entries


class Point(NamedTuple):
    """The values of cost, gradient and norms at a vector of unknowns.

    Attributes
    ----------
    unknowns, gradient : (n,)
        All unknowns, and the gradient of the Lagrangian with respect to them. Its entries for multipliers are the
        residuals.
    cost : float
        The discrete cost.
    residual, violation : float
        The largest modulus of a residual, and the sum of the moduli of all residuals.
    stationarity : float
        The largest modulus of the gradient with respect to a primal unknown.
    error : float
        The larger of residual and stationarity, infinite if the cost is not finite.
    """

    unknowns: np.ndarray
    gradient: np.ndarray
    cost: float
    residual: float
    violation: float
    stationarity: float
    error: float


def evaluate(grid, unknowns):
    """Return the Point at `unknowns` (n,)."""
    steps, h, nodes, _, parameters, is_multiplier, sizes, _, weight, _, _, problem = grid
    gradient, scaled = np.empty(unknowns.size), np.empty(sizes.size)
    measured = measured_gradient(
        problem.gradient.address, unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, scaled, gradient
    )
    return Point(unknowns, gradient, *measured)


def lagrangian(grid, point):
    """Return the value of the Lagrangian at a point.

    Up to second order, this is the cost at the nearby point where the equations hold exactly.
    """
    return point.cost + np.where(grid.is_multiplier, point.unknowns, 0.0).dot(point.gradient)


@njit(cache=True, error_model="numpy")
def measured_gradient(
    loop, unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, scaled, gradient
):  # fmt: skip
    """Fill the `gradient` (n,) of the Lagrangian; return (cost, residual, violation, stationarity, error) of a Point.

    `loop` is the address of the loop over intervals that fills the gradient. `sizes` and `weight` are the scaling
    factors of unknowns and cost. `scaled` is work space of the length of `sizes`.
    """
    nodes_at, parameters_at, gradient_at = nodes.ctypes.data, parameters.ctypes.data, gradient.ctypes.data
    width = parameters.shape[1]
    if sizes.size:
        for i in range(sizes.size):
            scaled[i] = unknowns[i] * sizes[i]
        cost = call_loop(loop, scaled.ctypes.data, steps, h, nodes_at, parameters_at, width, gradient_at) * weight
        for i in range(gradient.size):
            gradient[i] *= weight * sizes[i]
    else:
        cost = call_loop(loop, unknowns.ctypes.data, steps, h, nodes_at, parameters_at, width, gradient_at)
    residual, violation, stationarity = 0.0, 0.0, 0.0
    for i in range(gradient.size):
        value = abs(gradient[i])
        if not value < np.inf:
            return cost, np.inf, np.inf, np.inf, np.inf
        if is_multiplier[i]:
            violation += value
            residual = max(residual, value)
        else:
            stationarity = max(stationarity, value)
    error = max(residual, stationarity) if abs(cost) < np.inf else np.inf
    return cost, residual, violation, stationarity, error


def interval_parts(grid, unknowns):
    """Return the contribution of each interval to the gradient of the Lagrangian and to the cost.

    The array (bodies, N, element + shared + 1) has the gradient with respect to the unknowns of the interval, both its
    nodes and the linking variables. The cost is the last number. `unknowns` (n,) are in the problem's own units.
    """
    s = grid.problem.structure
    parts = np.empty((s.bodies, grid.steps, s.element + s.shared + 1))
    fill(grid.problem.parts.address, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, parts.reshape(-1))
    return parts


@njit(cache=True, error_model="numpy")
def fill(loop, unknowns, steps, h, nodes, parameters, filled):
    """Call the loop over intervals at the address `loop`, which fills the array `filled`; return the loop's result."""
    return call_loop(
        loop, unknowns.ctypes.data, steps, h, nodes.ctypes.data, parameters.ctypes.data, parameters.shape[1],
        filled.ctypes.data,
    )  # fmt: skip


def discrete_momenta(grid, unknowns):
    """Return the momenta (bodies, N + 1, m) by the forced discrete Legendre transforms.

    The momentum at a node is p_k = -(D1 Ld + f-) of the interval after the node, or D2 Ld + f+ of the last interval.
    The equations of motion are linear in their multipliers. In the contribution of an interval to the Lagrangian, the
    factors of these multipliers are the terms above.

    Contact forces act at nodes. The momentum of an inner node is then the mean of the momenta before and after the
    impulse. At the end it is the momentum after the impulse there; without such an impulse, half of the impulse of the
    last interval is added.
    """
    s = grid.problem.structure
    parts = np.empty((s.bodies, grid.steps, s.element + s.shared + 1))
    momenta = np.empty((s.bodies, grid.steps + 1, s.equations.size))
    fill_momenta(
        grid.problem.parts.address, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, s.equations, s.stride,
        parts, momenta,
    )  # fmt: skip
    metadata = grid.problem.metadata
    if metadata.contact_forces:
        after, without = np.empty_like(momenta), unknowns.copy()
        nodes, intervals = views(grid, without)
        intervals[:, :, [metadata.interval.index(name) for name in metadata.contact_forces]] = 0.0
        fill_momenta(
            grid.problem.parts.address, without, grid.steps, grid.h, grid.nodes, grid.parameters, s.equations,
            s.stride, parts, after,
        )  # fmt: skip
        impulses = after[:, :-1] - momenta[:, :-1]
        momenta[:, 1:-1] += impulses[:, 1:] / 2
        if metadata.end_impulses:
            # The equation of the end node contains the impulse, which is linear in the forces.
            without[:] = unknowns
            nodes[:, -1, [metadata.node.index(name) for name in metadata.end_impulses]] = 0.0
            change = evaluate(grid, unknowns).gradient - evaluate(grid, without).gradient
            momenta[:, -1] += views(grid, change)[0][:, -1, s.equations]
        else:
            momenta[:, -1] += impulses[:, -1] / 2
    return momenta


@njit(cache=True, error_model="numpy")
def fill_momenta(loop, unknowns, steps, h, nodes, parameters, equations, stride, parts, momenta):
    """Fill `momenta` (bodies, N + 1, m), see `discrete_momenta`.

    `loop` is the address of the loop that fills the work space `parts` (bodies, N, element + shared + 1).
    """
    call_loop(
        loop, unknowns.ctypes.data, steps, h, nodes.ctypes.data, parameters.ctypes.data, parameters.shape[1],
        parts.ctypes.data,
    )  # fmt: skip
    for body in range(parts.shape[0]):
        for i in range(equations.size):
            for k in range(steps):
                momenta[body, k, i] = -parts[body, k, equations[i]]
            momenta[body, steps, i] = parts[body, steps - 1, stride + equations[i]]


def cost(grid, unknowns):
    """Return the discrete cost."""
    return evaluate(grid, unknowns).cost


def cost_gradient(grid, unknowns):
    """Return the gradient of the discrete cost with respect to the free primal unknowns."""
    without_multipliers = np.where(grid.is_multiplier, 0.0, unknowns)
    return evaluate(grid, without_multipliers).gradient[primal_unknowns(grid)]


def constraints(grid, unknowns):
    """Return the residuals of all discrete equations that are imposed."""
    return evaluate(grid, unknowns).gradient[multiplier_unknowns(grid)]


def stationarity(grid, unknowns):
    """Return the gradient of the Lagrangian with respect to the free primal unknowns.

    The multipliers are taken from `unknowns` (n,).
    """
    return evaluate(grid, unknowns).gradient[primal_unknowns(grid)]


def jacobian(grid, unknowns):
    """Return the Jacobian of the residuals with respect to the free primal unknowns, as (rows, columns, values)."""
    return submatrix(grid, unknowns, multiplier_unknowns(grid), primal_unknowns(grid), False)


def hessian(grid, unknowns):
    """Return the Hessian of the Lagrangian with respect to the free primal unknowns, as (rows, columns, values).

    Both triangles are included.
    """
    return submatrix(grid, unknowns, primal_unknowns(grid), primal_unknowns(grid), True)


def submatrix(grid, unknowns, rows, columns, is_curvature):
    """Return the part of the KKT matrix with some `rows` and `columns`, as (rows, columns, values).

    Rows and columns of the result are numbered within the given ones. Entries at the same position are to be added.
    With `is_curvature`, only second derivatives with respect to two primal unknowns or two multipliers are taken;
    otherwise only mixed ones.
    """
    row, column = global_entries(grid.problem.structure, grid.steps)
    value = filled_entries(grid, unknowns, allocate_system(grid)).copy()
    wanted = ((grid.is_multiplier[row] == grid.is_multiplier[column]) == is_curvature) & (row >= 0)
    row, column, value = row[wanted], column[wanted], value[wanted]
    off_diagonal = row != column
    row, column = np.concatenate([row, column[off_diagonal]]), np.concatenate([column, row[off_diagonal]])
    value = np.concatenate([value, value[off_diagonal]])
    new_row, new_column = np.full(unknowns.size, -1), np.full(unknowns.size, -1)
    new_row[rows], new_column[columns] = np.arange(rows.size), np.arange(columns.size)
    tied = grid.problem.structure.ties(grid.steps)
    if tied.size:
        representative = np.arange(unknowns.size)
        representative[tied[:, 0]] = tied[:, 1]
        row, column = representative[row], representative[column]
    inside = (new_row[row] >= 0) & (new_column[column] >= 0)
    return new_row[row[inside]], new_column[column[inside]], value[inside]


def global_entries(s, steps):
    """Return the rows and the columns, as indices among all unknowns, of all second derivatives that the loop fills.

    The last derivatives are the matrix of the linking variables, of which the lower triangle is kept. Entries of its
    upper triangle repeat the lower one and have row and column -1, which is no unknown.
    """
    chain, size, n = steps * s.stride + s.node, s.size(steps), s.node
    root = size - s.root
    parts = [[], []]
    of_ends = (
        (0, (s.start_rows, s.start_columns), range(1)),
        (steps * s.stride, (s.end_rows, s.end_columns), range(1)),
    )
    first = (np.arange(s.bodies)[:, None] * chain + s.stride * np.arange(steps)).ravel()
    shared = np.repeat(root + s.root_indices(), steps, axis=0)
    for which, local in enumerate((s.rows, s.columns)):
        indices = first[:, None] + np.minimum(local, s.element - 1)
        linking = local >= s.element
        if linking.any():
            indices[:, linking] = shared[:, local[linking] - s.element]
        parts[which].append(indices.ravel())
    for begin, ends, _ in of_ends:
        for which, local in enumerate(ends):
            for body in range(s.bodies):
                own = body * chain + begin + np.minimum(local, n - 1)
                linking = local >= n
                if linking.any():
                    own[linking] = root + s.root_indices()[body][local[linking] - n]
                parts[which].append(own)
    if s.root:
        i, j = np.divmod(np.arange(s.root**2), s.root)
        parts[0].append(np.where(i >= j, root + i, -1))
        parts[1].append(np.where(i >= j, root + j, -1))
    return tuple(np.concatenate(part).astype(np.int64) for part in parts)
